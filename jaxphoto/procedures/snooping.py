"""Detect and reject blunders: robust initial solution, then iterated data snooping.

1. Adjust the block with Huber weights, iteratively: many blunders mask each other in tests of single observations but
hardly affect a robust estimate. If the result does not fit (very large errors in an image of few points, a file in
other units), restart from another solution (`robust.initial_solutions`).

2. Reject contradicting rows and adjust without them. Then, iteratively: each rejected row is predicted by the others
and reinstated if it agrees; the most significant row of each point is rejected if it contradicts (Baarda's data
snooping). Stop when no row changes.

3. Correct exchanges: two rejected image points of an image, control points or stations, each of which is predicted
where the other was observed. Reinstate points that were rejected while blunders distorted the images, once.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Huber (1981), Robust statistics.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import combinations
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, Adjustment, PaddedSizes, common_sizes, linearise, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, DatumError, JaxphotoError, RankError, counted
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.losses import AbstractLoss
from jaxphoto.observations import AbstractCoordinates, Correlated
from jaxphoto.procedures.adjust import start_of
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
from jaxphoto.statistics import (
    LEAST_CHECKED,
    LEAST_SIGMA0,
    LEVEL,
    UNCHECKED,
    Partition,
    Suspect,
    VarianceComponents,
    blunder_test,
    chi_square_limit,
    covariance,
    global_test,
    partition_observations,
    redundancy_numbers,
    variance_components,
)
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns

_MAX_ITERATIONS = 20
# Maximum number of times the same exchange is tried: other wrong rows of its image may hide it at first.
_TRIES = 3
# Maximum sigma0 of a solution that fits; larger values are not explained by weights (docs/trust.md).
_FITS = 3.0
# Minimum fraction of image points that remain.
_LEAST_LEFT = 0.5
SEVERAL = 4
"""Minimum number of rejected rows of a group that single errors do not explain. `_SINGLE` is the minimum fraction."""
_SINGLE = 1 / 3
# Ratio to the largest normalised residual below which a row is not rejected in the same iteration: blunders inflate
# neighbouring residuals.
_BESIDE_THE_WORST = 0.5
# Maximum ratio of the distance from another object's observation to the distance from the next nearest.
_NEAR = 0.2
# Maximum factor by which a point may be nearer than the nearest, or farther than the farthest, points of the block.
_DEPTH, _ANY_MISCLOSURE = 1.5, 1e6


@pretty_repr
class Exchange(NamedTuple):
    """Rows of a group that exchanged observed values and standard deviations."""

    group: str
    rows: tuple[tuple[int, int], ...]
    words: str
    """Message such as "points 12 and 31 of image A2 had each other's name"."""


@pretty_repr
class Snooped(NamedTuple):
    """Block adjusted without its blunders.

    `left_out` contains the rejected rows of the original block, worst first: they differ by `error` +- `sigma` from the
    prediction by the others. `exchanged` contains the corrected exchanges.
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
    completely: both coordinates of an image point, one coordinate of a control point. With `loss` the search starts
    from that robust adjustment (`jaxphoto.robust`). Raises the errors of `adjust`.

    The search refers residuals to the corrected image: a gross error moves a computed image point far beyond the
    format, where the distortion polynomial, to which residuals of the measured image refer, is meaningless. The result
    is adjusted with the residuals of the block.
    """
    kinds = {name: interior.residuals for name, interior in block.start.unknowns.interior.items()}
    corrected = dict.fromkeys(kinds, "model")
    at = None if start is None else _with_residuals(start, corrected)
    found = _search(_block_with_residuals(block, corrected), at, loss, max_steps, report)
    if kinds == corrected:
        return found
    part, unknowns = _block_with_residuals(found.adjusted.block, kinds), _with_residuals(found.adjusted.unknowns, kinds)
    return found._replace(adjusted=solve(part, unknowns, part.priors, max_steps))


def _with_residuals(unknowns: Unknowns, kinds: Mapping[str, Any]) -> Unknowns:
    interior = {name: dataclasses.replace(one, residuals=kinds[name]) for name, one in unknowns.interior.items()}
    return dataclasses.replace(unknowns, interior=interior)


def _block_with_residuals(block: Block, kinds: Mapping[str, Any]) -> Block:
    start = dataclasses.replace(block.start, unknowns=_with_residuals(block.start.unknowns, kinds))
    return dataclasses.replace(block, start=start, priors=_with_residuals(block.priors, kinds))


def _search(
    block: Block,
    start: Unknowns | None,
    loss: AbstractLoss | None,
    max_steps: int,
    report: Callable[[str], object],
) -> Snooped:
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
        # Unknowns that all observations together cannot determine are reported as in an adjustment.
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
    """Count (rejected, all) rows by group (except image points) and axis, if single errors do not explain them."""
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
    """Count (rejected, all) image points of images if single errors do not explain the number."""
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
    """Return True if `one` fits, has smaller sigma0, and does not reject more rows outside of `out`."""
    of_one, of_other = (sum(not (s.group in out and out[s.group][s.row]) for s in s.left_out) for s in (one, other))
    return _fits(one) and bool(one.adjusted.sigma0 < other.adjusted.sigma0) and of_one <= of_other


def _better(one: Snooped, other: Snooped) -> bool:
    """Return True if `one` is better: fewer rejected rows if both fit, otherwise smaller sigma0."""
    if _fits(one) and _fits(other):
        return len(one.left_out) < len(other.left_out)
    return bool(one.adjusted.sigma0 < other.adjusted.sigma0)


def _snooped(
    block: Block, begun: InitialSolution, max_steps: int, sizes: PaddedSizes, report: Callable[[str], object]
) -> Snooped:
    """Search for blunders from a robust initial solution."""
    at, r, flown = begun
    scale = residual_scales(at, r)
    worst = _largest_per_point(
        block, {name: size / scale[name] for name, size in blunder_statistics(at, r).items()}, 1.0
    )
    left = {name: flown[name] | worst[name] for name in worst}
    tried: list[RowMasks] = []
    done: list[Exchange] = []
    tries, returned = Counter[Exchange](), set[int]()
    while True:
        report(f"adjusting without {counted(sum(int(m.sum()) for m in left.values()), 'observation')}")
        adjusted, point, left = solve_without_diverged(block, left, at.unknowns, max_steps, sizes)
        at = linearise(block, restore_points(adjusted.unknowns, at.unknowns, point), block.priors, sizes)
        sigma0 = max(float(adjusted.sigma0), LEAST_SIGMA0)
        lost = np.setdiff1d(np.arange(len(block.points)), point)
        r = predicted_redundancy(at, left, sizes)
        # Coordinates first: wrong ones distort images, so names appear to be exchanged.
        found = lambda pairs: [e for e in pairs if tries[e] < _TRIES and sigma0 <= _FITS]  # noqa: B023, E731
        if new := found(_coordinate_exchanges(at, left)) or found(_name_exchanges(at, left, lost, sigma0)):
            for exchange in new:
                block, left = _exchanged(block, left, exchange)
            done += new
            tries.update(new)
            # The block has changed: earlier sets of rejections may succeed now.
            tried.clear()
            continue
        rejections = _next_rejections(adjusted, at, left, point, sigma0, r)
        still_there = _equal_masks(rejections, left)
        if not still_there and len(tried) < _MAX_ITERATIONS and not any(_equal_masks(rejections, t) for t in tried):
            tried.append(left)
            left = rejections
        elif wrong := [e for e in done if left[e.group][np.ravel(e.rows)].mean() >= 0.5]:
            for exchange in reversed(wrong):
                out = left
                block, left = _exchanged(block, left, exchange)
                left = left | {exchange.group: left[exchange.group] | out[exchange.group]}
                done.remove(exchange)
            tried.clear()
        elif still_there and len(lost := np.setdiff1d(lost, list(returned))):
            p, points = block.image_points, np.array(to_numpy(at.unknowns.points))
            rows = np.flatnonzero(np.isin(p.point, lost))
            places, valid = _intersect(at, rows, np.searchsorted(lost, p.point[rows]), len(lost), sigma0)
            if not valid.any():
                break
            back = lost[valid]
            returned.update(back.tolist())
            points[back] = places[valid]
            left = left | {p.group: left[p.group] & ~np.isin(p.point, back)}
            at = eqx.tree_at(lambda a: a.unknowns.points, at, points)
            tried.clear()
        else:
            break
    suspects = _suspects(at, left, _rows_of_points(block, point), r, sigma0)
    return Snooped(adjusted, suspects, tuple(done), tuple(block.points[p] for p in lost))


def _name_exchanges(at: Adjustment, left: RowMasks, lost: Int[np.ndarray, "n"], sigma0: float) -> Iterator[Exchange]:
    """Yield pairs of rejected image points of an image that intersect the other rays of each other's point."""
    block, p = at.block, at.block.image_points
    out = left[p.group]
    suspected = np.flatnonzero(out | np.isin(p.point, lost))
    pairs = []
    for image in np.unique(p.image[suspected]):
        in_image = suspected[p.image[suspected] == image].tolist()
        pairs += [(a, b) for a, b in combinations(in_image, 2) if p.point[a] != p.point[b]]
    rays_of: dict[int, list[int]] = {}
    for row in np.flatnonzero(np.isin(p.point, p.point[suspected])).tolist():
        rays_of.setdefault(int(p.point[row]), []).append(row)
    rows: list[int] = []
    which: list[int] = []
    for k, (row, measured) in enumerate(one for a, b in pairs for one in ((a, b), (b, a))):
        others = [other for other in rays_of[int(p.point[row])] if other != row]
        some = [measured, *([other for other in others if not out[other]] or others)]
        rows += some
        which += [k] * len(some)
    _, valid = _intersect(at, np.array(rows, int), np.array(which, int), 2 * len(pairs), sigma0)
    used: set[int] = set()
    for (a, b), both in zip(pairs, (valid[::2] & valid[1::2]).tolist(), strict=True):
        # Two points with two rays each, in the same images: exchange them in one image.
        if both and not used & {int(p.point[a]), int(p.point[b])}:
            used |= {int(p.point[a]), int(p.point[b])}
            names = f"{block.points[p.point[a]]} and {block.points[p.point[b]]}"
            words = f"points {names} of image {block.images[p.image[a]]} had each other's name"
            yield Exchange(p.group, ((a, b),), words)


def _coordinate_exchanges(at: Adjustment, left: RowMasks) -> Iterator[Exchange]:
    """Yield pairs of rejected control points or stations, each of which is predicted where the other was observed."""
    block = at.block
    for group, observed in block.named_observations.items():
        if not isinstance(observed, AbstractCoordinates) or len(observed.indices()) != 1:
            continue
        ((what, who),) = ((what, to_numpy(index)) for what, index in observed.indices())
        value, error = to_numpy(observed.value), np.array(to_numpy(observed.physical(at.residuals[group])))
        suspects = np.unique(who[left[group]])
        if what == "point":
            # Wrong coordinates may stay and reject all rays: intersect these, whatever their misclosure.
            p = block.image_points
            suspects = np.union1d(suspects, np.intersect1d(who, p.point[left[p.group]]))
            rays = np.flatnonzero(np.isin(p.point, suspects))
            which = np.searchsorted(suspects, p.point[rays])
            places, valid = _intersect(at, rays, which, len(suspects), _ANY_MISCLOSURE)
            for k in np.flatnonzero(np.isin(who, suspects[valid])):
                error[k] = value[k] - places[np.searchsorted(suspects, who[k]), observed.axis[k]]
        by_axes: dict[tuple[int, ...], list[np.ndarray]] = {}
        for k in suspects.tolist():
            rows = np.flatnonzero(who == k)
            rows = rows[np.argsort(observed.axis[rows])]
            by_axes.setdefault(tuple(observed.axis[rows].tolist()), []).append(rows)
        for objects in map(np.array, by_axes.values()):
            for a, b in _pairs(value[objects], (value - error)[objects]):
                ids = [int(who[objects[k][0]]) for k in (a, b)]
                one, other = ((block.points if what == "point" else block.images)[k] for k in ids)
                words = (
                    f"control points {one} and {other} had each other's coordinates, or their names are exchanged in "
                    "all images"
                    if what == "point"
                    else f"images {one} and {other} had each other's station, or their image points are exchanged"
                )
                yield Exchange(group, tuple(zip(objects[a].tolist(), objects[b].tolist(), strict=True)), words)


def _pairs(observed: Float[np.ndarray, "n axes"], predicted: Float[np.ndarray, "n axes"]) -> Iterator[tuple[int, int]]:
    """Yield pairs, each predicted near the observation of the other and far from all others."""
    if len(observed) < 2:
        return
    distance = np.abs(predicted[:, None] - observed).max(axis=2)
    nearest, (first, second) = distance.argmin(axis=1), np.sort(distance, axis=1)[:, :2].T
    for k, other in enumerate(nearest.tolist()):
        if k < other and nearest[other] == k and max(first[[k, other]] / second[[k, other]]) < _NEAR:
            yield k, other


def _exchanged(block: Block, left: RowMasks, exchange: Exchange) -> tuple[Block, RowMasks]:
    """Exchange the observations of these rows, and reinstate them."""
    rows = block.named_observations[exchange.group]
    order, out = np.arange(len(rows)), left[exchange.group].copy()
    for pair in exchange.rows:
        order[list(pair)] = pair[::-1]
    out[np.ravel(exchange.rows)] = False
    new, sigma = rows.with_observation(to_numpy(rows.observation)[order]), to_numpy(rows.sigmas)
    new = new.with_sigmas_times(sigma[order] / sigma)
    return block.with_observations({exchange.group: new}), left | {exchange.group: out}


def _intersect(
    at: Adjustment, rows: Int[np.ndarray, "n"], which: Int[np.ndarray, "n"], number: int, sigma0: float
) -> tuple[Float[np.ndarray, "number 3"], Bool[np.ndarray, "number"]]:
    """Intersect rays (m), `which` is the set of each; True for sets that meet at the distance of the block's points."""
    block, exterior = at.block, at.unknowns.exterior
    p, positions = block.image_points, to_numpy(exterior.position)
    camera = np.array(block.image_camera, object)[p.image]
    rays, sigma = np.zeros((len(p), 3)), to_numpy(p.sigma).mean(axis=1)
    for name, interior in at.unknowns.interior.items():
        of_camera = camera == name
        rays[of_camera] = camera_rays(interior, to_numpy(p.xy)[of_camera])
        sigma[of_camera] /= float(interior.c)
    origins, directions = positions[p.image], turn_to_object(to_numpy(exterior.camera_from_object), p.image, rays)
    nearest, farthest = np.quantile(
        np.linalg.norm(to_numpy(at.unknowns.points)[p.point] - origins, axis=1), [0.01, 0.99]
    )
    origins, directions = origins[rows], directions[rows]
    places, valid = intersect_points(origins, directions, which, number)
    towards = places[which] - origins
    far = np.sum(towards * directions, axis=1)
    square = np.sum((towards - far[:, None] * directions) ** 2, axis=1) / (far * sigma[rows]) ** 2
    square[~((far > nearest / _DEPTH) & (far < farthest * _DEPTH))] = np.inf
    limit = sigma0**2 * float(chi_square_limit(np.array(1), LEVEL / len(p)))
    freedom = 2 * np.bincount(which, minlength=number) - 3
    return places, valid & (np.bincount(which, square, number) <= limit * freedom)


def _next_rejections(
    adjusted: Adjustment, at: Adjustment, left: RowMasks, point: np.ndarray, sigma0: float, r: RedundancyBlocks
) -> RowMasks:
    """Return the next rejections. `adjusted` excludes `left`; `at` is the whole block linearised at its solution."""
    stays = _rows_of_points(at.block, point)
    wrong = {name: size > sigma0 for name, size in blunder_statistics(at, r, predicted=True).items()}
    reconsidered = {name: out & (wrong[name] | ~stays[name]) for name, out in left.items()}
    # `adjusted` has no rows of a group that is rejected completely.
    sizes = {name: np.zeros(len(out)) for name, out in left.items()}
    for name, size in blunder_statistics(adjusted, redundancy_blocks(adjusted)).items():
        sizes[name][~left[name] & stays[name]] = size / sigma0
    least = max(1.0, _BESIDE_THE_WORST * max(float(size.max(initial=0.0)) for size in sizes.values()))
    return {name: reconsidered[name] | new for name, new in _largest_per_point(at.block, sizes, least).items()}


def _largest_per_point(block: Block, sizes: dict[str, np.ndarray], limit: float) -> RowMasks:
    """Mark the row with the largest size above `limit` of each point; for rows without point, of each image."""
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
    """Mark the rows whose points are all in `point`."""
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
    """Return the rejected rows of adjusted points, each with its most significant component."""
    block, suspects = at.block, []
    for name, rows in block.named_observations.items():
        v = np.atleast_2d(at.residuals[name])
        # The redundancy of unchecked components is zero, or negative by rounding.
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
    """Return the test statistic of each row: sqrt(v' R^-1 v) over the root of its chi-square quantile; blunders exceed
    1.

    For rejected rows, `predicted` by the others, it uses sqrt(v' R v). Only directions that the other observations
    check are tested: a two-ray point is checked across the epipolar plane, not along it. The limit on the redundancy
    excludes rounding errors.
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
    """Return `redundancy_blocks`; for rejected rows, of the block to which that row alone is added."""
    rows = at.block.named_observations
    weak = {name: scale_weights(group, np.where(left[name], _WEAK**-2, 1.0)) for name, group in rows.items()}
    r = redundancy_blocks(linearise(at.block.with_observations(weak), at.unknowns, at.block.priors, sizes))
    for name, out in left.items():
        if out.any():
            values, vectors = np.linalg.eigh(r[name][out])
            # 1 / r = 1 + q, with q = variance of the prediction / variance of the row. The row's variance is _WEAK^2
            # here, normally 1.
            values = np.clip(values, 0.0, 1.0)
            values = values / (values + _WEAK**2 * (1 - values))
            r[name] = r[name].copy()
            r[name][out] = (vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2)
    return r


# Minimum ratio of the variance to the variance without the contradicting observations (key), by the maximum fraction of
# these (value). Normal errors with too small a stated sigma do not reach it: the ratio is 1.6 without the largest
# tenth, 3.4 without the largest third.
_INFLATION = {4.0: 0.1, 10.0: 1 / 3}


class InflatedComponent(NamedTuple):
    """Variance component inflated by a few observations."""

    label: str
    factor: float
    without: float
    """Variance factor without these observations."""
    words: tuple[str, ...]
    """Labels of the observations, worst first."""


def inflated_components(
    adjusted: Adjustment, components: VarianceComponents, partition: Partition, *, max_steps: int = MAX_STEPS
) -> tuple[InflatedComponent, ...]:
    """Return the components of `adjusted` (weights as stated) that a few blunders inflate.

    A control height with an error of 70 standard deviations raises the component of thirteen heights to 270; no
    observation is then significant. Blunders are detected by `snoop`, and the components re-estimated without them.
    """
    raised = [k for k, factor in enumerate(components.factor) if components.supported[k] and factor > min(_INFLATION)]
    if not raised or not blunder_test(adjusted, redundancy_numbers(adjusted, covariance(adjusted, rows=True))).suspects:
        return ()
    try:
        snooped = snoop(adjusted.block, adjusted.unknowns, max_steps=max_steps)
        clean = variance_components(snooped.adjusted, partition, max_steps=max_steps)
    except JaxphotoError:
        # Most observations are inconsistent in this case.
        return ()
    without = dict(zip(clean.labels, clean.factor.tolist(), strict=True))
    parts = partition_observations(adjusted, partition).part_of
    out = [(s.words, np.atleast_2d(parts[s.group])[:, s.row]) for s in snooped.left_out]
    out += [(e.words, np.atleast_2d(parts[e.group])[:, np.ravel(e.rows)]) for e in snooped.exchanged]
    inflated = []
    for k in raised:
        label, factor = components.labels[k], float(components.factor[k])
        number, words = sum(int((part == k).sum()) for _, part in out), tuple(w for w, part in out if (part == k).any())
        less = factor / without.get(label, factor)
        if any(less > t and 0 < number <= max(1.0, n * components.observations[k]) for t, n in _INFLATION.items()):
            inflated.append(InflatedComponent(label, factor, without[label], words))
    return tuple(inflated)
