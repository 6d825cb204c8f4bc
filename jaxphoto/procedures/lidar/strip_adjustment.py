"""Strip adjustment: laser strips fitted to each other where they overlap, by their scanner and their trajectory.

Planes are sought in the cells that two strips have in common, and observed to be one (`observations.StripPlanes`);
scanner and trajectory are corrected, the cloud is computed anew from range, angle and trajectory, and planes are sought
in it again, until nothing changes.
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
from jaxphoto.lidar.correction import scanner_path
from jaxphoto.lidar.coverage import check_covered
from jaxphoto.lidar.strip_correction import correct_flight, times_of
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.observations import StripPoints
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.photographs import Photographs, check_photographs, on_trajectory, spans_with
from jaxphoto.procedures.lidar.scanner_checks import check_measured_from
from jaxphoto.procedures.lidar.strip_control import (
    CHECK,
    CONTROL,
    ControlSearch,
    OnStrips,
    check_seen,
    with_control,
    with_datum,
)
from jaxphoto.procedures.lidar.strip_rows import step_rows
from jaxphoto.procedures.lidar.strip_search import CommonPlanes, StripSearch, check_joined
from jaxphoto.procedures.lidar.strip_unknowns import ScannerPriors, errors_of, knot_sigmas, strip_block
from jaxphoto.procedures.lidar.surveyed_gaps import SurveyedGap, surveyed_gaps
from jaxphoto.procedures.lidar.tie_point_search import PointPlanes, PointSearch
from jaxphoto.procedures.lidar.until_still import STILL, at_result, with_interior_held
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.statistics import Covariance, covariance
from jaxphoto.unknowns import FIXED

MAX_STRIP_ROUNDS = 10
PHOTOGRAPHS = "photographs"
"""What differences call the tie points of photographs beside strips."""
# From this round on returns stay in their cells: strips fit to their noise by then.
_SETTLED = 2
# Their matrix has 29 GB.
_MOST_KNOTS = 10_000


class StripRound(NamedTuple):
    """One adjustment, and what it changed."""

    number: int
    planes: int
    """Observed; of all that fit at most `StripSettings.most`."""
    points: int
    """Tie points of photographs observed to lie on a plane; one that lies on those of two strips counts twice."""
    control: int
    """Surveyed points observed likewise."""
    left_out: int
    """Planes and points that did not fit."""
    rms_m: float
    """Of the gaps of all planes that fit, before this adjustment; no number of one strip."""
    largest_change: float
    """Of an unknown of scanner, trajectory and cameras, in standard deviations."""


class StripDifference(NamedTuple):
    """Two strips where they overlap, or points over the planes of a strip, before and after.

    Points are tie points of photographs, control or check points: `one` says which.
    """

    one: str
    other: str
    planes_before: int
    planes: int
    mean_before_m: float
    """Of the gaps along the normals of the planes that fit, by which the first lies above the other."""
    rms_before_m: float
    mean_m: float
    rms_m: float
    noise_m: float
    """What the roughness of the planes lets expect of `rms_m` where nothing else is wrong; of tie points, at most."""


class StripAdjustment(eqx.Module):
    """Strips after their adjustment, and before."""

    before: Adjustment | None
    """The photographs alone, their interior orientation held; None without any."""
    adjusted: Adjustment
    covariance: Covariance
    cloud: Cloud
    """Corrected, with all that it had."""
    trajectory: Trajectory | None
    """Corrected."""
    errors: StripErrors
    """What was taken off."""
    differences: tuple[StripDifference, ...]
    rounds: tuple[StripRound, ...]
    still: bool
    """Whether nothing changed any more at the end."""
    odd: tuple[str, ...] = ()
    """What is odd about cloud and trajectory, in sentences."""
    surveyed: tuple[SurveyedGap, ...] = ()
    """Control and check points, each over the plane of each strip that has one."""


def adjust_strips(
    cloud: Cloud,
    trajectory: Trajectory | None = None,
    settings: StripSettings | None = None,
    priors: ScannerPriors | None = None,
    *,
    photographs: Photographs | None = None,
    control: SurveyedPoints | None = None,
    held: Collection[str] | Literal["all"] = (),
    max_rounds: int = MAX_STRIP_ROUNDS,
    report: Callable[[StripRound], None] = lambda made: None,
) -> StripAdjustment:
    """Adjust the strips of `cloud`; `trajectory` is that of its scanner, on the cloud's clock.

    Standard deviations that it states are those of its errors, in place of those of `settings`; zero states none.

    `photographs` that were taken on it are adjusted with them: their exposures have the trajectory's errors, and their
    tie points lie on the planes of the strips, those on breaklines on both that meet there. What of their cameras and
    mounts is estimated their block says; its stations and attitudes are taken for the trajectory's.

    `control` are surveyed points on smooth surfaces, in the cloud's system (m): where strips have planes about them,
    these go through them. Its check points are compared alone. Without a trajectory it is the datum, too.

    `priors` are those of the scanner and say its pattern; by default lines, its boresight FREE and all else FIXED. Of
    one that looks all around, what a strip saw ahead and behind is compared, too. The trajectory of strips
    named in `held` is right, or that of all. Without a trajectory each strip has a shift alone, and the first is held
    where none is named, in the directions that control does not tell.

    Raises InputError for a cloud of one strip without control, of strips without points or without the times that a
    trajectory needs, for a time offset of a scanner that looks all around and for control without heights or standard
    deviations;
    BlockError for strips that no plane joins, for control that lies elsewhere and for a trajectory that does not cover
    the cloud or the exposures; and as `jaxphoto.adjust`.
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
    held = cloud.strips if held == "all" else held
    names = _check(cloud, trajectory, held, photographs is None and priors.right, control is not None)
    path = None if trajectory is None else scanner_path(trajectory)
    pattern = priors.calibration.pattern
    odd = [] if path is None else check_measured_from(cloud, path, None if priors.right else pattern)
    spans, images = _spans(cloud), None
    if photographs is not None:
        check_photographs(photographs, trajectory)
        spans = spans_with(photographs.time, spans)
    splines = _splines(spans, trajectory, settings)
    alone = None if photographs is None else with_interior_held(photographs.block)
    if photographs is not None and alone is not None:
        images = at_result(on_trajectory(photographs, splines, spans, settings), alone.unknowns)
    sigmas = knot_sigmas(splines, trajectory, settings)
    block, number = images, np.zeros(0, int)
    if control is not None:
        block, number = with_control(empty_block("strips and control") if images is None else images, control)
    if trajectory is None:
        # With control its datum, below, is in place of a strip.
        right = held if held or control is not None else names[:1]
        block = strip_block(names, splines, right, sigmas, None, block)
    else:
        block = strip_block(names, splines, held, sigmas, priors, block)
    steps = tuple(rows for rows in step_rows(splines, sigmas, settings) if len(rows))
    search, errors = StripSearch(cloud, path, settings, pattern), errors_of(block.start.unknowns, splines)
    first = seen = search.look(errors, settled=False)
    check_joined(names, seen)
    ties = None
    if images is not None and photographs is not None:
        lines = tie_points(images, photographs.breaklines)
        ties = PointSearch(search, np.setdiff1d(tie_points(images), lines), lines)
    first_on = on = [] if ties is None or alone is None else ties.look(*_of(ties, alone, covariance(alone)), False)
    surveyed = None if control is None else ControlSearch(search, control, number)
    first_met = met = OnStrips([], []) if surveyed is None else surveyed.look(settled=False)
    if control is not None:
        check_seen(control, met, search)
        block = block if trajectory is not None or held else with_datum(block, names[0], met, settings)
    rounds: list[StripRound] = []
    before = np.zeros(())
    while True:
        planes, points = search.rows(seen, errors), () if ties is None else ties.rows(on, errors)
        given = () if surveyed is None else surveyed.rows(met, errors)
        lying = (StripPoints.joined(*points, *given),) if points or given else ()
        posed = dataclasses.replace(block, more=(*block.more, planes, *lying, *steps))
        adjusted = adjust(posed, posed.start.unknowns)
        # With rows, as nobody knows which round is the last: its covariance serves the tables of the result, too.
        known = covariance(adjusted, rows=True)
        now = np.asarray(adjusted.values.shared)[adjusted.structure.free]
        counted = len(planes), sum(map(len, points)), sum(map(len, given))
        rounds.append(_round(len(rounds) + 1, counted, seen, [*on, *met.control], _change(now - before, known)))
        report(rounds[-1])
        still = rounds[-1].largest_change < STILL and bool(adjusted.converged)
        block, before, errors = at_result(block, adjusted.unknowns), now, errors_of(adjusted.unknowns, splines)
        settled = len(rounds) >= _SETTLED
        seen = search.look(errors, settled)
        on = [] if ties is None else ties.look(*_of(ties, adjusted, known), settled)
        met = OnStrips([], []) if surveyed is None else surveyed.look(settled)
        if still or len(rounds) >= max_rounds:
            return StripAdjustment(
                alone,
                adjusted,
                known,
                search.corrected_cloud,
                None if trajectory is None else correct_flight(trajectory, errors),
                errors,
                _differences(first, seen)
                + _point_differences(PHOTOGRAPHS, first_on, on)
                + _point_differences(CONTROL, first_met.control, met.control)
                + _point_differences(CHECK, first_met.check, met.check),
                tuple(rounds),
                still,
                (*odd, *(() if ties is None else ties.unseen(on, adjusted.block.points))),
                () if control is None else surveyed_gaps(control, met, errors, path, adjusted, known),
            )
        # Of a large flight gigabytes, which the next round needs.
        del adjusted, known


def _check(
    cloud: Cloud, trajectory: Trajectory | None, held: Collection[str], strips_alone: bool, controlled: bool
) -> tuple[str, ...]:
    names = cloud.strips
    if cloud.strip is None or len(names) < (1 if controlled else 2):
        raise InputError(
            "the cloud has one strip, and nothing to compare it with: give each flight line its own point source ID, "
            "or a column strip; or control (--control)"
        )
    for k, name in enumerate(names):
        if not np.any(cloud.strip == k):
            raise InputError(
                f"strip {name} of the cloud has no points: leave it out, or read other classes and returns"
            )
    for name in held:
        if name not in names:
            raise InputError(f"{name} is no strip of the cloud, which has {', '.join(names)}: correct its name")
    if set(names) <= set(held) and (strips_alone or trajectory is None):
        raise InputError("all strips are held, so that nothing is left to adjust: hold fewer")
    if trajectory is not None and cloud.time is None:
        raise InputError(
            "the cloud has no times, and a trajectory says nothing of points without them: take a cloud with GPS "
            "times, or leave the trajectory out, for a shift of each strip"
        )
    if trajectory is not None:
        check_covered(cloud, trajectory)
    return names


def _spans(cloud: Cloud) -> Float[np.ndarray, "strips 2"]:
    """First and last time of each strip (s)."""
    time = times_of(cloud)
    own = [time[cloud.strip == k] for k in range(len(cloud.strips))]
    return np.array([(t.min(), t.max()) for t in own])


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


def _round(
    number: int, observed: tuple[int, int, int], seen: Sequence[CommonPlanes], on: Sequence[PointPlanes], change: float
) -> StripRound:
    gaps = np.concatenate([np.zeros(0), *(f.pairs.gap[f.fits] for f in seen)])
    left_out = sum(int((~f).sum()) for f in (*(f.fits for f in seen), *(f.fits for f in on)))
    return StripRound(number, *observed, left_out, _rms(gaps), change)


def _of(search: PointSearch, adjusted: Adjustment, known: Covariance) -> tuple[np.ndarray, np.ndarray]:
    """Where its points are (m), as adjusted, and their covariances."""
    return np.asarray(adjusted.unknowns.points)[search.points], np.asarray(known.points)[search.points]


def _change(moved: Float[np.ndarray, "unknowns"], known: Covariance) -> float:
    """The largest change of an unknown, in standard deviations."""
    sigma = np.asarray(known.shared_sigma)
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
    """Of points over the planes of each strip."""
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
