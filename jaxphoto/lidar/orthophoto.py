"""Orthophoto of one image: every visible cell of a surface model, resampled from the photograph."""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation, in_field, project
from jaxphoto.compiling import call_compiled
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS, Corrections, apparent_point
from jaxphoto.lidar.raster import Raster

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
    up, found = camera[2] - points[:, 2], np.zeros(len(points), bool)
    # Steps go from line to line of the axis along which the distance is larger.
    by_row = np.abs(down) >= np.abs(across)
    for chosen, heights, way in (
        (by_row, raster.heights, (row, down, column, across)),
        (~by_row, raster.heights.T, (column, across, row, down)),
    ):
        found[chosen] = _blocked(heights, *(v[chosen] for v in (*way, points[:, 2], up)))
    return found


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
    found = np.zeros(len(line), bool)
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
        found[left[blocked]] = True
        left = left[~blocked & (last[left] > k)]
    return found


def _imaged(
    interior: InteriorOrientation, exterior: ExteriorOrientation, points: np.ndarray, corrections: Corrections
) -> tuple[np.ndarray, np.ndarray]:
    """Return image coordinates (mm) of points, and their validity; in portions of one size, compiled once."""
    arrays = jax.tree.map(np.float64, interior)
    xy, good = np.empty((len(points), 2)), np.empty(len(points), bool)
    for begin in range(0, len(points), _CHUNK):
        part = points[begin : begin + _CHUNK]
        padded = np.concatenate([part, np.repeat(part[-1:], _CHUNK - len(part), axis=0)])
        found = call_compiled(_each_imaged, arrays, exterior, padded, corrections)
        xy[begin : begin + _CHUNK], good[begin : begin + _CHUNK] = (np.asarray(v)[: len(part)] for v in found)
    return xy, good


@eqx.filter_jit
def _each_imaged(interior, exterior, points: Float[Array, "n 3"], corrections: Corrections):
    def one(point):
        aim = apparent_point(exterior.position, point, corrections)
        return project(interior, exterior, aim), in_field(interior, exterior, aim)

    return jax.vmap(one)(points)
