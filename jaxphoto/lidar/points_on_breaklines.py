"""Object points on breaklines: two smooth faces of a strip that intersect, such as those of a roof in its ridge.

The returns in a window of two cells about a point are divided by a straight line, of any direction, that minimises the
residuals of two planes; then by the intersection of these planes, until it does not change. Each face is a plane on
which the point lies: both together leave it free only along the line. Source: Habib, Ghanma, Morgan and Al-Ruzouq
(2005), Photogrammetric and lidar data registration using linear features, where roofs give the lines of the lidar as
well.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.lidar.points_on_planes import returns_about
from jaxphoto.lidar.strip_settings import StripSettings

# Number of directions of the line that are tried, and of iterations.
_DIRECTIONS = np.pi * np.arange(12) / 12
_TURNS = 10
# Planes whose slopes differ by less (a tangent) form no breakline.
_BREAK = 0.15
# As fractions of the cell: returns this close to the line may be of either face; a line farther from the point is
# another one.
_NEAR, _FAR = 0.1, 0.5
# Returns beyond this number of robust standard deviations from their face belong to another object, such as a chimney.
_OTHER = 4.0


def faces_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return the returns of the two faces about each point, and their faces: 2 k and 2 k + 1 are those of point k.

    A point without two such faces has none.
    """
    index, point = returns_about(xyz, points, dataclasses.replace(settings, cell_m=2 * settings.cell_m))
    found = [np.zeros((2, 0), int)]
    for k in np.flatnonzero(np.bincount(point, minlength=len(points)) >= 2 * settings.returns):
        own = index[point == k]
        side = _sides(xyz[own] - points[k], settings)
        found.append(np.stack([own, 2 * k + side])[:, side >= 0])
    index, face = np.concatenate(found, axis=1)
    return index, face


def _sides(off: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """Return 0 and 1 for the returns of either face about the origin; -1 for neither."""
    none = np.full(len(off), -1)
    tried = [off[:, :2] @ np.array([np.cos(a), np.sin(a)]) > 0 for a in _DIRECTIONS]
    tried = [first for first in tried if _enough(first, settings)]
    if not tried:
        return none
    first = min(tried, key=lambda one: float(np.sum(np.square(_fitted(off, one)[1]))))
    for _ in range(_TURNS):
        planes, residual = _fitted(off, first)
        constant, slope = planes[0, 0] - planes[1, 0], planes[0, 1:] - planes[1, 1:]
        size = float(np.linalg.norm(slope))
        if size < _BREAK or abs(constant) / size > _FAR * settings.cell_m:
            return none
        beyond = (constant + off[:, :2] @ slope) / size
        parted = beyond > 0
        # A ridge is the lower of its planes on either side, a valley the higher.
        parted = parted if np.mean(parted == first) > 0.5 else ~parted
        if not _enough(parted, settings):
            return none
        if np.array_equal(parted, first):
            break
        first = parted
    spread = 1.4826 * float(np.median(np.abs(residual)))
    own = (np.abs(beyond) > _NEAR * settings.cell_m) & (np.abs(residual) <= _OTHER * spread)
    return np.where(own, np.where(first, 0, 1), -1)


def _enough(first: np.ndarray, settings: StripSettings) -> bool:
    return settings.returns <= int(first.sum()) <= len(first) - settings.returns


def _fitted(off: Float[np.ndarray, "n 3"], first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return height at the origin and slopes of the planes of both sides, and the residual of each return."""
    rows, residual, planes = np.column_stack([np.ones(len(off)), off[:, :2]]), np.empty(len(off)), []
    for side in (first, ~first):
        planes.append(np.linalg.lstsq(rows[side], off[side, 2])[0])
        residual[side] = off[side, 2] - rows[side] @ planes[-1]
    return np.stack(planes), residual
