"""Initial solutions of a search for blunders: estimates that are robust to blunders, the most likely first.

Weights decrease with the residual (Huber), iteratively: many blunders mask one another in tests of single observations,
but hardly affect such an estimate. If no observation set fits (very large errors in an image of few points), Tukey's
loss ignores them; or control and stations serve as little more than the datum; or all control, or all stations, are
ignored, as if their file had other units or permuted rows.

Source: Huber (1981), Robust statistics.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, linearise
from jaxphoto.block import Block
from jaxphoto.losses import AbstractLoss, Tukey
from jaxphoto.observations import AbstractCoordinates, AbstractObservations
from jaxphoto.procedures.adjust import start_of
from jaxphoto.procedures.robust import (
    Blocks,
    Masks,
    all_points,
    checked_parts,
    residual_scales,
    robust,
    solve_placed,
)
from jaxphoto.statistics import LEAST_CHECKED, LEVEL, covariance, systematic_effect_tests
from jaxphoto.unknowns import Unknowns
from jaxphoto.variants import without_observations

# Huber's constant: residuals up to this number of standard deviations have full weight (95 % efficiency).
_HUBER = 1.345
_ROBUST_STEPS = 10
# Sigma factors of control and stations that serve as little more than the datum, and that are ignored, except where
# nothing else determines the block.
_LOOSE, _NOTHING = 1e-4, 1e-12
# A smaller change of weights in a robust iteration does not change the suspects.
_STILL = 0.02


class Begun(NamedTuple):
    """Initial solution of a search."""

    at: Adjustment
    """Whole block, linearised."""
    redundancy: Blocks
    left: Masks
    """Initially rejected: image points of diverged points, and ignored groups."""


def beginnings(
    block: Block,
    start: Unknowns | None,
    loss: AbstractLoss | None,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
) -> Iterator[Callable[[], Begun]]:
    """Yield initial solutions, to be tried until one fits; with a `loss` only that one. Raises what `adjust` raises."""

    def robustly(loss: AbstractLoss) -> Begun:
        begun = robust(block, loss, from_all(), max_steps=max_steps, sizes=sizes, report=report)
        return Begun(begun.at, checked_parts(begun.at), begun.diverged_points)

    @cache
    def from_all() -> Unknowns:
        return start_of(block, report) if start is None else start

    if loss is not None:
        yield lambda: robustly(loss)
        return
    rows = block.named_observations
    coordinates = [name for name, own in rows.items() if isinstance(own, AbstractCoordinates)]
    yield lambda: _reweighted(block, from_all(), max_steps, sizes, report, {})
    yield lambda: robustly(Tukey())
    yield lambda: _reweighted(block, from_all(), max_steps, sizes, report, dict.fromkeys(coordinates, _LOOSE))
    for name in coordinates if len(coordinates) > 1 else ():
        yield partial(_without, block, start, max_steps, sizes, report, {name: np.ones(len(rows[name]), bool)})


def without_what_is_alike(
    block: Block,
    start: Unknowns | None,
    found: Adjustment,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
) -> Iterator[tuple[Masks, Callable[[], Begun]]]:
    """Return an initial solution without rows that share an error along an axis of their group.

    Other unknowns absorb most of such an error, and then valid rows contradict plausible ones.
    """
    tested = systematic_effect_tests(found, np.asarray(covariance(found).shared_sigma))
    for trend in tested:
        if trend.p_value < LEVEL / len(tested) and (axes := [h.term.name for h in trend.significant_terms]):
            rows = block.named_observations[trend.pattern.group]
            out = {trend.pattern.group: np.any(np.isin(rows.axis_of_numbers, axes), axis=0)}
            yield out, partial(_without, block, start, max_steps, sizes, report, out)


def _without(
    block: Block,
    start: Unknowns | None,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
    out: Masks,
) -> Begun:
    """Adjust the block without some rows."""
    none = {name: out.get(name, np.zeros(len(rows), bool)) for name, rows in block.named_observations.items()}
    start = start_of(without_observations(block, none)[0], report) if start is None else start
    least = {name: np.where(own, _NOTHING, 1.0) for name, own in out.items()}
    begun = _reweighted(block, start, max_steps, sizes, report, least)
    return begun._replace(left=begun.left | {name: begun.left[name] | own for name, own in out.items()})


def _reweighted(
    block: Block,
    start: Unknowns,
    max_steps: int,
    sizes: PaddedSizes,
    report: Callable[[str], object],
    least: Mapping[str, float | np.ndarray],
) -> Begun:
    """Adjust with weights that decrease with the residual, from `least` on by group, or from 1."""
    rows, unknowns = block.named_observations, start
    weight = {name: np.broadcast_to(least.get(name, 1.0), len(own)) for name, own in rows.items()}
    least = weight
    left = {name: np.zeros(len(own), bool) for name, own in rows.items()}
    at: Adjustment | None = None
    r: Blocks = {}
    for step in range(_ROBUST_STEPS + 1):
        report(f"robust step {step}" if step else "adjusting all observations")
        lighter = block.with_observations({name: weighed(own, weight[name]) for name, own in rows.items()})
        found, point, left = solve_placed(lighter, left, unknowns, max_steps, sizes)
        unknowns = all_points(found.unknowns, unknowns, point)
        at = linearise(block, unknowns, block.priors, sizes)
        r = r or checked_parts(at)
        scale = residual_scales(at, r)
        new = {name: least[name] / np.maximum(_largest(at, name, r) / (_HUBER * scale[name]), 1.0) for name in rows}
        if max(float(np.abs(new[name] - weight[name]).max(initial=0.0)) for name in rows) < _STILL:
            break
        weight = new
    assert at is not None
    return Begun(at, r, left)


def weighed(rows: AbstractObservations, weight: Float[np.ndarray, "_"]) -> AbstractObservations:
    """Scale the weights of rows, one factor per row."""
    factor = (weight**-0.5).reshape(-1, *[1] * (np.ndim(rows.sigmas) - 1))
    return rows.with_sigmas_times(np.broadcast_to(factor, np.shape(rows.sigmas)))


def _largest(at: Adjustment, name: str, r: Blocks) -> Float[np.ndarray, "_"]:
    """Return the largest |v| / sqrt(r) of each row; very small if hardly anything checks it."""
    own = np.diagonal(r[name], axis1=1, axis2=2).T
    checked = own > LEAST_CHECKED
    size = np.abs(np.atleast_2d(at.residuals[name])) / np.sqrt(np.where(checked, own, 1.0))
    return np.where(checked, size, 0.0).max(axis=0, initial=0.0)
