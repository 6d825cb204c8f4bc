"""The mounting of a camera beside a GNSS/IMU: lever arm, boresight, shift and drift of the positions.

Functions of one image. Frames and signs: docs/conventions.md; source: paper 000, equations (1)-(4), paper 003.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.rotation import rotate, small_angles, small_rotation

# Nominal mount: camera x forward, y left, z up, in body axes right, forward, up (docs/models.md).
_BODY_FROM_CAMERA = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Mount(eqx.Module):
    """Lever arm from the projection centre to the GNSS/IMU reference (m: right, forward, up) and boresight (rad)."""

    lever_arm: Float[Array, "3"]
    boresight: Float[Array, "3"]


class StripBias(eqx.Module):
    """Shift (m) and drift (m/s), per axis, of the GNSS positions of one strip."""

    shift: Float[Array, "3"]
    drift: Float[Array, "3"]


def body_from_camera(boresight: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Nominal mount times the misalignment (small rotation in the camera frame, rad)."""
    return _BODY_FROM_CAMERA @ small_rotation(boresight)


def object_from_body(camera_from_object: Float[Array, "3 3"], boresight: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Attitude of the body from the orientation of the camera and the boresight misalignment."""
    return camera_from_object.T @ body_from_camera(boresight).T


def sensor_position(
    position: Float[Array, "3"],
    camera_from_object: Float[Array, "3 3"],
    mount: Mount,
    bias: StripBias,
    time: Float[Array, ""],
) -> Float[Array, "3"]:
    """What GNSS observes: X + R l + shift + drift (t - t0), in m (paper 000, equation (1)).

    `time` is in seconds from the strip's reference time.
    """
    arm = rotate(object_from_body(camera_from_object, mount.boresight), mount.lever_arm)
    return position + arm + bias.shift + bias.drift * time


def attitude_residual(
    observed_object_from_body: Float[Array, "3 3"],
    camera_from_object: Float[Array, "3 3"],
    boresight: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Observed minus computed attitude as a small rotation about (forward, right, down), in rad.

    These are the axes of roll, pitch and yaw, so near level flight each component is one angle's residual.
    """
    computed = object_from_body(camera_from_object, boresight)
    right, forward, up = -small_angles(computed.T @ observed_object_from_body)
    return jnp.stack([forward, right, -up])
