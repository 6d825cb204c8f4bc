"""Boresight of a laser scanner relative to the GNSS/IMU, and shifts of its strips.

Functions take one laser point; frames and signs as for a camera mount (docs/conventions.md).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_rotation
from jaxphoto.static_values import ordered


class Scanner(AbstractParameters):
    """Errors of a point cloud georeferenced without boresight and shifts.

    `boresight`: misalignment, a small rotation about the body's right, forward and up axes (rad). `shifts`: offset of
    the points of each lidar strip from the object frame (m), by strip name.
    """

    kind = "scanner"
    owner = "lidar"
    names = {"boresight": tuple(f"boresight_{axis}_rad" for axis in ("right", "forward", "up"))}  # noqa: RUF012

    boresight: Float[Array, "3"]
    shifts: dict[str, Float[Array, "3"]] = eqx.field(converter=ordered)

    def labels(self, owner: str) -> tuple[str, ...]:
        """Return labels: boresight, then the shift of each lidar strip."""
        shifts = (f"{self.kind}[{name}].shift_{axis}_m" for name in self.shifts for axis in "XYZ")
        return (*(f"{self.kind}.{name}" for name in self.names["boresight"]), *shifts)


def corrected_point(
    point: Float[Array, "3"],
    position: Float[Array, "3"],
    object_from_body: Float[Array, "3 3"],
    boresight: Float[Array, "3"],
    shift: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Correct a laser point (m): `position + R small_rotation(boresight) R' (point - position) - shift`.

    `position` and `object_from_body` (R): scanner pose at the time of the point, from the trajectory.
    """
    in_body = rotate(object_from_body.T, point - position)
    return position + rotate(object_from_body, rotate(small_rotation(boresight), in_body)) - shift


def raised_by_boresight(
    point: Float[Array, "3"],
    normal: Float[Array, "3"],
    position: Float[Array, "3"],
    object_from_body: Float[Array, "3 3"],
) -> Float[Array, "3"]:
    """Return the rise of a laser point along `normal` per component of an uncorrected boresight (m per rad).

    To first order; `position` and `object_from_body` are as in `corrected_point`.
    """
    none = jnp.zeros(3)
    return -jax.grad(lambda b: normal @ corrected_point(point, position, object_from_body, b, none))(none)
