"""A network that grows image by image: from two images of the best triplet, the most compatible image next.

1. The two images of the start, its base the unit of length; the points that their rays meet in.
2. Of the images that see nearly most of the points met so far, the one whose pairs agree best on its rotation is
   oriented by two steps (`two_steps`) and then by its points; where that fails it is resected from its points alone.
3. The points that it sees are met anew; each time the network has grown by two fifths, everything is adjusted.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block
from jaxphoto.errors import BlockError, counted
from jaxphoto.initial.averaging import best_triplet
from jaxphoto.initial.resection import refine, resect_ideal
from jaxphoto.procedures.orientation.network import (
    Network,
    empty_network,
    meet,
    meet_some,
    misfits,
    normalised_misfits,
    robust_scale,
    sight_of,
)
from jaxphoto.procedures.orientation.refine import Asked, SelfCalibration, early, refined
from jaxphoto.procedures.orientation.related_pairs import Pair, Report
from jaxphoto.procedures.orientation.two_steps import Placed, two_steps

# Rays at less than this do not make a point; where images see too few points, less will do.
ANGLES = (np.deg2rad(1.5), np.deg2rad(0.4))
# Of the points that an image sees, the part that fits at least.
_FITTING = 0.4
# Rays that miss by more are left out: in robust standard deviations of those that are not, and in a priori ones.
_LIMIT, _LEAST_LIMIT = 5.0, 4.0
_GROWN = 1.4
# Images that tell of their camera: before, points are as wrong as it is, though rays of two images meet in them well.
_TELLING = 3
_NEARLY_MOST = 0.6
# Part of the largest misfit at which a ray counts half when an image is oriented by its points.
_DOUBTFUL = 0.3
# Starts that are tried where one orients less than this part of the images.
_STARTS, _ENOUGH = 4, 0.6


class Grown(NamedTuple):
    """A network that no image can be added to."""

    network: Network
    order: tuple[int, ...]
    """The images as they were added."""
    refused: dict[int, str]
    """Images that are not oriented, and why."""
    angle: float
    """The least angle (rad) at which rays make a point."""


def grown(
    block: Block,
    pairs: Sequence[Pair],
    calibration: SelfCalibration,
    least: int,
    most: float,
    report: Report = lambda text: None,
) -> Grown:
    """The largest network that grows from one of the best starts; each of its images sees `least` points or more.

    Rays that miss their points by more than `most` standard deviations are never used.

    Raises BlockError where no two images begin it.
    """
    best: Grown | None = None
    for pair, third in _starts(pairs):
        found = _grow(_Growth(block, pairs, calibration, least, most, report), pair, third)
        if best is None or len(found.order) > len(best.order):
            best = found
        if len(best.order) >= _ENOUGH * len(block.images):
            break
    if best is None or len(best.order) < 2:
        raise BlockError(
            "no two images see enough points at a wide enough angle to begin with: take photographs from more "
            "different places that overlap by more than half"
        )
    return best


def _starts(pairs: Sequence[Pair]) -> Iterator[tuple[Pair, tuple[int, ...]]]:
    """The pair to begin with and an image to go on with: the best triplet, its pair with the widest rays first.

    Of two orientations that a pair may have, each that the triplet bears out is a start of its own.
    """
    left = list(pairs)
    for _ in range(_STARTS):
        if not left:
            return
        triplet = best_triplet(left)
        among = [p for p in left if triplet is None or {p.first, p.second} <= set(triplet)]
        pair = max((p for p in among if triplet is None or _borne_out(p, among)), key=_worth)
        yield pair, tuple(k for k in triplet or () if k not in (pair.first, pair.second))
        left = [other for other in left if other is not pair]


def _borne_out(pair: Pair, among: Sequence[Pair]) -> bool:
    """Whether the other two pairs of a triplet close with this orientation of `pair`."""
    ends = {pair.first, pair.second}
    return best_triplet([pair, *(other for other in among if {other.first, other.second} != ends)]) is not None


def _worth(pair: Pair) -> float:
    return pair.n * min(pair.angle, np.deg2rad(15.0))


class _Growth:
    """What one start has come to. A working table of one call, not a value: it is filled in place."""

    def __init__(
        self,
        block: Block,
        pairs: Sequence[Pair],
        calibration: SelfCalibration,
        least: int,
        most: float,
        report: Report,
    ) -> None:
        self.block, self.pairs, self.calibration, self.report = block, pairs, calibration, report
        self.least, self.most = least, most
        self.network = empty_network(block)
        self.sight = sight_of(block, self.network.interior)
        self.order: list[int] = []
        self.refused: dict[int, str] = {}
        self.adjusted = 0
        self.angle = ANGLES[0]
        self.limit = most
        self.by_point = np.argsort(self.sight.point, kind="stable")
        self.begins = np.searchsorted(self.sight.point[self.by_point], np.arange(len(block.points) + 1))

    def meet(self) -> None:
        """Points anew, with the limit that follows from those before."""
        self.network = meet(self.sight, self.network, self.limit, self.angle)
        self._limit(normalised_misfits(self.sight, self.network))

    def meet_seen_by(self, image: int) -> None:
        """The points that `image` sees anew: when it joins the network, no others change."""
        point = self.sight.point[self.sight.of_image(image)]
        begin, many = self.begins[point], self.begins[point + 1] - self.begins[point]
        within = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
        rows = self.by_point[np.repeat(begin, many) + within]
        self.network, missed = meet_some(self.sight, self.network, rows, self.limit, self.angle)
        self._limit(missed)

    def _limit(self, missed: Float[np.ndarray, " used"]) -> None:
        if self.adjusted >= _TELLING:
            self.limit = min(max(_LEAST_LIMIT, _LIMIT * robust_scale(missed)), self.most)

    def add(self, image: int, position: np.ndarray, matrix: np.ndarray) -> bool:
        """Orient `image`; False, and nothing changed, where it then sees too few points."""
        before = self.network
        self.network = before.with_image(image, position, matrix)
        self.meet_seen_by(image)
        if len(self.order) >= 1 and self.network.used[self.sight.of_image(image)].sum() < self.least:
            self.network = before
            return False
        self.order.append(image)
        self.refused.pop(image, None)
        return True

    def adjust(self) -> None:
        """All that is oriented, and points by what it gives."""
        self.report(f"adjusting {len(self.order)} images")
        estimated = early(self.calibration) if len(self.order) >= _TELLING else Asked({}, {})
        self.network, _ = refined(self.block, self.network, self.calibration, estimated, growing=True)
        self.sight = sight_of(self.block, self.network.interior)
        self.adjusted = len(self.order)
        self.meet()
        # Once more with the limit that follows from the camera as it is known now.
        self.meet()

    def seen(self) -> Int[np.ndarray, " images"]:
        """How many points that are met each image sees."""
        rows = self.network.met(self.sight)[self.sight.point]
        return np.bincount(self.sight.image[rows], minlength=len(self.block.images))

    def known(self, image: int) -> Int[np.ndarray, " n"]:
        """The rows of `image` whose points are met."""
        rows = self.sight.of_image(image)
        return rows[self.network.met(self.sight)[self.sight.point[rows]]]


def _grow(growth: "_Growth", pair: Pair, third: tuple[int, ...]) -> Grown:
    first, second = pair.first, pair.second
    _, matrix, base = pair.of(first)
    growth.add(first, np.zeros(3), np.eye(3))
    if not growth.add(second, base, matrix):
        return Grown(growth.network, (), {}, growth.angle)
    for image in third:
        _orient_next(growth, [image])
    n = len(growth.block.images)
    while len(growth.order) < n:
        count = growth.seen()
        waiting = [i for i in range(n) if not growth.network.oriented[i] and i not in growth.refused]
        ready = [i for i in waiting if count[i] >= growth.least]
        if not ready:
            if not _try_again(growth):
                break
            continue
        most = max(count[i] for i in ready)
        _orient_next(growth, [i for i in ready if count[i] >= _NEARLY_MOST * most])
        if len(growth.order) >= max(_TELLING, _GROWN * growth.adjusted):
            growth.adjust()
    if growth.adjusted < len(growth.order):
        growth.adjust()
    count = growth.seen()
    paired = {image for pair in growth.pairs for image in (pair.first, pair.second)}
    for i in np.flatnonzero(~growth.network.oriented).tolist():
        few = f"it sees {counted(int(count[i]), 'point')} of the others, and {growth.least} are needed"
        growth.refused.setdefault(i, few if i in paired else "no other image has a relative orientation to it")
    return Grown(growth.network, tuple(growth.order), growth.refused, growth.angle)


def _try_again(growth: _Growth) -> bool:
    """After an adjustment, or with narrower rays, images may be oriented that were not; False where all was tried."""
    if growth.adjusted < len(growth.order):
        growth.adjust()
    elif growth.angle != ANGLES[1]:
        growth.angle = ANGLES[1]
        growth.meet()
    else:
        return False
    growth.refused.clear()
    return True


def _orient_next(growth: _Growth, images: Sequence[int]) -> None:
    """Orient the one of `images` whose pairs agree best on its rotation, or refuse it."""
    placed = {i: two_steps(i, growth.pairs, growth.network, growth.sight) for i in images}
    image = min(images, key=lambda i: np.inf if placed[i] is None else placed[i].spread)  # type: ignore[union-attr]
    rows, of_pairs = growth.known(image), placed[image]
    if len(rows) < growth.least:
        growth.refused[image] = f"it sees {counted(len(rows), 'point')} of the others, and {growth.least} are needed"
        return
    growth.report(f"orienting image {len(growth.order) + 1} of {len(growth.block.images)}")
    fitting = 0.0
    for position, matrix in _by_points(growth, image, rows, of_pairs):
        trial = growth.network.with_image(image, position, matrix)
        fitting = float(np.mean(misfits(growth.sight, trial, rows) <= growth.most))
        if fitting >= _FITTING and growth.add(image, position, matrix):
            return
    growth.refused[image] = f"only {fitting:.0%} of the {len(rows)} points it shares with others fit one orientation"


def _by_points(
    growth: _Growth, image: int, rows: Int[np.ndarray, " n"], placed: Placed | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The orientation of `image` by the points of its `rows`, from where its pairs place it, then from nothing."""
    sight, points = growth.sight, growth.network.points[growth.sight.point[rows]]
    c, ideal = float(sight.c_mm[rows[0]]), sight.ideal[rows]
    if placed is not None:
        origin = points.mean(axis=0)
        start = (placed.position - origin)[None], placed.camera_from_object[None]
        # Rays off by more count less and less.
        limit = _DOUBTFUL * growth.most * float(np.median(sight.sigma[rows]))
        refined_image = refine(c, ideal, points - origin, *start, limit)
        yield refined_image.positions[0] + origin, refined_image.matrices[0]
    try:
        found = resect_ideal(c, ideal, points, growth.block.images[image])
    except BlockError:
        return
    yield np.asarray(found.position), np.asarray(found.camera_from_object)
