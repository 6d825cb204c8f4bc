"""Rolling shutter: rows of a photograph are exposed sequentially while the camera moves and rotates.

The exterior orientation refers to the middle row. A row with the image coordinate y (mm, up, from the centre of the
format of height h) is exposed

    t = -readout y / h = readout (row / rows - 1/2)

after the middle row. `readout` is the time from the first row of the file to the last, negative if the last row is
exposed first. The camera then has the position C + R' v t and the rotation small_rotation(w t) R. A point p in the
camera frame of the middle row has, in the camera frame of that row, the coordinates

    p(t) = small_rotation(w t) (p - v t)

with the velocity v (m/s) and the rotation rate w (rad/s) in the camera axes. y is the measured coordinate, so no
iteration is needed. v and w are relative to the ground: object points are assumed static.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_rotation

Scalar = Float[Array, "*images"] | float


class RowMotion(eqx.Module):
    """Motion of the camera between rows, added to the interior orientation of an image."""

    time_per_mm: Scalar = 0.0
    """Readout over the height of the format (s/mm)."""
    velocity_x: Scalar = 0.0
    velocity_y: Scalar = 0.0
    velocity_z: Scalar = 0.0
    rate_x: Scalar = 0.0
    rate_y: Scalar = 0.0
    rate_z: Scalar = 0.0

    def at_row(self, y: Array, in_camera: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Transform a point from the camera frame of the middle row to the frame of the row at measured `y` (mm)."""
        t = -self.time_per_mm * y
        velocity = jnp.stack([jnp.asarray(v) for v in (self.velocity_x, self.velocity_y, self.velocity_z)])
        rate = jnp.stack([jnp.asarray(w) for w in (self.rate_x, self.rate_y, self.rate_z)])
        u, v, w = rotate(small_rotation(rate * t), jnp.stack([*in_camera]) - velocity * t)
        return u, v, w


class RollingShutter(AbstractParameters):
    """Readout time (ms) of one camera from first to last row of a photograph; negative if in reverse order."""

    kind = "shutters"
    owner = "camera"
    names = {"readout": ("readout_ms",)}  # noqa: RUF012
    modifies_interior = ("time_per_mm",)

    readout: Scalar

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation with the exposure times of its rows."""
        rows = interior.rows or RowMotion()
        rows = dataclasses.replace(rows, time_per_mm=1e-3 * self.readout / exposure.height)
        return dataclasses.replace(interior, rows=rows)


class ImageMotion(AbstractParameters):
    """Velocity (m/s) and rotation rate (rad/s) of one image in its camera axes: x right, y up, z out of its back.

    A positive rate about z rotates the camera counter-clockwise as seen from behind.
    """

    kind = "motions"
    owner = "image"
    names = {  # noqa: RUF012
        "velocity": tuple(f"velocity_{axis}_m_per_s" for axis in "xyz"),
        "rate": tuple(f"rate_{axis}_rad_per_s" for axis in "xyz"),
    }
    modifies_interior = ("velocity_x", "velocity_y", "velocity_z", "rate_x", "rate_y", "rate_z")

    velocity: Float[Array, "3 *images"]
    rate: Float[Array, "3 *images"]

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation with the motion of its rows."""
        rows = interior.rows or RowMotion()
        moving = dict(zip(self.modifies_interior, [*self.velocity, *self.rate], strict=True))
        return dataclasses.replace(interior, rows=dataclasses.replace(rows, **moving))
