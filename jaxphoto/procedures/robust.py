"""Robust adjustment, and robust initial solutions of the search for blunders.

`robust` minimises a robust loss in one solution, without rejecting rows. The scale of each group is re-estimated from
the residuals in every iteration. It is large at first, so the result does not depend on the initial values. For
Student's distribution the degrees of freedom are also estimated.

`initial_solutions` yields solutions robust to blunders, the most likely first. Many blunders mask each other in tests
of single observations but hardly affect a Huber estimate. If the result does not fit (very large errors in an image of
few points), the next solutions are: Tukey's loss, which ignores such errors; weights of control and stations just
sufficient for the datum; all control, or all stations, ignored, for files with other units or permuted rows.

Sources: Huber (1981), Robust statistics, chapters 6 and 7; Lange, Little and Taylor (1989), JASA 84.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, MINIMAL_SIZES, Adjustment, Outcome, PaddedSizes, linearise, solve
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, RankError
from jaxphoto.losses import AbstractLoss, Huber, StudentT, Tukey
from jaxphoto.observations import AbstractCoordinates, AbstractObservations
from jaxphoto.procedures.adjust import start_of
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import (
    LEAST_CHECKED,
    LEAST_SIGMA0,
    LEVEL,
    covariance,
    redundancy_numbers,
    systematic_effect_tests,
)
from jaxphoto.statistics.quantiles import student_freedom
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns
from jaxphoto.variants import without_observations

RowMasks = dict[str, Bool[np.ndarray, "_"]]
"""Mask of rows by observation group."""
RedundancyBlocks = dict[str, Float[np.ndarray, "_ _ _"]]
"""Redundancy matrices (rows, components, components) by observation group."""
# Median of |N(0, 1)|; minimum number of residuals for a separate scale of a group.
_MEDIAN, _ENOUGH = 0.6745, 30
# Initial scale; minimum ratio of a scale to the previous one; maximum relative change at convergence.
_WIDE, _FALL, _CONVERGED = 1e3, 0.1, 0.02
_ROUNDS = 20


@pretty_repr
class Robust(NamedTuple):
    """Result of a robust adjustment: the minimum of the sum of the losses."""

    unknowns: Unknowns
    converged: bool
    losses: dict[str, AbstractLoss]
    """Losses by observation group, with the estimated scales."""
    weights: dict[str, Float[np.ndarray, "_"]]
    """Weights by observation group, one per row: 1 full weight, 0 none."""
    at: Adjustment
    """Block linearised at the result; residuals and normal equations are least-squares quantities."""
    diverged_points: RowMasks
    """Image points of points that the observations do not determine; not used."""


@outside_transformations
def robust(
    block: Block,
    loss: AbstractLoss | Mapping[str, AbstractLoss] | None = None,
    start: Unknowns | None = None,
    *,
    max_steps: int = MAX_STEPS,
    sizes: PaddedSizes = MINIMAL_SIZES,
    report: Callable[[str], object] = lambda text: None,
) -> Robust:
    """Adjust `block` with `loss` (default Huber) for all observation groups, or one loss per named group.

    The result has no standard deviations: `jaxphoto.snoop(block, loss)` continues from it to an adjustment with them.
    Raises the errors of `adjust`, and BlockError for a group that the block does not have.
    """
    rows = block.named_observations
    loss = Huber() if loss is None else loss
    losses = dict(loss) if isinstance(loss, Mapping) else dict.fromkeys(rows, loss)
    if unknown := [name for name in losses if name not in rows]:
        raise BlockError(f"unknown observation group {unknown[0]}; use one of {', '.join(rows)}")
    unknowns = start_of(block, report) if start is None else start
    left = {name: np.zeros(len(group), bool) for name, group in rows.items()}
    estimated: dict[str, AbstractLoss] = {name: dataclasses.replace(loss, scale=_WIDE) for name, loss in losses.items()}
    r: RedundancyBlocks = {}
    at: Adjustment | None = None
    converged = False
    for turn in range(_ROUNDS):
        report(f"robust adjustment, iteration {turn + 1}")
        solved, point, left = solve_without_diverged(block, left, unknowns, max_steps, sizes, estimated)
        unknowns, converged = restore_points(solved.unknowns, unknowns, point), bool(solved.converged)
        at = linearise(block, unknowns, block.priors, sizes)
        r = r or redundancy_blocks(at)
        new = _rescale(estimated, at, r)
        change = max(abs(float(new[name].scale) / float(estimated[name].scale) - 1) for name in estimated)
        if change < _CONVERGED:
            break
        estimated = new
    assert at is not None
    weights = {name: np.ones(len(group)) for name, group in rows.items()}
    for name, each in estimated.items():
        v = np.atleast_2d(at.residuals[name])
        weights[name] = each.weights(np.sum(v**2, axis=0), len(v))
    return Robust(unknowns, converged, estimated, weights, at, left)


def solve_without_diverged(
    block: Block,
    left: RowMasks,
    unknowns: Unknowns,
    max_steps: int,
    sizes: PaddedSizes,
    losses: Mapping[str, AbstractLoss] | None = None,
) -> tuple[Adjustment, Int[np.ndarray, "points"], RowMasks]:
    """Adjust `block` from `unknowns` without the rows `left` and without points that the others do not determine.

    Also returns the indices of the remaining points, and `left` with the image points of the removed points: a point
    with blunders may converge anywhere along its rays. Raises the errors of `solve`, and BlockError if points keep
    diverging or the adjustment diverges.
    """
    rows, left = block.image_points, dict(left)
    for _ in range(_ROUNDS):
        part, point = without_observations(block, left)
        try:
            solved = solve(part, select_points(unknowns, point), part.priors, max_steps, sizes, losses=losses or {})
        except RankError as error:
            if not error.points:
                raise
            lost = np.array(error.points)
        else:
            if solved.outcome is Outcome.DIVERGED:
                raise BlockError(solved.outcome.value)
            lost = np.flatnonzero(solved.diverged_points)
        if not len(lost):
            return solved, point, left
        # Restart from `unknowns`: a diverged point has distorted the other unknowns.
        left[rows.group] = left[rows.group] | np.isin(rows.point, point[lost])
    raise BlockError(f"too many object points diverge: {Outcome.DIVERGED_POINTS.value}")


def _rescale(losses: dict[str, AbstractLoss], at: Adjustment, r: RedundancyBlocks) -> dict[str, AbstractLoss]:
    """Return the losses with scales estimated from the residuals."""
    scales = residual_scales(at, r)
    rescaled: dict[str, AbstractLoss] = {}
    for name, loss in losses.items():
        rescaled[name] = dataclasses.replace(loss, scale=max(scales[name], _FALL * float(loss.scale)))
        r_rows = r[name]
        checked = np.linalg.eigvalsh(r_rows)[:, 0] > LEAST_CHECKED
        if isinstance(loss, StudentT) and int(checked.sum()) >= _ENOUGH:
            # v' R^-1 v has the expectation of the squared error. Fix the scale: if it was free, some residuals would
            # become zero and the likelihood infinite.
            v, r_rows = np.atleast_2d(at.residuals[name]).T[checked, :, None], r_rows[checked]
            square = (v * np.linalg.solve(r_rows, v)).sum((1, 2)) / float(rescaled[name].scale) ** 2
            rescaled[name] = dataclasses.replace(
                rescaled[name], threshold=student_freedom(square, r_rows.shape[1]) ** 0.5
            )
    return rescaled


def residual_scales(at: Adjustment, r: RedundancyBlocks) -> dict[str, float]:
    """Return a robust standard deviation of the whitened residuals, by group."""
    scales = {}
    for name, r_rows in r.items():
        diagonal = np.diagonal(r_rows, axis1=1, axis2=2).T
        checked = diagonal > LEAST_CHECKED
        if int(checked.sum()) >= _ENOUGH:
            size = np.abs(np.atleast_2d(at.residuals[name]))[checked] / np.sqrt(diagonal[checked])
            scales[name] = max(float(np.median(size)) / _MEDIAN, LEAST_SIGMA0)
    usual = scales.get(at.block.image_points.group, 1.0)
    return {name: scales.get(name, usual) for name in r}


def redundancy_blocks(adjusted: Adjustment) -> RedundancyBlocks:
    """Return the redundancy matrix of each row, by observation group."""
    blocks = redundancy_numbers(adjusted, covariance(adjusted, rows=True)).blocks
    return {name: blocks[name] for name in adjusted.block.named_observations}


def select_points(unknowns: Unknowns, point: np.ndarray) -> Unknowns:
    """Restrict the unknowns to some points."""
    return dataclasses.replace(unknowns, points=to_numpy(unknowns.points)[point])


def restore_points(unknowns: Unknowns, before: Unknowns, point: np.ndarray) -> Unknowns:
    """Restore all points; removed points get their values from `before`."""
    points = np.array(before.points)
    points[point] = to_numpy(unknowns.points)
    return dataclasses.replace(unknowns, points=points)


# Maximum residual with full weight, in standard deviations (Huber; 95 % efficiency).
_HUBER = 1.345
_ROBUST_STEPS = 10
# Weight factor of control and stations just sufficient for the datum; weight factor that ignores them unless nothing
# else determines the block.
_LOOSE, _NOTHING = 1e-4, 1e-12
_CONVERGED = 0.02


class InitialSolution(NamedTuple):
    """Initial solution of the search for blunders."""

    at: Adjustment
    """Whole block, linearised at the solution."""
    redundancy: RedundancyBlocks
    left: RowMasks
    """Initially rejected rows: image points of diverged points, and ignored groups."""


def initial_solutions(
    block: Block,
    start: Unknowns | None,
    loss: AbstractLoss | None,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
) -> Iterator[Callable[[], InitialSolution]]:
    """Yield initial solutions to try until one fits; with a `loss` only one. Raises the errors of `adjust`."""

    def robustly(loss: AbstractLoss) -> InitialSolution:
        begun = robust(block, loss, from_all(), max_steps=max_steps, sizes=sizes, report=report)
        return InitialSolution(begun.at, redundancy_blocks(begun.at), begun.diverged_points)

    @cache
    def from_all() -> Unknowns:
        return start_of(block, report) if start is None else start

    if loss is not None:
        yield lambda: robustly(loss)
        return
    rows = block.named_observations
    coordinates = [name for name, group in rows.items() if isinstance(group, AbstractCoordinates)]
    yield lambda: _huber_solution(block, from_all(), max_steps, sizes, report, {})
    yield lambda: robustly(Tukey())
    yield lambda: _huber_solution(block, from_all(), max_steps, sizes, report, dict.fromkeys(coordinates, _LOOSE))
    for name in coordinates if len(coordinates) > 1 else ():
        yield partial(_without, block, start, max_steps, sizes, report, {name: np.ones(len(rows[name]), bool)})


def without_common_errors(
    block: Block,
    start: Unknowns | None,
    adjusted: Adjustment,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
) -> Iterator[tuple[RowMasks, Callable[[], InitialSolution]]]:
    """Yield initial solutions without rows that share an error along an axis of their group.

    Other unknowns absorb most of such an error, so valid rows contradict plausible ones.
    """
    tested = systematic_effect_tests(adjusted, np.asarray(covariance(adjusted).shared_sigma))
    for trend in tested:
        axes = [h.term.name for h in trend.significant_terms] if trend.pattern.group else []
        if trend.p_value < LEVEL / len(tested) and axes:
            rows = block.named_observations[trend.pattern.group]
            out = {trend.pattern.group: np.any(np.isin(rows.axis_of_numbers, axes), axis=0)}
            yield out, partial(_without, block, start, max_steps, sizes, report, out)


def _without(
    block: Block,
    start: Unknowns | None,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
    out: RowMasks,
) -> InitialSolution:
    """Adjust the block without some rows."""
    none = {name: out.get(name, np.zeros(len(rows), bool)) for name, rows in block.named_observations.items()}
    start = start_of(without_observations(block, none)[0], report) if start is None else start
    least = {name: np.where(rejected, _NOTHING, 1.0) for name, rejected in out.items()}
    begun = _huber_solution(block, start, max_steps, sizes, report, least)
    return begun._replace(left=begun.left | {name: begun.left[name] | rejected for name, rejected in out.items()})


def _huber_solution(
    block: Block,
    start: Unknowns,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
    least: Mapping[str, float | np.ndarray],
) -> InitialSolution:
    """Adjust with Huber weights. Initial weights are `least` by group; the default is 1."""
    rows, unknowns = block.named_observations, start
    weight = {name: np.broadcast_to(least.get(name, 1.0), len(group)) for name, group in rows.items()}
    least = weight
    left = {name: np.zeros(len(group), bool) for name, group in rows.items()}
    at: Adjustment | None = None
    r: RedundancyBlocks = {}
    for step in range(_ROBUST_STEPS + 1):
        report(f"robust step {step}" if step else "adjusting all observations")
        lighter = block.with_observations({name: scale_weights(group, weight[name]) for name, group in rows.items()})
        adjusted, point, left = solve_without_diverged(lighter, left, unknowns, max_steps, sizes)
        unknowns = restore_points(adjusted.unknowns, unknowns, point)
        at = linearise(block, unknowns, block.priors, sizes)
        r = r or redundancy_blocks(at)
        scale = residual_scales(at, r)
        new = {
            name: least[name] / np.maximum(_largest_normalised(at, name, r) / (_HUBER * scale[name]), 1.0)
            for name in rows
        }
        if max(float(np.abs(new[name] - weight[name]).max(initial=0.0)) for name in rows) < _CONVERGED:
            break
        weight = new
    assert at is not None
    return InitialSolution(at, r, left)


def scale_weights(rows: AbstractObservations, weight: Float[np.ndarray, "_"]) -> AbstractObservations:
    """Scale the weights of rows, one factor per row."""
    factor = (weight**-0.5).reshape(-1, *[1] * (np.ndim(rows.sigmas) - 1))
    return rows.with_sigmas_times(np.broadcast_to(factor, np.shape(rows.sigmas)))


def _largest_normalised(at: Adjustment, name: str, r: RedundancyBlocks) -> Float[np.ndarray, "_"]:
    """Return the largest |v| / sqrt(r) of each row; 0 if its redundancy is negligible."""
    diagonal = np.diagonal(r[name], axis1=1, axis2=2).T
    checked = diagonal > LEAST_CHECKED
    size = np.abs(np.atleast_2d(at.residuals[name])) / np.sqrt(np.where(checked, diagonal, 1.0))
    return np.where(checked, size, 0.0).max(axis=0, initial=0.0)
