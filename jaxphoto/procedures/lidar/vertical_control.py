"""Vertical control from a cloud: the height of the laser points below each tie point.

The images determine the position of a tie point, the cloud its height there. The images are re-adjusted with this
height, iteratively, to convergence (paper 001). With `method` "image" the height comes from the pseudo control point of
paper 001, interpolated in the image; otherwise from `lidar.heights_at`. Control is vertical only; the reason is in
docs/lidar_heights.md.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.lidar import Grid, HeightFlag, HeightSettings, heights_at, index_cloud
from jaxphoto.lidar.pseudo_control import pseudo_control_of_block
from jaxphoto.observations import ControlCoordinates
from jaxphoto.procedures.lidar.iterate_to_convergence import (
    MAX_ROUNDS,
    Round,
    SurfaceAtPoints,
    adjust_with_fixed_interior,
    at_result,
    iterate_to_convergence,
    with_common_error,
)
from jaxphoto.statistics import Covariance

Method = Literal["plane", "local", "image"]
METHODS = get_args(Method)
"""Names of the interpolation methods."""


class LidarControl(eqx.Module):
    """Vertical control from a cloud, and the adjustment with it; arrays are over the candidate `points`."""

    block: Block
    """Block with the control, and the adjusted unknowns as initial values."""
    adjusted: Adjustment
    points: Int[np.ndarray, "points"]
    """Index of each point in the block."""
    height: Float[np.ndarray, "points"]
    """Z (m) of the cloud at the point; NaN if undetermined."""
    sigma: Float[np.ndarray, "points"]
    """Standard deviation of the control height (m): from the cloud's height and the point's position on a slope."""
    flag: Integer[np.ndarray, "points"]
    """Sum of `lidar.HeightFlag` values."""
    used: Bool[np.ndarray, "points"]
    """True if the height is used as control: determined and not an outlier."""
    rounds: tuple[Round, ...]
    converged: bool
    """True if the iteration converged."""


def lidar_control(
    block: Block,
    cloud: Cloud | Grid,
    method: Method = "plane",
    settings: HeightSettings | None = None,
    *,
    points: Collection[str] | None = None,
    max_rounds: int = MAX_ROUNDS,
    report: Callable[[Round], None] = lambda made: None,
) -> LidarControl:
    """Adjust `block` with control heights from a cloud in its object frame, for `points` or all tie points.

    A tie point has no control, fixed or check coordinates. The block needs a datum without the cloud: camera stations
    or control. `report` is called after each iteration.
    """
    settings = HeightSettings() if settings is None else settings
    grid = cloud if isinstance(cloud, Grid) else index_cloud(cloud)
    which = tie_points(block, points)
    heights: dict[str, np.ndarray] = {}

    def look(adjusted: Adjustment) -> SurfaceAtPoints:
        z, sigma, gradient, heights["flag"] = _heights(adjusted, which, grid, method, settings)
        usable = np.isfinite(z)
        if not usable.any():
            raise no_surface_error(np.asarray(adjusted.unknowns.points)[which], np.asarray(grid.xyz), heights["flag"])
        place = np.asarray(adjusted.unknowns.points)[which]
        normal = np.column_stack([-gradient, np.ones(len(which))])
        slant = np.linalg.norm(normal, axis=1)
        foot = np.column_stack([place[:, :2], z])
        sigma = with_common_error(sigma, usable, settings.sigma_systematic_m)
        return SurfaceAtPoints(which, foot, normal / slant[:, None], sigma / slant, usable)

    def build(adjusted: Adjustment, cov: Covariance, surface: SurfaceAtPoints, used: np.ndarray) -> Block:
        heights["sigma"] = _sigma(cov, surface)
        rows = ControlCoordinates(which[used], np.full(used.sum(), 2), surface.foot[used, 2], heights["sigma"][used])
        return dataclasses.replace(
            at_result(block, adjusted.unknowns), control=ControlCoordinates.joined(block.control, rows)
        )

    result = iterate_to_convergence(
        adjust_with_fixed_interior(block), look, build, max_rounds, report, "control_points"
    )
    return LidarControl(
        at_result(result.adjusted.block, result.adjusted.unknowns), result.adjusted, which, result.seen.foot[:, 2],
        heights["sigma"], heights["flag"], result.used, result.rounds, result.converged,
    )  # fmt: skip


def tie_points(block: Block, names: Collection[str] | None = None) -> Int[np.ndarray, "points"]:
    """Return the named points, or all without control, fixed or check coordinates."""
    observed = [rows.who for rows in (block.control, block.fixed, block.check)]
    if names is None:
        free = np.setdiff1d(np.arange(len(block.points)), np.concatenate(observed).astype(int))
        if not len(free):
            raise BlockError("the block has no tie point for a height from the cloud: give the points")
        return free
    place = {name: k for k, name in enumerate(block.points)}
    high = {int(p) for rows in (block.control, block.fixed) for p in np.asarray(rows.who)[rows.axis == 2]}
    for name in names:
        if name not in place:
            raise InputError(f"unknown point {name}; choose points of image_points.csv")
        if place[name] in high:
            raise InputError(
                f"the height of point {name} is already control: omit the point, or remove it from the control"
            )
    return np.array(sorted(place[name] for name in set(names)), int)


def no_surface_error(points: np.ndarray, cloud: np.ndarray, flag: np.ndarray) -> BlockError:
    """Return the reason why no point has a height: the cloud does not overlap the block, or all heights are
    undetermined.
    """
    (low, high), (least, most) = ((v[:, :2].min(axis=0), v[:, :2].max(axis=0)) for v in (points, cloud))
    if np.any(low > most) or np.any(high < least):
        block, other = (
            f"X {a[0]:.0f} to {b[0]:.0f} m, Y {a[1]:.0f} to {b[1]:.0f} m" for a, b in ((low, high), (least, most))
        )
        return BlockError(
            f"the cloud does not cover the block: its points lie at {other}, those of the block at {block}; read the "
            "cloud for the block's frame (its EPSG code and unit), or use another cloud"
        )
    counts = ", ".join(f"{n} {name.lower()}" for name, n in flag_counts(flag).items())
    return BlockError(
        f"the cloud determines the height of none of the {len(points)} points ({counts}): use a denser cloud, other "
        "classes or returns, or another method"
    )


def flag_counts(flag: Integer[np.ndarray, "points"]) -> dict[str, int]:
    """Return the number of heights with each flag."""
    counts = {f.name or "": int(((flag & int(f)) != 0).sum()) for f in HeightFlag if f}
    return {name: n for name, n in counts.items() if n}


def _heights(adjusted: Adjustment, which: np.ndarray, grid: Grid, method: Method, settings: HeightSettings):
    """Return height, standard deviation, gradient of the surface and flag, at each of some points."""
    if method == "image":
        # Results are in the order of `which`, because it is sorted.
        pseudo = pseudo_control_of_block(adjusted.block, adjusted.unknowns, grid, which, settings).control
        return np.asarray(pseudo.xyz)[:, 2], *map(np.asarray, (pseudo.sigma_z, pseudo.gradient, pseudo.flag))
    heights = heights_at(grid, np.asarray(adjusted.unknowns.points)[which, :2], method, settings)
    return heights.z, heights.sigma, heights.gradient, heights.flag


def _sigma(cov: Covariance, surface: SurfaceAtPoints) -> Float[np.ndarray, "points"]:
    """Return the sigma of control heights, from the surface and from the point's position covariance on a slope."""
    of_place = np.asarray(cov.points)[surface.point][:, :2, :2]
    upright = surface.normal[:, 2]
    gradient = -surface.normal[:, :2] / upright[:, None]
    return np.sqrt((surface.sigma / upright) ** 2 + np.einsum("ni,nij,nj->n", gradient, of_place, gradient))
