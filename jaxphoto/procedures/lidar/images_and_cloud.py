"""Simultaneous adjustment of images and a point cloud (paper 001): the cloud constrains the images, the images correct
the cloud.

Every tie point is observed to lie on the surface of each lidar strip that covers it. Unknowns are the orientations, the
boresight of the scanner and the shifts of its strips. The surface at a point depends on its position, so the adjustment
is iterated to convergence. Then the trajectory is corrected by the shifts of the strips, and the cloud is recomputed
from it.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Scanner, Trajectory, raised_by_boresight
from jaxphoto.lidar import Grid, HeightSettings, index_cloud, nearest
from jaxphoto.lidar.correction import (
    ScannerPath,
    ScannerPoses,
    check_covered,
    correct_cloud,
    correct_trajectory,
    corrected_xyz,
    in_portions,
    scanner_path,
    scanner_poses,
)
from jaxphoto.lidar.heights import Method, heights_at
from jaxphoto.observations import SurfaceRows
from jaxphoto.procedures.lidar.iterate_to_convergence import (
    MAX_ROUNDS,
    Round,
    SurfaceAtPoints,
    adjust_with_fixed_interior,
    at_result,
    check_without_surfaces,
    iterate_to_convergence,
    with_common_error,
)
from jaxphoto.procedures.lidar.strip_model import check_measured_from
from jaxphoto.procedures.lidar.vertical_control import no_surface_error, tie_points
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import Covariance
from jaxphoto.unknowns import FIXED, FREE, Weighted

SHIFT_SIGMA = 0.3
"""Default standard deviation (m) of a lidar strip's shift."""
# Number of laser points of a strip near a tie point that can affect its surface; minimum ratio to the number used for
# interpolation.
_NEAR, _TIMES = 400, 8


@pretty_repr
class Simultaneous(eqx.Module):
    """Images and cloud before and after simultaneous adjustment."""

    before: Adjustment
    """Adjustment of the block alone, with fixed interior orientation."""
    adjusted: Adjustment
    cloud: Cloud
    """Corrected cloud."""
    trajectory: Trajectory | None
    """Trajectory corrected by the shifts of its strips."""
    scanner: Scanner
    points: Int[np.ndarray, "rows"]
    """Point of the block, for each observation of a surface."""
    strip: Int[np.ndarray, "rows"]
    apart_before: Float[np.ndarray, "rows"]
    """Height of points above the surface of the original cloud, before adjustment (m); NaN if undetermined."""
    apart: Float[np.ndarray, "rows"]
    """Height of points above the surface of the corrected cloud (m); NaN if undetermined."""
    moved_cloud: Float[np.ndarray, "3"]
    """Root mean square correction (m) of the laser points along X, Y and Z."""
    rounds: tuple[Round, ...]
    converged: bool
    """True if the iteration converged."""


def simultaneous(
    block: Block,
    cloud: Cloud,
    trajectory: Trajectory | None = None,
    priors: Scanner | None = None,
    *,
    method: Method = "local",
    settings: HeightSettings | None = None,
    points: Collection[str] | None = None,
    max_rounds: int = MAX_ROUNDS,
    report: Callable[[Round], None] = lambda made: None,
) -> Simultaneous:
    """Adjust `block` with its tie points on the surface of `cloud`, which is in the block's object frame.

    `priors` are the priors of the scanner. By default its boresight is FREE if `trajectory` (of the scanner, on the
    cloud's clock) gives the scanner position of each point, and FIXED without one; shifts are weighted at zero with
    `SHIFT_SIGMA`. `points` are the names of points on the surface; None selects all tie points.
    """
    settings = HeightSettings() if settings is None else settings
    names = cloud.strips or ("cloud",)
    timed = trajectory is not None and cloud.time is not None
    if priors is None:
        shift = Weighted(np.zeros(3), np.full(3, SHIFT_SIGMA))
        priors = Scanner(FREE if timed else FIXED, dict.fromkeys(names, shift))  # type: ignore[arg-type]
    if set(priors.shifts) != set(names):
        raise InputError(
            f"the scanner has priors for the strips {', '.join(priors.shifts)}, but the cloud has {', '.join(names)}: "
            "give one for each of these"
        )
    # Sort by the cloud's strips.
    priors = Scanner(priors.boresight, {name: priors.shifts[name] for name in names})
    if priors.boresight != FIXED and not timed:
        raise InputError(
            "the boresight of the scanner needs its trajectory and the time of each laser point: give them, or fix "
            "the boresight"
        )
    check_without_surfaces(block)
    if timed:
        check_covered(cloud, trajectory)  # type: ignore[arg-type]
    which = tie_points(block, points)
    first = adjust_with_fixed_interior(block)
    path = scanner_path(trajectory) if timed else None  # type: ignore[arg-type]
    if path is not None:
        check_measured_from(cloud, path)
    strips = []
    for k, name in enumerate(names):
        returns = cloud if cloud.strip is None else cloud.take(np.flatnonzero(cloud.strip == k))
        if not len(returns):
            raise InputError(f"strip {name} of the cloud has no points: omit it, or read other classes and returns")
        strips.append((returns, index_cloud(returns.xyz)))
    none: Scanner = jax.tree.map(np.asarray, Scanner(jnp.zeros(3), dict.fromkeys(names, jnp.zeros(3))))
    strip = np.repeat(np.arange(len(names)), len(which))

    last: dict[str, Any] = {}

    def look(adjusted: Adjustment) -> SurfaceAtPoints:
        scanner = adjusted.unknowns.scanner or none
        xy = np.asarray(adjusted.unknowns.points)[which, :2]
        last["poses"], planes = [], []
        for of, shift in zip(strips, scanner.shifts.values(), strict=True):
            near, poses = _near(*of, path, xy, scanner, shift, settings)
            grid = index_cloud(near)
            heights = heights_at(grid, xy, method, settings)
            # Tangent plane; the height error is projected onto its normal.
            normal = np.column_stack([-heights.gradient, np.ones(len(xy))])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            normal[np.isnan(heights.z)] = np.nan
            planes.append((np.column_stack([xy, heights.z]), normal, heights.sigma * normal[:, 2], heights.flag))
            one = np.asarray(grid.order)[nearest(grid, xy, 1).index[:, 0]]
            last["poses"].append(None if poses is None else jax.tree.map(lambda v, k=one: v[k], poses))
        foot, normal, sigma, flag = map(np.concatenate, zip(*planes, strict=True))
        usable = np.isfinite(foot).all(axis=1)
        sigma = with_common_error(sigma, usable, settings.sigma_systematic_m)
        if not usable.any():
            raise no_surface_error(np.asarray(adjusted.unknowns.points)[which], cloud.xyz, flag)
        return SurfaceAtPoints(np.tile(which, len(names)), foot, normal, sigma, usable)

    def build(adjusted: Adjustment, cov: Covariance, surface: SurfaceAtPoints, used: np.ndarray) -> Block:
        scanner = adjusted.unknowns.scanner or none
        last["turn"] = _turns(surface, strip, last["poses"])
        rows = _surface_rows(surface, used, strip, last["turn"], scanner)
        unknowns = dataclasses.replace(adjusted.unknowns, scanner=scanner)
        posed = dataclasses.replace(block, surfaces=rows, priors=dataclasses.replace(block.priors, scanner=priors))
        return at_result(posed, unknowns)

    def carry(surface: SurfaceAtPoints, before: Adjustment, now: Adjustment) -> SurfaceAtPoints:
        old, new = before.unknowns.scanner or none, now.unknowns.scanner or none
        shift = np.stack([np.asarray(new.shifts[name]) - np.asarray(old.shifts[name]) for name in names])[strip]
        raised = last["turn"] @ (np.asarray(new.boresight) - np.asarray(old.boresight))
        return surface._replace(foot=surface.foot - shift - raised[:, None] * surface.normal)

    result = iterate_to_convergence(first, look, build, max_rounds, report, "surfaces", carry)
    scanner = result.adjusted.unknowns.scanner
    assert scanner is not None
    corrected, used = correct_cloud(cloud, scanner, path), result.used
    after = look(result.adjusted)
    return Simultaneous(
        first, result.adjusted, corrected,
        correct_trajectory(trajectory, cloud, scanner) if trajectory is not None else None, scanner,
        result.seen.point[used], strip[used], result.before.apart(first)[used], after.apart(result.adjusted)[used],
        np.sqrt(((corrected.xyz - cloud.xyz) ** 2).mean(axis=0)), result.rounds, result.converged,
    )  # fmt: skip


def _near(
    strip: Cloud,
    grid: Grid,
    path: ScannerPath | None,
    xy: Float[np.ndarray, "n 2"],
    scanner: Scanner,
    shift: Float[ArrayLike, "3"],
    settings: HeightSettings,
) -> tuple[Cloud, ScannerPoses | None]:
    """Return the corrected laser points that can affect the surface at some positions, and their scanner poses."""

    def corrected(index: Int[np.ndarray, "m"]) -> tuple[Cloud, ScannerPoses | None]:
        returns = strip.take(index)
        poses = None if path is None or returns.time is None else scanner_poses(path, returns.time)
        return dataclasses.replace(returns, xyz=corrected_xyz(returns.xyz, poses, scanner.boresight, shift)), poses

    order = np.asarray(grid.order)
    # Positions in the measured cloud: remove the correction of the nearest laser point.
    one = order[nearest(grid, xy, 1).index[:, 0]]
    offset = strip.xyz[one, :2] - corrected(one)[0].xyz[:, :2]
    enough = min(max(_NEAR, _TIMES * settings.points), len(strip))
    return corrected(np.unique(order[nearest(grid, xy + offset, enough).index]))


def _turns(
    surface: SurfaceAtPoints, strip: Int[np.ndarray, "rows"], poses: list[ScannerPoses | None]
) -> Float[np.ndarray, "rows 3"]:
    """Return `SurfaceRows.turn` of all rows, used or rejected: the shape is the same in every iteration."""
    turn = np.zeros_like(surface.foot)
    for k, one in enumerate(poses):
        if one is not None:
            mask = strip == k
            rows = surface.foot[mask], surface.normal[mask], one.position, one.object_from_body
            turn[mask] = in_portions(_raised, rows)
    return turn


def _surface_rows(
    surface: SurfaceAtPoints,
    used: Bool[np.ndarray, "rows"],
    strip: Int[np.ndarray, "rows"],
    turn: Float[np.ndarray, "rows 3"],
    scanner: Scanner,
) -> SurfaceRows:
    """Return the observations of the measured cloud, linearised in shift and boresight at `scanner`."""
    of, turn, foot, normal = strip[used], turn[used], surface.foot[used], surface.normal[used]
    shift = np.stack([np.asarray(v) for v in scanner.shifts.values()])[of]
    raised = turn @ np.asarray(scanner.boresight)
    return SurfaceRows(
        surface.point[used], of, foot + shift + raised[:, None] * normal, normal, turn, surface.sigma[used]
    )


_raised = eqx.filter_jit(jax.vmap(raised_by_boresight))
