"""Strip adjustment: laser strips fitted to each other where they overlap, by their scanner and their trajectory.

Planes are sought in the cells that two strips have in common, and observed to be one (`observations.StripPlanes`);
scanner and trajectory are corrected, the cloud is computed anew from range, angle and trajectory, and planes are sought
in it again, until nothing changes.
"""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import StripErrors, StripSpline, Trajectory
from jaxphoto.lidar.correction import check_covered, scanner_poses
from jaxphoto.lidar.strip_correction import correct_flight, correct_strips
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.lidar.strip_rows import step_rows
from jaxphoto.procedures.lidar.strip_search import CommonPlanes, StripSearch, check_joined
from jaxphoto.procedures.lidar.strip_unknowns import ScannerPriors, errors_of, strip_block
from jaxphoto.procedures.lidar.until_still import STILL, at_result
from jaxphoto.statistics import Covariance, covariance

MAX_STRIP_ROUNDS = 10
# From this round on returns stay in their cells: strips fit to their noise by then.
_SETTLED = 2
# No laser scanner measures farther; so many points are looked at.
_FARTHEST_M, _PROBED = 10_000.0, 1000


class StripRound(NamedTuple):
    """One adjustment, and what it changed."""

    number: int
    planes: int
    """Observed; of all that fit at most `StripSettings.most`."""
    left_out: int
    """Those that did not fit."""
    rms_m: float
    """Of the gaps of all that fit, before this adjustment."""
    largest_change: float
    """Of an unknown of scanner and trajectory, in standard deviations."""


class StripDifference(NamedTuple):
    """Two strips where they overlap, before and after."""

    one: str
    other: str
    planes_before: int
    planes: int
    mean_before_m: float
    """Of the gaps along the normals of the planes that fit, by which the first strip lies above the other."""
    rms_before_m: float
    mean_m: float
    rms_m: float
    noise_m: float
    """What the roughness of the planes lets expect of `rms_m` where nothing else is wrong."""


class StripAdjustment(eqx.Module):
    """Strips after their adjustment, and before."""

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


def adjust_strips(
    cloud: Cloud,
    trajectory: Trajectory | None = None,
    settings: StripSettings | None = None,
    priors: ScannerPriors | None = None,
    *,
    held: Collection[str] = (),
    max_rounds: int = MAX_STRIP_ROUNDS,
    report: Callable[[StripRound], None] = lambda made: None,
) -> StripAdjustment:
    """Adjust the strips of `cloud`; `trajectory` is that of its scanner, on the cloud's clock.

    `priors` are those of the scanner; by default its boresight is FREE and all else FIXED. The trajectory of strips
    named in `held` is right. Without a trajectory each strip has a shift alone, and the first is held where none is
    named.

    Raises InputError for a cloud of one strip, of strips without points or without the times that a trajectory needs,
    BlockError for strips that no plane joins and for a trajectory that does not cover the cloud, and as
    `jaxphoto.adjust`.
    """
    settings = StripSettings() if settings is None else settings
    names = _check(cloud, trajectory, held)
    splines = _splines(cloud, trajectory, settings)
    if trajectory is None:
        block = strip_block(names, splines, held or names[:1], settings, None)
    else:
        block = strip_block(names, splines, held, settings, priors or ScannerPriors())
    steps = tuple(rows for rows in step_rows(splines, settings) if len(rows))
    search, errors = StripSearch(cloud, trajectory, settings), errors_of(block.start.unknowns, splines)
    first = seen = search.look(errors, settled=False)
    check_joined(names, seen)
    rounds: list[StripRound] = []
    before, still = np.zeros(()), False
    while not still and len(rounds) < max_rounds:
        rows = search.rows(seen, errors)
        posed = dataclasses.replace(block, more=(rows, *steps))
        adjusted = adjust(posed, posed.start.unknowns)
        known = covariance(adjusted)
        now = np.asarray(adjusted.values.shared)[adjusted.structure.free]
        rounds.append(_round(len(rounds) + 1, len(rows), seen, _change(now - before, known)))
        report(rounds[-1])
        still = rounds[-1].largest_change < STILL and bool(adjusted.converged)
        block, before, errors = at_result(block, adjusted.unknowns), now, errors_of(adjusted.unknowns, splines)
        seen = search.look(errors, settled=len(rounds) >= _SETTLED)
    return StripAdjustment(
        adjusted,
        known,
        correct_strips(cloud, errors, trajectory),
        None if trajectory is None else correct_flight(trajectory, errors),
        errors,
        _differences(names, first, seen),
        tuple(rounds),
        still,
    )


def _check(cloud: Cloud, trajectory: Trajectory | None, held: Collection[str]) -> tuple[str, ...]:
    names = cloud.strips
    if cloud.strip is None or len(names) < 2:
        raise InputError(
            "the cloud has one strip, and nothing to compare it with: give each flight line its own point source ID, "
            "or a column strip"
        )
    for k, name in enumerate(names):
        if not np.any(cloud.strip == k):
            raise InputError(
                f"strip {name} of the cloud has no points: leave it out, or read other classes and returns"
            )
    for name in held:
        if name not in names:
            raise InputError(f"{name} is no strip of the cloud, which has {', '.join(names)}: correct its name")
    if set(names) <= set(held):
        raise InputError("all strips are held, so that nothing is left to adjust: hold fewer")
    if trajectory is not None and cloud.time is None:
        raise InputError(
            "the cloud has no times, and a trajectory says nothing of points without them: take a cloud with GPS "
            "times, or leave the trajectory out, for a shift of each strip"
        )
    if trajectory is not None:
        check_covered(trajectory, cloud.time)  # type: ignore[arg-type]
        _check_above(cloud, trajectory)
    return names


def _check_above(cloud: Cloud, trajectory: Trajectory) -> None:
    """Raise BlockError for points that no scanner on this trajectory can have measured, as of another system."""
    some = np.linspace(0, len(cloud) - 1, _PROBED).astype(int)
    away = np.linalg.norm(cloud.xyz[some] - scanner_poses(trajectory, cloud.time[some]).position, axis=1)  # type: ignore[index]
    if np.median(away) > _FARTHEST_M:
        raise BlockError(
            f"the laser points lie {np.median(away) / 1000:.0f} km from where the trajectory says that the scanner "
            "was: bring cloud and trajectory into one coordinate system, in metres, and onto one clock"
        )


def _splines(cloud: Cloud, trajectory: Trajectory | None, settings: StripSettings) -> tuple[StripSpline, ...]:
    splines: list[StripSpline] = []
    for k in range(len(cloud.strips)):
        first = sum(s.size for s in splines)
        if trajectory is None or cloud.time is None:
            splines.append(StripSpline.constant(first))
        else:
            time = cloud.time[cloud.strip == k]
            splines.append(StripSpline.over(first, float(time.min()), float(time.max()), settings.knots_s))
    return tuple(splines)


def _round(number: int, planes: int, seen: Sequence[CommonPlanes], change: float) -> StripRound:
    gaps = np.concatenate([f.pairs.gap[f.fits] for f in seen])
    return StripRound(number, planes, sum(int((~f.fits).sum()) for f in seen), _rms(gaps), change)


def _change(moved: Float[np.ndarray, "unknowns"], known: Covariance) -> float:
    """The largest change of an unknown, in standard deviations."""
    sigma = np.asarray(known.shared_sigma)
    return float(np.max(np.abs(moved)[sigma > 0] / sigma[sigma > 0], initial=0.0))


def _differences(
    names: Sequence[str], before: Sequence[CommonPlanes], after: Sequence[CommonPlanes]
) -> tuple[StripDifference, ...]:
    then, rows = {(f.one, f.other): f.pairs.gap[f.fits] for f in before}, []
    for f in after:
        was = then.get((f.one, f.other), np.array([np.nan]))
        gap, noise = f.pairs.gap[f.fits], _rms(f.pairs.sigma[f.fits])
        told = (float(was.mean()), _rms(was), float(gap.mean()), _rms(gap), noise)
        rows.append(StripDifference(names[f.one], names[f.other], int(np.isfinite(was).sum()), len(gap), *told))
    return tuple(rows)


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))
