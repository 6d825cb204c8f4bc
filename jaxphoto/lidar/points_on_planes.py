"""Object points on the plane of one strip's returns about each of them.

The plane of a point is that of the returns in a window of one cell about it (`corresponding_planes.planes_of`), so that
the point lies in its middle, where a plane is known best and a curved ground least off it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.lidar.cell_returns import cells_of
from jaxphoto.lidar.corresponding_planes import StripPatches, up_to_plane, variance_of_plane
from jaxphoto.lidar.strip_settings import StripSettings


class PointsOnPlanes(NamedTuple):
    """Points of which a strip has the plane, and how far they are from it."""

    patch: Int[np.ndarray, "n"]
    """Of the `StripPatches`."""
    point: Int[np.ndarray, "n"]
    """Of those looked for."""
    foot: Float[np.ndarray, "n 3"]
    """The place on the plane (m), corrected."""
    gap: Float[np.ndarray, "n"]
    """By how much the point lies above the plane, along its normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Of the plane there (m), by its roughness."""


def returns_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Returns in the window of each point, one cell wide, and the point that each of these is about."""
    half = settings.cell_m / 2
    cell = cells_of(xyz, settings)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    found: list[np.ndarray] = []
    # A window is as wide as a cell: it reaches into the cells of its four corners, and into no other.
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
    """In how many windows a return about each point lies on average; of those of `returns_about`.

    The variances of planes times this say of points that are close together what all their returns say, once.
    """
    often = np.bincount(index)[index]
    return np.bincount(point, often) / np.maximum(np.bincount(point), 1)


def on_planes(patches: StripPatches, points: Float[np.ndarray, "points 3"]) -> PointsOnPlanes:
    """The points whose plane a strip has; the cells of `patches` are the numbers of the points."""
    patch, place = np.arange(len(patches.cell)), points[patches.cell]
    up = up_to_plane(patches, patch, place, patches.normal)
    sigma = np.sqrt(variance_of_plane(patches, patch, place))
    return PointsOnPlanes(patch, patches.cell, place + up[:, None] * patches.normal, -up, sigma)
