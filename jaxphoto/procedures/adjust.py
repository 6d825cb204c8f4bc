"""The main job: complete the start values of a block and adjust it."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment import MAX_STEPS, MINIMAL_SIZES, Adjustment, Outcome, PaddedSizes, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.arrays import is_traced
from jaxphoto.block import Block, sensor_rows
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError, DatumError, RankError, few
from jaxphoto.initial import approximate
from jaxphoto.initial.approximate import PointsBehind, completed, intersected
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.observations import AbstractObservations, KnownParameters
from jaxphoto.procedures.orientation import orient_block
from jaxphoto.statistics import prepare_statistics
from jaxphoto.unknowns import FREE, Unknowns
from jaxphoto.variants import without_observations

_FromStart = Callable[[Block, Unknowns], Adjustment]

ABSURD = 30.0
"""A sigma naught that neither blunders nor weights explain: the place is wrong."""
# Of the square sum: with blunders in a block nothing fits, but some places are no place at all.
_FAR_BETTER = 0.01
# Tie points that may be left out, as a part of all points: where more are gone, cameras stand in the wrong place.
_GONE = 0.05
# A sigma naught with points that were gone, over that without, up to which nothing speaks against them.
_AS_GOOD = 1.5
# Rays that miss by more (rad) are off by more than lenses distort.
_NEAR = 0.02


def adjust(
    block: Block,
    start: Unknowns | None = None,
    priors: Unknowns | None = None,
    *,
    more: Sequence[AbstractObservations | KnownParameters] = (),
    max_steps: int = MAX_STEPS,
    sizes: PaddedSizes = MINIMAL_SIZES,
) -> Adjustment:
    """Self-calibrating bundle adjustment of `block`.

    `start` gives every unknown an approximate value; where it is None, those of the block are completed by resection
    and intersection, and where these do not reach all images, or lead nowhere, found from image points alone and
    brought to the known frame (docs/photographs.md). `priors` says what is FREE, FIXED or Weighted; where it is
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
    if start is None and is_traced((block, priors)):
        start = _start_in_transformation(block)
    if start is not None:
        return solve(block, start, priors, max_steps, sizes)
    own = priors is block.priors

    def from_start(part: Block, start: Unknowns) -> Adjustment:
        return solve(part, start, part.priors if own else priors, max_steps, sizes)

    found = _from_the_best_start(block, priors, from_start, max_steps, may_lose_points=own)
    if found.left_out:
        warnings.warn(left_out_words(found), stacklevel=2)
    return found


def adjust_for_tables(
    block: Block,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
    sizes: PaddedSizes = MINIMAL_SIZES,
) -> Adjustment:
    """`adjust`, with what tables and report will want compiled meanwhile; `report` is told what is being done.

    The seconds of the result have those of the search for approximate values, too: start.
    """
    spent, began = {"start": 0.0}, time.perf_counter()

    def from_start(part: Block, start: Unknowns) -> Adjustment:
        nonlocal began
        spent["start"] += time.perf_counter() - began
        rows = len(part.image_points.image)
        report(f"adjusting {len(part.images)} images, {len(part.points)} points, {rows} image points")
        done = solve(part, start, part.priors, max_steps, sizes, meanwhile=prepare_statistics)
        began = time.perf_counter()
        return done

    found = _from_the_best_start(block, block.priors, from_start, max_steps, report=report)
    found.seconds.update(spent)
    return found


def left_out_words(adjusted: Adjustment) -> str:
    """What became of `Adjustment.left_out`, in a sentence."""
    return (
        f"left out, because their rays meet nowhere: point {few(adjusted.left_out)}; look for blunders in their image "
        "points, or let jaxphoto adjust --snoop find them"
    )


def _from_the_best_start(
    block: Block,
    priors: Unknowns,
    from_start: _FromStart,
    max_steps: int,
    may_lose_points: bool = True,
    report: Callable[[str], object] = lambda text: None,
) -> Adjustment:
    """The adjustment from the approximate values that are given; or, where these lead nowhere, from image points alone.

    Warns where the second is the better one.
    """
    first, refused = None, None
    try:
        first = from_start(block, start_of(block, report))
    except PointsBehind as error:
        refused = error
    if first is not None and may_lose_points:
        first = _without_points_gone(first, from_start)
    # What is known of exterior orientations is not to be looked for elsewhere.
    free = priors.exterior.position == FREE and priors.exterior.camera_from_object == FREE
    elsewhere = free and np.asarray(block.start.image_known).any()
    if first is not None and (not elsewhere or _somewhere(first, max_steps)):
        return first
    second = _from_image_points(block, from_start, report) if elsewhere else None
    if second is not None and may_lose_points:
        second = _without_points_gone(second, from_start)
    if second is None or not _better(second, first):
        if first is None:
            assert refused is not None
            raise refused
        return first
    warnings.warn(
        "the approximate exterior orientations that were given lead nowhere: the images were oriented by their common "
        "points instead, which fits better; look at the frame, angles and units of images.csv, at the "
        "coordinates of points where they are given, and at the interior orientation where it is held",
        stacklevel=3,
    )
    return second


def _without_points_gone(adjusted: Adjustment, from_start: _FromStart) -> Adjustment:
    """Once more without tie points that went astray, where they are few: blunders, or a start that is far off.

    From where that leads they are placed anew, and stay if they do not go astray again and fit.
    """
    if adjusted.factored is None:
        return adjusted
    block, found, names = adjusted.block, adjusted, list[str]()
    most = _GONE * len(block.points)
    while (gone := found.diverged_points).any() and len(names) + gone.sum() <= most:
        rows = gone[found.block.image_points.point]
        part, kept = without_observations(found.block, {IMAGE_POINTS: rows})
        if len(kept) == len(gone):
            break
        names += [found.block.points[p] for p in np.setdiff1d(np.arange(len(gone)), kept)]
        try:
            found = from_start(part, start_of(part))
        except (BlockError, DatumError, RankError):
            return adjusted
    if not names or not bool(found.converged):
        return adjusted
    start = dataclasses.replace(
        block.start,
        unknowns=dataclasses.replace(
            block.start.unknowns, interior=found.unknowns.interior, exterior=found.unknowns.exterior
        ),
        image_known=np.ones(len(block.images), bool),
    )
    try:
        whole = from_start(block, approximate(dataclasses.replace(block, start=start)))
    except (BlockError, DatumError, RankError):
        whole = adjusted
    if bool(whole.converged) and float(whole.sigma0) < _AS_GOOD * float(found.sigma0):
        return whole
    return dataclasses.replace(found, left_out=tuple(names))


def _from_image_points(block: Block, from_start: _FromStart, report: Callable[[str], object]) -> Adjustment | None:
    """The adjustment without given exterior orientations and points, but for known ones; None: it leads nowhere."""
    known, s = np.zeros((len(block.points), 3), bool), block.start
    for rows in (block.control, block.fixed):
        known[rows.who, rows.axis] = True
    images, points = np.zeros_like(np.asarray(s.image_known)), known.all(axis=1) & np.asarray(s.point_known)
    try:
        oriented = orient_block(
            dataclasses.replace(block, start=dataclasses.replace(s, image_known=images, point_known=points)), report
        )
        return from_start(block, approximate(oriented))
    except (BlockError, DatumError, RankError):
        return None


def _better(one: Adjustment, other: Adjustment | None) -> bool:
    """Whether an adjustment from elsewhere is an optimum, and fits; or fits incomparably better than another."""
    if not bool(one.converged):
        return False
    least = np.inf if other is None else float(np.nan_to_num(other.sum_of_squares, nan=np.inf))
    return float(one.sum_of_squares) < (1.0 if float(one.sigma0) < ABSURD else _FAR_BETTER) * least


def _somewhere(adjusted: Adjustment, max_steps: int) -> bool:
    """Whether an adjustment ended where its observations might belong; or was given too few steps to tell."""
    if adjusted.factored is None or (adjusted.outcome is Outcome.STEPS and max_steps < MAX_STEPS):
        return True
    return adjusted.outcome in (Outcome.CONVERGED, Outcome.STEPS, Outcome.FLAT) and float(adjusted.sigma0) < ABSURD


def _start_in_transformation(block: Block) -> Unknowns:
    """Approximate values of a block that a JAX transformation traces; only what is known has derivatives."""
    numbers, known = jax.lax.stop_gradient(block), block.start.unknowns
    if block.start.image_known.all() and block.start.point_known.all():
        return known
    found = intersected(numbers) if is_traced(numbers) else start_of(numbers)
    image_known, point_known = np.asarray(block.start.image_known), np.asarray(block.start.point_known)[:, None]
    exterior = ExteriorOrientation(
        jnp.where(image_known[:, None], known.exterior.position, found.exterior.position),
        jnp.where(image_known[:, None, None], known.exterior.camera_from_object, found.exterior.camera_from_object),
    )
    return dataclasses.replace(known, exterior=exterior, points=jnp.where(point_known, known.points, found.points))


def start_of(block: Block, report: Callable[[str], object] = lambda text: None) -> Unknowns:
    """All approximate values of `block`: `approximate`, after its images are oriented to one another if need be.

    `report` is told what is being done.

    Raises BlockError where neither reaches all images, naming those that are left, and where points are not met.
    """
    reached, enough = _reached(block)
    if enough:
        return approximate(reached)
    try:
        oriented = orient_block(block, report)
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
    if not given.all():
        given[sensor_rows(block, block.start.unknowns).image] = True
    return reached, bool(given.all() or (np.all(reached.start.image_known) and _fits(reached)))


def _fits(block: Block) -> bool:
    """True if nine in ten rays to known points pass near them, and none of these lies behind its image."""
    start, rows = block.start.unknowns, block.image_points
    known = np.asarray(block.start.point_known)[np.asarray(rows.point)]
    image, point, xy = (np.asarray(v)[known] for v in (rows.image, rows.point, rows.xy))
    if not len(image):
        return False
    camera = np.array(block.image_camera)[image]
    rays = np.zeros((len(image), 3))
    for name in set(camera):
        rays[camera == name] = camera_rays(start.interior[name], xy[camera == name])
    exterior = start.exterior
    direction = turn_to_object(np.asarray(exterior.camera_from_object), image, rays)
    towards = np.asarray(start.points)[point] - np.asarray(exterior.position)[image]
    across = np.linalg.norm(np.cross(direction, towards), axis=1) / np.linalg.norm(towards, axis=1)
    in_front = np.einsum("ni,ni->n", direction, towards) > 0
    return bool(in_front.all() and np.quantile(across, 0.9) < _NEAR)
