"""Detect and reject blunders: robust start, then iterated data snooping.

1. The block is adjusted with Huber weights, iteratively: many blunders mask one another in tests of single observations
but hardly affect a robust estimate. If the result does not fit (very large errors in an image of few points, a file in
other units), the search restarts from another solution (`robust.initial_solutions`).

2. Contradicting rows are rejected and the block is adjusted without them. Then, iteratively: each rejected row is
predicted by the others and reinstated if it agrees; of the others, the worst of each point is rejected if it
contradicts (Baarda's data snooping), until nothing changes.

3. Control points or stations with exchanged coordinates, and image points of one image with exchanged names, are
corrected (`exchanges`).

4. Finally, points rejected while blunders still distorted the images are reinstated if their rays intersect.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Huber (1981), Robust statistics.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import MAX_STEPS, Adjustment, PaddedSizes, common_sizes, linearise, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, DatumError, JaxphotoError, RankError, counted
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.losses import AbstractLoss
from jaxphoto.observations import Correlated
from jaxphoto.procedures.adjust import start_of
from jaxphoto.procedures.exchanges import (
    Exchange,
    coordinate_exchanges,
    exchanged,
    intersecting_points,
    merge_exchanges,
    name_exchanges,
    reinstate_points,
    with_dependants,
    with_positions,
)
from jaxphoto.procedures.robust import (
    InitialSolution,
    RedundancyBlocks,
    RowMasks,
    initial_solutions,
    redundancy_blocks,
    residual_scales,
    restore_points,
    scale_weights,
    solve_without_diverged,
    without_common_errors,
)
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import LEAST_CHECKED, LEAST_SIGMA0, LEVEL, UNCHECKED, Suspect, chi_square_limit, global_test
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns

_MAX_ITERATIONS = 20
# Maximum sigma0 of a solution that fits: a larger one is not a matter of weights (docs/trust.md).
_FITS = 3.0
# Minimum fraction of image points kept.
_LEAST_LEFT = 0.5
SEVERAL = 4
"""Minimum number of rejected rows, and `_SINGLE` minimum fraction of a group, that single errors do not explain."""
_SINGLE = 1 / 3
# A blunder inflates neighbouring residuals: rows below this fraction of the largest are not rejected in the same
# iteration.
_BESIDE_THE_WORST = 0.5


@pretty_repr
class Snooped(NamedTuple):
    """Block adjusted without its blunders.

    `left_out` are rejected rows of the original block, worst first: the others contradict them by `error` +- `sigma`.
    `exchanged` are the exchanges that were corrected.
    """

    adjusted: Adjustment
    left_out: tuple[Suspect, ...]
    exchanged: tuple[Exchange, ...]
    points: tuple[str, ...]
    """Points with too few remaining observations."""


@outside_transformations
def snoop(
    block: Block,
    start: Unknowns | None = None,
    *,
    loss: AbstractLoss | None = None,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> Snooped:
    """Adjust `block` and reject observations that contradict the others.

    All observations are tested (image points, control, stations and further kinds), but not priors. A row is rejected
    as a whole: both coordinates of an image point, one coordinate of a control point. With `loss` the search starts
    from that robust adjustment (`jaxphoto.robust`). Raises what `adjust` raises.
    """
    sizes = common_sizes([block])
    best: Snooped | None = None
    failed: list[JaxphotoError] = []

    def from_there(begin: Callable[[], InitialSolution]) -> Snooped | None:
        try:
            new = _snooped(block, begin(), max_steps, sizes, report)
            left, number = len(new.adjusted.block.image_points), len(block.image_points)
            if left < _LEAST_LEFT * number:
                raise BlockError(f"{left} of {number} image points are left")
        except (DatumError, RankError, BlockError) as error:
            failed.append(error)
            return None
        return new

    for begin in initial_solutions(block, start, loss, max_steps, sizes, report):
        new = from_there(begin)
        best = new if new is not None and (best is None or _better(new, best)) else best
        if best is not None and _fits(best) and not mostly_rejected(best, block) and not rejected_images(best, block):
            break
    if best is None:
        # What all observations together cannot determine is reported as in an adjustment.
        solve(block, start_of(block, report) if start is None else start, block.priors, max_steps, sizes)
        raise BlockError(
            "too many observations contradict the others: check names, units, axes and the order of rows, and adjust "
            f"all observations. The search ended with: {failed[0]}"
        ) from failed[0]
    if global_test(best.adjusted).p_value < LEVEL:
        for out, begin in without_common_errors(block, start, best.adjusted, max_steps, sizes, report):
            if (new := from_there(begin)) is not None and _improves(new, best, out):
                best = new
    return best


def mostly_rejected(snooped: Snooped, block: Block) -> dict[str, dict[str, tuple[int, int]]]:
    """Return (rejected, all) by group (except image points) and axis, where more are rejected than single errors
    explain.
    """
    groups: dict[str, dict[str, tuple[int, int]]] = {}
    for name, rows in block.named_observations.items():
        left = [s for s in snooped.left_out if s.group == name]
        if name == IMAGE_POINTS or isinstance(rows, Correlated) or len(left) < SEVERAL:
            continue
        axes = rows.axis_of_numbers
        lost = np.isin(np.arange(len(rows)), [s.row for s in left])
        counted = {a: (int(((axes == a) & lost).sum()), int((axes == a).sum())) for a in dict.fromkeys(axes.flat)}
        if many := {a: (n, of) for a, (n, of) in counted.items() if n >= SEVERAL and n > _SINGLE * of}:
            groups[name] = many
    return groups


def rejected_images(snooped: Snooped, block: Block) -> dict[int, tuple[int, int]]:
    """Return (rejected, all) image points of images of which more are rejected than single errors explain."""
    rows = block.image_points
    out = np.isin(np.array(block.points, object)[rows.point], snooped.points)
    out[[s.row for s in snooped.left_out if s.group == rows.group]] = True
    total, gone = (np.bincount(rows.image[k], minlength=len(block.images)) for k in (np.s_[:], out))
    return {k: (int(gone[k]), int(total[k])) for k in np.flatnonzero((gone >= SEVERAL) & (gone > total / 2)).tolist()}


def _fits(snooped: Snooped) -> bool:
    adjusted = snooped.adjusted
    agrees = bool(adjusted.converged) and float(adjusted.sigma0) <= _FITS
    return agrees and not len(looking_away(adjusted.block, in_front(adjusted.block, adjusted.unknowns)))


def _improves(one: Snooped, other: Snooped, out: RowMasks) -> bool:
    """Return True if `one` fits, with smaller sigma0, and rejects no more rows outside of `out`."""
    of_one, of_other = (sum(not (s.group in out and out[s.group][s.row]) for s in s.left_out) for s in (one, other))
    return _fits(one) and bool(one.adjusted.sigma0 < other.adjusted.sigma0) and of_one <= of_other


def _better(one: Snooped, other: Snooped) -> bool:
    """Return True if only `one` fits or it rejects fewer rows; if neither fits, if its sigma0 is smaller."""
    if _fits(one) and _fits(other):
        return len(one.left_out) < len(other.left_out)
    return bool(one.adjusted.sigma0 < other.adjusted.sigma0)


def _snooped(
    block: Block, begun: InitialSolution, max_steps: int, sizes: PaddedSizes, report: Callable[[str], object]
) -> Snooped:
    """Search from a robust solution."""
    at, r, flown = begun
    scale = residual_scales(at, r)
    worst = _largest_per_point(
        block, {name: size / scale[name] for name, size in blunder_statistics(at, r).items()}, 1.0
    )
    left = {name: flown[name] | worst[name] for name in worst}
    tried: list[RowMasks] = []
    # Before any rejection: wrong coordinates distort images, and valid rows would be rejected with them.
    lost = np.unique(block.image_points.point[flown[block.image_points.group]])
    done, at = coordinate_exchanges(at, left, lost, sizes)
    for exchange in done:
        block, left = exchanged(block, left, exchange)
    # A repeated exchange is undone, and would be undone again.
    tried_exchanges = {(e.group, e.rows) for e in done}
    returned, again = set[int](), set[tuple]()
    while True:
        report(f"adjusting without {counted(sum(int(m.sum()) for m in left.values()), 'observation')}")
        adjusted, point, left = solve_without_diverged(block, left, at.unknowns, max_steps, sizes)
        at = linearise(block, restore_points(adjusted.unknowns, at.unknowns, point), block.priors, sizes)
        sigma0 = max(float(adjusted.sigma0), LEAST_SIGMA0)
        lost = np.setdiff1d(np.arange(len(block.points)), point)
        r = predicted_redundancy(at, left, sizes)
        new, placed = _new_exchanges(at, left, lost, sigma0, r, sizes, tried_exchanges)
        for exchange in new:
            (block, left), at = exchanged(block, left, exchange), placed
            done.append(exchange)
        if new:
            # The block has changed: rejections that led nowhere may succeed now.
            tried.clear()
            continue
        rejections = _next_rejections(adjusted, at, left, point, sigma0, r)
        still_there = _equal_masks(rejections, left)
        if still_there or len(tried) == _MAX_ITERATIONS or any(_equal_masks(rejections, old) for old in tried):
            # Exchanges that do not fit, or are unnecessary, are undone. If nothing fits, all are undone and may be
            # tried once more.
            fits = bool(adjusted.converged) and sigma0 <= _FITS
            wrong = [not fits or not _is_necessary(at, left, e, sigma0) for e in done]
            if undone := with_dependants(done, wrong):
                for exchange in reversed(undone):
                    block, left = exchanged(block, left, exchange.undone)
                    done.remove(exchange)
                went = set() if fits else {(e.group, e.rows) for e in undone}
                tried_exchanges, again = tried_exchanges - (went - again), again | went
                tried.clear()
                continue
            # Points rejected while blunders still distorted the images.
            back = {p: place for p, place in intersecting_points(at, left, lost, sigma0).items() if p not in returned}
            if not still_there or not back:
                break
            returned |= set(back)
            left, at = reinstate_points(block, left, back), with_positions(at, back)
            tried.clear()
            continue
        tried.append(left)
        left = rejections
    suspects = _suspects(at, left, _rows_of_points(block, point), r, sigma0)
    return Snooped(adjusted, suspects, tuple(merge_exchanges(block, done, left)), tuple(block.points[p] for p in lost))


def _new_exchanges(
    at: Adjustment, left: RowMasks, lost: np.ndarray, sigma0: float, r: RedundancyBlocks, sizes: PaddedSizes, tried: set
) -> tuple[list[Exchange], Adjustment]:
    """Return exchanges that are not `known`, which is extended, and `at` with the corrected positions.

    Coordinates first: wrong ones distort images, in which names then seem exchanged.
    """
    for find in (
        lambda: coordinate_exchanges(at, left, lost, sizes),
        lambda: name_exchanges(at, left, lost, sigma0, r),
    ):
        pairs, placed = find()
        if new := [e for e in pairs if (e.group, e.rows) not in tried]:
            tried.update((e.group, e.rows) for e in new)
            return new, placed
    return [], at


def _is_necessary(at: Adjustment, left: RowMasks, exchange: Exchange, sigma0: float) -> bool:
    """Return True if the exchanged rows fit, and would not without the exchange."""
    p, rows = at.block.image_points, np.setdiff1d(np.ravel(exchange.rows), exchange.out)
    if left[exchange.group][rows].mean() >= 0.5:
        return False
    if exchange.group != p.group:
        return True
    block, _ = exchanged(at.block, left, exchange.undone)
    points = np.unique(p.point[rows])
    unexchanged = eqx.tree_at(lambda a: a.block, at, block)
    return len(intersecting_points(unexchanged, left, points, sigma0)) < len(points)


def _next_rejections(
    adjusted: Adjustment, at: Adjustment, left: RowMasks, point: np.ndarray, sigma0: float, r: RedundancyBlocks
) -> RowMasks:
    """Return the next rejections; `adjusted` excludes `left`, `at` is the whole block linearised there."""
    stays = _rows_of_points(at.block, point)
    wrong = {name: size > sigma0 for name, size in blunder_statistics(at, r, predicted=True).items()}
    reconsidered = {name: out & (wrong[name] | ~stays[name]) for name, out in left.items()}
    # `adjusted` has no rows of a group that is rejected entirely.
    sizes = {name: np.zeros(len(out)) for name, out in left.items()}
    for name, size in blunder_statistics(adjusted, redundancy_blocks(adjusted)).items():
        sizes[name][~left[name] & stays[name]] = size / sigma0
    least = max(1.0, _BESIDE_THE_WORST * max(float(size.max(initial=0.0)) for size in sizes.values()))
    return {name: reconsidered[name] | new for name, new in _largest_per_point(at.block, sizes, least).items()}


def _largest_per_point(block: Block, sizes: dict[str, np.ndarray], limit: float) -> RowMasks:
    """Mark the row with the largest size above `limit` of each point; of rows without point, of each image."""
    groups = block.named_observations
    worst: dict[object, tuple[float, str, int]] = {}
    for name, rows in groups.items():
        for row in np.flatnonzero(sizes[name] > limit).tolist():
            touched = {what: np.ravel(index[row])[0] for what, index in reversed(rows.indices())}
            what = "point" if "point" in touched else next(iter(touched), "")
            place, size = (what, touched.get(what)), float(sizes[name][row])
            worst[place] = max(worst.get(place, (0.0, "", 0)), (size, name, row))
    masks = {name: np.zeros(len(rows), bool) for name, rows in groups.items()}
    for _, name, row in worst.values():
        masks[name][row] = True
    return masks


def _rows_of_points(block: Block, point: np.ndarray) -> RowMasks:
    """Mark the rows all of whose points are kept."""
    masks = {}
    for name, rows in block.named_observations.items():
        masks[name] = np.ones(len(rows), bool)
        for what, index in rows.indices():
            if what == "point":
                masks[name] &= np.isin(index, point).reshape(len(rows), -1).all(axis=1)
    return masks


def _equal_masks(one: RowMasks, other: RowMasks) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in one)


def _suspects(
    at: Adjustment, left: RowMasks, stays: RowMasks, r: RedundancyBlocks, sigma0: float
) -> tuple[Suspect, ...]:
    """Return the rejected rows of kept points, each with its most contradicting component."""
    block, suspects = at.block, []
    for name, rows in block.named_observations.items():
        v = np.atleast_2d(at.residuals[name])
        # Unchecked components have redundancy zero, or less by rounding.
        root = np.sqrt(np.maximum(np.diagonal(r[name], axis1=1, axis2=2).T, UNCHECKED))
        error, sigma = np.atleast_2d(rows.physical(v)), np.atleast_2d(np.asarray(rows.sigmas).T)
        out = np.flatnonzero(left[name] & stays[name])
        worst = np.abs(v[:, out] * root[:, out]).argmax(axis=0)
        words = rows.words_of(worst, out, block.images, block.points)
        for row, k, word in zip(out.tolist(), worst.tolist(), words, strict=True):
            sigma_error = sigma0 * float(sigma[k, row] / root[k, row])
            discrepancy = float(error[k, row])
            suspects.append(Suspect(name, row, k, word, discrepancy / sigma_error, discrepancy, sigma_error, rows.unit))
    return tuple(sorted(suspects, key=lambda out: -abs(out.w)))


# Factor of standard deviations of rejected rows: negligible weight, without loss of digits.
_WEAK = 1000.0


def blunder_statistics(
    at: Adjustment, r: RedundancyBlocks, predicted: bool = False
) -> dict[str, Float[np.ndarray, "_"]]:
    """Return, for each row, sqrt(v' R^-1 v) over the root of its chi-square quantile: above 1 it is a blunder.

    Or sqrt(v' R v), for rejected rows, which the others `predict`. Only directions that the others check count: a point
    of two rays is checked across their epipolar plane, not along it. A prediction hardly checks what is hardly
    determined, but rounding does not enter.
    """
    axes = {name: np.linalg.eigh(matrix) for name, matrix in r.items()}
    least = UNCHECKED if predicted else LEAST_CHECKED
    checked = {name: values > least for name, (values, _) in axes.items()}
    n = sum(int(matrix.any(axis=1).sum()) for matrix in checked.values())
    statistics = {}
    for name, (values, vectors) in axes.items():
        along = np.einsum("nij,in->nj", vectors, np.atleast_2d(at.residuals[name])) ** 2
        scale = np.where(checked[name], values, 1.0)
        squares = np.sum(np.where(checked[name], along * scale if predicted else along / scale, 0.0), axis=1)
        freedom = np.maximum(checked[name].sum(axis=1), 1)
        statistics[name] = np.sqrt(squares / chi_square_limit(freedom, LEVEL / max(n, 1)))
    return statistics


def predicted_redundancy(at: Adjustment, left: RowMasks, sizes: PaddedSizes) -> RedundancyBlocks:
    """Return `redundancy_blocks`, of rejected rows as if each was added to the others, which then predict it."""
    rows = at.block.named_observations
    weak = {name: scale_weights(group, np.where(left[name], _WEAK**-2, 1.0)) for name, group in rows.items()}
    r = redundancy_blocks(linearise(at.block.with_observations(weak), at.unknowns, at.block.priors, sizes))
    for name, out in left.items():
        if out.any():
            values, vectors = np.linalg.eigh(r[name][out])
            # 1 / r = 1 + q, for a prediction of the variance q, relative to the row's own of 1; here that is _WEAK^2.
            values = np.clip(values, 0.0, 1.0)
            values = values / (values + _WEAK**2 * (1 - values))
            r[name] = r[name].copy()
            r[name][out] = (vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2)
    return r
