"""Surface models: heights in map cells from laser points; filling of small holes, hillshade.

Cells are counted from the north-west corner: row 0 is in the north, column 0 in the west.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import Literal, get_args

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.cloud import Cloud
from jaxphoto.collinearity import ExteriorOrientation, in_field, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS, Corrections, apparent_point
from jaxphoto.lidar.strip_planes import (
    CellReturns,
    CellTally,
    StripSettings,
    columns_and_rows,
    corresponding,
    planes_from,
)

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


_CHUNK = 1 << 16
# Clearance (m) of a line of sight above the surface: heights in files are rounded.
_GRAZING_M = 1e-3

Frames = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


class Picture(eqx.Module):
    """Pixels of the cells of a raster, and the visibility of the cells; zero if not visible."""

    pixels: np.ndarray
    """(bands, rows, columns), of the photograph's type."""
    seen: Bool[np.ndarray, "rows columns"]


def orthophoto(
    raster: Raster,
    photograph: np.ndarray,
    sensor: Sensor,
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    *,
    object_from_map: Frames = lambda xyz: xyz,
    map_from_object: Frames = lambda xyz: xyz,
    corrections: Corrections = NO_CORRECTIONS,
) -> Picture:
    """Resample the `photograph` (bands, height, width) of one image bilinearly to the cells of `raster`.

    `object_from_map` converts coordinates (m) of the raster's system to the object frame, `map_from_object` back. A
    cell is not visible if it has no height, lies behind the camera or beyond the centres of the outermost pixels, where
    the distortion is not invertible (`InteriorOrientation.valid`), and where the surface hides it (`hidden`). The
    collinearity equations are those of `jaxphoto.project`.
    """
    rows, columns = raster.heights.shape
    bands = len(photograph)
    pixels, seen = np.zeros((bands, rows * columns), photograph.dtype), np.zeros(rows * columns, bool)
    camera = map_from_object(np.asarray(exterior.position)[None])[0]
    format_px = np.array([sensor.width_px, sensor.height_px])
    per_part = max(1, _CHUNK // columns)
    for begin in range(0, rows, per_part):
        part = slice(begin, min(begin + per_part, rows))
        place = np.flatnonzero(~np.isnan(raster.heights[part].ravel()))
        if not len(place):
            continue
        on_map = raster.centres(part)[place]
        xy, good = _imaged(interior, exterior, object_from_map(on_map), corrections)
        px = sensor.px_from_mm(xy)
        good &= ((px >= 0.5) & (px <= format_px - 0.5)).all(axis=1)
        good[good] = ~hidden(raster, on_map[good], camera)
        cells = begin * columns + place[good]
        # The centre of the first pixel is (0.5, 0.5), its index 0.
        at = px[good][:, ::-1].T - 0.5
        for band in range(bands):
            values = scipy.ndimage.map_coordinates(photograph[band], at, float, order=1, mode="nearest")
            pixels[band, cells] = np.rint(values) if pixels.dtype.kind in "iu" else values
        seen[cells] = True
    return Picture(pixels.reshape(bands, rows, columns), seen.reshape(rows, columns))


def hidden(raster: Raster, points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "n"]:
    """Return True where the surface hides `points`, cell centres, from `camera`; X, Y, Z of the raster (m).

    The line of sight is followed from cell to cell. Wherever it crosses a line of centres, its height is compared with
    that of the surface between the two nearest; a cell without height hides nothing.
    """
    row = (raster.north - points[:, 1]) / raster.cell_m - 0.5
    column = (points[:, 0] - raster.west) / raster.cell_m - 0.5
    down, across = (points[:, 1] - camera[1]) / raster.cell_m, (camera[0] - points[:, 0]) / raster.cell_m
    up, result = camera[2] - points[:, 2], np.zeros(len(points), bool)
    # Steps go from line to line of the axis along which the distance is larger.
    by_row = np.abs(down) >= np.abs(across)
    for chosen, heights, way in (
        (by_row, raster.heights, (row, down, column, across)),
        (~by_row, raster.heights.T, (column, across, row, down)),
    ):
        result[chosen] = _blocked(heights, *(v[chosen] for v in (*way, points[:, 2], up)))
    return result


def _blocked(
    heights: np.ndarray,
    line: np.ndarray,
    lines: np.ndarray,
    place: np.ndarray,
    places: np.ndarray,
    z: np.ndarray,
    up: np.ndarray,
) -> np.ndarray:
    """Apply `hidden` from a `place` in a `line` of `heights`, at `z`, of a camera `lines`, `places` and `up` away."""
    steps = np.maximum(np.abs(lines), 1e-12)
    forward, shift, rise = np.sign(lines).astype(int), places / steps, up / steps
    n, m = np.array(heights.shape) - 1
    # At most to the camera, the edges, and where the line of sight is above everything.
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = [
            np.ceil(steps) - 1,
            np.where(forward > 0, n - line, line) + 0.5,
            np.where(shift > 0, (m - place) / shift, np.where(shift < 0, place / -shift, np.inf)),
            np.where(rise > 0, (np.nanmax(heights) - z) / rise, np.inf),
        ]
    last = np.floor(np.min(limits, axis=0))
    line = np.rint(line).astype(int)
    result = np.zeros(len(line), bool)
    left = np.flatnonzero(last >= 1)
    k = 0
    while len(left):
        k += 1
        at, here = line[left] + k * forward[left], place[left] + k * shift[left]
        low = np.floor(np.maximum(here, 0)).astype(int)
        a, b = heights[at, low], heights[at, np.minimum(low + 1, m)]
        # Next to a cell without height only the other one counts.
        a, b = np.where(np.isnan(a), b, a), np.where(np.isnan(b), a, b)
        blocked = a + (here - low) * (b - a) > z[left] + k * rise[left] + _GRAZING_M
        result[left[blocked]] = True
        left = left[~blocked & (last[left] > k)]
    return result


def _imaged(
    interior: InteriorOrientation, exterior: ExteriorOrientation, points: np.ndarray, corrections: Corrections
) -> tuple[np.ndarray, np.ndarray]:
    """Return image coordinates (mm) of points, and their validity; in portions of one size, compiled once."""
    arrays = jax.tree.map(np.float64, interior)
    xy, good = np.empty((len(points), 2)), np.empty(len(points), bool)
    for begin in range(0, len(points), _CHUNK):
        part = points[begin : begin + _CHUNK]
        padded = np.concatenate([part, np.repeat(part[-1:], _CHUNK - len(part), axis=0)])
        images = call_compiled(_each_imaged, arrays, exterior, padded, corrections)
        xy[begin : begin + _CHUNK], good[begin : begin + _CHUNK] = (np.asarray(v)[: len(part)] for v in images)
    return xy, good


@eqx.filter_jit
def _each_imaged(interior, exterior, points: Float[Array, "n 3"], corrections: Corrections):
    def one(point):
        aim = apparent_point(exterior.position, point, corrections)
        return project(interior, exterior, aim), in_field(interior, exterior, aim)

    return jax.vmap(one)(points)


# Map of the height differences between strips, by cell.
#
# In a cell with planes of several strips, the gap is the height of the plane of the later strip above that of the
# earlier one at their common place; of more than two strips that of the two that differ most. Rough ground and partly
# covered cells have no plane and no gap, so slopes and trees cause none.


def strip_differences(strips: Cloud | Iterable[CellReturns], settings: StripSettings) -> Raster | None:
    """Return the gaps (m) of strips in cells of `settings.cell_m`, NaN if there is none; None without any.

    For a cloud larger than memory its accumulated cells suffice.
    """
    cells = _cells(strips, settings) if isinstance(strips, Cloud) else strips
    patches = [planes_from(returns, settings) for returns in cells]
    columns, ups = columns_and_rows(np.concatenate([p.cell for p in patches]))
    if not len(columns):
        return None
    west, south = int(columns.min()), int(ups.min())
    rows = int(ups.max()) + 1 - south
    gaps = np.full((rows, int(columns.max()) + 1 - west), np.nan)
    for one, other in combinations(range(len(patches)), 2):
        pairs = corresponding(patches[one], patches[other], settings)
        column, up = columns_and_rows(pairs.cell)
        # Along the normal, of the earlier over the later.
        height = -pairs.gap / pairs.normal[:, 2]
        row, column = rows - 1 - (up - south), column - west
        larger = ~(np.abs(gaps[row, column]) >= np.abs(height))
        gaps[row[larger], column[larger]] = height[larger]
    if np.isnan(gaps).all():
        return None
    return Raster(gaps, west * settings.cell_m, (south + rows) * settings.cell_m, settings.cell_m)


def _cells(cloud: Cloud, settings: StripSettings) -> Iterable[CellReturns]:
    tally = CellTally(settings)
    for k, name in enumerate(cloud.strips):
        tally.add(name, cloud.xyz[cloud.strip == k])
    return tally.strips.values()
