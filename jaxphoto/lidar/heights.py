"""Heights at X, Y from a cloud, with standard deviations; refused where the cloud does not determine them.

Two interpolations of the heights of surrounding points, H = sum w_i Z_i:

- `plane`: least squares through the nearest points,
- `local`: moving least squares, a quadratic with Gaussian weights; a plane if the points do not determine a quadratic.

Error model: `height_estimate`; files and figures: docs/lidar_heights.md.
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
    HeightSettings,
    LidarNoise,
    Neighbours,
    estimate_heights,
    lie_on_two_planes,
)

Method = Literal["plane", "local"]
# Batch sizes of positions; calls are padded to these, for few compiled programs.
_PLACES = (64, 512, 4096)
# Maximum number of points for the surface, for clouds much denser than their horizontal errors.
_MOST_WIDE = 4 * WIDE


class Heights(eqx.Module):
    """Heights (m) and their properties; NaN where refused or undetermined."""

    z: Float[ArrayLike, "places"]
    sigma: Float[ArrayLike, "places"]
    flag: Integer[ArrayLike, "places"]
    """Bitwise sum of `HeightFlag`."""
    count: Int[ArrayLike, "places"]
    """Number of points used."""
    density: Float[ArrayLike, "places"]
    """Points per m^2 around the position."""
    roughness: Float[ArrayLike, "places"]
    """Standard deviation (m) of the points about the local surface."""
    gradient: Float[ArrayLike, "places 2"]
    """Gradient of the local surface (dZ/dX, dZ/dY)."""

    def __len__(self) -> int:
        return len(self.z)

    @property
    def slope(self) -> Float[ArrayLike, "places"]:
        """Return the slope as rise over run: 1 is 45 degrees."""
        return np.hypot(*np.asarray(self.gradient).T)

    def flagged(self, flag: HeightFlag) -> Bool[np.ndarray, "places"]:
        """Return True for positions with any flag of `flag`."""
        return (np.asarray(self.flag) & int(flag)) != 0


def heights_at(
    cloud: Cloud | Grid,
    xy: Float[np.ndarray, "places 2"],
    method: Method = "plane",
    settings: HeightSettings | None = None,
) -> Heights:
    """Interpolate heights of the cloud at X, Y (m) by one of two methods, with standard deviations and flags.

    Pass a `Grid` to avoid re-indexing the cloud. Positions with a flag of `settings.refuse` are NaN; `Heights.flag`
    gives the reason. 95 % of the errors are within 1.96 standard deviations.

    Raises InputError for an unknown method, positions that are not pairs of numbers, and an empty cloud.
    """
    settings = HeightSettings() if settings is None else settings
    if method not in get_args(Method):
        raise InputError(f"unknown method {method!r}; choose one of {', '.join(get_args(Method))}")
    xy = np.asarray(xy, float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise InputError("invalid places; give an array of two columns, X_m and Y_m, without NaN")
    grid = cloud if isinstance(cloud, Grid) else index_cloud(cloud)
    # Mean number of points within the range of horizontal errors; a multiple of `WIDE`.
    covered = np.count_nonzero(np.diff(grid.start)) * float(grid.cell_m) ** 2
    many = np.pi * (APART * settings.sigma_xy_m) ** 2 * len(grid) / covered
    wide = max(WIDE, TIMES * settings.points, min(WIDE * int(np.ceil(many / WIDE)), _MOST_WIDE))
    estimate = _estimates(grid, xy, method, settings, wide)
    return _judged(estimate, _broken(grid, xy, estimate, wide), settings)


def _estimates(grid: Grid, xy: np.ndarray, method: Method, settings: HeightSettings, k: int) -> HeightEstimate:
    """Estimate positions from their `k` nearest points, in batches of few sizes."""
    most = max(1, _PLACES[-1] * WIDE // k)
    noise = LidarNoise(np.array(settings.sigma_z_m), np.array(settings.sigma_xy_m))
    # Process one portion even without positions.
    parts, sizes = [], [*(size for size in _PLACES if size < most), most]
    for first in range(0, max(len(xy), 1), most):
        some = xy[first : first + most]
        room = next(size for size in sizes if len(some) <= size)
        padded = np.concatenate([some, np.broadcast_to(grid.xyz[0, :2], (room - len(some), 2))])
        near, base, leafy = _neighbours(grid, padded, k)
        part = call_compiled(estimate_heights, near, leafy, np.array(settings.points), noise, method)
        part = HeightEstimate(*(np.array(v)[: len(some)] for v in part))
        parts.append(part._replace(height=part.height + base[: len(some)]))
    return HeightEstimate(*(np.concatenate(v) for v in zip(*parts, strict=True)))


def _neighbours(grid: Grid, xy: np.ndarray, k: int) -> tuple[Neighbours, ArrayLike, ArrayLike]:
    """Return the neighbours of the positions, the height of the nearest neighbour, and a mask of vegetation."""
    neighbours = nearest(grid, xy, k)
    points = grid.xyz[neighbours.index]
    there = np.isfinite(neighbours.distance)
    base = points[:, 0, 2]
    near = Neighbours(points[:, :, :2] - xy[:, None], points[:, :, 2] - base[:, None], neighbours.distance, there)
    return near, base, grid.leafy[neighbours.index] & there


def _judged(estimate: HeightEstimate, broken: np.ndarray, settings: HeightSettings) -> Heights:
    """Combine flags, and set refused heights to NaN."""
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
    """Return True for positions at a breakline, where one smooth surface does not fit."""
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
