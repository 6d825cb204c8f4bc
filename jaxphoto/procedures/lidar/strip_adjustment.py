"""Strip adjustment: fit overlapping laser strips to each other by scanner and trajectory corrections.

Planes common to two strips are found by cells, and observed to coincide (`observations.StripPlanes`). Scanner and
trajectory are corrected, and the cloud is recomputed from range, angle and trajectory. Search and adjustment are
iterated to convergence.
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
from jaxphoto.lidar.correction import check_covered, correct_flight, scanner_path, times_of
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.iterate_to_convergence import CHANGE_LIMIT, adjust_with_fixed_interior, at_result
from jaxphoto.procedures.lidar.plane_search import CommonPlanes, PointPlanes, PointSearch, StripSearch, check_joined
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
from jaxphoto.procedures.lidar.strip_model import (
    Photographs,
    ScannerPriors,
    check_measured_from,
    check_photographs,
    errors_of,
    knot_sigmas,
    on_trajectory,
    spans_with,
    step_rows,
    strip_block,
)
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.statistics import Covariance, covariance
from jaxphoto.unknowns import FIXED

MAX_STRIP_ROUNDS = 10
PHOTOGRAPHS = "photographs"
"""Name of the tie points of photographs in tables of differences."""
# Number of iterations after which returns stay in their cells: strips then fit to their noise.
_SETTLED = 2
# Maximum number of spline knots; their normal matrix has 29 GB.
_MOST_KNOTS = 10_000


class StripRound(NamedTuple):
    """Record of one iteration."""

    number: int
    planes: int
    """Number of planes observed; at most `StripSettings.most` of the fitting ones."""
    points: int
    """Number of observations that tie points of photographs lie on a plane; a point on planes of two strips counts
    twice.
    """
    control: int
    """Number of observations that surveyed points lie on a plane."""
    left_out: int
    """Number of rejected planes and points."""
    rms_m: float
    """RMS gap of all fitting planes, before this adjustment; NaN for one strip."""
    largest_change: float
    """Largest change of the unknowns of scanner, trajectory and cameras, in standard deviations."""


class StripDifference(NamedTuple):
    """Difference of two strips in their overlap, or of points and the planes of a strip, before and after adjustment.

    Points are tie points of photographs, control or check points, as named in `one`.
    """

    one: str
    other: str
    planes_before: int
    planes: int
    mean_before_m: float
    """Mean gap along the normals of fitting planes: the first above the second."""
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
    """Corrected cloud, with all fields."""
    trajectory: Trajectory | None
    """Corrected trajectory."""
    errors: StripErrors
    """Errors that were removed."""
    differences: tuple[StripDifference, ...]
    rounds: tuple[StripRound, ...]
    converged: bool
    """True if the iteration converged."""
    surveyed: tuple[SurveyedGap, ...] = ()
    """Control and check points above the planes of strips: one item per point and plane."""


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
    """Adjust the strips of `cloud`; `trajectory` is the path of its scanner, on the cloud's clock.

    Standard deviations in the trajectory replace the values of `settings`; zero means unknown.

    `photographs` of the same flight are also adjusted: their exposures have the trajectory's errors, and their tie
    points lie on the planes of the strips. Their block defines the unknowns of cameras and mounts; its stations and
    attitudes are assumed to come from the trajectory.

    `control` contains surveyed points on smooth surfaces, in the cloud's system (m): planes near them are observed to
    pass through them. Its check points are only compared. Without a trajectory, control also defines the datum.

    `priors` are the priors of the scanner and include its pattern; by default lines, its boresight FREE and all else
    FIXED. For circular patterns, forward and backward looks of a strip are also compared. `fixed` are strips whose
    trajectory is not corrected, or "all". Without a trajectory, each strip has only a shift, and by default the first
    is fixed in the directions that control does not determine.
    """
    settings = StripSettings() if settings is None else settings
    if trajectory is None and priors is not None:
        raise InputError(
            "without a trajectory only strip shifts are estimated, not the scanner: give the trajectory "
            "(--trajectory), or omit the scanner"
        )
    priors = ScannerPriors() if priors is None else priors
    if priors.calibration.pattern == "circle" and priors.calibration.time_offset != FIXED:
        raise InputError(
            "the time offset of a circular scanner is not estimated, because its returns of one plane are seconds "
            "apart: omit time-offset, and shift the trajectory (--trajectory-shift-s)"
        )
    fixed = cloud.strips if fixed == "all" else fixed
    names = _check(cloud, trajectory, fixed, photographs is None and priors.right, control is not None)
    path = None if trajectory is None else scanner_path(trajectory)
    pattern = priors.calibration.pattern
    if path is not None:
        check_measured_from(cloud, path, None if priors.right else pattern)
    time, images = times_of(cloud), None
    spans = np.array([(t.min(), t.max()) for t in (time[cloud.strip == k] for k in range(len(names)))])
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
        # With control, `with_datum` below replaces the fixed strip.
        right = fixed if fixed or control is not None else names[:1]
        block = strip_block(names, splines, right, sigmas, None, block)
    else:
        block = strip_block(names, splines, fixed, sigmas, priors, block)
    steps = tuple(rows for rows in step_rows(splines, sigmas, settings) if len(rows))
    search, errors = StripSearch(cloud, path, settings, pattern), errors_of(block.start.unknowns, splines)
    ties = None if images is None else PointSearch(search, tie_points(images))
    surveyed = None if control is None else ControlSearch(search, control, number)

    def look(
        adjusted: Adjustment | None, cov: Covariance | None, settled: bool
    ) -> tuple[list[CommonPlanes], list[PointPlanes], OnStrips]:
        """Search for common planes of strips, and planes at tie points and surveyed points."""
        common, on_ties = search.look(errors, settled), []
        if ties is not None and adjusted is not None and cov is not None:
            place, spread = (np.asarray(v)[ties.points] for v in (adjusted.unknowns.points, cov.points))
            on_ties = ties.look(place, spread, settled)
        return common, on_ties, OnStrips([], []) if surveyed is None else surveyed.look(settled)

    first, first_on_ties, first_on_surveyed = common, on_ties, on_surveyed = look(
        before_strips, None if before_strips is None else covariance(before_strips), False
    )
    check_joined(names, common)
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
        # Include rows, because any iteration may be the last: its covariance also serves the tables of the result.
        cov = covariance(adjusted, rows=True)
        now = np.asarray(adjusted.values.shared)[adjusted.structure.free]
        gaps = np.concatenate([np.zeros(0), *(f.pairs.gap[f.fits] for f in common)])
        fits = [f.fits for f in common] + [f.fits for f in (*on_ties, *on_surveyed.control)]
        rejected = sum(int((~of).sum()) for of in fits)
        counted = len(planes), sum(map(len, points)), sum(map(len, control_rows))
        sigma = np.asarray(cov.shared_sigma)
        change = float(np.max(np.abs(now - before)[sigma > 0] / sigma[sigma > 0], initial=0.0))
        rounds.append(StripRound(len(rounds) + 1, *counted, rejected, _rms(gaps), change))
        report(rounds[-1])
        converged = rounds[-1].largest_change < CHANGE_LIMIT and bool(adjusted.converged)
        block, before, errors = at_result(block, adjusted.unknowns), now, errors_of(adjusted.unknowns, splines)
        settled = len(rounds) >= _SETTLED
        common, on_ties, on_surveyed = look(adjusted, cov, settled)
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
                () if control is None else surveyed_gaps(control, on_surveyed, errors, path, adjusted, cov),
            )
        # Free gigabytes for large flights before the next iteration.
        del adjusted, cov


def _check(
    cloud: Cloud, trajectory: Trajectory | None, fixed: Collection[str], strips_alone: bool, controlled: bool
) -> tuple[str, ...]:
    names = cloud.strips
    if cloud.strip is None or len(names) < (1 if controlled else 2):
        raise InputError(
            "the cloud has one strip only: give each flight line its own point source ID, or a column strip; or "
            "control (--control)"
        )
    for k, name in enumerate(names):
        if not np.any(cloud.strip == k):
            raise InputError(f"strip {name} of the cloud has no points: omit it, or read other classes and returns")
    for name in fixed:
        if name not in names:
            raise InputError(f"unknown strip {name}; choose among {', '.join(names)}")
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


def _splines(
    spans: Float[np.ndarray, "strips 2"], trajectory: Trajectory | None, settings: StripSettings
) -> tuple[StripSpline, ...]:
    splines: list[StripSpline] = []
    wanted = 0 if trajectory is None else float(np.ptp(spans, axis=1).sum()) / settings.knots_s
    if wanted > _MOST_KNOTS:
        raise InputError(
            f"with knots {settings.knots_s:g} s apart the trajectory has {wanted:.0f} knots of six unknowns each "
            f"(limit {_MOST_KNOTS}): increase --knots-s"
        )
    for start, end in spans.tolist():
        first = sum(s.size for s in splines)
        constant = trajectory is None
        splines.append(
            StripSpline.constant(first) if constant else StripSpline.over(first, start, end, settings.knots_s)
        )
    return tuple(splines)


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
