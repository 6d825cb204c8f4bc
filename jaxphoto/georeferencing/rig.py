"""Rig: rigidly connected cameras with common exposures, such as a nadir camera with oblique heads.

One camera is the reference. Every other camera has a position l (m), its projection centre in the frame of the
reference camera, and a rotation t (rad), the rotation vector of its orientation relative to the reference:

    X = X_ref + R_ref' l,    R = small_rotation(t) R_ref        (R takes the object frame to the camera)

`small_rotation` is exact for angles below 360 degrees, so the direction of a camera is arbitrary. The deviation of a
photograph is

    p = R_ref (X - X_ref) - l (m, in the axes of the reference),    r: small_rotation(r) = R R_ref' small_rotation(t)'

which is zero for a rigid rig. A camera that exposes with a delay tau after the reference refers to the pose of the
reference at that time. It follows from the velocity v of the GNSS/IMU, its lever arm a and rotation rate w (both in
body axes), and the rotation M from camera to body:

    X_ref(tau) = X_ref + (v - R_ref' M' (w x a)) tau,    R_ref(tau) = small_rotation(M' w tau) R_ref

Frames and signs: docs/conventions.md; use of rigs: docs/rigs.md.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing.mount import Exposure, Mount, body_from_camera, nominal_mount
from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_angles, small_rotation


class RigCamera(AbstractParameters):
    """Position and orientation of a camera relative to the reference camera of its rig, which has no `RigCamera`.

    `place`: projection centre in the axes of the reference camera (m: x right, y up, z backwards). `turn`:
    rotation vector (rad) about these axes, `camera_from_reference = small_rotation(turn)`. `delay`: exposure time minus
    exposure time of the reference camera (s).
    """

    kind = "rig_cameras"
    owner = "camera"
    names = {  # noqa: RUF012
        "place": tuple(f"place_{axis}_m" for axis in "xyz"),
        "turn": tuple(f"turn_{axis}_rad" for axis in "xyz"),
        "delay": ("delay_s",),
    }

    place: Float[Array, "3 *images"]
    turn: Float[Array, "3 *images"]
    delay: Float[Array, "*images"] | float = 0.0


def reference_later(
    delay: Float[Array, ""] | float,
    position: Float[Array, "3"],
    camera_from_object: Float[Array, "3 3"],
    mount: Mount,
    exposure: Exposure,
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return position (m) and orientation of the reference camera `delay` seconds after its exposure."""
    body = body_from_camera(mount.boresight, nominal_mount(mount, exposure))
    # Velocity of the camera from the velocity of the GNSS/IMU and the lever arm.
    velocity = exposure.velocity - rotate(camera_from_object.T @ body.T, jnp.cross(exposure.rate, mount.lever_arm))
    turn = small_rotation(rotate(body.T, exposure.rate) * delay)
    return position + velocity * delay, turn @ camera_from_object


def rig_place(
    reference: Float[Array, "3"], camera_from_object: Float[Array, "3 3"], position: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Compute a projection centre in the frame of the reference camera (m).

    The first two arguments refer to the reference camera.
    """
    return rotate(camera_from_object, position - reference)


def rig_turn(reference: Float[Array, "3 3"], camera_from_object: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector (rad) of a camera relative to the reference; both are `camera_from_object`."""
    return small_angles(camera_from_object @ reference.T)


def in_rig(
    position: Float[Array, "3"], camera_from_object: Float[Array, "3 3"], camera: RigCamera
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Compute position and orientation of a camera of a rig from its reference camera."""
    there = position + rotate(camera_from_object.T, camera.place)
    return there, small_rotation(camera.turn) @ camera_from_object


def turn_off(
    reference: Float[Array, "3 3"], camera_from_object: Float[Array, "3 3"], turn: Float[Array, "3"]
) -> Float[ArrayLike, "3"]:
    """Return the deviation of a camera from its orientation in the rig (rotation vector in rad, about its own axes)."""
    return small_angles(camera_from_object @ reference.T @ small_rotation(turn).T)
