"""Adjust an oriented block with control, and reject control that contradicts the other observations.

1. Rays of marks are intersected; a mark that contradicts the others of its point is rejected.

2. Three or more consistent control points transform the block to their frame. With fewer the block is not transformed.

3. The block is adjusted with control. Iteratively, the control observation with the largest normalised residual is
rejected, and rejected points that agree are reinstated. Check points are never adjusted.

Normalised residuals test observations (Baarda). Check points and rejected points are tested by their difference divided
by its standard deviation, which includes survey and adjustment.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Start
from jaxphoto.errors import DatumError, InputError, counted, few
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control.frame import MIN_POINTS, InFrame, in_frame, on_a_line, onto_control
from jaxphoto.procedures.control.marks import Marked, intersected, into_block, marked, with_gnss_bias, without_names
from jaxphoto.procedures.control.surveyed import MARK_SIGMA_PX, SIGMA_M, GivenControl, SurveyedPoints
from jaxphoto.statistics import LEAST_CHECKED, covariance, normalised_residuals, redundancy_numbers

CRITICAL = 4.0
"""Maximum normalised residual: one valid observation of 16,000 exceeds it."""

# Minimum number of residuals for a scatter estimate; median of the larger of two standard normal errors.
_ENOUGH, _LARGER = 8, 1.05


class TestedControl(NamedTuple):
    """Test of the last `points` of a block and of their marks."""

    adjusted_m: Float[np.ndarray, "points 3"]
    off_m: Float[np.ndarray, "points 3"]
    """Surveyed minus adjusted; NaN without survey."""
    sigma_m: Float[np.ndarray, "points 3"]
    """Standard deviation of the adjusted coordinates, a posteriori."""
    w: Float[np.ndarray, "points 3"]
    """Normalised residuals; NaN if not tested."""
    marks_px: Float[np.ndarray, "rows 2"]
    """Measured minus computed column and row of the marks, in the order of the block."""
    marks_w: Float[np.ndarray, "rows"]
    """Normalised residuals, maximum of both axes; NaN if not tested."""


def test_control(
    adjusted: Adjustment, n: int, xyz: Float[np.ndarray, "points 3"], sigma: Float[np.ndarray, "points 3"]
) -> TestedControl:
    """Test the last `n` points, surveyed at `xyz` with `sigma` (m), whether control, check or rejected points."""
    block = adjusted.block
    first = len(block.points) - n
    cov = covariance(adjusted, rows=True)
    redundancy = redundancy_numbers(adjusted, cov)
    tested = normalised_residuals(adjusted, redundancy)
    place = np.asarray(adjusted.unknowns.points, float)[first:]
    point_sigma = np.asarray(cov.point_sigma)[first:]
    off = xyz - place
    w = np.abs(off) / np.hypot(point_sigma, np.where(np.isfinite(sigma), sigma, 0.0))
    control = block.control
    if len(control):
        r, normalised = np.asarray(redundancy["control_points"]), np.asarray(tested["control_points"])
        mine = np.asarray(control.who) >= first
        who, axis = np.asarray(control.who)[mine] - first, np.asarray(control.axis)[mine]
        w[who, axis] = np.where(r[mine] > LEAST_CHECKED, np.abs(normalised[mine]), np.nan)
    rows = np.asarray(block.image_points.point) >= first
    pixel = np.array([block.sensors[c].pixel_mm for c in block.image_camera])[block.image_points.image[rows]]
    residual = np.asarray(adjusted.residuals.image)[:, rows] * np.asarray(block.image_points.sigma).T[:, rows]
    of_marks = np.where(
        np.asarray(redundancy.image)[:, rows] > LEAST_CHECKED, np.abs(np.asarray(tested.image)[:, rows]), np.nan
    )
    marks_px = residual.T / pixel[:, None] * (1, -1)
    return TestedControl(place, off, point_sigma, w, marks_px, _largest(of_marks))


def _largest(w: Float[np.ndarray, "2 rows"]) -> Float[np.ndarray, "rows"]:
    """Return the maximum along the first axis, ignoring NaN; NaN if all are NaN."""
    largest = np.max(np.nan_to_num(w, nan=-1.0), axis=0, initial=-1.0)
    return np.where(largest < 0, np.nan, largest)


def scatter(marks_w: Float[np.ndarray, "rows"]) -> float:
    """Estimate the robust scatter of the normalised residuals of marks; at least 1, and 1 for few marks.

    Manual marks are often less accurate than stated. Such marks are not blunders.
    """
    finite = marks_w[np.isfinite(marks_w)]
    return max(1.0, float(np.median(finite)) / _LARGER) if len(finite) >= _ENOUGH else 1.0


def beyond(w: Float[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
    """Return True for points with a significant normalised residual."""
    return np.nan_to_num(w).max(axis=1, initial=0.0) > CRITICAL


_ROUNDS = 8
# Maximum number of messages about marks in an error message.
_SAID = 2
# Ratio to the largest normalised residual below which no other observation is rejected in the same iteration.
_BESIDE_THE_WORST = 0.7


class ControlledBlock(NamedTuple):
    """Block adjusted with control, and the result of each surveyed point. Arrays are over the surveyed points."""

    adjusted: Adjustment
    ids: tuple[str, ...]
    check: Bool[np.ndarray, "points"]
    state: tuple[str, ...]
    """One of: control, check, left out (rejected), not marked (in too few photographs)."""
    n_marks: tuple[int, ...]
    xyz_m: Float[np.ndarray, "points 3"]
    """Surveyed coordinates in the local frame of the block; NaN if unknown."""
    off_m: Float[np.ndarray, "points 3"]
    """Surveyed minus adjusted, in the local frame of the block; NaN if undefined."""
    survey_sigma_m: Float[np.ndarray, "points 3"]
    sigma_m: Float[np.ndarray, "points 3"]
    """Standard deviation of the adjusted coordinates, a posteriori."""
    w: Float[np.ndarray, "points 3"]
    marks: Marked
    """Accepted marks; `point` is the index of the surveyed points."""
    marks_px: Float[np.ndarray, "rows 2"]
    """Residuals of the marks (column, row)."""
    sentences: tuple[str, ...]


def control_block(
    block: Block,
    control: GivenControl,
    *,
    system: str | None = None,
    code: int | None = None,
    vertical: int | None = None,
    elsewhere: Collection[str] = (),
    adjust: Callable[[Block], Adjustment] = adjust_for_tables,
    report: Callable[[str], object] = lambda text: None,
) -> ControlledBlock:
    """Adjust `block`, whose images and points have initial values, with `control`.

    `system` is the coordinate system of the points if their file does not specify one, `code` the EPSG code of a block
    without a system, `vertical` the EPSG code of heights in files. `elsewhere` lists photographs of other blocks.
    Raises InputError for unusable control (`in_frame`, `onto_control`), and if no mark is in a photograph of the block.
    """
    points, ids = control.points, control.points.ids
    frame = in_frame(block, points, system, code, vertical)
    rows, messages = marked(block, points, control.marks, elsewhere)
    if not len(rows.image):
        first = f" ({few(list(dict.fromkeys(control.marks.image)))})" if control.marks.image else ""
        raise InputError(f"{points.file}: no mark{first} is in a photograph of the block ({few(block.images)})")
    met = intersected(block, block.start.unknowns, rows, ids)
    rows, messages = rows.take(met.good), [*messages, *met.sentences]
    sigma = np.where(np.isnan(points.sigma_m), SIGMA_M, points.sigma_m)
    try:
        block, start, agree, placed_messages = _placed(block, frame, met.points, met.covariance, sigma, points)
    except InputError as error:
        # Rejected marks explain why too few points remain.
        raise InputError("; ".join([str(error), *_one_height(points), *met.sentences[:_SAID]])) from error
    messages += placed_messages
    count = np.bincount(rows.point, minlength=len(ids))
    known = np.where(np.isnan(points.coordinates), np.nan, frame.xyz)
    # One ray of a known point is an observation; one ray of an unknown point is not.
    seen = (count > 1) & np.isfinite(start).all(axis=1) | (count == 1) & ~points.check & np.isfinite(known).all(axis=1)
    start = np.where(np.isfinite(start), start, frame.xyz)
    base = without_names(block, ids)
    used = seen & ~points.check & agree
    if len(base.stations) and all(np.isfinite(known[used, axis]).any() for axis in range(3)):
        base = with_gnss_bias(base)
        messages.append("positions of the receiver have a separate shift, estimated from the control")
    now = rows.take(seen[rows.point])
    tried: list[tuple] = []
    for number in range(_ROUNDS):
        report(f"adjusting with {int(used.sum())} control points")
        which = np.flatnonzero(seen)
        place = np.cumsum(seen) - 1
        of_seen = now._replace(point=place[now.point])
        names = tuple(ids[k] for k in which)
        # A default standard deviation of check points must not affect the reported accuracy.
        seen_sigma = np.where(points.check[:, None] & np.isnan(points.sigma_m), 0.0, sigma)[which]
        roles = used[which], points.check[which]
        controlled = into_block(base, names, known[which], seen_sigma, start[which], of_seen, *roles)
        try:
            adjusted = adjust(controlled)
        except DatumError as error:
            # The default standard deviations may be the reason why control does not determine the datum.
            raise DatumError("; ".join([str(error), *_assumed(control)])) from error
        if not bool(adjusted.converged):
            messages.append("the adjustment with control did not converge; it is not tested")
        tested = _spread(test_control(adjusted, len(which), known[which], sigma[which]), seen)
        new, rejected, text = _tested(tested, now, used, seen & ~points.check, ids, block.images)
        key = (used.tobytes(), len(now.image))
        if number + 1 == _ROUNDS or not text or key in tried or not bool(adjusted.converged):
            break
        tried.append(key)
        messages += text
        used, now = new, now.take(~rejected)
        count = np.bincount(now.point, minlength=len(ids))
        seen &= count > 0
        used &= seen
        base = _from(base, adjusted)
        start[which] = np.asarray(adjusted.unknowns.points)[len(base.points) :]
    left = seen & ~points.check & ~used
    messages = [*_assumed(control), *messages]
    for k in np.flatnonzero(left):
        offset = ", ".join(f"{v:.3g}" for v in tested.off_m[k])
        messages.append(f"control point {ids[k]} contradicts the rest by {offset} m (east, north, up) and is rejected")
    state = np.where(points.check, "check", np.where(used, "control", "left out"))
    state = np.where(seen, state, "not marked")
    if not_marked := [ids[k] for k in np.flatnonzero(~seen)]:
        messages.append(f"{len(not_marked)} surveyed points are marked in too few photographs: {few(not_marked)}")
    n_marks = tuple(int(v) for v in np.bincount(now.point, minlength=len(ids)))
    return ControlledBlock(
        adjusted, ids, points.check, tuple(state.tolist()), n_marks, known, tested.off_m, sigma, tested.sigma_m,
        tested.w, now, tested.marks_px, tuple(dict.fromkeys(filter(None, messages))),
    )  # fmt: skip


def _placed(block: Block, frame: InFrame, met, covariance, sigma, points: SurveyedPoints):
    """Transform the block to the frame of control.

    Return block, initial points, consistent points, and messages.
    """
    whole = np.isfinite(points.coordinates).all(axis=1)
    known = np.flatnonzero(np.isfinite(met).all(axis=1) & ~points.check & whole)
    agree = np.ones(len(met), bool)
    by_positions = len(block.stations) > 0 and not len(block.control)
    line = len(known) >= MIN_POINTS and on_a_line(met[known], frame.xyz[known])
    if frame.at_place and (line or len(known) < MIN_POINTS):
        how = " lie on a line, so the rotation about it is undetermined" if line else ""
        stays = f"the block stays {'at its positions' if by_positions else 'where it lies'}"
        messages = [f"{counted(len(known), 'control point')} in two photographs or more{how}: {stays}"]
        return block, met, agree, messages
    spread = np.sqrt(np.trace(covariance[known], axis1=1, axis2=2))
    surveyed = np.linalg.norm(sigma[known], axis=1)
    if not frame.at_place:
        # `spread` is in the unit of the block: convert it by the scale of a first similarity.
        first = onto_control(met[known], frame.xyz[known], surveyed, points.file)
        spread = spread * first.similarity.scale
    onto = onto_control(met[known], frame.xyz[known], np.hypot(surveyed, spread), points.file)
    agree[known] = onto.agree
    messages = [f"{int(onto.agree.sum())} of {counted(len(known), 'control point')} bring the block to their frame"]
    if frame.at_place:
        off = np.median((frame.xyz - met)[known[onto.agree]], axis=0)
        offset = ", ".join(f"{v:.2f}" for v in np.round(off, 2) + 0.0)
        there = "the positions of the photographs have" if by_positions else "the block has"
        messages.append(f"control lies {offset} m (east, north, up) from where {there} it")
    block = dataclasses.replace(onto.similarity.of_block(block), frame=frame.frame)
    return block, onto.similarity.of(met), agree, messages


def _assumed(control: GivenControl) -> list[str]:
    messages = []
    if n := int(np.isnan(control.points.sigma_m).any(axis=1).sum()):
        messages.append(
            f"{n} surveyed points have no standard deviations: {max(SIGMA_M[:2]):.2g} m east and north, "
            f"{SIGMA_M[2]:.2g} m up are assumed"
        )
    messages += _one_height(control.points)
    if n := int(np.isnan(control.marks.sigma_px).sum()):
        messages.append(f"{n} marks have no standard deviations: {MARK_SIGMA_PX:g} px is assumed")
    return messages


def _one_height(points: SurveyedPoints) -> list[str]:
    height = points.coordinates[:, 2]
    if len(height) < MIN_POINTS or np.ptp(height) != 0:
        return []
    return [
        f"all {len(height)} surveyed heights are {height[0]:g} m; if they were not surveyed, leave them empty and "
        "give positions of the photographs, which determine the tilt of the block"
    ]


def _tested(tested: TestedControl, now: Marked, used, able, ids, images):
    """Return accepted control points, marks to reject, and a message per change (may be empty); none if all agree."""
    new, rejected, messages = used.copy(), np.zeros(len(now.image), bool), []
    of_points, of_marks = np.where(used, np.nan_to_num(tested.w).max(axis=1), 0.0), np.nan_to_num(tested.marks_w)
    wide = scatter(tested.marks_w)
    worst = max(of_points.max(initial=0.0), of_marks.max(initial=0.0) / wide)
    if not worst > CRITICAL:
        back = able & ~used & ~beyond(tested.w) & np.isfinite(tested.w).any(axis=1)
        return new | back, rejected, [""] * bool(back.any())
    # A blunder often causes smaller residuals nearby.
    limit = max(CRITICAL, _BESIDE_THE_WORST * worst)
    for p in np.unique(now.point).tolist():
        row = max(np.flatnonzero(now.point == p), key=lambda k: of_marks[k])
        if max(of_marks[row] / wide, of_points[p]) < limit:
            continue
        if of_marks[row] < of_points[p]:
            new[p] = False
            messages.append("")
            continue
        rejected[row] = True
        off, image = np.linalg.norm(tested.marks_px[row]), images[now.image[row]]
        messages.append(
            f"the mark of {ids[p]} in {image} is {off:.3g} px off (w = {tested.marks_w[row]:.3g}) and rejected"
        )
    return new, rejected, messages


def _spread(tested: TestedControl, seen) -> TestedControl:
    """Expand to all surveyed points, with NaN for points that are not in the block."""
    wide = lambda v: np.where(seen[:, None], v[np.cumsum(seen) - 1], np.nan)  # noqa: E731
    return tested._replace(
        adjusted_m=wide(tested.adjusted_m), off_m=wide(tested.off_m), sigma_m=wide(tested.sigma_m), w=wide(tested.w)
    )


def retest(controlled: ControlledBlock, adjusted: Adjustment) -> ControlledBlock:
    """Repeat the tests after another adjustment of the block, for example with other weights."""
    seen = np.array(controlled.state, object) != "not marked"
    xyz, sigma = controlled.xyz_m[seen], controlled.survey_sigma_m[seen]
    new = _spread(test_control(adjusted, int(seen.sum()), xyz, sigma), seen)
    return controlled._replace(adjusted=adjusted, off_m=new.off_m, sigma_m=new.sigma_m, w=new.w, marks_px=new.marks_px)


def at_optimum(adjusted: Adjustment) -> Block:
    """Return the adjusted block with initial values at the optimum."""
    block = adjusted.block
    known = (np.ones(len(names), bool) for names in (block.images, block.points))
    return dataclasses.replace(block, start=Start(adjusted.unknowns, *known))


def _from(base: Block, adjusted: Adjustment) -> Block:
    """Return `base` with initial values from the optimum of the same block with control."""
    unknowns = dataclasses.replace(adjusted.unknowns, points=np.asarray(adjusted.unknowns.points)[: len(base.points)])
    return dataclasses.replace(base, start=dataclasses.replace(base.start, unknowns=unknowns))
