"""Object points on planes fitted to one strip's surrounding returns.

The plane of a point is that of the returns in a window of one cell about it (`corresponding_planes.planes_of`), so the
point is at its centre, where a plane is best determined and curvature has the least effect.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.lidar.cell_returns import cells_of
from jaxphoto.lidar.corresponding_planes import StripPatches, up_to_plane, variance_of_plane
from jaxphoto.lidar.strip_settings import StripSettings


class PointsOnPlanes(NamedTuple):
    """Points with a plane of a strip, and their distances from it."""

    patch: Int[np.ndarray, "n"]
    """Index of `StripPatches`."""
    point: Int[np.ndarray, "n"]
    """Index of the given points."""
    foot: Float[np.ndarray, "n 3"]
    """Point on the plane (m), corrected."""
    gap: Float[np.ndarray, "n"]
    """Height of the point above the plane, along its normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Of the plane there (m), from its roughness."""


def returns_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return the returns in the window of each point, one cell wide, and the point of each."""
    half = settings.cell_m / 2
    cell = cells_of(xyz, settings)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    found: list[np.ndarray] = []
    # A window is as wide as a cell: it overlaps the cells of its four corners, and no others.
    for corner in ((-half, -half, 0.0), (-half, half, 0.0), (half, -half, 0.0), (half, half, 0.0)):
        at = cells_of(points + np.array(corner), settings)
        first, last = np.searchsorted(ordered, at, "left"), np.searchsorted(ordered, at, "right")
        count = last - first
        point = np.repeat(np.arange(len(points)), count)
        index = order[np.arange(len(point)) + np.repeat(first - (np.cumsum(count) - count), count)]
        inside = (np.abs(xyz[index, :2] - points[point, :2]) < half).all(axis=1)
        found.append(np.stack([index[inside], point[inside]]))
    index, point = np.concatenate(found, axis=1)
    return index, point


def windows_of_returns(index: Int[np.ndarray, "n"], point: Int[np.ndarray, "n"]) -> Float[np.ndarray, "points"]:
    """Return the mean number of windows, from `returns_about`, that a return about each point belongs to.

    Variances of planes times this number count the returns of close points once.
    """
    often = np.bincount(index)[index]
    return np.bincount(point, often) / np.maximum(np.bincount(point), 1)


def on_planes(patches: StripPatches, points: Float[np.ndarray, "points 3"]) -> PointsOnPlanes:
    """Match points with planes of a strip; the cells of `patches` are the indices of the points."""
    patch, place = np.arange(len(patches.cell)), points[patches.cell]
    up = up_to_plane(patches, patch, place, patches.normal)
    sigma = np.sqrt(variance_of_plane(patches, patch, place))
    return PointsOnPlanes(patch, patches.cell, place + up[:, None] * patches.normal, -up, sigma)
