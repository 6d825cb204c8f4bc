"""Bundle adjustment, including the search for missing approximate values."""

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
from jaxphoto.errors import BlockError, DatumError, RankError, camera_words, few
from jaxphoto.initial.approximate import PointsBehind, approximate, completed, intersected
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.observations import AbstractObservations, KnownParameters
from jaxphoto.unknowns import FREE, Unknowns

_FromStart = Callable[[Block, Unknowns], Adjustment]

ABSURD = 30.0
"""Value of sigma0 above which the approximate values are wrong: neither blunders nor weights explain it."""
# Maximum ratio of v'Pv (new / old) at which a new solution with large sigma0 replaces the old one.
_VPV_RATIO = 0.01
# Maximum fraction of diverged tie points that may be rejected; more indicate wrong orientations.
_MAX_DIVERGED = 0.05
# Maximum ratio of sigma0 with reinstated points to sigma0 without them.
_SIGMA0_RATIO = 1.5
# Maximum misclosure (rad) of rays that lens distortion may explain.
_MAX_MISCLOSURE_RAD = 0.02


def adjust(
    block: Block,
    start: Unknowns | None = None,
    priors: Unknowns | None = None,
    *,
    more: Sequence[AbstractObservations | KnownParameters] = (),
    max_steps: int = MAX_STEPS,
    sizes: PaddedSizes = MINIMAL_SIZES,
) -> Adjustment:
    """Adjust `block` by a self-calibrating bundle adjustment.

    `start`: approximate values of all unknowns. By default the values of the block are completed by resection and
    intersection. If these do not reach all images, or diverge, images are oriented by their image points alone and
    transformed to the frame of the control (docs/photographs.md). `priors` are FREE, FIXED or Weighted; the default is
    the block's priors. `more` contains further observations of any kind, including user-defined ones
    (docs/extending.md), and jointly known parameters; they are added to `block.more` of the result.

    Compiled code serves all blocks of similar size. A study of many blocks compiles once if it passes common `sizes`
    (`common_sizes`). With `start`, the result is a pure function of the values in the arguments: `jax.grad` and
    `jax.vmap` apply.

    Raises BlockError if approximate values cannot be found, DatumError if position, orientation or scale are
    undetermined, RankError if unknowns are inseparable. Failure to converge is not an error: see `Adjustment.outcome`.
    """
    if more:
        block = dataclasses.replace(block, more=(*block.more, *more))
    priors = block.priors if priors is None else priors
    if start is None and is_traced((block, priors)):
        start = _start_in_transformation(block)
    if start is not None:
        return solve(block, start, priors, max_steps, sizes)
    default_priors = priors is block.priors

    def from_start(part: Block, start: Unknowns) -> Adjustment:
        return solve(part, start, part.priors if default_priors else priors, max_steps, sizes)

    adjusted = _adjust_from_best_start(block, priors, from_start, max_steps, may_lose_points=default_priors)
    if adjusted.left_out:
        warnings.warn(left_out_words(adjusted), stacklevel=2)
    return adjusted


def adjust_for_tables(
    block: Block,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
    sizes: PaddedSizes = MINIMAL_SIZES,
) -> Adjustment:
    """Run `adjust` and compile the statistics of tables and reports meanwhile; `report` receives progress.

    `seconds["start"]` of the result includes the search for approximate values.
    """
    from jaxphoto.statistics import prepare_statistics
    from jaxphoto.statistics.block_geometry import size_mismatches

    spent, began = {"start": 0.0}, time.perf_counter()

    def from_start(part: Block, start: Unknowns) -> Adjustment:
        nonlocal began
        spent["start"] += time.perf_counter() - began
        rows = len(part.image_points.image)
        report(f"adjusting {len(part.images)} images, {len(part.points)} points, {rows} image points")
        done = solve(part, start, part.priors, max_steps, sizes, meanwhile=prepare_statistics)
        began = time.perf_counter()
        return done

    try:
        adjusted = _adjust_from_best_start(block, block.priors, from_start, max_steps, report=report)
    except BlockError as error:
        for camera, mismatch in size_mismatches(block).items():
            error.add_note(f"{camera_words(camera)}: {mismatch.text}")
        raise
    adjusted.seconds.update(spent)
    return adjusted


def left_out_words(adjusted: Adjustment) -> str:
    """Return the message about `Adjustment.left_out`."""
    return (
        f"rejected points whose rays do not intersect: {few(adjusted.left_out)}. Check their image points, or use "
        "jaxphoto adjust --snoop"
    )


def _adjust_from_best_start(
    block: Block,
    priors: Unknowns,
    from_start: _FromStart,
    max_steps: int,
    may_lose_points: bool = True,
    report: Callable[[str], object] = lambda text: None,
) -> Adjustment:
    """Adjust from the given approximate values; if that fails, from image points alone.

    Warns if the second method is used.
    """
    first, refused = None, None
    try:
        first = from_start(block, start_of(block, report))
    except PointsBehind as error:
        refused = error
    if first is not None and may_lose_points:
        first = _without_diverged_points(first, from_start)
    # Prior information about exterior orientations excludes other approximate values.
    free = priors.exterior.position == FREE and priors.exterior.camera_from_object == FREE
    elsewhere = free and np.asarray(block.start.image_known).any()
    if first is not None and (not elsewhere or _is_plausible(first, max_steps)):
        return first
    second = _from_image_points(block, from_start, report) if elsewhere else None
    if second is not None and may_lose_points:
        second = _without_diverged_points(second, from_start)
    if second is None or not _better(second, first):
        if first is None:
            assert refused is not None
            raise refused
        return first
    warnings.warn(
        "the adjustment fails from the given exterior orientations: the images were oriented by their common points "
        "instead. Check frame, angles and units of images.csv, given point coordinates, and a fixed interior "
        "orientation",
        stacklevel=3,
    )
    return second


def _without_diverged_points(adjusted: Adjustment, from_start: _FromStart) -> Adjustment:
    """Repeat the adjustment without diverged tie points, if these are few.

    Their positions are then recomputed. Points that converge and fit are reinstated.
    """
    if adjusted.factored is None or not adjusted.diverged_points.any():
        return adjusted
    from jaxphoto.variants import without_observations

    block, reduced, names = adjusted.block, adjusted, list[str]()
    most = _MAX_DIVERGED * len(block.points)
    while (diverged := reduced.diverged_points).any() and len(names) + diverged.sum() <= most:
        rows = diverged[reduced.block.image_points.point]
        part, point = without_observations(reduced.block, {IMAGE_POINTS: rows})
        if len(point) == len(diverged):
            break
        names += [reduced.block.points[p] for p in np.setdiff1d(np.arange(len(diverged)), point)]
        try:
            reduced = from_start(part, start_of(part))
        except (BlockError, DatumError, RankError):
            return adjusted
    if not names or not bool(reduced.converged):
        return adjusted
    start = dataclasses.replace(
        block.start,
        unknowns=dataclasses.replace(
            block.start.unknowns, interior=reduced.unknowns.interior, exterior=reduced.unknowns.exterior
        ),
        image_known=np.ones(len(block.images), bool),
    )
    try:
        whole = from_start(block, approximate(dataclasses.replace(block, start=start)))
    except (BlockError, DatumError, RankError):
        whole = adjusted
    if bool(whole.converged) and float(whole.sigma0) < _SIGMA0_RATIO * float(reduced.sigma0):
        return whole
    return dataclasses.replace(reduced, left_out=tuple(names))


def _from_image_points(block: Block, from_start: _FromStart, report: Callable[[str], object]) -> Adjustment | None:
    """Adjust without given exterior orientations and tie points; return None if that fails."""
    is_control, s = np.zeros((len(block.points), 3), bool), block.start
    for rows in (block.control, block.fixed):
        is_control[rows.who, rows.axis] = True
    images, points = np.zeros_like(np.asarray(s.image_known)), is_control.all(axis=1) & np.asarray(s.point_known)
    from jaxphoto.procedures.orientation import orient_block

    try:
        oriented = orient_block(
            dataclasses.replace(block, start=dataclasses.replace(s, image_known=images, point_known=points)), report
        )
        return from_start(block, approximate(oriented))
    except (BlockError, DatumError, RankError):
        return None


def _better(one: Adjustment, other: Adjustment | None) -> bool:
    """Return True if `one` converged and fits, or has a far smaller v'Pv than `other`."""
    if not bool(one.converged):
        return False
    least = np.inf if other is None else float(np.nan_to_num(other.sum_of_squares, nan=np.inf))
    return float(one.sum_of_squares) < (1.0 if float(one.sigma0) < ABSURD else _VPV_RATIO) * least


def _is_plausible(adjusted: Adjustment, max_steps: int) -> bool:
    """Return True if the solution is plausible, or stopped too early to decide."""
    if adjusted.factored is None or (adjusted.outcome is Outcome.STEPS and max_steps < MAX_STEPS):
        return True
    return adjusted.outcome in (Outcome.CONVERGED, Outcome.STEPS, Outcome.FLAT) and float(adjusted.sigma0) < ABSURD


def _start_in_transformation(block: Block) -> Unknowns:
    """Return approximate values of a traced block; only given values have derivatives."""
    numbers, start = jax.lax.stop_gradient(block), block.start.unknowns
    if block.start.image_known.all() and block.start.point_known.all():
        return start
    completed_start = intersected(numbers) if is_traced(numbers) else start_of(numbers)
    image_known, point_known = np.asarray(block.start.image_known), np.asarray(block.start.point_known)[:, None]
    exterior = ExteriorOrientation(
        jnp.where(image_known[:, None], start.exterior.position, completed_start.exterior.position),
        jnp.where(
            image_known[:, None, None], start.exterior.camera_from_object, completed_start.exterior.camera_from_object
        ),
    )
    return dataclasses.replace(
        start, exterior=exterior, points=jnp.where(point_known, start.points, completed_start.points)
    )


def start_of(block: Block, report: Callable[[str], object] = lambda text: None) -> Unknowns:
    """Compute approximate values of all unknowns by `approximate`, after relative orientation of the images if
    necessary.

    `report` receives progress. Raises BlockError, with the images, if some cannot be oriented, and for points whose
    rays do not intersect.
    """
    reached, enough = _reached(block)
    if enough:
        return approximate(reached)
    from jaxphoto.procedures.orientation import orient_block

    try:
        oriented = orient_block(block, report)
    except (BlockError, DatumError, RankError) as error:
        if not reached.start.image_known.any():
            raise
        try:
            return approximate(reached)
        except BlockError as why:
            raise BlockError(f"{why}; orientation by common points fails, too: {error}") from error
    return approximate(oriented)


def _reached(block: Block) -> tuple[Block, bool]:
    """Complete the approximate values by resection and intersection; also return True if they are sufficient."""
    reached = dataclasses.replace(block, start=completed(block))
    is_given = np.array(block.start.image_known)
    if not is_given.all():
        is_given[sensor_rows(block, block.start.unknowns).image] = True
    return reached, bool(is_given.all() or (np.all(reached.start.image_known) and _rays_fit(reached)))


def _rays_fit(block: Block) -> bool:
    """Return True if 90 % of the rays to known points pass near them and no ray has its point behind the image."""
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
    return bool(in_front.all() and np.quantile(across, 0.9) < _MAX_MISCLOSURE_RAD)
