"""The mounting of a camera beside a GNSS/IMU: lever arm, boresight, time offset; shift and drift of the positions.

Functions of one image. Frames and signs: docs/conventions.md; source: paper 000, equations (1)-(4), paper 003.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.rotation import rotate, small_angles, small_rotation

ImageX = Literal["forward", "left", "back", "right"]
"""Where the camera's x axis points in the aircraft."""
# Columns: the camera's x, y and z axis in body axes right, forward, up; z is always up (docs/models.md).
NOMINAL: dict[str, np.ndarray] = {
    "forward": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "left": np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    "back": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "right": np.eye(3),
}
IMAGE_X = tuple(NOMINAL)


class Mount(eqx.Module):
    """How a camera sits beside the GNSS/IMU, and how its clock runs.

    `lever_arm` from the projection centre to the GNSS/IMU reference (m: right, forward, up), `boresight` as a small
    rotation in the camera frame (rad), `time_offset` of the true exposure after the recorded one (s). `image_x` is the
    nominal mount: where the camera's x axis points.
    """

    lever_arm: Float[Array, "3"]
    boresight: Float[Array, "3"]
    time_offset: Float[Array, ""] | float = 0.0
    image_x: ImageX = eqx.field(static=True, default="forward")

    def __check_init__(self) -> None:
        if self.image_x not in NOMINAL:
            raise ValueError(f"image_x is one of {', '.join(IMAGE_X)}, got {self.image_x!r}")

    @property
    def nominal(self) -> Float[np.ndarray, "3 3"]:
        """`body_from_camera` without misalignment."""
        return NOMINAL[self.image_x]


class StripBias(eqx.Module):
    """Shift (m) and drift (m/s), per axis, of the GNSS positions of one strip."""

    shift: Float[Array, "3"]
    drift: Float[Array, "3"]


class Exposure(eqx.Module):
    """What is known of an exposure besides its observations; of many with a leading axis.

    `time` from the strip's reference time (s), `velocity` of the GNSS/IMU in the object frame (m/s), `rate` of turn
    about the body's right, forward and up axes (rad/s), `nominal` mount of the camera (`Mount.nominal`). Velocity and
    rate are what a time offset acts on.
    """

    time: Float[Array, "*images"]
    velocity: Float[Array, "*images 3"]
    rate: Float[Array, "*images 3"]
    nominal: Float[Array, "*images 3 3"]


def body_from_camera(boresight: Float[Array, "3"], nominal: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Nominal mount times the misalignment (small rotation in the camera frame, rad)."""
    return nominal @ small_rotation(boresight)


def object_from_body(
    camera_from_object: Float[Array, "3 3"], boresight: Float[Array, "3"], nominal: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """Attitude of the body from the orientation of the camera and the boresight misalignment."""
    return camera_from_object.T @ body_from_camera(boresight, nominal).T


def sensor_position(
    position: Float[Array, "3"],
    camera_from_object: Float[Array, "3 3"],
    mount: Mount,
    bias: StripBias,
    exposure: Exposure,
) -> Float[Array, "3"]:
    """What GNSS observes at the recorded time, in m: X + R l + shift + drift (t - t0) - v tau.

    tau is the mount's time offset. Source: paper 000, equation (1).
    """
    arm = rotate(object_from_body(camera_from_object, mount.boresight, exposure.nominal), mount.lever_arm)
    return position + arm + bias.shift + bias.drift * exposure.time - exposure.velocity * mount.time_offset


def recorded_attitude(camera_from_object: Float[Array, "3 3"], mount: Mount, exposure: Exposure) -> Float[Array, "3 3"]:
    """`object_from_body` at the recorded time: an offset tau before the exposure, with `rate * tau` still to turn."""
    body = object_from_body(camera_from_object, mount.boresight, exposure.nominal)
    return body @ small_rotation(exposure.rate * mount.time_offset)


def attitude_residual(
    observed_object_from_body: Float[Array, "3 3"], computed_object_from_body: Float[Array, "3 3"]
) -> Float[Array, "3"]:
    """Observed minus computed attitude as a small rotation about (forward, right, down), in rad.

    These are the axes of roll, pitch and yaw, so near level flight each component is one angle's residual.
    """
    right, forward, up = -small_angles(computed_object_from_body.T @ observed_object_from_body)
    return jnp.stack([forward, right, -up])
