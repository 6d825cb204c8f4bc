"""What a strip adjustment found: its verdict; tables of strips, scanner and trajectory; the lines on a screen."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from rich.console import Console

from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.observations import AttitudeSteps, PositionSteps
from jaxphoto.procedures.lidar import StripAdjustment, StripDifference, StripRound
from jaxphoto.procedures.lidar.strip_adjustment import PHOTOGRAPHS
from jaxphoto.procedures.lidar.strip_control import CHECK, CONTROL
from jaxphoto.procedures.lidar.surveyed_gaps import SurveyedGap
from jaxphoto.report.digits import of_sigma, with_sigma
from jaxphoto.report.findings import Finding, Level, Verdict, p_words
from jaxphoto.report.tables import Tables
from jaxphoto.report.units import label_unit
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import LEVEL, correlation_matrix
from jaxphoto.statistics.global_test import global_test

_OF_POINTS = (PHOTOGRAPHS, CONTROL, CHECK)
# Times their noise by which strips may be off surveyed points, of a few by this number of standard deviations.
_FAR, _BEYOND = 2.0, 3.0
# Times what is expected from which on what was given contradicts itself, and nothing found of it is of use.
_CONTRADICTS = 10.0
# From jaxphoto's units of a knot (m, rad) to those of files.
_IN_FILES = np.array([1.0, 1.0, 1.0, 180 / np.pi, 180 / np.pi, 180 / np.pi])


def differences_table(differences: Sequence[StripDifference]) -> pd.DataFrame:
    """One row for two strips: planes, mean and root mean square of their gaps (m) before and after."""
    return pd.DataFrame(differences, columns=list(StripDifference._fields))


def strip_rounds_table(rounds: Sequence[StripRound]) -> pd.DataFrame:
    """round, planes, points, control, left_out, rms_m, largest_change (in standard deviations)."""
    return pd.DataFrame(rounds, columns=["round", *StripRound._fields[1:]])


def surveyed_table(result: StripAdjustment) -> pd.DataFrame:
    """One row for a surveyed point in a strip, what is farthest off for its standard deviation first."""
    table = pd.DataFrame(result.surveyed, columns=list(SurveyedGap._fields))
    return table.sort_values("w", key=np.abs, ascending=False, kind="stable", ignore_index=True)


def all_correlations(result: StripAdjustment) -> pd.DataFrame:
    """Of all unknowns of scanner, trajectory and cameras: a row and a column each, named by `parameter`."""
    labels = list(result.adjusted.structure.labels)
    rho = correlation_matrix(result.covariance)[-len(labels) :, -len(labels) :]
    return pd.DataFrame(rho, columns=labels).set_index(pd.Index(labels, name="parameter"))


def calibration_table(result: StripAdjustment) -> pd.DataFrame:
    """parameter, value, sigma, the parameter that it is least told from: `with`, rho; and unit. Angles in degrees.

    Of scanner, cameras and mounts: of all unknowns but the trajectory's.
    """
    known, s = result.covariance, result.adjusted.structure
    rho, sigma = correlation_matrix(known), np.asarray(known.shared_sigma)
    value = np.asarray(result.adjusted.values.shared)[s.free]
    first, rows = len(rho) - len(s.free), []
    for k, label in enumerate(s.labels):
        if label.startswith(TrajectoryKnot.kind):
            continue
        to = np.abs(rho[first + k, first:])
        to[k] = -1.0
        other = int(np.argmax(to))
        unit, correlation = 180 / np.pi if label.endswith("_rad") else 1.0, rho[first + k, first + other]
        names = _in_degrees(label), _in_degrees(s.labels[other])
        told = label_unit(names[0], result.adjusted.unknowns.interior)
        rows.append((names[0], unit * value[k], unit * sigma[k], names[1], correlation, told))
    return pd.DataFrame(rows, columns=["parameter", "value", "sigma", "with", "rho", "unit"])


def _in_degrees(label: str) -> str:
    return f"{label.removesuffix('_rad')}_deg" if label.endswith("_rad") else label


def trajectory_errors_table(result: StripAdjustment) -> pd.DataFrame:
    """strip, time_s, and the coefficients of its spline there with sigmas: X_m ... right_deg ...; 0 where held."""
    errors, labels, rows = result.errors, _knot_labels(result), []
    of_label = dict(zip(result.adjusted.structure.labels, np.asarray(result.covariance.shared_sigma), strict=True))
    for name, spline in zip(result.cloud.strips, errors.splines, strict=True):
        for k, time in enumerate(spline.times, spline.first):
            sigma = np.array([of_label.get(label, 0.0) for label in labels[k]])
            value = np.concatenate([errors.position[k], errors.attitude[k]])
            rows.append((name, time, *(value * _IN_FILES), *(sigma * _IN_FILES)))
    columns = ["X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg"]
    return pd.DataFrame(rows, columns=["strip", "time_s", *columns, *(f"sigma_{c}" for c in columns)])


def errors_along(
    result: StripAdjustment, strip: int, time: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6"]]:
    """What the trajectory was off by at times (s) of a strip: X, Y, Z (m), right, forward, up (degrees), and sigmas."""
    value = np.concatenate(result.errors.at(strip, time), axis=1)
    spline, labels = result.errors.splines[strip], _knot_labels(result)
    _, weights = spline.all_weights(time)
    place = {label: k for k, label in enumerate(result.adjusted.structure.labels)}
    covariances, variance = np.asarray(result.covariance.matrix)[-len(place) :, -len(place) :], np.zeros_like(value)
    for c in range(value.shape[1]):
        # A knot that is held has no label among the estimated ones.
        own = np.array([place.get(labels[k][c], -1) for k in range(spline.first, spline.first + spline.size)])
        known, by = own[own >= 0], weights[:, own >= 0]
        variance[:, c] = np.einsum("ni,ij,nj->n", by, covariances[np.ix_(known, known)], by)
    return value * _IN_FILES, np.sqrt(np.maximum(variance, 0.0)) * _IN_FILES


def _knot_labels(result: StripAdjustment) -> list[list[str]]:
    """Of every knot of all strips the labels of its six numbers."""
    zero = np.zeros(3)
    knot = TrajectoryKnot(zero, zero)  # type: ignore[arg-type]
    return [list(knot.labels(owner)) for owner in result.adjusted.unknowns.more[TrajectoryKnot.kind]]


def strips_verdict(result: StripAdjustment, tables: Tables | None) -> Verdict:
    """What is to be known of it first; `tables` are those of the adjustment where photographs are in it."""
    found = _of_strips(result) if tables is None else verdict_of(tables).findings
    odd = (Finding(Level.WARNING, sentence) for sentence in result.odd)
    return Verdict.of((*_of_rounds(result), *_of_steps(result), *odd, *_of_surveyed(result), *found))


def _of_rounds(result: StripAdjustment) -> Iterator[Finding]:
    if not result.still:
        change = result.rounds[-1].largest_change
        yield Finding(
            Level.ALARM,
            f"planes were looked up {len(result.rounds)} times and it still changes (by {change:.2g} standard "
            "deviations the last time): ask for more rounds",
        )


def _of_steps(result: StripAdjustment) -> Iterator[Finding]:
    """Whether the trajectory had to be bent by many times what it is known by, so that strips come to lie on others."""
    strips = result.cloud.strips
    for steps, errors, unit in (
        (PositionSteps, result.errors.position, "m"),
        (AttitudeSteps, np.rad2deg(result.errors.attitude), "degrees"),
    ):
        over_sigma = np.abs(result.adjusted.residuals.named.get(steps.group, np.zeros(1))).max()
        if over_sigma > _CONTRADICTS:
            largest = [np.abs(errors[s.first : s.first + s.size]).max() for s in result.errors.splines]
            worst = int(np.argmax(largest))
            yield Finding(
                Level.ALARM,
                f"strips lie on one another where the trajectory of strip {strips[worst]} is off by "
                f"{largest[worst]:.2g} {unit}, which changes by {over_sigma:.0f} times its standard deviation on the "
                "way: look at the heights and the system of this strip, and at its trajectory",
            )


def _of_surveyed(result: StripAdjustment) -> Iterator[Finding]:
    """How far strips are from control and check points, and whether that is more than these let expect."""
    for what, told in surveyed_summary(result).items():
        rms, noise, planes = told["rms_m"], told["noise_m"], told["planes"]
        far = rms > max(_FAR, 1 + _BEYOND / np.sqrt(2 * planes)) * noise
        yield Finding(
            Level.ALARM if rms > _CONTRADICTS * noise else Level.WARNING if far else Level.INFORMATION,
            f"{what.replace('_', ' ')} {rms:.3f} m off the strips (RMS of {planes} planes), {told['rms_before_m']:.3f} "
            f"m before; plane and survey let expect {noise:.3f}"
            + (
                f": {_worst(result, what)}look at the points, their standard deviations and the trajectory's"
                if far
                else ""
            ),
        )


def _worst(result: StripAdjustment, what: str) -> str:
    """Which of the points is farthest off for its standard deviation."""
    table = surveyed_table(result)
    first = table[(table.role == "control") == (what == "control")].iloc[0]
    return f"most at {first.point}, {first.gap_m:+.3f} m on strip {first.strip} ({abs(first.w):.1f} of its sigma); "


def surveyed_summary(result: StripAdjustment) -> dict[str, dict[str, float]]:
    """Of control and of check points over all strips: planes, RMS of their gaps (m) before and after, and their noise.

    Nothing of what there is not.
    """
    summary: dict[str, dict[str, float]] = {}
    for what in (CONTROL, CHECK):
        own = [d for d in result.differences if d.one == what]
        if own:
            now, then = ([getattr(d, name) for d in own] for name in ("planes", "planes_before"))
            pooled = {"rms_before_m": then, "rms_m": now, "noise_m": now}
            told = {name: _pooled([getattr(d, name) for d in own], counts) for name, counts in pooled.items()}
            summary[what.replace(" ", "_")] = {"planes": sum(now), **told}
    return summary


def _pooled(rms: Sequence[float], counts: Sequence[int]) -> float:
    """Root mean square of several together; what is none has an rms that is no number."""
    return float(np.sqrt(np.nansum(np.square(rms) * counts) / max(sum(counts), 1)))


def _of_strips(result: StripAdjustment) -> Iterator[Finding]:
    """Convergence and sigma naught of planes and trajectory alone."""
    if not bool(result.adjusted.converged):
        yield Finding(Level.ALARM, result.adjusted.outcome.value)
        return
    whole = global_test(result.adjusted)
    if whole.redundancy > 0 and whole.p_value < LEVEL:
        small = whole.factor < 1
        lie = f"planes lie {'nearer to' if small else 'farther from'} one another than their roughness"
        if result.trajectory is None:
            why = f"{lie} lets expect" + (
                "" if small else " after a shift of each strip: what else is wrong its trajectory tells (--trajectory)"
            )
        else:
            why = f"{lie} and the trajectory's standard deviations let expect; these are too " + (
                "large" if small else "small, or knots too far apart"
            )
        said = f"sigma naught {whole.factor**0.5:.3g}, expected 1 ({p_words(whole.p_value)})"
        # Shifts alone leave what the trajectory is off by, and may be all that there is.
        absurd = result.trajectory is not None and whole.factor > _CONTRADICTS**2
        yield Finding(Level.ALARM if absurd else Level.WARNING, f"{said}: {why}")


def print_strips(result: StripAdjustment, console: Console) -> None:
    """What the rounds came to, how far strips were apart, and the scanner, a line each."""
    last = result.rounds[-1]
    end = "nothing changes any more" if result.still else "it still changes: ask for more rounds"
    ties = f" and {last.points} tie points on them" if last.points else ""
    ties += f" and {last.control} of control" if last.control else ""
    said = f"{last.number} rounds, {end}; {last.planes} planes{ties}, {last.left_out} left out"
    console.print(said, highlight=False, soft_wrap=True)
    for d in result.differences:
        before = f"{d.rms_before_m:.3f} m" if np.isfinite(d.rms_before_m) else "unknown"
        strips = f"{d.one} and strip {d.other}" if d.one in _OF_POINTS else f"strips {d.one} and {d.other}"
        console.print(
            f"  {strips}: from {before} to {d.rms_m:.3f} m apart (RMS of {d.planes} planes, whose "
            f"noise is {d.noise_m:.3f} m)",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if result.trajectory is None:
        for line in _shift_lines(result):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    scanner = calibration_table(result)
    numbers = scanner[["value", "sigma"]].to_numpy(float)
    for parameter, (value, sigma) in zip(scanner["parameter"], numbers, strict=True):
        said = f"  {parameter}: {with_sigma(value, sigma)} (sigma {of_sigma(sigma)})"
        console.print(said, highlight=False, markup=False, soft_wrap=True)


def _shift_lines(result: StripAdjustment) -> Iterator[str]:
    """By how much each strip is off where nothing else is estimated."""
    for one in trajectory_errors_table(result).to_dict("records"):
        axes = [axis for axis in "XYZ" if one[f"sigma_{axis}_m"] > 0]
        told = ((axis, one[f"{axis}_m"], one[f"sigma_{axis}_m"]) for axis in axes)
        said = ", ".join(
            f"{axis} {with_sigma(value, sigma)} m (sigma {of_sigma(sigma)})" for axis, value, sigma in told
        )
        yield f"  strip {one['strip']} {'is off by ' + said if said else 'is held'}"
