"""A rig: cameras that are exposed together and sit still beside one another, such as a nadir camera with oblique heads.

One of them is the reference. Of every other the rig has the place of its projection centre in the frame of the
reference camera, l (m), and a turn t (rad), the rotation vector of its orientation beside that of the reference:

    X = X_ref + R_ref' l,    R = small_rotation(t) R_ref        (R takes the object frame to the camera)

`small_rotation` is exact for any angle below a whole turn, so heads may look anywhere. What a photograph is off by is

    p = R_ref (X - X_ref) - l (m, in the axes of the reference),    r: small_rotation(r) = R R_ref' small_rotation(t)'

which is nothing where the rig is rigid. A camera that exposes a delay tau after the reference does so beside the
reference as it is by then, by the velocity v of the GNSS/IMU, its lever arm a and the rate of turn w (both in the axes
of the body), and M, which takes the camera to the body:

    X_ref(tau) = X_ref + (v - R_ref' M' (w x a)) tau,    R_ref(tau) = small_rotation(M' w tau) R_ref

Frames and signs: docs/conventions.md; what is known of rigs: docs/rigs.md.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.arrays import Numbers
from jaxphoto.georeferencing.mount import Exposure, Mount, body_from_camera, nominal_mount
from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_angles, small_rotation


class RigCamera(AbstractParameters):
    """Where a camera sits beside the reference camera of its rig, and how it is turned; that has none of its own.

    `place` of its projection centre in the axes of the reference camera (m: x right, y up, z out of its back), `turn`
    about these axes (rad), the rotation vector of `camera_from_reference = small_rotation(turn)`, `delay` of its
    exposures after those of the reference camera (s).
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
    """Position (m) and orientation of the reference camera `delay` seconds after its exposure."""
    body = body_from_camera(mount.boresight, nominal_mount(mount, exposure))
    # Of the GNSS/IMU, which a lever arm carries about the camera.
    velocity = exposure.velocity - rotate(camera_from_object.T @ body.T, jnp.cross(exposure.rate, mount.lever_arm))
    turn = small_rotation(rotate(body.T, exposure.rate) * delay)
    return position + velocity * delay, turn @ camera_from_object


def rig_place(
    reference: Float[Array, "3"], camera_from_object: Float[Array, "3 3"], position: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Where a projection centre is in the frame of the reference camera (m); the first two are of the reference."""
    return rotate(camera_from_object, position - reference)


def rig_turn(reference: Float[Array, "3 3"], camera_from_object: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The rotation vector (rad) of a camera beside the reference; both are `camera_from_object`."""
    return small_angles(camera_from_object @ reference.T)


def in_rig(
    position: Float[Array, "3"], camera_from_object: Float[Array, "3 3"], camera: RigCamera
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Position and orientation of a camera of a rig whose reference is there."""
    there = position + rotate(camera_from_object.T, camera.place)
    return there, small_rotation(camera.turn) @ camera_from_object


def turn_off(
    reference: Float[Array, "3 3"], camera_from_object: Float[Array, "3 3"], turn: Float[Array, "3"]
) -> Float[Numbers, "3"]:
    """By how much a camera is turned beside its place in the rig (rad, about its own axes)."""
    return small_angles(camera_from_object @ reference.T @ small_rotation(turn).T)
