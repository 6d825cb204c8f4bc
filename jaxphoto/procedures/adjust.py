"""The main job: complete the start values of a block and adjust it."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence

import numpy as np

from jaxphoto.adjustment import LEAST, MAX_STEPS, Adjustment, Outcome, Sizes, solve
from jaxphoto.block import Block, sensor_rows
from jaxphoto.errors import BlockError, DatumError, RankError
from jaxphoto.observations import AbstractObservations, KnownParameters
from jaxphoto.orientation import approximate
from jaxphoto.orientation.approximate import PointsBehind, completed
from jaxphoto.procedures.orientation import orient_block
from jaxphoto.procedures.orientation.network import empty_network, misfits, sight_of
from jaxphoto.statistics import prepare_statistics
from jaxphoto.unknowns import FREE, Unknowns

# A sigma naught that neither blunders nor weights explain: the place is wrong.
_ABSURD = 30.0
# Rays that miss by more (rad) are off by more than lenses distort.
_NEAR = 0.02


def adjust(
    block: Block,
    start: Unknowns | None = None,
    priors: Unknowns | None = None,
    *,
    more: Sequence[AbstractObservations | KnownParameters] = (),
    max_steps: int = MAX_STEPS,
    sizes: Sizes = LEAST,
) -> Adjustment:
    """Self-calibrating bundle adjustment of `block`.

    `start` gives every unknown an approximate value; where it is None, those of the block are completed by resection
    and intersection, and where these do not reach all images, or lead nowhere, found from image points alone and
    brought to the frame of what is known (docs/orient.md). `priors` says what is FREE, FIXED or Weighted; where it is
    None, what the block says. `more` are observations of any kind, those of your own among them (docs/extending.md),
    and parameters known beforehand together: they are added to `block.more`, so that the block of the result has them.

    What is compiled for a block serves all of similar size; a study of many blocks compiles once if it gives `sizes`
    that all fit into (`common_sizes`).

    With `start` given it is a pure function of the numbers in its arguments: `jax.grad` and `jax.vmap` go through it.

    Raises BlockError where no approximate values can be found, DatumError where position, orientation or scale are left
    open, RankError where the observations cannot tell unknowns apart. A solve that does not converge is no error: see
    `Adjustment.outcome`.
    """
    if more:
        block = dataclasses.replace(block, more=(*block.more, *more))
    priors = block.priors if priors is None else priors
    if start is not None:
        return solve(block, start, priors, max_steps, sizes)
    return _from_the_best_start(block, priors, lambda start: solve(block, start, priors, max_steps, sizes), max_steps)


def adjust_for_tables(block: Block, max_steps: int = MAX_STEPS) -> Adjustment:
    """`adjust`, with what tables and report will want compiled meanwhile."""
    from_start = lambda start: solve(block, start, block.priors, max_steps, meanwhile=prepare_statistics)  # noqa: E731
    return _from_the_best_start(block, block.priors, from_start, max_steps)


def _from_the_best_start(
    block: Block, priors: Unknowns, from_start: Callable[[Unknowns], Adjustment], max_steps: int
) -> Adjustment:
    """The adjustment from the approximate values that are given; or, where these lead nowhere, from image points alone.

    Warns where the second is the better one.
    """
    first, refused = None, None
    try:
        first = from_start(start_of(block))
    except PointsBehind as error:
        refused = error
    # What is known of exterior orientations is not to be looked for elsewhere.
    free = priors.exterior.position is FREE and priors.exterior.camera_from_object is FREE
    elsewhere = free and np.asarray(block.start.image_known).any()
    if first is not None and (not elsewhere or _somewhere(first, max_steps)):
        return first
    second = _from_image_points(block, from_start) if elsewhere else None
    if second is None or (first is not None and not _less(second, first)):
        if first is None:
            assert refused is not None
            raise refused
        return first
    warnings.warn(
        "the approximate exterior orientations that were given lead nowhere: the images were oriented by their common "
        "points instead, which leads to an optimum; look at the frame, angles and units of images.csv, at the "
        "coordinates of points where they are given, and at the interior orientation where it is held",
        stacklevel=3,
    )
    return second


def _from_image_points(block: Block, from_start: Callable[[Unknowns], Adjustment]) -> Adjustment | None:
    """The adjustment without given exterior orientations and points, but for known ones; None: it leads nowhere."""
    known, s = np.zeros((len(block.points), 3), bool), block.start
    for rows in (block.control, block.fixed):
        known[rows.who, rows.axis] = True
    images, points = np.zeros_like(np.asarray(s.image_known)), known.all(axis=1) & np.asarray(s.point_known)
    try:
        oriented = orient_block(
            dataclasses.replace(block, start=dataclasses.replace(s, image_known=images, point_known=points))
        )
        found = from_start(approximate(oriented))
    except (BlockError, DatumError, RankError):
        return None
    return found if bool(found.converged) else None


def _less(one: Adjustment, other: Adjustment) -> bool:
    return float(one.square_sum) < float(np.nan_to_num(other.square_sum, nan=np.inf))


def _somewhere(adjusted: Adjustment, max_steps: int) -> bool:
    """Whether an adjustment ended where its observations might belong; or was given too few steps to tell."""
    if adjusted.factored is None or (adjusted.outcome is Outcome.STEPS and max_steps < MAX_STEPS):
        return True
    return adjusted.outcome in (Outcome.CONVERGED, Outcome.STEPS) and float(adjusted.sigma0) < _ABSURD


def start_of(block: Block) -> Unknowns:
    """All approximate values of `block`: `approximate`, after its images are oriented to one another if need be.

    Raises BlockError where neither reaches all images, naming those that are left, and where points are not met.
    """
    reached, enough = _reached(block)
    if enough:
        return approximate(reached)
    try:
        oriented = orient_block(block)
    except (BlockError, DatumError, RankError) as error:
        if not reached.start.image_known.any():
            raise
        try:
            return approximate(reached)
        except BlockError as why:
            raise BlockError(f"{why}; nor can they be oriented by their common points: {error}") from error
    return approximate(oriented)


def needs_orientation(block: Block) -> bool:
    """Whether resection and intersection from what is known do not reach all images of `block`.

    Or reach them so badly, as from a few images known roughly, that rays miss their points by far.
    """
    return not _reached(block)[1]


def _reached(block: Block) -> tuple[Block, bool]:
    """`block` with what resection and intersection find, and whether that will do."""
    reached = dataclasses.replace(block, start=completed(block))
    given = np.array(block.start.image_known)
    given[sensor_rows(block, block.start.unknowns).image] = True
    return reached, bool(given.all() or (np.all(reached.start.image_known) and _fits(reached)))


def _fits(block: Block) -> bool:
    """Whether nine in ten rays to known points pass near them, and none of these lies behind its image."""
    start = block.start.unknowns
    sight = sight_of(block, start.interior)
    network = empty_network(block)._replace(
        positions=np.asarray(start.exterior.position),
        camera_from_object=np.asarray(start.exterior.camera_from_object),
        points=np.asarray(start.points),
    )
    rows = np.flatnonzero(np.asarray(block.start.point_known)[sight.point])
    off = misfits(sight, network, rows) * sight.sigma[rows]
    return bool(np.isfinite(off).all() and np.quantile(off, 0.9) < _NEAR)
