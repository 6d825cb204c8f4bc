"""Adjusting again and again with lidar observations that follow from the result, until nothing changes."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Start
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError, DatumError, RankError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.statistics import LEAST_CHECKED, Covariance, angle_differences, covariance, redundancy_numbers
from jaxphoto.unknowns import FIXED, Unknowns

MAX_ROUNDS = 20
STILL = 0.1
"""Nothing changes any more where no unknown moves by more than this part of its standard deviation.

Less may never come: with each move some laser point becomes a neighbour, and another ceases to be one.
"""
# A point farther from the surface, in standard deviations, is no point of it; it is tried again in the next round.
_OUTLIER = 4.0
# In one round only those are left out that are so near to the largest.
_LARGEST = 0.5
# After this round, because before it the orientation may be far off; and after that one with a last word.
_JUDGED, _SETTLED = 2, 5
# Observations that differ by less, in standard deviations, are the same; after so many rounds nobody looks again.
_SAME, _LAST_LOOK = 0.5, 8
# Part of the height over the cloud by which points may miss it at first: what a principal distance may be off by.
_FAR = 0.1
# Part of the observations that must fit at the end.
_BORNE_OUT = 0.7
# Part by which a principal distance seldom is off that of the laboratory.
_UNUSUAL = 0.02


class Round(NamedTuple):
    """One adjustment, and what it changed."""

    number: int
    observed: int
    """Observations of the lidar."""
    left_out: int
    """Those that are too far off all others."""
    moved_m: float
    """Root mean square move of the object points since the adjustment before."""
    largest_change: float
    """Of interior and exterior orientation since then, in standard deviations."""
    rmse_m: float
    """Of the distances between the points observed and the surface, after the adjustment."""


class SeenByCloud(NamedTuple):
    """What a cloud says of points: one row for each that it may observe, in an order that stays from round to round."""

    point: Int[np.ndarray, "rows"]
    foot: Float[np.ndarray, "rows 3"]
    normal: Float[np.ndarray, "rows 3"]
    sigma: Float[np.ndarray, "rows"]
    """Of the surface along its normal (m)."""
    usable: Bool[np.ndarray, "rows"]

    def apart(self, adjusted: Adjustment) -> Float[np.ndarray, "rows"]:
        """By how much the adjusted points lie above the surface, along its normal (m)."""
        points = np.asarray(adjusted.unknowns.points)[self.point]
        return np.einsum("nk,nk->n", self.normal, points - self.foot)


class Observed(NamedTuple):
    """The last of the rounds: its adjustment, what the cloud said, and which of it was used."""

    before: SeenByCloud
    """What the cloud said at first."""
    adjusted: Adjustment
    covariance: Covariance
    seen: SeenByCloud
    used: Bool[np.ndarray, "rows"]
    rounds: tuple[Round, ...]
    still: bool
    """Whether nothing changed any more."""


Look = Callable[[Adjustment], SeenByCloud]
Carry = Callable[[SeenByCloud, Adjustment, Adjustment], SeenByCloud]
Build = Callable[[Adjustment, Covariance, SeenByCloud, Bool[np.ndarray, "rows"]], Block]


def with_interior_held(block: Block) -> Adjustment:
    """`block` adjusted with the interior orientation held: where its points lie, as far as it knows by itself.

    Where its datum is open or nearly so, as that of a strip whose stations lie on a line, exterior orientation is held
    as it begins, from direct georeferencing: what the cloud adds may close the datum. Raises as `adjust`, and
    BlockError where it does not converge.
    """
    held = interior_held(block).priors
    try:
        found = adjust(block, priors=held)
        placed = bool(found.converged)
    except (DatumError, RankError):
        placed = False
    if not placed:
        exterior = ExteriorOrientation(FIXED, FIXED)  # type: ignore[arg-type]
        found = adjust(block, priors=dataclasses.replace(held, exterior=exterior))
    if not bool(found.converged):
        raise BlockError(f"the block by itself, its interior orientation held, is {found.outcome.value}")
    return found


def interior_held(block: Block) -> Block:
    """`block` whose interior orientation is right."""
    interior = jax.tree.map(lambda _: FIXED, block.start.unknowns.interior)
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))


def check_without_surfaces(block: Block) -> None:
    """Raise BlockError for a block with observations that are about to be made."""
    if len(block.surfaces.point) or block.start.unknowns.scanner is not None:
        raise BlockError(
            "the block has points on the surfaces of a laser scanner already: take the block as it was before, without "
            "surfaces.csv and [scanner]"
        )


def with_common_error(
    sigma: Float[np.ndarray, "rows"], usable: Bool[np.ndarray, "rows"], common_m: float
) -> Float[np.ndarray, "rows"]:
    """Standard deviations whose mean over n rows keeps an error that all have in common: sigma^2 + (n - 1) common^2.

    `sigma` contains the common error once. An adjustment takes its observations for independent, and would average it.
    """
    return np.sqrt(sigma**2 + max(int(usable.sum()) - 1, 0) * common_m**2)


def until_still(
    first: Adjustment,
    look: Look,
    build: Build,
    max_rounds: int,
    report: Callable[[Round], None],
    group: Literal["control_points", "surfaces"],
    carry: Carry = lambda seen, before, now: seen,
) -> Observed:
    """`look` at the cloud, `build` a block with what it says, adjust; from `first` on, until nothing changes.

    Each block is adjusted from the unknowns that `build` gives it. Towards the end an observation stays the one it was
    where the cloud, looked at again, says nearly the same, and then in any case: else a laser point could become a
    neighbour, cease to be one with the move that this makes, and so on for ever. `carry` brings an earlier observation
    from the cloud as corrected before to that of now. The observations are the last rows of their `group`.

    Raises BlockError where the cloud does not lie where the points are.
    """
    adjusted, known, fits = first, covariance(first), np.array(True)
    before, at_first = first, look(first)
    seen = at_first
    _check_heights(first, seen)
    rounds: list[Round] = []
    while True:
        used = seen.usable & fits
        block = build(adjusted, known, seen, used)
        new = adjust(block, block.start.unknowns)
        now = covariance(new)
        moved = np.asarray(new.unknowns.points) - np.asarray(adjusted.unknowns.points)
        change = _change(adjusted, new, now)
        apart = seen.apart(new)[used]
        rounds.append(
            Round(
                len(rounds) + 1,
                int(used.sum()),
                int((seen.usable & ~used).sum()),
                float(np.sqrt((moved**2).sum(axis=1).mean())),
                change,
                float(np.sqrt((apart**2).mean())) if len(apart) else np.nan,
            )
        )
        report(rounds[-1])
        before, adjusted, known = adjusted, new, now
        still = len(rounds) > _JUDGED and change < STILL and bool(new.converged)
        if still or len(rounds) >= max_rounds:
            _check_used(seen, used)
            _warn_of_scale(first, new)
            return Observed(at_first, adjusted, known, seen, used, tuple(rounds), still)
        if len(rounds) >= _JUDGED:
            # Towards the end what was left out stays so: some observation might come and go for ever.
            fits = _fit(seen, adjusted, known, used, group) & (fits if len(rounds) >= _SETTLED else True)
        if len(rounds) < _SETTLED:
            seen = look(adjusted)
            continue
        seen = carry(seen, before, adjusted)
        if len(rounds) < _LAST_LOOK:
            seen = _kept(seen, look(adjusted), adjusted)


def at_result(block: Block, unknowns: Unknowns) -> Block:
    """`block` with an adjustment's unknowns for its start."""
    known = Start(unknowns, np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    return dataclasses.replace(block, start=known)


def _check_heights(first: Adjustment, seen: SeenByCloud) -> None:
    """Raise BlockError where the cloud is as far from the points as no principal distance explains."""
    apart = seen.apart(first)[seen.usable]
    camera = float(np.mean(np.asarray(first.unknowns.exterior.position)[:, 2]))
    off, height = (float(np.median(v)) for v in (apart, camera - seen.foot[seen.usable, 2]))
    if abs(off) > _FAR * abs(height):
        raise BlockError(
            f"the cloud lies {abs(off):.0f} m {'below' if off > 0 else 'above'} where the block puts its points, with "
            f"the cameras {height:.0f} m over the cloud: its heights may count in feet or belong to another vertical "
            "system, or the principal distance that the block begins with is wrong"
        )


def _check_used(seen: SeenByCloud, used: Bool[np.ndarray, "rows"]) -> None:
    """Raise BlockError where the block contradicts what the cloud says of most points."""
    n, most = int(used.sum()), int(seen.usable.sum())
    if n < max(1.0, _BORNE_OUT * most):
        raise BlockError(
            f"the block bears out only {n} of {most} observations of the cloud: check that cloud and block are in one "
            "system, that the stated standard deviations are true, and that the block adjusts well without the cloud"
        )


def _warn_of_scale(first: Adjustment, found: Adjustment) -> None:
    """A UserWarning where the heights want another principal distance than any laboratory would have missed."""
    for name, interior in found.unknowns.interior.items():
        before, after = float(first.unknowns.interior[name].c), float(interior.c)
        if abs(after - before) > _UNUSUAL * abs(before):
            warnings.warn(
                f"the principal distance of {name} became {after:.3f} mm from {before:.3f} mm, which is much: heights "
                "of another vertical system than that of the stations would do this",
                UserWarning,
                stacklevel=4,
            )


def _kept(old: SeenByCloud, new: SeenByCloud, adjusted: Adjustment) -> SeenByCloud:
    """The old observations where the new ones hardly differ from them."""
    same = np.abs(old.apart(adjusted) - new.apart(adjusted)) < _SAME * new.sigma
    chosen = (np.where(same[:, None] if v.ndim > 1 else same, u, v) for u, v in zip(old[1:], new[1:], strict=True))
    return SeenByCloud(new.point, *chosen)


def _fit(
    seen: SeenByCloud, adjusted: Adjustment, known: Covariance, used: Bool[np.ndarray, "rows"], group: str
) -> Bool[np.ndarray, "rows"]:
    """Which observations the others bear out."""
    # Those used, by their normalised residuals: the lidar's are the last of their group.
    numbers, residuals = redundancy_numbers(adjusted, known), adjusted.residuals
    # A group without rows has no residuals.
    none = np.zeros(0)
    v, r = (np.asarray(of.named.get(group, none)) for of in (residuals, numbers))
    v, r = (of_group[len(of_group) - int(used.sum()) :] for of_group in (v, r))
    # The others against where all others put their points.
    points = np.einsum("ni,nij,nj->n", seen.normal, np.asarray(known.points)[seen.point], seen.normal)
    w = np.where(seen.usable, np.abs(seen.apart(adjusted)) / np.sqrt(seen.sigma**2 + points), 0.0)
    w[used] = np.abs(v) / np.sqrt(np.maximum(r, LEAST_CHECKED))
    # The largest first: they spoil the others.
    limit = _OUTLIER * max(1.0, float(adjusted.sigma0))
    return w <= max(limit, _LARGEST * w.max(initial=0.0))


def _change(old: Adjustment, new: Adjustment, known: Covariance) -> float:
    """The largest change of a free interior or exterior orientation, in standard deviations."""
    if old.structure.labels != new.structure.labels:
        return np.inf
    sigma = np.sqrt(np.maximum(np.asarray(known.matrix).diagonal(), 0.0))
    moved = np.asarray(new.unknowns.exterior.position) - np.asarray(old.unknowns.exterior.position)
    exterior = np.column_stack([moved, angle_differences(new, old)[1]]).ravel()
    free = new.structure.free
    shared = np.asarray(new.values.shared)[free] - np.asarray(old.values.shared)[free]
    known_at_all = sigma > 0
    change = np.abs(np.concatenate([exterior, shared]))
    return float(np.max(change[known_at_all] / sigma[known_at_all], initial=0.0))
