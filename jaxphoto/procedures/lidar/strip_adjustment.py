"""Strip adjustment: laser strips fitted to each other in their overlap, by scanner and trajectory corrections.

Planes common to two strips are found by cells, and observed to coincide (`observations.StripPlanes`); scanner and
trajectory are corrected, the cloud is recomputed from range, angle and trajectory, and planes are found in it again,
until convergence.
"""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import empty_block
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import StripErrors, StripSpline, Trajectory
from jaxphoto.lidar.correction import correct_flight, scanner_path, times_of
from jaxphoto.lidar.coverage import check_covered
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.iterate_to_convergence import CHANGE_LIMIT, adjust_with_fixed_interior, at_result
from jaxphoto.procedures.lidar.photographs import Photographs, check_photographs, on_trajectory, spans_with
from jaxphoto.procedures.lidar.plane_search import CommonPlanes, PointPlanes, PointSearch, StripSearch, check_joined
from jaxphoto.procedures.lidar.scanner_checks import check_measured_from
from jaxphoto.procedures.lidar.strip_control import (
    CHECK,
    CONTROL,
    ControlSearch,
    OnStrips,
    SurveyedGap,
    check_seen,
    surveyed_gaps,
    with_control,
    with_datum,
)
from jaxphoto.procedures.lidar.strip_model import ScannerPriors, errors_of, knot_sigmas, step_rows, strip_block
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.statistics import Covariance, covariance
from jaxphoto.unknowns import FIXED

MAX_STRIP_ROUNDS = 10
PHOTOGRAPHS = "photographs"
"""Name of the tie points of photographs in tables of differences."""
# From this iteration on returns stay in their cells: strips fit to their noise by then.
_SETTLED = 2
# Their matrix has 29 GB.
_MOST_KNOTS = 10_000


class StripRound(NamedTuple):
    """One iteration."""

    number: int
    planes: int
    """Number observed; at most `StripSettings.most` of those that fit."""
    points: int
    """Tie points of photographs observed to lie on a plane; one on planes of two strips counts twice."""
    control: int
    """Surveyed points observed likewise."""
    left_out: int
    """Rejected planes and points."""
    rms_m: float
    """Of the gaps of all fitting planes, before this adjustment; NaN for one strip."""
    largest_change: float
    """Of the unknowns of scanner, trajectory and cameras, in standard deviations."""


class StripDifference(NamedTuple):
    """Difference of two strips in their overlap, or of points and the planes of a strip, before and after.

    Points are tie points of photographs, control or check points: named in `one`.
    """

    one: str
    other: str
    planes_before: int
    planes: int
    mean_before_m: float
    """Mean gap along the normals of fitting planes: the first above the other."""
    rms_before_m: float
    mean_m: float
    rms_m: float
    noise_m: float
    """Expected `rms_m` from the roughness of the planes alone; for tie points an upper bound."""


class StripAdjustment(eqx.Module):
    """Strips before and after their adjustment."""

    before: Adjustment | None
    """Adjustment of the photographs alone, with fixed interior orientation; None without photographs."""
    adjusted: Adjustment
    covariance: Covariance
    cloud: Cloud
    """Corrected, with all fields."""
    trajectory: Trajectory | None
    """Corrected."""
    errors: StripErrors
    """Errors that were removed."""
    differences: tuple[StripDifference, ...]
    rounds: tuple[StripRound, ...]
    converged: bool
    """True if the iteration converged."""
    warnings: tuple[str, ...] = ()
    """Messages about inconsistencies of cloud and trajectory."""
    surveyed: tuple[SurveyedGap, ...] = ()
    """Control and check points, each above the plane of each strip that has one."""


def adjust_strips(
    cloud: Cloud,
    trajectory: Trajectory | None = None,
    settings: StripSettings | None = None,
    priors: ScannerPriors | None = None,
    *,
    photographs: Photographs | None = None,
    control: SurveyedPoints | None = None,
    fixed: Collection[str] | Literal["all"] = (),
    max_rounds: int = MAX_STRIP_ROUNDS,
    report: Callable[[StripRound], None] = lambda made: None,
) -> StripAdjustment:
    """Adjust the strips of `cloud`; `trajectory` is that of its scanner, on the cloud's clock.

    Standard deviations stated by the trajectory replace those of `settings`; zero states none.

    `photographs` taken on it are adjusted as well: their exposures have the trajectory's errors, and their tie points
    lie on the planes of the strips, those on breaklines on both faces. Their block defines the unknowns of cameras and
    mounts; its stations and attitudes are taken to be the trajectory's.

    `control` are surveyed points on smooth surfaces, in the cloud's system (m): strips with planes about them pass
    through them. Its check points are only compared. Without a trajectory it is the datum, too.

    `priors` are those of the scanner and include its pattern; by default lines, its boresight FREE and all else FIXED.
    For circular patterns, forward and backward looks of a strip are compared, too. `fixed` are strips whose trajectory
    is not corrected, or "all". Without a trajectory each strip has only a shift, and the first is fixed if none is
    named, in the directions that control does not determine.

    Raises InputError for a cloud of one strip without control, of strips without points or without the times that a
    trajectory needs, for a time offset of a circular scanner and for control without heights or standard deviations;
    BlockError for strips without common planes, for control away from them and for a trajectory that does not cover the
    cloud or the exposures; and what `jaxphoto.adjust` raises.
    """
    settings = StripSettings() if settings is None else settings
    if trajectory is None and priors is not None:
        raise InputError(
            "without a trajectory strips have shifts alone, and nothing is estimated of their scanner: give the "
            "trajectory (--trajectory), or say nothing of the scanner"
        )
    priors = ScannerPriors() if priors is None else priors
    if priors.calibration.pattern == "circle" and priors.calibration.time_offset != FIXED:
        raise InputError(
            "the time offset of a scanner that looks all around is not estimated, because what it sees of one plane is "
            "seconds apart: leave out time-offset, and shift the trajectory (--trajectory-shift-s)"
        )
    fixed = cloud.strips if fixed == "all" else fixed
    names = _check(cloud, trajectory, fixed, photographs is None and priors.right, control is not None)
    path = None if trajectory is None else scanner_path(trajectory)
    pattern = priors.calibration.pattern
    messages = [] if path is None else check_measured_from(cloud, path, None if priors.right else pattern)
    spans, images = _spans(cloud), None
    if photographs is not None:
        check_photographs(photographs, trajectory)
        spans = spans_with(photographs.time, spans)
    splines = _splines(spans, trajectory, settings)
    before_strips = None if photographs is None else adjust_with_fixed_interior(photographs.block)
    if photographs is not None and before_strips is not None:
        images = at_result(on_trajectory(photographs, splines, spans, settings), before_strips.unknowns)
    sigmas = knot_sigmas(splines, trajectory, settings)
    block, number = images, np.zeros(0, int)
    if control is not None:
        block, number = with_control(empty_block("strips and control") if images is None else images, control)
    if trajectory is None:
        # With control, its datum below replaces that of a strip.
        right = fixed if fixed or control is not None else names[:1]
        block = strip_block(names, splines, right, sigmas, None, block)
    else:
        block = strip_block(names, splines, fixed, sigmas, priors, block)
    steps = tuple(rows for rows in step_rows(splines, sigmas, settings) if len(rows))
    search, errors = StripSearch(cloud, path, settings, pattern), errors_of(block.start.unknowns, splines)
    first = common = search.look(errors, settled=False)
    check_joined(names, common)
    ties = None
    if images is not None and photographs is not None:
        lines = tie_points(images, photographs.breaklines)
        ties = PointSearch(search, np.setdiff1d(tie_points(images), lines), lines)
    first_on_ties = on_ties = (
        []
        if ties is None or before_strips is None
        else ties.look(*_points_and_covariances(ties, before_strips, covariance(before_strips)), False)
    )
    surveyed = None if control is None else ControlSearch(search, control, number)
    first_on_surveyed = on_surveyed = OnStrips([], []) if surveyed is None else surveyed.look(settled=False)
    if control is not None:
        check_seen(control, on_surveyed, search)
        block = block if trajectory is not None or fixed else with_datum(block, names[0], on_surveyed, settings)
    rounds: list[StripRound] = []
    before = np.zeros(())
    while True:
        planes, points = search.rows(common, errors), () if ties is None else ties.rows(on_ties, errors)
        control_rows = () if surveyed is None else surveyed.rows(on_surveyed, errors)
        point_rows = (StripPoints.joined(*points, *control_rows),) if points or control_rows else ()
        observed = dataclasses.replace(block, more=(*block.more, planes, *point_rows, *steps))
        adjusted = adjust(observed, observed.start.unknowns)
        # With rows, because any iteration may be the last: its covariance also serves the tables of the result.
        cov = covariance(adjusted, rows=True)
        now = np.asarray(adjusted.values.shared)[adjusted.structure.free]
        counted = len(planes), sum(map(len, points)), sum(map(len, control_rows))
        rounds.append(
            _iteration_record(
                len(rounds) + 1, counted, common, [*on_ties, *on_surveyed.control], _change(now - before, cov)
            )
        )
        report(rounds[-1])
        converged = rounds[-1].largest_change < CHANGE_LIMIT and bool(adjusted.converged)
        block, before, errors = at_result(block, adjusted.unknowns), now, errors_of(adjusted.unknowns, splines)
        settled = len(rounds) >= _SETTLED
        common = search.look(errors, settled)
        on_ties = [] if ties is None else ties.look(*_points_and_covariances(ties, adjusted, cov), settled)
        on_surveyed = OnStrips([], []) if surveyed is None else surveyed.look(settled)
        if converged or len(rounds) >= max_rounds:
            return StripAdjustment(
                before_strips,
                adjusted,
                cov,
                search.corrected_cloud,
                None if trajectory is None else correct_flight(trajectory, errors),
                errors,
                _differences(first, common)
                + _point_differences(PHOTOGRAPHS, first_on_ties, on_ties)
                + _point_differences(CONTROL, first_on_surveyed.control, on_surveyed.control)
                + _point_differences(CHECK, first_on_surveyed.check, on_surveyed.check),
                tuple(rounds),
                converged,
                (*messages, *(() if ties is None else ties.unseen(on_ties, adjusted.block.points))),
                () if control is None else surveyed_gaps(control, on_surveyed, errors, path, adjusted, cov),
            )
        # For a large flight gigabytes, which the next iteration needs.
        del adjusted, cov


def _check(
    cloud: Cloud, trajectory: Trajectory | None, fixed: Collection[str], strips_alone: bool, controlled: bool
) -> tuple[str, ...]:
    names = cloud.strips
    if cloud.strip is None or len(names) < (1 if controlled else 2):
        raise InputError(
            "the cloud has one strip, and nothing to compare it with: give each flight line its own point source ID, "
            "or a column strip; or control (--control)"
        )
    for k, name in enumerate(names):
        if not np.any(cloud.strip == k):
            raise InputError(f"strip {name} of the cloud has no points: omit it, or read other classes and returns")
    for name in fixed:
        if name not in names:
            raise InputError(f"{name} is no strip of the cloud, which has {', '.join(names)}: correct its name")
    if set(names) <= set(fixed) and (strips_alone or trajectory is None):
        raise InputError("all strips are fixed: nothing is left to adjust; fix fewer")
    if trajectory is not None and cloud.time is None:
        raise InputError(
            "the cloud has no times, which a trajectory requires: use a cloud with GPS times, or omit the trajectory "
            "to estimate one shift per strip"
        )
    if trajectory is not None:
        check_covered(cloud, trajectory)
    return names


def _spans(cloud: Cloud) -> Float[np.ndarray, "strips 2"]:
    """Return first and last time of each strip (s)."""
    time = times_of(cloud)
    times = [time[cloud.strip == k] for k in range(len(cloud.strips))]
    return np.array([(t.min(), t.max()) for t in times])


def _splines(
    spans: Float[np.ndarray, "strips 2"], trajectory: Trajectory | None, settings: StripSettings
) -> tuple[StripSpline, ...]:
    splines: list[StripSpline] = []
    wanted = 0 if trajectory is None else float(np.ptp(spans, axis=1).sum()) / settings.knots_s
    if wanted > _MOST_KNOTS:
        raise InputError(
            f"with knots {settings.knots_s:g} s apart the trajectory has {wanted:.0f} of them, of six unknowns each, "
            f"and {_MOST_KNOTS} fill a computer: take them farther apart (--knots-s)"
        )
    for start, end in spans.tolist():
        first = sum(s.size for s in splines)
        constant = trajectory is None
        splines.append(
            StripSpline.constant(first) if constant else StripSpline.over(first, start, end, settings.knots_s)
        )
    return tuple(splines)


def _iteration_record(
    number: int,
    observed: tuple[int, int, int],
    planes: Sequence[CommonPlanes],
    on: Sequence[PointPlanes],
    change: float,
) -> StripRound:
    gaps = np.concatenate([np.zeros(0), *(f.pairs.gap[f.fits] for f in planes)])
    left_out = sum(int((~f).sum()) for f in (*(f.fits for f in planes), *(f.fits for f in on)))
    return StripRound(number, *observed, left_out, _rms(gaps), change)


def _points_and_covariances(
    search: PointSearch, adjusted: Adjustment, cov: Covariance
) -> tuple[np.ndarray, np.ndarray]:
    """Return adjusted positions of points (m), and their covariances."""
    return np.asarray(adjusted.unknowns.points)[search.points], np.asarray(cov.points)[search.points]


def _change(moved: Float[np.ndarray, "unknowns"], cov: Covariance) -> float:
    """Return the largest change of an unknown, in standard deviations."""
    sigma = np.asarray(cov.shared_sigma)
    return float(np.max(np.abs(moved)[sigma > 0] / sigma[sigma > 0], initial=0.0))


def _differences(before: Sequence[CommonPlanes], after: Sequence[CommonPlanes]) -> tuple[StripDifference, ...]:
    then, rows = {(f.one.name, f.other.name): f.pairs.gap[f.fits] for f in before}, []
    for f in after:
        was = then.get((f.one.name, f.other.name), np.zeros(0))
        rows.append(_difference(f.one.name, f.other.name, was, f.pairs.gap[f.fits], f.pairs.sigma[f.fits]))
    return tuple(rows)


def _point_differences(
    what: str, before: Sequence[PointPlanes], after: Sequence[PointPlanes]
) -> tuple[StripDifference, ...]:
    """Return the differences of points and planes, by strip."""
    rows = []
    for was, now in zip(before, after, strict=True):
        if now.fits.any():
            then, sigma = was.found.gap[was.fits], now.sigma if what != PHOTOGRAPHS else now.found.sigma
            rows.append(_difference(what, now.look.name, then, now.found.gap[now.fits], sigma[now.fits]))
    return tuple(rows)


def _difference(one: str, other: str, was: np.ndarray, gap: np.ndarray, sigma: np.ndarray) -> StripDifference:
    then = (float(was.mean()), _rms(was)) if len(was) else (np.nan, np.nan)
    return StripDifference(one, other, len(was), len(gap), *then, float(gap.mean()), _rms(gap), _rms(sigma))


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
