"""Rolling shutter: rows of a photograph are exposed one after another while the camera moves and turns.

The exterior orientation is that of the middle row. A row with the image coordinate y (mm, up, from the centre of the
format of height h) is exposed

    t = -readout y / h = readout (row / rows - 1/2)

after it: the time from the first row of the file to the last is `readout`, negative where the last comes first. Then
the camera is at C + R' v t and its rotation is small_rotation(w t) R, so that a point that lies at p in the camera of
the middle row lies, for that row, at

    p(t) = small_rotation(w t) (p - v t)

with the velocity v (m/s) and the rate of turn w (rad/s) in the axes of the camera. y is the measured coordinate:
nothing is iterated. v and w are those of the camera over the ground, so where points move, too, nothing is known.
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
    """How the camera moves from row to row: what parameters add to the interior orientation of an image."""

    time_per_mm: Scalar = 0.0
    """Readout over the height of the format (s/mm)."""
    velocity_x: Scalar = 0.0
    velocity_y: Scalar = 0.0
    velocity_z: Scalar = 0.0
    rate_x: Scalar = 0.0
    rate_y: Scalar = 0.0
    rate_z: Scalar = 0.0

    def at_row(self, y: Array, in_camera: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """A point in the frame of the camera of the middle row, in that of the row with the measured `y` (mm)."""
        t = -self.time_per_mm * y
        velocity = jnp.stack([jnp.asarray(v) for v in (self.velocity_x, self.velocity_y, self.velocity_z)])
        rate = jnp.stack([jnp.asarray(w) for w in (self.rate_x, self.rate_y, self.rate_z)])
        u, v, w = rotate(small_rotation(rate * t), jnp.stack([*in_camera]) - velocity * t)
        return u, v, w


class RollingShutter(AbstractParameters):
    """Time (ms) from the first row of a photograph to the last, of one camera; negative where the last comes first."""

    kind = "shutters"
    owner = "camera"
    names = {"readout": ("readout_ms",)}  # noqa: RUF012
    bends = ("time_per_mm",)

    readout: Scalar

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation, which now knows when its rows are exposed."""
        rows = interior.rows or RowMotion()
        rows = dataclasses.replace(rows, time_per_mm=1e-3 * self.readout / exposure.height)
        return dataclasses.replace(interior, rows=rows)


class ImageMotion(AbstractParameters):
    """Velocity (m/s) and rate of turn (rad/s) of one image in the axes of its camera: x right, y up, z out of its back.

    The rate is that of the camera: a positive one about z turns it counter-clockwise as seen from behind.
    """

    kind = "motions"
    owner = "image"
    names = {  # noqa: RUF012
        "velocity": tuple(f"velocity_{axis}_m_per_s" for axis in "xyz"),
        "rate": tuple(f"rate_{axis}_rad_per_s" for axis in "xyz"),
    }
    bends = ("velocity_x", "velocity_y", "velocity_z", "rate_x", "rate_y", "rate_z")

    velocity: Float[Array, "3 *images"]
    rate: Float[Array, "3 *images"]

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation, which now knows how its rows move."""
        rows = interior.rows or RowMotion()
        moving = dict(zip(self.bends, [*self.velocity, *self.rate], strict=True))
        return dataclasses.replace(interior, rows=dataclasses.replace(rows, **moving))
