"""Heights at X, Y from a cloud, with standard deviations; refused where the cloud does not determine them.

Four interpolations of the heights of points around a place, H = sum w_i Z_i:

- `idw`: w ~ distance^-power over the nearest points (only the point at the place, if there is one), - `plane`: least
squares through the nearest points, - `tin`: linear in the triangle of the Delaunay triangulation of the whole cloud
(`tin`), - `local`: moving least squares, a quadratic with Gaussian weights; a plane if the points do not determine a
quadratic.

Error model: `height_error`; files and figures: docs/lidar_heights.md.
"""

from typing import Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from jaxphoto.arrays import ArrayLike
from jaxphoto.cloud import Cloud
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.lidar.grid import Grid, index_cloud, nearest
from jaxphoto.lidar.height_estimate import (
    APART,
    TIMES,
    WIDE,
    HeightEstimate,
    HeightFlag,
    HeightNumbers,
    HeightSettings,
    LidarNoise,
    Neighbours,
    estimate_heights,
    lie_on_two_planes,
)

Method = Literal["idw", "plane", "tin", "local"]
# Places of a call are padded to one of these: few programs.
_PLACES = (64, 512, 4096)
# Points among which the triangle over a place is searched: multiplied repeatedly, up to a limit.
_MORE, _MOST = 4, 384
# Maximum number of points that determine the surface, if a cloud is much denser than its horizontal errors.
_MOST_WIDE = 4 * WIDE


class Heights(eqx.Module):
    """Heights of places (m) and their properties; NaN where refused or undetermined."""

    z: Float[ArrayLike, "places"]
    sigma: Float[ArrayLike, "places"]
    flag: Integer[ArrayLike, "places"]
    """Sums of `HeightFlag`."""
    count: Int[ArrayLike, "places"]
    """Number of points used."""
    density: Float[ArrayLike, "places"]
    """Points per m^2 around the place."""
    roughness: Float[ArrayLike, "places"]
    """Standard deviation (m) of the points about the local surface."""
    gradient: Float[ArrayLike, "places 2"]
    """Gradient of the local surface by X and Y."""

    def __len__(self) -> int:
        return len(self.z)

    @property
    def slope(self) -> Float[ArrayLike, "places"]:
        """Rise over run: 1 is 45 degrees."""
        return np.hypot(*np.asarray(self.gradient).T)

    def flagged(self, flag: HeightFlag) -> Bool[np.ndarray, "places"]:
        """Return True for places with any flag of `flag`."""
        return (np.asarray(self.flag) & int(flag)) != 0


def heights_at(
    cloud: Cloud | Grid,
    xy: Float[np.ndarray, "places 2"],
    method: Method = "idw",
    settings: HeightSettings | None = None,
) -> Heights:
    """Return heights of the cloud at places X, Y (m), by one of four methods, with standard deviations and flags.

    A `Grid` saves indexing the cloud again. Places with a flag of `settings.refuse` are NaN; `Heights.flag` gives the
    reason. The standard deviation is such that 95 % of the errors are within 1.96 sigma.

    Raises InputError for an unknown method, places that are not pairs of numbers, and an empty cloud.
    """
    settings = HeightSettings() if settings is None else settings
    if method not in get_args(Method):
        raise InputError(f"the method is {method!r}: choose one of {', '.join(get_args(Method))}")
    xy = np.asarray(xy, float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise InputError("places are rows of X_m and Y_m: give an array of two columns without NaN")
    grid = cloud if isinstance(cloud, Grid) else index_cloud(cloud)
    wide = max(WIDE, TIMES * settings.points, _points_of_noise(grid, settings.sigma_xy_m))
    if settings.radius_m is not None:
        wide = _points_of_radius(grid, xy, settings.radius_m, wide)
    estimate = _estimates(grid, xy, method, settings, wide)
    return _judged(estimate, _broken(grid, xy, estimate, wide), settings)


def _points_of_noise(grid: Grid, sigma_xy_m: float) -> int:
    """Return the mean number of points closer to a place than horizontal errors matter; a multiple of `WIDE`."""
    covered = np.count_nonzero(np.diff(grid.start)) * float(grid.cell_m) ** 2
    many = np.pi * (APART * sigma_xy_m) ** 2 * len(grid) / covered
    return min(WIDE * int(np.ceil(many / WIDE)), _MOST_WIDE)


def _points_of_radius(grid: Grid, xy: np.ndarray, radius_m: float, wide: int) -> int:
    """Return the number of nearest points that hold `TIMES` those of the radius, at every place."""
    while wide < len(grid):
        within = (nearest(grid, xy, wide).distance <= radius_m).sum(axis=1).max(initial=0)
        if TIMES * within <= wide:
            break
        wide *= 2
    return wide


def _estimates(grid: Grid, xy: np.ndarray, method: Method, settings: HeightSettings, k: int) -> HeightEstimate:
    """Estimate all places, and with more points again those whose triangle might change."""
    estimate = _with_points(grid, xy, method, settings, k)
    refused = estimate.hole * HeightFlag.HOLE | ~estimate.surrounded * HeightFlag.EDGE
    left = np.flatnonzero(~estimate.final & (refused & settings.refuse == 0))
    while len(left) and k < min(_MOST, len(grid)):
        k *= _MORE
        again = _with_points(grid, xy[left], method, settings, k)
        for old, new in zip(estimate, again, strict=True):
            old[left] = new
        left = left[~again.final]
    if k < len(grid):
        np.asarray(estimate.height)[left] = np.nan
    return estimate


def _with_points(grid: Grid, xy: np.ndarray, method: Method, settings: HeightSettings, k: int) -> HeightEstimate:
    """Estimate places from their `k` nearest points, in portions of few sizes."""
    most = max(1, _PLACES[-1] * WIDE // k)
    noise = LidarNoise(np.array(settings.sigma_z_m), np.array(settings.sigma_xy_m))
    numbers = HeightNumbers(
        np.array(settings.points), np.array(settings.power), np.array(settings.radius_m or 0.0), noise
    )
    # No places are one portion, too.
    parts, sizes = [], [*(size for size in _PLACES if size < most), most]
    for first in range(0, max(len(xy), 1), most):
        some = xy[first : first + most]
        room = next(size for size in sizes if len(some) <= size)
        padded = np.concatenate([some, np.broadcast_to(grid.xyz[0, :2], (room - len(some), 2))])
        near, base, leafy = _neighbours(grid, padded, k)
        part = call_compiled(estimate_heights, near, leafy, numbers, method)
        part = HeightEstimate(*(np.array(v)[: len(some)] for v in part))
        parts.append(part._replace(height=part.height + base[: len(some)]))
    return HeightEstimate(*(np.concatenate(v) for v in zip(*parts, strict=True)))


def _neighbours(grid: Grid, xy: np.ndarray, k: int) -> tuple[Neighbours, ArrayLike, ArrayLike]:
    """Return the nearest points of places, the height of the nearest of all, and which of them are vegetation."""
    neighbours = nearest(grid, xy, k)
    points = grid.xyz[neighbours.index]
    there = np.isfinite(neighbours.distance)
    base = points[:, 0, 2]
    near = Neighbours(points[:, :, :2] - xy[:, None], points[:, :, 2] - base[:, None], neighbours.distance, there)
    return near, base, grid.leafy[neighbours.index] & there


def _judged(estimate: HeightEstimate, broken: np.ndarray, settings: HeightSettings) -> Heights:
    """Combine flags, and remove refused heights."""
    rough = estimate.misfit & estimate.rough & ~broken
    of_leaves = (estimate.leafy > 0) & (estimate.leafy >= settings.leafy_share)
    flag = estimate.hole * HeightFlag.HOLE | ~(estimate.surrounded & np.isfinite(estimate.height)) * HeightFlag.EDGE
    flag = flag | (rough | of_leaves) * HeightFlag.VEGETATION | broken * HeightFlag.BREAKLINE
    flag = flag | estimate.plane * HeightFlag.PLANE
    refused = flag & settings.refuse != 0
    return Heights(
        z=np.where(refused, np.nan, estimate.height),
        sigma=np.where(refused, np.nan, np.hypot(estimate.sigma, settings.sigma_systematic_m)),
        flag=flag.astype(np.uint8),
        count=estimate.used,
        density=estimate.density,
        roughness=estimate.roughness,
        gradient=estimate.gradient,
    )


def _broken(grid: Grid, xy: np.ndarray, estimate: HeightEstimate, k: int) -> np.ndarray:
    """Return True for places at the border of two surfaces, among those where one smooth surface does not fit."""
    broken = np.zeros(len(xy), bool)
    doubtful = np.flatnonzero(estimate.misfit)
    for first in range(0, len(doubtful), _PLACES[1]):
        some = doubtful[first : first + _PLACES[1]]
        padded = np.concatenate([some, np.full(_PLACES[1] - len(some), some[0])])
        near, _, _ = _neighbours(grid, xy[padded], k)
        there = near.there & (np.arange(k) < estimate.wide[padded, None])
        near = near._replace(xy=np.where(there[..., None], near.xy, 0.0), there=there)
        broken[some] = np.asarray(call_compiled(lie_on_two_planes, near, estimate.one_surface[padded]))[: len(some)]
    return broken


class TangentPlanes(eqx.Module):
    """Planes at places; NaN where the cloud does not determine the surface (see `heights_at`)."""

    foot: Float[np.ndarray, "places 3"]
    """Point on the surface above or below the place (m)."""
    normal: Float[np.ndarray, "places 3"]
    """Unit vectors, upwards."""
    sigma: Float[np.ndarray, "places"]
    """Standard deviation of the surface along the normal (m)."""
    flag: Integer[np.ndarray, "places"]
    """Sums of `HeightFlag`."""
    nearest: Int[np.ndarray, "places"]
    """Laser point nearest to the place, in the order of the cloud."""


def tangent_planes(
    grid: Grid, xy: Float[np.ndarray, "places 2"], method: Method, settings: HeightSettings
) -> TangentPlanes:
    """Return the tangent planes of the surface at places X, Y (m).

    With the gradient g of the surface, the normal is (-g, 1) / sqrt(1 + g.g), and its height error is projected
    accordingly. Raises what `heights_at` raises.
    """
    heights = heights_at(grid, xy, method, settings)
    normal = np.column_stack([-heights.gradient, np.ones(len(xy))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[np.isnan(heights.z)] = np.nan
    nearest_index = nearest(grid, xy, 1).index[:, 0]
    return TangentPlanes(
        np.column_stack([xy, heights.z]),
        normal,
        np.asarray(heights.sigma) * normal[:, 2],
        np.asarray(heights.flag),
        np.asarray(grid.order)[nearest_index],
    )
