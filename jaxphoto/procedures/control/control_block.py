"""An oriented block adjusted with control: placed, tested, and what contradicts the rest left out and named.

1. Rays of the marks meet in points; a mark that contradicts the others of its point goes.
2. Three control points or more that agree bring the block to their frame. With fewer it stays where it is.
3. It is adjusted with them. Then, in turns, the one observation of control that contradicts the rest most is left out,
   and points that were left out come back where they agree. Check points never enter.
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
from jaxphoto.procedures.control.intersected import intersected
from jaxphoto.procedures.control.into_block import into_block, with_gnss_bias, without_names
from jaxphoto.procedures.control.judged import CRITICAL, JudgedControl, beyond, judged, poorer_survey, scatter
from jaxphoto.procedures.control.marked import Marked, marked
from jaxphoto.procedures.control.onto_control import MINIMAL_SIZES, on_a_line, onto_control
from jaxphoto.procedures.control.placed import InFrame, in_frame
from jaxphoto.procedures.control.surveyed import MARK_SIGMA_PX, SIGMA_M, GivenControl, SurveyedPoints

_ROUNDS = 8
# Sentences about marks in an error, which is one line.
_SAID = 2
# Of the worst normalised residual: what is less is not left out beside it.
_BESIDE_THE_WORST = 0.7


class ControlledBlock(NamedTuple):
    """A block adjusted with control, and what became of each surveyed point. Arrays are over the surveyed points."""

    adjusted: Adjustment
    ids: tuple[str, ...]
    check: Bool[np.ndarray, "points"]
    state: tuple[str, ...]
    """control, check, left out (it contradicts the rest), not marked (in too few photographs)."""
    n_marks: tuple[int, ...]
    xyz_m: Float[np.ndarray, "points 3"]
    """Surveyed, in the local frame of the block; NaN for what is not known."""
    off_m: Float[np.ndarray, "points 3"]
    """Surveyed minus adjusted, in the local frame of the block; NaN where there is none."""
    survey_sigma_m: Float[np.ndarray, "points 3"]
    sigma_m: Float[np.ndarray, "points 3"]
    """Of the adjusted coordinates, a posteriori."""
    w: Float[np.ndarray, "points 3"]
    marks: Marked
    """Those that were adjusted with; `point` counts the surveyed points."""
    marks_px: Float[np.ndarray, "rows 2"]
    """Their residuals, column and row."""
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
    """`block`, whose images and points have a start, adjusted with `control`.

    `system` names that of the points where their file does not, `code` the EPSG code of a block that has none yet,
    `vertical` that of the heights that it has in files. `elsewhere` are photographs that are known but not of this
    block. Raises InputError for control that cannot be used as it stands: see `in_frame` and `onto_control`; and where
    no mark is in a photograph of the block.
    """
    points, ids = control.points, control.points.ids
    frame = in_frame(block, points, system, code, vertical)
    rows, said = marked(block, points, control.marks, elsewhere)
    if not len(rows.image):
        first = f" ({few(list(dict.fromkeys(control.marks.image)))})" if control.marks.image else ""
        raise InputError(f"{points.file}: no mark{first} is in a photograph of the block ({few(block.images)})")
    met = intersected(block, block.start.unknowns, rows, ids)
    rows, said = rows.take(met.good), [*said, *met.sentences]
    sigma = np.where(np.isnan(points.sigma_m), SIGMA_M, points.sigma_m)
    try:
        block, start, agree, sigma, told = _placed(block, frame, met.points, met.covariance, sigma, points)
    except InputError as error:
        # What marks say of one another is why there is too little, where there is.
        raise InputError("; ".join([str(error), *_one_height(points), *met.sentences[:_SAID]])) from error
    said += told
    count = np.bincount(rows.point, minlength=len(ids))
    known = np.where(np.isnan(points.coordinates), np.nan, frame.xyz)
    # One ray and a known place are an observation, one ray alone is none.
    seen = (count > 1) & np.isfinite(start).all(axis=1) | (count == 1) & ~points.check & np.isfinite(known).all(axis=1)
    start = np.where(np.isfinite(start), start, frame.xyz)
    base = without_names(block, ids)
    used = seen & ~points.check & agree
    if len(base.stations) and all(np.isfinite(known[used, axis]).any() for axis in range(3)):
        base = with_gnss_bias(base)
        said.append("positions of the receiver have a shift of their own, which control tells")
    now = rows.take(seen[rows.point])
    tried: list[tuple] = []
    for number in range(_ROUNDS):
        report(f"adjusting with {int(used.sum())} control points")
        which = np.flatnonzero(seen)
        place = np.cumsum(seen) - 1
        own = now._replace(point=place[now.point])
        names = tuple(ids[k] for k in which)
        # What is taken for the survey of check points is no ground to claim an accuracy on.
        told = np.where(points.check[:, None] & np.isnan(points.sigma_m), 0.0, sigma)[which]
        roles = used[which], points.check[which]
        made = into_block(base, names, known[which], told, start[which], own, *roles)
        try:
            adjusted = adjust(made)
        except DatumError as error:
            # What is taken of the control beforehand may be why it does not tell enough.
            raise DatumError("; ".join([str(error), *_assumed(control, sigma)])) from error
        if not bool(adjusted.converged):
            said.append("the adjustment with control did not converge; it is not tested")
        found = _spread(judged(adjusted, len(which), known[which], sigma[which]), seen)
        poorer = poorer_survey(found.w[used], sigma[used], np.isnan(points.sigma_m[used]), SIGMA_M)
        if poorer is not None and number + 1 < _ROUNDS and bool(adjusted.converged):
            # Before any is judged by a guess that most contradict.
            sigma = np.where(np.isnan(points.sigma_m), poorer, sigma)
            continue
        new, gone, text = _tested(found, now, used, seen & ~points.check, ids, block.images)
        key = (used.tobytes(), len(now.image))
        if number + 1 == _ROUNDS or not text or key in tried or not bool(adjusted.converged):
            break
        tried.append(key)
        said += text
        used, now = new, now.take(~gone)
        count = np.bincount(now.point, minlength=len(ids))
        seen &= count > 0
        used &= seen
        base = _from(base, adjusted)
        start[which] = np.asarray(adjusted.unknowns.points)[len(base.points) :]
    left = seen & ~points.check & ~used
    said = [*_assumed(control, sigma), *said]
    said += _left_out(ids, left, found, frame)
    state = np.where(points.check, "check", np.where(used, "control", "left out"))
    state = np.where(seen, state, "not marked")
    if not_marked := [ids[k] for k in np.flatnonzero(~seen)]:
        said.append(f"{len(not_marked)} surveyed points are marked in too few photographs: {few(not_marked)}")
    n_marks = tuple(int(v) for v in np.bincount(now.point, minlength=len(ids)))
    return ControlledBlock(
        adjusted, ids, points.check, tuple(state.tolist()), n_marks, known, found.off_m, sigma, found.sigma_m,
        found.w, now, found.marks_px, tuple(dict.fromkeys(filter(None, said))),
    )  # fmt: skip


def _placed(block: Block, frame: InFrame, met, covariance, sigma, points: SurveyedPoints):
    """The block in the frame of control, where its points begin, which agree with it, how well they were surveyed, and
    what is to be said."""
    whole = np.isfinite(points.coordinates).all(axis=1)
    known = np.flatnonzero(np.isfinite(met).all(axis=1) & ~points.check & whole)
    agree = np.ones(len(met), bool)
    by_positions = len(block.stations) > 0 and not len(block.control)
    line = len(known) >= MINIMAL_SIZES and on_a_line(met[known], frame.xyz[known])
    if frame.at_place and (line or len(known) < MINIMAL_SIZES):
        how = " lie on a line, which leaves a turn about it open" if line else ""
        stays = f"the block stays {'at its positions' if by_positions else 'where it lies'}"
        said = [f"{counted(len(known), 'control point')} in two photographs or more{how}: {stays}"]
        return block, met, agree, sigma, said
    spread = np.sqrt(np.trace(covariance[known], axis1=1, axis2=2))
    assumed, surveyed = np.isnan(points.sigma_m[known]).any(axis=1), np.linalg.norm(sigma[known], axis=1)
    if not frame.at_place:
        # In the unit of the block's own frame, which a similarity is to tell.
        first = onto_control(met[known], frame.xyz[known], surveyed, points.file, assumed)
        spread = spread * first.similarity.scale
    onto = onto_control(met[known], frame.xyz[known], np.hypot(surveyed, spread), points.file, assumed)
    if onto.scatter_m is not None:
        sigma = np.where(np.isnan(points.sigma_m), onto.scatter_m, sigma)
    agree[known] = onto.agree
    said = [f"{int(onto.agree.sum())} of {counted(len(known), 'control point')} bring the block to their frame"]
    if frame.at_place:
        off = np.median((frame.xyz - met)[known[onto.agree]], axis=0)
        told = ", ".join(f"{v:.2f}" for v in np.round(off, 2) + 0.0)
        there = "the positions of the photographs have" if by_positions else "the block has"
        said.append(f"control lies {told} m (east, north, up) from where {there} it")
    block = dataclasses.replace(onto.similarity.of_block(block), frame=frame.frame)
    return block, onto.similarity.of(met), agree, sigma, said


def _assumed(control: GivenControl, sigma: Float[np.ndarray, "points 3"]) -> list[str]:
    said, none = [], np.isnan(control.points.sigma_m)
    if n := int(none.any(axis=1).sum()):
        taken = np.where(none, sigma, 0.0).max(axis=0)
        why = "they scatter about the photographs: " if (taken > SIGMA_M).any() else ""
        east, north, up = np.where(none.any(axis=0), np.maximum(taken, SIGMA_M), SIGMA_M)
        said.append(
            f"{n} surveyed points have no standard deviations: {why}{max(east, north):.2g} m east and north, "
            f"{up:.2g} m up are taken"
        )
    said += _one_height(control.points)
    if n := int(np.isnan(control.marks.sigma_px).sum()):
        said.append(f"{n} marks have no standard deviations: {MARK_SIGMA_PX:g} px is taken")
    return said


def _one_height(points: SurveyedPoints) -> list[str]:
    height = points.coordinates[:, 2]
    if len(height) < MINIMAL_SIZES or np.ptp(height) != 0:
        return []
    return [
        f"all {len(height)} surveyed heights are {height[0]:g} m; where nobody surveyed them, leave them empty and "
        "give positions of the photographs, which tell how the block lies"
    ]


def _tested(found: JudgedControl, now: Marked, used, able, ids, images):
    """Control points in use after the test, marks that go, and a sentence for each; nothing where all agree."""
    new, gone, said = used.copy(), np.zeros(len(now.image), bool), []
    of_points, of_marks = np.where(used, np.nan_to_num(found.w).max(axis=1), 0.0), np.nan_to_num(found.marks_w)
    wide = scatter(found.marks_w)
    worst = max(of_points.max(initial=0.0), of_marks.max(initial=0.0) / wide)
    if not worst > CRITICAL:
        back = able & ~used & ~beyond(found.w) & np.isfinite(found.w).any(axis=1)
        return new | back, gone, [""] * bool(back.any())
    # What a blunder does to the residuals about it is no second one.
    limit = max(CRITICAL, _BESIDE_THE_WORST * worst)
    for p in np.unique(now.point).tolist():
        row = max(np.flatnonzero(now.point == p), key=lambda k: of_marks[k])
        if max(of_marks[row] / wide, of_points[p]) < limit:
            continue
        if of_marks[row] < of_points[p]:
            new[p] = False
            said.append("")
            continue
        gone[row] = True
        off, image = np.linalg.norm(found.marks_px[row]), images[now.image[row]]
        said.append(f"the mark of {ids[p]} in {image} is {off:.3g} px off (w = {found.marks_w[row]:.3g}) and left out")
    return new, gone, said


def _left_out(ids, left, found: JudgedControl, frame: InFrame):
    for k in np.flatnonzero(left):
        told = ", ".join(f"{v:.3g}" for v in found.off_m[k])
        text = f"control point {ids[k]} contradicts the rest by {told} m (east, north, up) and is left out"
        near = np.linalg.norm(frame.xyz - found.adjusted_m[k], axis=1)
        other = int(np.argmin(np.where(np.arange(len(ids)) == k, np.inf, near)))
        if near[other] < 0.1 * np.linalg.norm(found.off_m[k]):
            text += f": its marks show {ids[other]}, so look at the names"
        yield text


def _spread(own: JudgedControl, seen) -> JudgedControl:
    """Over all surveyed points, NaN for those that are not in the block."""
    wide = lambda v: np.where(seen[:, None], v[np.cumsum(seen) - 1], np.nan)  # noqa: E731
    return own._replace(
        adjusted_m=wide(own.adjusted_m), off_m=wide(own.off_m), sigma_m=wide(own.sigma_m), w=wide(own.w)
    )


def rejudged(found: ControlledBlock, adjusted: Adjustment) -> ControlledBlock:
    """The same by another adjustment of its block, as with other weights."""
    seen = np.array(found.state, object) != "not marked"
    own = _spread(judged(adjusted, int(seen.sum()), found.xyz_m[seen], found.survey_sigma_m[seen]), seen)
    return found._replace(adjusted=adjusted, off_m=own.off_m, sigma_m=own.sigma_m, w=own.w, marks_px=own.marks_px)


def at_optimum(adjusted: Adjustment) -> Block:
    """The block of an adjustment, all of whose images and points start where that has led."""
    block = adjusted.block
    known = (np.ones(len(names), bool) for names in (block.images, block.points))
    return dataclasses.replace(block, start=Start(adjusted.unknowns, *known))


def _from(base: Block, adjusted: Adjustment) -> Block:
    """`base` that starts at the optimum of the same with control."""
    unknowns = dataclasses.replace(adjusted.unknowns, points=np.asarray(adjusted.unknowns.points)[: len(base.points)])
    return dataclasses.replace(base, start=dataclasses.replace(base.start, unknowns=unknowns))
