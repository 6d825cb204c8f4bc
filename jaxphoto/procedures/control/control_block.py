"""Adjust an oriented block with control, and reject control that contradicts the other observations.

1. Rays of marks are intersected; a mark that contradicts the others of its point is rejected.

2. Three or more consistent control points transform the block to their frame. With fewer the block is not transformed.

3. The block is adjusted with control. Iteratively, the control observation with the largest normalised residual is
rejected, and rejected points that agree are reinstated. Check points are never adjusted.

Normalised residuals test observations (Baarda). Check points and rejected points are tested by their difference divided
by its standard deviation, which includes survey and adjustment.

Every three points (or 300 samples of three) determine a similarity. The one with the most consistent points is refined
by least squares of these, unless more than half of all points fit another one ten times better (least trimmed squares,
Rousseeuw 1984). The tolerance allows for deformations that the adjustment removes: distortion, or weakly
determined positions. The first adjustment, which tests all points, starts without inconsistent ones.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block, Frame, Start
from jaxphoto.errors import DatumError, InputError, counted, few
from jaxphoto.georeferencing.map_frame import MapFrame, check_area, check_heights
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control.marks import (
    Marked,
    are_undistorted,
    factor_of_marks,
    intersected,
    into_block,
    marked,
    turned_marks,
    with_gnss_bias,
    without_names,
)
from jaxphoto.procedures.control.surveyed import (
    MARK_SIGMA_PX,
    SIGMA_M,
    ControlSystem,
    GivenControl,
    SurveyedPoints,
    check_near,
    filled,
    places,
    system_of,
)
from jaxphoto.procedures.georeference_photographs import looks_up, utm_of
from jaxphoto.procedures.orientation.blocks import Similarity, similarity_between
from jaxphoto.statistics import LEAST_CHECKED, covariance, normalised_residuals, redundancy_numbers

_SAMPLES = 300
# Tolerance of a point: number of standard deviations plus fraction of the extent of the control.
_BEYOND, _BENT = 5.0, 0.01
MIN_POINTS = 3


class OntoControl(NamedTuple):
    """Similarity, and the points that agree with it."""

    similarity: Similarity
    agree: Bool[np.ndarray, "points"]


def onto_control(
    there: Float[np.ndarray, "points 3"],
    here: Float[np.ndarray, "points 3"],
    sigma_m: Float[np.ndarray, "points"],
    file: str,
) -> OntoControl:
    """Estimate the similarity from `there`, in the frame of a block, to surveyed points `here`.

    `sigma_m`: standard deviations of the differences.

    Raises InputError for fewer than three points, for collinear points, and if no four points are consistent, with the
    cure if exchanging coordinates would help.
    """
    if len(here) < MIN_POINTS:
        raise InputError(
            f"{file}: {counted(len(here), 'control point')} in two photographs or more, but position, scale and "
            "attitude of a block need three; mark more"
        )
    best = _best(there, here, sigma_m)
    if best is None:
        raise InputError(
            f"{file}: the control points lie on a line, so the rotation about it is undetermined; mark one off the "
            "line, or orient photographs with positions"
        )
    if len(here) > MIN_POINTS and best.agree.sum() > MIN_POINTS:
        return best
    if best.agree.all() and len(here) == MIN_POINTS:
        return best
    exchanged = _best(there, here[:, [1, 0, 2]], sigma_m)
    if exchanged is not None and exchanged.agree.sum() > max(MIN_POINTS, best.agree.sum()):
        raise InputError(
            f"{file}: the control points fit the photographs with X and Y exchanged; exchange the two columns"
        )
    off = _off(best.similarity, there, here)
    raise InputError(
        f"{file}: the marks of the control points do not fit their coordinates ({np.median(off):.3g} m off in the "
        "median); check names, system and order of coordinates, and give standard deviations of a less accurate survey"
    )


def on_a_line(there: Float[np.ndarray, "points 3"], here: Float[np.ndarray, "points 3"]) -> bool:
    """Return True if all points are collinear, which leaves the rotation about their line undetermined."""
    return next(_of_threes(there, here), None) is None


# Minimum number of points for an affine transformation, maximum ratio of its misfit to that of a similarity, maximum
# relative difference of axes with the same unit.
_AFFINE_POINTS, _FITS_BETTER, _SAME_UNIT = 6, 0.1, 0.02


def check_units(there, here, file: str) -> None:
    """Raise InputError if the control fits with one axis in another unit: an affine transformation fits, no similarity.

    A = D s R of the least-squares transformation has A A' = s^2 D^2 with the factors D of the axes.
    """
    similarity = similarity_between(there, here)
    if len(here) < _AFFINE_POINTS or similarity is None:
        return
    columns = np.column_stack([there - there.mean(axis=0), np.ones(len(there))])
    solution, _, rank, _ = np.linalg.lstsq(columns, here, rcond=1e-3)
    freedom = 3 * len(here) - 12
    misfit = np.sqrt(np.sum((here - columns @ solution) ** 2) / freedom)
    if rank < 4 or misfit > _FITS_BETTER * np.sqrt(np.mean(_off(similarity, there, here) ** 2)):
        return
    squares = solution[:3].T @ solution[:3]
    size = np.sqrt(np.diagonal(squares))
    oblique = squares / np.outer(size, size) - np.eye(3)
    for axis, name in enumerate("XYZ"):
        others = np.delete(size, axis)
        factor = float(others.mean() / size[axis])
        same = max(np.abs(oblique).max(), np.ptp(others) / others.mean()) < _SAME_UNIT
        if same and abs(factor - 1) > _SAME_UNIT:
            raise InputError(
                f"{file}: the control points fit the photographs if {name} is multiplied by {factor:.4g}: correct its "
                "unit (1 ft is 0.3048 m)"
            )


def _off(similarity: Similarity, there, here) -> Float[np.ndarray, "points"]:
    return np.linalg.norm(here - similarity.of(there), axis=1)


def _size(here) -> float:
    return float(np.linalg.norm(np.ptp(here, axis=0)))


def _tolerance(here, sigma_m) -> Float[np.ndarray, "points"]:
    return _BEYOND * sigma_m + _BENT * _size(here)


def _of_threes(there, here) -> Iterator[Similarity]:
    samples = list(combinations(range(len(here)), MIN_POINTS))
    if len(samples) > _SAMPLES:
        rng = np.random.default_rng(0)
        samples = [tuple(rng.choice(len(here), MIN_POINTS, replace=False)) for _ in range(_SAMPLES)]
    for pick in samples:
        similarity = similarity_between(there[list(pick)], here[list(pick)], 0.02)
        if similarity is not None:
            yield similarity


def _best(there, here, sigma_m) -> OntoControl | None:
    samples = list(_of_threes(there, here))
    if not samples:
        return None
    tolerance = _tolerance(here, sigma_m)

    def score(similarity: Similarity) -> float:
        off = _off(similarity, there, here) / tolerance
        return float(np.sum(off < 1) - np.minimum(off, 1).mean())

    similarity = max(samples, key=score)
    for _ in range(5):
        agree = _off(similarity, there, here) < tolerance
        refined = similarity_between(there[agree], here[agree])
        if refined is None:
            break
        similarity = refined
    off = _off(similarity, there, here)
    agree = off < tolerance
    # A tilt may bring wrong heights within the tolerance: without them, more than half of the points fit far better.
    most = len(here) // 2 + 2
    if most < len(here) and agree.any():
        trimmed = _trimmed(samples, there, here, most)
        rest = _off(trimmed, there, here)
        scatter = np.sqrt(np.mean(np.sort(rest)[:most] ** 2))
        if scatter < _FITS_BETTER * np.sqrt(np.mean(off[agree] ** 2)):
            return OntoControl(trimmed, rest < np.minimum(tolerance, _BEYOND * np.hypot(sigma_m, scatter)))
    return OntoControl(similarity, agree)


def _trimmed(samples: list[Similarity], there, here, most: int) -> Similarity:
    """Return the similarity with the least sum of the `most` smallest squares (least trimmed squares, C-steps)."""

    def square(similarity: Similarity) -> float:
        return float(np.sum(np.sort(_off(similarity, there, here))[:most] ** 2))

    best = min(samples, key=square)
    for _ in range(5):
        chosen = np.argsort(_off(best, there, here))[:most]
        refined = similarity_between(there[chosen], here[chosen])
        if refined is None or square(refined) >= square(best):
            break
        best = refined
    return best


class InFrame(NamedTuple):
    """Surveyed points in a Cartesian frame."""

    frame: Frame
    xyz: Float[np.ndarray, "points 3"]
    """Coordinates in m; unknown heights are replaced by the median of the others."""
    at_place: bool
    """True if the block is already in this frame."""


def in_frame(
    block: Block, points: SurveyedPoints, words: str | None, code: int | None, vertical: int | None = None
) -> InFrame:
    """Transform the points to the frame of `block`, or to a new frame.

    `words` is the coordinate system if the file does not specify one. `code` is the EPSG code of a new frame, by
    default the system of the points or UTM; `vertical` is the EPSG code of its heights, by default as in the points.
    Raises InputError for a missing, contradictory or unusable system, and for points far from the block.
    """
    system = stated_system(points, words)
    if block.frame.kind == "epsg":
        assert block.frame.code is not None and block.frame.origin is not None
        if code is not None and code != block.frame.code:
            raise InputError(f"the block is in EPSG:{block.frame.code} already, and EPSG:{code} is given; omit it")
        if system.crs is None:
            raise InputError(
                f"{points.file} is in a local system and the block in EPSG:{block.frame.code}: give the control there, "
                "or orient the photographs without their positions"
            )
        check_near(points, system, *block.frame.origin[:2])
        there = places(points, system, block.frame.code)
        heights = block.frame.vertical if vertical is None else vertical
        if heights is None and block.frame.code == system.code:
            # The transformed block uses the vertical system of the points.
            heights = system.vertical
        return InFrame(
            dataclasses.replace(block.frame, vertical=heights), block.frame.map.local_from_place(there), True
        )
    if system.crs is None:
        return InFrame(dataclasses.replace(block.frame, kind="local"), filled(points), False)
    code = new_code(points, system) if code is None else code
    there = places(points, system, code)
    if system.code is not None:
        _check_area(points, system, system.code, there)
    middle = np.median(there, axis=0)
    origin = (round(float(middle[0]), 4), round(float(middle[1]), 4), 0.0)
    if vertical is None and code == system.code:
        vertical = system.vertical
    if vertical is not None:
        check_heights(code, vertical)
    return InFrame(
        Frame("epsg", code, vertical, origin=origin), MapFrame(code, vertical, origin).local_from_place(there), False
    )


def _check_area(points: SurveyedPoints, system: ControlSystem, code: int, there: Float[np.ndarray, "points 3"]) -> None:
    """Raise InputError for points outside the area of their system, with the cure if exchanging coordinates helps."""
    exchanged = points._replace(coordinates=points.coordinates[:, [1, 0, 2]])
    try:
        check_area(code, places(exchanged, system, code), points.file, exchanged.coordinates, "")
        cure = "with X and Y exchanged they are inside: exchange the two columns"
    except InputError:
        cure = "correct their unit or the system"
    check_area(code, there, points.file, points.coordinates, cure)


def stated_system(points: SurveyedPoints, words: str | None) -> ControlSystem:
    """Return the system in the file of `points`, else `words`. Raises InputError for none, and if they differ."""
    stated = system_of(points.system, points.file) if points.system else None
    given = system_of(words, "the EPSG code of the control") if words else None
    if stated and given and stated.crs != given.crs:
        raise InputError(f"{points.file} states {stated.name}, but {given.name} is given; omit the wrong one")
    system = stated or given
    if system is None:
        raise InputError(
            f"{points.file} does not state the coordinate system of its points; give its EPSG code (or local, for "
            "Cartesian metres without a map)"
        )
    return system


def new_code(points: SurveyedPoints, system: ControlSystem) -> int:
    """Return the EPSG code for a block without one: the map system of the points, or the UTM zone."""
    if system.code is not None and system.crs is not None and system.crs.is_projected:
        return system.code
    longitude, latitude, _ = np.median(places(points, system, 4326), axis=0)
    return utm_of(longitude, latitude)


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
    if (turned := turned_marks(block, block.start.unknowns, rows, met.good)) is not None:
        raise InputError(
            f"{points.file}: the marks contradict one another, but agree if {turned}. Columns and rows count from the "
            "upper left corner of the stored picture, whatever its EXIF orientation: convert the marks"
        )
    if (factor := factor_of_marks(block, block.start.unknowns, rows, met.good)) is not None:
        sensor = block.sensors[block.image_camera[rows.image[0]]]
        raise InputError(
            f"{points.file}: the marks contradict one another, but agree if their pixel coordinates are multiplied by "
            f"{factor:.3g}: they were measured in pictures of about {sensor.width_px / factor:.0f} x "
            f"{sensor.height_px / factor:.0f} px, the camera has {sensor.width_px} x {sensor.height_px} px. Multiply "
            "them, or mark the photographs in full size"
        )
    if are_undistorted(block, block.start.unknowns, rows):
        raise InputError(
            f"{points.file}: the rays of the marks intersect far better without the distortion of the camera, as if "
            "measured in undistorted pictures: measure them in the original pictures"
        )
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
        stays = f"the block {'remains in the frame of its positions' if by_positions else 'is not transformed'}"
        messages = [f"{counted(len(known), 'control point')} in two photographs or more{how}: {stays}"]
        return block, met, agree, messages
    check_units(met[known], frame.xyz[known], points.file)
    spread = np.sqrt(np.trace(covariance[known], axis1=1, axis2=2))
    surveyed = np.linalg.norm(sigma[known], axis=1)
    if not frame.at_place:
        # `spread` is in the unit of the block: convert it by the scale of a first similarity.
        first = onto_control(met[known], frame.xyz[known], surveyed, points.file)
        spread = spread * first.similarity.scale
    onto = onto_control(met[known], frame.xyz[known], np.hypot(surveyed, spread), points.file)
    agree[known] = onto.agree
    if not frame.at_place:
        check_handedness(block, onto, met[known], frame.xyz[known], np.hypot(surveyed, spread), points.file)
    messages = [f"{int(onto.agree.sum())} of {counted(len(known), 'control point')} define the frame of the block"]
    if frame.at_place:
        off = np.median((frame.xyz - met)[known[onto.agree]], axis=0)
        offset = ", ".join(f"{v:.2f}" for v in np.round(off, 2) + 0.0)
        there = "the positions of the photographs" if by_positions else "the block"
        messages.append(f"offset of the control from {there}: {offset} m (east, north, up)")
    block = dataclasses.replace(onto.similarity.of_block(block), frame=frame.frame)
    return block, onto.similarity.of(met), agree, messages


def check_handedness(block: Block, onto: OntoControl, there, here, sigma_m, file: str) -> None:
    """Raise InputError if all images look up and the control fits as well with X and Y exchanged.

    A mirrored plan on flat ground is that of a block turned by half a turn about a horizontal axis.
    """
    if not looks_up(block, onto.similarity):
        return
    exchanged = _best(there, here[:, [1, 0, 2]], sigma_m)
    if exchanged is not None and exchanged.agree.sum() >= onto.agree.sum():
        raise InputError(
            f"{file}: with these coordinates all images would be below the ground and look up. With X and Y exchanged "
            "they fit as well, and the images look down: exchange the two columns, or correct the sign of one axis. If "
            "the images do look up (a ceiling), survey a point off the plane of the others"
        )


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
    # A blunder often causes further, smaller residuals nearby.
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
