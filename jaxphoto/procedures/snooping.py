"""Blunders found and left out: a robust start, then tests until nothing changes.

1. The block is adjusted with weights that fall with the residual (Huber), again and again: many blunders hide one
   another from the test of a single one, but hardly move such an estimate. Where that leads to nothing that fits
   (enormous errors in an image of few points; a file in other units), it begins elsewhere (`beginnings`).
2. What contradicts it is left out, and the block adjusted without it. Then, in turns: each observation left out is
   predicted by the others and put back where the prediction agrees; of those that are in, the worst of each point is
   left out where it contradicts the others (Baarda's data snooping). Until nothing changes.
3. Control points or stations that have one another's coordinates, and two image points of one image that have each
   other's name, get them back.
4. At the end, points that went while blunders still turned the images are put back where their rays meet after all.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Huber (1981), Robust statistics.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto.adjustment import MAX_STEPS, Adjustment, PaddedSizes, common_sizes, linearise, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, DatumError, JaxphotoError, RankError, counted
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.losses import AbstractLoss
from jaxphoto.observations import Correlated
from jaxphoto.procedures.adjust import start_of
from jaxphoto.procedures.beginnings import Begun, beginnings, without_what_is_alike
from jaxphoto.procedures.contradictions import predicted_parts, row_sizes
from jaxphoto.procedures.exchange import Exchange, exchanged, with_places, with_what_rests_on_them
from jaxphoto.procedures.exchanged_coordinates import as_one, coordinate_exchanges
from jaxphoto.procedures.exchanged_names import name_exchanges, points_that_meet, put_back
from jaxphoto.procedures.robust import Blocks, Masks, all_points, checked_parts, residual_scales, solve_placed
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import (
    LEAST_SIGMA0,
    LEVEL,
    UNCHECKED,
    Suspect,
    global_test,
)
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns

_ROUNDS = 20
# Where the others agree no better than this, weights do not explain it (docs/trust.md), and there is another beginning.
_FITS = 3.0
# Of all image points, what must be left: most of them are not wrong.
_LEAST_LEFT = 0.5
SEVERAL = 4
"""So many are no chance; and more of a group than `_SINGLE` no single errors."""
_SINGLE = 1 / 3
# A blunder inflates the residuals around it: in one turn nothing goes that is less than this part of the worst.
_BESIDE_THE_WORST = 0.5


@pretty_repr
class Snooped(NamedTuple):
    """A block without its blunders, adjusted; what was left out, the worst first; what was put right.

    `left_out` are rows of the block as given: the others contradict them by `error` +- `sigma`.
    """

    adjusted: Adjustment
    left_out: tuple[Suspect, ...]
    exchanged: tuple[Exchange, ...]
    points: tuple[str, ...]
    """Those that went because too little was left of them."""


@outside_transformations
def snoop(
    block: Block,
    start: Unknowns | None = None,
    *,
    loss: AbstractLoss | None = None,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> Snooped:
    """Adjust `block` without the observations that contradict the others.

    All observations are tested, image points, control, stations and every further kind, but not priors. A row goes as a
    whole: both coordinates of an image point, one coordinate of a control point. With `loss` it begins with the robust
    adjustment that this means (`jaxphoto.robust`). Raises what `adjust` raises.
    """
    sizes = common_sizes([block])
    found: Snooped | None = None
    failed: list[JaxphotoError] = []

    def from_there(begin: Callable[[], Begun]) -> Snooped | None:
        try:
            new = _snooped(block, begin(), max_steps, sizes, report)
            left, number = len(new.adjusted.block.image_points), len(block.image_points)
            if left < _LEAST_LEFT * number:
                raise BlockError(f"{left} of {number} image points are left")
        except (DatumError, RankError, BlockError) as error:
            failed.append(error)
            return None
        return new

    for begin in beginnings(block, start, loss, max_steps, sizes, report):
        new = from_there(begin)
        found = new if new is not None and (found is None or _better(new, found)) else found
        if found is not None and _fits(found) and not mostly_out(found, block) and not images_out(found, block):
            break
    if found is None:
        # What the block cannot tell with all of its observations either, is said as ever.
        solve(block, start_of(block, report) if start is None else start, block.priors, max_steps, sizes)
        raise BlockError(
            "so much contradicts the other observations that without it too little is left to adjust: look at names, "
            f"units, axes and the order of rows (an adjustment of all says more). What ended the search: {failed[0]}"
        ) from failed[0]
    if global_test(found.adjusted).p_value < LEVEL:
        for out, begin in without_what_is_alike(block, start, found.adjusted, max_steps, sizes, report):
            if (new := from_there(begin)) is not None and _fits_more(new, found, out):
                found = new
    return found


def mostly_out(snooped: Snooped, block: Block) -> dict[str, dict[str, tuple[int, int]]]:
    """By group besides image points, and axis, how many of all, where more are left out than single errors explain."""
    found: dict[str, dict[str, tuple[int, int]]] = {}
    for name, rows in block.named_observations.items():
        left = [s for s in snooped.left_out if s.group == name]
        if name == IMAGE_POINTS or isinstance(rows, Correlated) or len(left) < SEVERAL:
            continue
        axes = rows.axis_of_numbers
        lost = np.isin(np.arange(len(rows)), [s.row for s in left])
        counted = {a: (int(((axes == a) & lost).sum()), int((axes == a).sum())) for a in dict.fromkeys(axes.flat)}
        if many := {a: (n, of) for a, (n, of) in counted.items() if n >= SEVERAL and n > _SINGLE * of}:
            found[name] = many
    return found


def images_out(snooped: Snooped, block: Block) -> dict[int, tuple[int, int]]:
    """By image of which more image points are left out than single errors explain, how many of all."""
    rows = block.image_points
    out = np.isin(np.array(block.points, object)[rows.point], snooped.points)
    out[[s.row for s in snooped.left_out if s.group == rows.group]] = True
    seen, gone = (np.bincount(rows.image[k], minlength=len(block.images)) for k in (np.s_[:], out))
    return {k: (int(gone[k]), int(seen[k])) for k in np.flatnonzero((gone >= SEVERAL) & (gone > seen / 2)).tolist()}


def _fits(found: Snooped) -> bool:
    adjusted = found.adjusted
    agrees = bool(adjusted.converged) and float(adjusted.sigma0) <= _FITS
    return agrees and not len(looking_away(adjusted.block, in_front(adjusted.block, adjusted.unknowns)))


def _fits_more(one: Snooped, other: Snooped, out: Masks) -> bool:
    """Whether it fits, better, and leaves out no more of what is not `out` anyhow."""
    of_one, of_other = (sum(not (s.group in out and out[s.group][s.row]) for s in s.left_out) for s in (one, other))
    return _fits(one) and bool(one.adjusted.sigma0 < other.adjusted.sigma0) and of_one <= of_other


def _better(one: Snooped, other: Snooped) -> bool:
    """Whether it fits, and the other does not or leaves more out; or where neither does, fits less badly."""
    if _fits(one) and _fits(other):
        return len(one.left_out) < len(other.left_out)
    return bool(one.adjusted.sigma0 < other.adjusted.sigma0)


def _snooped(
    block: Block, begun: Begun, max_steps: int, sizes: PaddedSizes, report: Callable[[str], object]
) -> Snooped:
    """From where a robust adjustment has led."""
    at, r, flown = begun
    scale = residual_scales(at, r)
    worst = _worst(block, {name: size / scale[name] for name, size in row_sizes(at, r).items()}, 1.0)
    left = {name: flown[name] | worst[name] for name in worst}
    tried: list[Masks] = []
    # Before anything is left out: wrong coordinates turn images, and sound rows go with them.
    lost = np.unique(block.image_points.point[flown[block.image_points.group]])
    done, at = coordinate_exchanges(at, left, lost, sizes)
    for exchange in done:
        block, left = exchanged(block, left, exchange)
    # What is exchanged twice is as it was, and what went twice would go again.
    known = {(e.group, e.rows) for e in done}
    returned, again = set[int](), set[tuple]()
    while True:
        report(f"adjusting without {counted(sum(int(m.sum()) for m in left.values()), 'observation')}")
        adjusted, point, left = solve_placed(block, left, at.unknowns, max_steps, sizes)
        at = linearise(block, all_points(adjusted.unknowns, at.unknowns, point), block.priors, sizes)
        sigma0 = max(float(adjusted.sigma0), LEAST_SIGMA0)
        lost = np.setdiff1d(np.arange(len(block.points)), point)
        r = predicted_parts(at, left, sizes)
        new, placed = _exchanges(at, left, lost, sigma0, r, sizes, known)
        for exchange in new:
            (block, left), at = exchanged(block, left, exchange), placed
            done.append(exchange)
        if new:
            # Another block: what led nowhere in the old one may lead on.
            tried.clear()
            continue
        found = _tested(adjusted, at, left, point, sigma0, r)
        still_there = _same(found, left)
        if still_there or len(tried) == _ROUNDS or any(_same(found, old) for old in tried):
            # What does not fit although it was exchanged, or fits as well as it was given, gets its own back. Where
            # nothing fits all do, whoever is to blame, and may be exchanged once more.
            fits = bool(adjusted.converged) and sigma0 <= _FITS
            wrong = [not fits or not _needed(at, left, e, sigma0) for e in done]
            if undone := with_what_rests_on_them(done, wrong):
                for exchange in reversed(undone):
                    block, left = exchanged(block, left, exchange.undone)
                    done.remove(exchange)
                went = set() if fits else {(e.group, e.rows) for e in undone}
                known, again = known - (went - again), again | went
                tried.clear()
                continue
            # What went while blunders still turned the images.
            back = {p: place for p, place in points_that_meet(at, left, lost, sigma0).items() if p not in returned}
            if not still_there or not back:
                break
            returned |= set(back)
            left, at = put_back(block, left, back), with_places(at, back)
            tried.clear()
            continue
        tried.append(left)
        left = found
    told = _told(at, left, _stays(block, point), r, sigma0)
    return Snooped(adjusted, told, tuple(as_one(block, done, left)), tuple(block.points[p] for p in lost))


def _exchanges(
    at: Adjustment, left: Masks, lost: np.ndarray, sigma0: float, r: Blocks, sizes: PaddedSizes, known: set
) -> tuple[list[Exchange], Adjustment]:
    """Exchanges that are not `known`, and are from now on; and `at` with what they are of where it is seen.

    Of coordinates first: wrong ones turn images, in which names then seem exchanged.
    """
    for find in (
        lambda: coordinate_exchanges(at, left, lost, sizes),
        lambda: name_exchanges(at, left, lost, sigma0, r),
    ):
        pairs, placed = find()
        if new := [e for e in pairs if (e.group, e.rows) not in known]:
            known.update((e.group, e.rows) for e in new)
            return new, placed
    return [], at


def _needed(at: Adjustment, left: Masks, exchange: Exchange, sigma0: float) -> bool:
    """Whether what was exchanged fits, and would not as it was given."""
    p, rows = at.block.image_points, np.setdiff1d(np.ravel(exchange.rows), exchange.out)
    if left[exchange.group][rows].mean() >= 0.5:
        return False
    if exchange.group != p.group:
        return True
    block, _ = exchanged(at.block, left, exchange.undone)
    points = np.unique(p.point[rows])
    given = eqx.tree_at(lambda a: a.block, at, block)
    return len(points_that_meet(given, left, points, sigma0)) < len(points)


def _tested(adjusted: Adjustment, at: Adjustment, left: Masks, point: np.ndarray, sigma0: float, r: Blocks) -> Masks:
    """What is to be left out next: `adjusted` is without `left`, `at` the whole block linearised there."""
    stays = _stays(at.block, point)
    wrong = {name: size > sigma0 for name, size in row_sizes(at, r, predicted=True).items()}
    found = {name: out & (wrong[name] | ~stays[name]) for name, out in left.items()}
    # Of a group all of whose rows are out, `adjusted` has nothing.
    sizes = {name: np.zeros(len(out)) for name, out in left.items()}
    for name, size in row_sizes(adjusted, checked_parts(adjusted)).items():
        sizes[name][~left[name] & stays[name]] = size / sigma0
    least = max(1.0, _BESIDE_THE_WORST * max(float(size.max(initial=0.0)) for size in sizes.values()))
    return {name: found[name] | new for name, new in _worst(at.block, sizes, least).items()}


def _worst(block: Block, sizes: dict[str, np.ndarray], limit: float) -> Masks:
    """Of the rows whose size is above `limit`, the largest of each point; of those that touch none, of each image."""
    groups = block.named_observations
    worst: dict[object, tuple[float, str, int]] = {}
    for name, rows in groups.items():
        for row in np.flatnonzero(sizes[name] > limit).tolist():
            touched = {what: np.ravel(index[row])[0] for what, index in reversed(rows.indices())}
            what = "point" if "point" in touched else next(iter(touched), "")
            place, size = (what, touched.get(what)), float(sizes[name][row])
            worst[place] = max(worst.get(place, (0.0, "", 0)), (size, name, row))
    found = {name: np.zeros(len(rows), bool) for name, rows in groups.items()}
    for _, name, row in worst.values():
        found[name][row] = True
    return found


def _stays(block: Block, point: np.ndarray) -> Masks:
    """Which rows touch no point that is gone."""
    found = {}
    for name, rows in block.named_observations.items():
        found[name] = np.ones(len(rows), bool)
        for what, index in rows.indices():
            if what == "point":
                found[name] &= np.isin(index, point).reshape(len(rows), -1).all(axis=1)
    return found


def _same(one: Masks, other: Masks) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in one)


def _told(at: Adjustment, left: Masks, stays: Masks, r: Blocks, sigma0: float) -> tuple[Suspect, ...]:
    """The rows left out of points that stay, with the number of each that contradicts most."""
    block, found = at.block, []
    for name, rows in block.named_observations.items():
        v = np.atleast_2d(at.residuals[name])
        # What nothing checks has none, and by rounding less than none.
        own = np.sqrt(np.maximum(np.diagonal(r[name], axis1=1, axis2=2).T, UNCHECKED))
        error, sigma = np.atleast_2d(rows.physical(v)), np.atleast_2d(np.asarray(rows.sigmas).T)
        out = np.flatnonzero(left[name] & stays[name])
        worst = np.abs(v[:, out] * own[:, out]).argmax(axis=0)
        words = rows.words_of(worst, out, block.images, block.points)
        for row, k, word in zip(out.tolist(), worst.tolist(), words, strict=True):
            known = sigma0 * float(sigma[k, row] / own[k, row])
            off = float(error[k, row])
            found.append(Suspect(name, row, k, word, off / known, off, known, rows.unit))
    return tuple(sorted(found, key=lambda out: -abs(out.w)))
