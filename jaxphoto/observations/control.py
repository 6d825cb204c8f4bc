"""Control: surveyed coordinates of object points."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.observations.base import AXES, AbstractCoordinates, index_of


class ControlCoordinates(AbstractCoordinates):
    """Surveyed coordinates of point `who`: `axis` (0, 1, 2), `value` and `sigma` (m).

    Vertical control consists of rows with axis 2. Check coordinates and fixed coordinates use the same class.
    """

    group = "control_points"
    unit = "m"
    columns = {"who": "point"}  # noqa: RUF012

    who: Int[np.ndarray, "n"] = index_of("point")
    axis: Int[np.ndarray, "n"]
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, point: Float[Array, "3"]) -> Float[ArrayLike, ""]:
        """Return surveyed minus computed (m)."""
        return self.value - point[self.axis]

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "control point T11 in Z"."""
        rows = zip(self.who, self.axis, strict=True)
        return np.array([f"control point {points[p]} in {AXES[a]}" for p, a in rows], object)
