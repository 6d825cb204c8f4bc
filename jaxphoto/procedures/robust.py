"""Robust adjustment: rows that contradict the others count little, in one solution and without leaving any out.

The scale of each group is estimated with the unknowns, in turns: wide at first, so that nothing is far and the start
decides nothing, then as the residuals say. Of Student's distribution the degrees of freedom are estimated as well.

Source: Huber (1981), Robust statistics, chapters 6 and 7; Lange, Little and Taylor (1989), JASA 84.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, MINIMAL_SIZES, Adjustment, Outcome, PaddedSizes, linearise, solve
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, RankError
from jaxphoto.losses import AbstractLoss, Huber, StudentT
from jaxphoto.procedures.adjust import start_of
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import LEAST_CHECKED, LEAST_SIGMA0, covariance, redundancy_numbers
from jaxphoto.statistics.quantiles import student_freedom
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns
from jaxphoto.variants import without_observations

Masks = dict[str, Bool[np.ndarray, "_"]]
"""By group of observations: which rows."""
Blocks = dict[str, Float[np.ndarray, "_ _ _"]]
"""By group of observations: (rows, numbers of a row, numbers of a row)."""
# Median size of a standard normal number; of fewer numbers than these it says too little of a group by itself.
_MEDIAN, _ENOUGH = 0.6745, 30
# Nothing is far in the first round; from one to the next scales fall by no more than the second; a change of less than
# the third ends it.
_WIDE, _FALL, _STILL = 1e3, 0.1, 0.02
_ROUNDS = 20


@pretty_repr
class Robust(NamedTuple):
    """A robust adjustment: where its losses together are least."""

    unknowns: Unknowns
    converged: bool
    losses: dict[str, AbstractLoss]
    """By group of observations, with the scales that were found."""
    weights: dict[str, Float[np.ndarray, "_"]]
    """By group of observations, of each row: 1 counts whole, 0 not at all."""
    at: Adjustment
    """The block linearised there; its residuals and normal equations are those of least squares."""
    diverged_points: Masks
    """Image points of points that these rows do not place: they had no part in it."""


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
    """Adjust `block` with `loss` (Huber's if None) for all groups of observations, or with one for each that is named.

    It has no standard deviations of its own: `jaxphoto.snoop(block, loss)` goes on from here to an adjustment that has.
    Raises what `adjust` raises, and BlockError for a group that the block does not have.
    """
    rows = block.named_observations
    loss = Huber() if loss is None else loss
    losses = dict(loss) if isinstance(loss, Mapping) else dict.fromkeys(rows, loss)
    if unknown := [name for name in losses if name not in rows]:
        raise BlockError(f"there are no observations {unknown[0]} in this block, only {', '.join(rows)}")
    unknowns = start_of(block, report) if start is None else start
    left = {name: np.zeros(len(own), bool) for name, own in rows.items()}
    found: dict[str, AbstractLoss] = {name: dataclasses.replace(own, scale=_WIDE) for name, own in losses.items()}
    r: Blocks = {}
    at: Adjustment | None = None
    converged = False
    for turn in range(_ROUNDS):
        report(f"robust adjustment, round {turn + 1}")
        solved, point, left = solve_placed(block, left, unknowns, max_steps, sizes, found)
        unknowns, converged = all_points(solved.unknowns, unknowns, point), bool(solved.converged)
        at = linearise(block, unknowns, block.priors, sizes)
        r = r or checked_parts(at)
        new = _rescaled(found, at, r)
        change = max(abs(float(new[name].scale) / float(found[name].scale) - 1) for name in found)
        if change < _STILL:
            break
        found = new
    assert at is not None
    weights = {name: np.ones(len(own)) for name, own in rows.items()}
    for name, own in found.items():
        v = np.atleast_2d(at.residuals[name])
        weights[name] = own.weights(np.sum(v**2, axis=0), len(v))
    return Robust(unknowns, converged, found, weights, at, left)


def solve_placed(
    block: Block,
    left: Masks,
    unknowns: Unknowns,
    max_steps: int,
    sizes: PaddedSizes,
    losses: Mapping[str, AbstractLoss] | None = None,
) -> tuple[Adjustment, Int[np.ndarray, "points"], Masks]:
    """`block` adjusted from `unknowns` without what is `left` out, and without points that the rest does not place.

    With it the points that it has, and what is left out with the image points of the others: blunders may leave a point
    any place along its rays. Raises what `solve` raises, and BlockError where points do not cease to be lost or the
    adjustment diverges.
    """
    rows, left = block.image_points, dict(left)
    for _ in range(_ROUNDS):
        kept, point = without_observations(block, left)
        try:
            solved = solve(kept, some_points(unknowns, point), kept.priors, max_steps, sizes, losses=losses or {})
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
        # From where it began: what is lost has pulled at the others.
        left[rows.group] = left[rows.group] | np.isin(rows.point, point[lost])
    raise BlockError(f"too many object points fly away: {Outcome.ASTRAY.value}")


def _rescaled(losses: dict[str, AbstractLoss], at: Adjustment, r: Blocks) -> dict[str, AbstractLoss]:
    """The losses with the scales that residuals say."""
    scales = residual_scales(at, r)
    found: dict[str, AbstractLoss] = {}
    for name, loss in losses.items():
        found[name] = dataclasses.replace(loss, scale=max(scales[name], _FALL * float(loss.scale)))
        own = r[name]
        checked = np.linalg.eigvalsh(own)[:, 0] > LEAST_CHECKED
        if isinstance(loss, StudentT) and int(checked.sum()) >= _ENOUGH:
            # v' R^-1 v, as large as the errors' own square. With the scale left free, too, some residuals would be made
            # zero, and the likelihood infinite.
            v, own = np.atleast_2d(at.residuals[name]).T[checked, :, None], own[checked]
            square = (v * np.linalg.solve(own, v)).sum((1, 2)) / float(found[name].scale) ** 2
            found[name] = dataclasses.replace(found[name], threshold=student_freedom(square, own.shape[1]) ** 0.5)
    return found


def residual_scales(at: Adjustment, r: Blocks) -> dict[str, float]:
    """By group, a standard deviation of whitened residuals that blunders hardly move."""
    found = {}
    for name, own in r.items():
        diagonal = np.diagonal(own, axis1=1, axis2=2).T
        checked = diagonal > LEAST_CHECKED
        if int(checked.sum()) >= _ENOUGH:
            size = np.abs(np.atleast_2d(at.residuals[name]))[checked] / np.sqrt(diagonal[checked])
            found[name] = max(float(np.median(size)) / _MEDIAN, LEAST_SIGMA0)
    usual = found.get(at.block.image_points.group, 1.0)
    return {name: found.get(name, usual) for name in r}


def checked_parts(adjusted: Adjustment) -> Blocks:
    """Of each row, what its own residuals show of a change of its whitened numbers."""
    blocks = redundancy_numbers(adjusted, covariance(adjusted, rows=True)).blocks
    return {name: blocks[name] for name in adjusted.block.named_observations}


def some_points(unknowns: Unknowns, point: np.ndarray) -> Unknowns:
    """The unknowns of a block that has some of the points only."""
    return dataclasses.replace(unknowns, points=to_numpy(unknowns.points)[point])


def all_points(unknowns: Unknowns, before: Unknowns, point: np.ndarray) -> Unknowns:
    """The unknowns with all points: those that are gone, where they were."""
    points = np.array(before.points)
    points[point] = to_numpy(unknowns.points)
    return dataclasses.replace(unknowns, points=points)
