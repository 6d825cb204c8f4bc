"""A calibration board, and its targets as measured in photographs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# Of its largest extent: what the points of a board may be off a plane and still count as flat. Surveyed targets on a
# wall are never exact; beyond a hundredth, views are no homographies and circles face elsewhere.
_FLAT = 1e-2


class Board(NamedTuple):
    """Targets with known coordinates, in a frame of their own: for a flat board Z points to who looks at it."""

    name: str
    points: tuple[str, ...]
    """Ids of the targets."""
    xyz_m: Float[np.ndarray, "points 3"]
    diameter_m: Float[np.ndarray, "points"]
    """Of circles; 0 for the corners of squares."""

    @property
    def plane(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]] | None:
        """The middle of a flat board and axes (columns; right-handed, the third is the normal), or None.

        The normal is either of the two; of a board that does not stand upright that with Z > 0.
        """
        middle = self.xyz_m.mean(axis=0)
        _, size, axes = np.linalg.svd(self.xyz_m - middle, full_matrices=False)
        if size[2] > _FLAT * size[0]:
            return None
        axes = axes.T * np.where(np.diag(axes.T) < 0, -1.0, 1.0)
        axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
        return middle, axes


class Detection(NamedTuple):
    """The targets of a board that were found in one photograph."""

    image: str
    point: Int[np.ndarray, "n"]
    """Index into the board's points."""
    column_row: Float[np.ndarray, "n 2"]
    """In pixels; the centre of the upper-left pixel is (0.5, 0.5) (docs/conventions.md)."""
    sigma_px: Float[np.ndarray, "n 2"]
    """Standard deviations of column and row."""

    def take(self, chosen: np.ndarray) -> "Detection":
        """The targets that `chosen` (an index or a mask) names."""
        return Detection(self.image, self.point[chosen], self.column_row[chosen], self.sigma_px[chosen])
