"""Surface models: heights in map cells from laser points; filling of small holes, hillshade.

Cells are counted from the north-west corner: row 0 is in the north, column 0 in the west.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.errors import InputError

Statistic = Literal["highest", "mean", "lowest"]
"""Height of a cell from its points."""
_MOST_CELLS = 500_000_000


class Raster(eqx.Module):
    """Heights (m) of square cells, NaN if missing; `west` and `north` (m) are outer edges of cell (0, 0)."""

    heights: Float[np.ndarray, "rows columns"]
    west: float
    north: float
    cell_m: float

    @property
    def extent(self) -> Float[np.ndarray, "2 2"]:
        """Minimum and maximum X, Y (m) of the outer edges."""
        rows, columns = self.heights.shape
        east, south = self.west + columns * self.cell_m, self.north - rows * self.cell_m
        return np.array([[self.west, south], [east, self.north]])

    def centres(self, rows: slice = slice(None)) -> Float[np.ndarray, "n 3"]:
        """Return X, Y (m) of the cell centres and their heights, row by row; `rows` selects some."""
        heights = self.heights[rows]
        x = self.west + (np.arange(heights.shape[1]) + 0.5) * self.cell_m
        y = self.north - (np.arange(len(self.heights))[rows] + 0.5) * self.cell_m
        return np.stack([*map(np.ravel, np.meshgrid(x, y)), heights.ravel()], axis=1)


def surface_model(
    parts: Iterable[Float[np.ndarray, "_ 3"]],
    extent: Float[np.ndarray, "2 2"] | Sequence,
    cell_m: float,
    statistic: Statistic = "highest",
) -> Raster:
    """Return the highest, mean or lowest height of the points in every cell; NaN in cells without points.

    `parts` are X, Y, Z (m) in portions of any size, so that a cloud need not fit in memory. `extent` is the minimum and
    maximum X and Y: points outside are ignored, and empty rows and columns at its edges are removed. Edges of cells lie
    at integer multiples of `cell_m`; a point on an edge belongs to the cell east or north of it.

    Raises InputError for a cell size that is not positive, or gives too many cells, and without points.
    """
    if statistic not in get_args(Statistic):
        raise InputError(f"the statistic {statistic!r} is unknown; choose one of {', '.join(get_args(Statistic))}")
    if not (np.isfinite(cell_m) and cell_m > 0):
        raise InputError(f"a cell has a positive size, got {cell_m:g} m; 1 to 2 times the distance of points is usual")
    first, last = np.floor(np.asarray(extent) / cell_m).astype(int)
    columns, rows = (last - first + 1).tolist()
    if rows * columns > _MOST_CELLS:
        raise InputError(f"cells of {cell_m:g} m make {columns} x {rows} of them, which is too many; take larger ones")
    start = {"highest": -np.inf, "mean": 0.0, "lowest": np.inf}[statistic]
    cells = np.full(rows * columns, start)
    counts = np.zeros(rows * columns, np.int32)
    gather = {"highest": np.maximum, "mean": np.add, "lowest": np.minimum}[statistic]
    for xyz in parts:
        column, up = (np.floor(xyz[:, :2] / cell_m).astype(int) - first).T
        inside = (column >= 0) & (column < columns) & (up >= 0) & (up < rows)
        cell = ((rows - 1 - up) * columns + column)[inside]
        gather.at(cells, cell, xyz[inside, 2])
        np.add.at(counts, cell, np.int32(1))
    if statistic == "mean":
        cells /= np.maximum(counts, 1)
    cells[counts == 0] = np.nan
    there = (counts > 0).reshape(rows, columns)
    (top, bottom), (left, right) = (_span(np.any(there, axis=axis)) for axis in (1, 0))
    heights = cells.reshape(rows, columns)[top:bottom, left:right]
    return Raster(heights, float((first[0] + left) * cell_m), float((first[1] + rows - top) * cell_m), float(cell_m))


def _span(there) -> tuple[int, int]:
    """Return the range from the first to after the last nonempty place."""
    places = np.flatnonzero(there)
    if not len(places):
        raise InputError("no point lies in the extent of the surface model; take the extent of the cloud")
    return int(places[0]), int(places[-1]) + 1


def filled(raster: Raster, distance_m: float) -> Raster:
    """Fill small holes by the mean of surrounding heights, weighted by the inverse square of the distance.

    A hole is a group of cells without height connected by edges. It is filled completely, from cells at most
    `distance_m` away from each, or not at all: if one of its cells is farther from any height, and if it reaches the
    edge of the raster, which is outside the cloud.
    """
    empty = np.isnan(raster.heights)
    holes, n = scipy.ndimage.label(empty)
    if n == 0 or empty.all():
        return raster
    away = scipy.ndimage.distance_transform_edt(empty) * raster.cell_m
    small = scipy.ndimage.maximum(away, holes, np.arange(n + 1)) <= distance_m * (1 + 1e-9)
    edge = np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])
    small[edge] = False
    small[0] = False
    rows, columns = np.nonzero(small[holes])
    total, weight = np.zeros(len(rows)), np.zeros(len(rows))
    reach = int(distance_m / raster.cell_m * (1 + 1e-9))
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            square = down * down + across * across
            if not 0 < square * raster.cell_m**2 <= (distance_m * (1 + 1e-9)) ** 2:
                continue
            row, column = rows + down, columns + across
            inside = (row >= 0) & (row < empty.shape[0]) & (column >= 0) & (column < empty.shape[1])
            heights = np.full(len(rows), np.nan)
            heights[inside] = raster.heights[row[inside], column[inside]]
            there = ~np.isnan(heights)
            total[there] += heights[there] / square
            weight[there] += 1 / square
    heights = raster.heights.copy()
    heights[rows, columns] = total / weight
    return dataclasses.replace(raster, heights=heights)


def hillshade(
    raster: Raster, azimuth_deg: float = 315.0, altitude_deg: float = 45.0
) -> Float[np.ndarray, "rows columns"]:
    """Return the illumination of the surface by a sun in `azimuth_deg` (from north, clockwise) at `altitude_deg`: 0 to
    1.

        n . s,   n = (-dZ/dX, -dZ/dY, 1) normalised, s towards the sun

    Central differences; NaN where a required height is missing.
    """
    south, east = (
        np.gradient(raster.heights, raster.cell_m, axis=axis) if raster.heights.shape[axis] > 1 else 0.0
        for axis in (0, 1)
    )
    azimuth, altitude = np.deg2rad([azimuth_deg, altitude_deg])
    level = np.cos(altitude) * (south * np.cos(azimuth) - east * np.sin(azimuth)) + np.sin(altitude)
    bright = level / np.sqrt(1 + south * south + east * east) + 0 * raster.heights
    return np.clip(bright, 0, 1)
