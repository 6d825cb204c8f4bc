"""Strip adjustment: verdict, tables of strips, scanner and trajectory, plots, result folder, terminal output."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from jaxtyping import Float
from rich.console import Console

from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.lidar.strip_planes import Raster
from jaxphoto.observations import AttitudeSteps, PositionSteps
from jaxphoto.procedures.lidar import StripAdjustment, StripDifference, StripRound
from jaxphoto.procedures.lidar.strip_control import CHECK, CONTROL, SurveyedGap
from jaxphoto.report.draws import in_degrees
from jaxphoto.report.findings import Finding, Severity, Verdict, as_sentence, p_words
from jaxphoto.report.formatting import label_unit, to_rich
from jaxphoto.report.lidar import ITERATIONS
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot, verdict_parts
from jaxphoto.report.plots import axes_or_new, colour_bar, draw_matrix, label, title
from jaxphoto.report.results import write_results, write_study
from jaxphoto.report.tables import Tables, about_sigma, initial_values
from jaxphoto.report.terminal import print_lines, print_sigma0, print_verdict
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import LEVEL, correlation_matrix
from jaxphoto.statistics.global_test import global_test
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Ratio of gaps at surveyed points to their noise above which they are a warning; additional tolerance for few planes
# (sigmas).
_FAR, _BEYOND = 2.0, 3.0
# Ratio of deviation to expectation above which the input is contradictory and no result is usable.
_CONTRADICTS = 10.0
# Factors from internal units of a knot (m, rad) to units of files.
_IN_FILES = np.array([1.0, 1.0, 1.0, 180 / np.pi, 180 / np.pi, 180 / np.pi])
_COLUMNS = ["X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg"]


# Tables ----------------------------------------------------------------------------------------------------------


def differences_table(differences: Sequence[StripDifference]) -> pd.DataFrame:
    """Tabulate the pairs of strips: number of planes, mean and RMS of their gaps (m) before and after."""
    return pd.DataFrame(differences, columns=list(StripDifference._fields))


def strip_rounds_table(rounds: Sequence[StripRound]) -> pd.DataFrame:
    """Tabulate the iterations.

    Columns: round, planes, points, control, left_out, rms_m, largest_change (in standard deviations).
    """
    return pd.DataFrame(rounds, columns=["round", *StripRound._fields[1:]])


def surveyed_table(result: StripAdjustment) -> pd.DataFrame:
    """Tabulate the surveyed points in each strip by decreasing normalised gap."""
    table = pd.DataFrame(result.surveyed, columns=list(SurveyedGap._fields))
    return table.sort_values("w", key=np.abs, ascending=False, kind="stable", ignore_index=True)


def all_correlations(result: StripAdjustment) -> pd.DataFrame:
    """Return the correlation matrix of all unknowns of scanner, trajectory and cameras, indexed by `parameter`."""
    labels = list(result.adjusted.structure.labels)
    rho = correlation_matrix(result.covariance)[-len(labels) :, -len(labels) :]
    return pd.DataFrame(rho, columns=labels).set_index(pd.Index(labels, name="parameter"))


def gaps_table(before: Raster, after: Raster) -> pd.DataFrame:
    """Tabulate gaps of strips by cell: X_m and Y_m of its centre, before_m and after_m (m)."""
    parts = []
    for name, raster in (("before_m", before), ("after_m", after)):
        row, column = np.nonzero(np.isfinite(raster.heights))
        x, y = raster.west + (column + 0.5) * raster.cell_m, raster.north - (row + 0.5) * raster.cell_m
        parts.append(pd.DataFrame({"X_m": x.round(3), "Y_m": y.round(3), name: raster.heights[row, column]}))
    return parts[0].merge(parts[1], "outer")


def calibration_table(result: StripAdjustment) -> pd.DataFrame:
    """Tabulate the parameters of scanner, cameras and mounts; angles in degrees.

    Columns: parameter, initial (before the strips are used), value, sigma, unit, with (the most correlated parameter),
    rho.
    """
    # Only scanner parameters have no value before the adjustment; use zero.
    initial = initial_values(result.before.unknowns) if result.before else {}
    covariance, s = result.covariance, result.adjusted.structure
    rho, sigma = correlation_matrix(covariance), np.asarray(covariance.shared_sigma)
    value = np.asarray(result.adjusted.values.shared)[s.free]
    first, rows = len(rho) - len(s.free), []
    for k, path in enumerate(s.labels):
        if path.startswith(TrajectoryKnot.kind):
            continue
        others = np.abs(rho[first + k, first:])
        others[k] = -1.0
        other = int(np.argmax(others))
        factor = 180 / np.pi if path.endswith("_rad") else 1.0
        name, unit = in_degrees(path), label_unit(in_degrees(path), result.adjusted.unknowns.interior)
        correlation = rho[first + k, first + other]
        estimate = initial.get(name, 0.0), factor * value[k], factor * sigma[k], unit
        rows.append((name, *estimate, in_degrees(s.labels[other]), correlation))
    return pd.DataFrame(rows, columns=["parameter", "initial", "value", "sigma", "unit", "with", "rho"])


def trajectory_errors_table(result: StripAdjustment) -> pd.DataFrame:
    """Tabulate trajectory errors: strip, time_s, spline coefficients X_m ... up_deg and their sigmas (0 if fixed)."""
    errors, labels, rows = result.errors, _knot_labels(result), []
    sigmas = dict(zip(result.adjusted.structure.labels, np.asarray(result.covariance.shared_sigma), strict=True))
    for name, spline in zip(result.cloud.strips, errors.splines, strict=True):
        for k, at in enumerate(spline.times, spline.first):
            sigma = np.array([sigmas.get(path, 0.0) for path in labels[k]])
            value = np.concatenate([errors.position[k], errors.attitude[k]])
            rows.append((name, at, *(value * _IN_FILES), *(sigma * _IN_FILES)))
    return pd.DataFrame(rows, columns=["strip", "time_s", *_COLUMNS, *(f"sigma_{c}" for c in _COLUMNS)])


def errors_along(
    result: StripAdjustment, strip: int, time: Float[np.ndarray, n]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6"]]:
    """Return trajectory errors of a strip at times (s): X, Y, Z (m), right, forward, up (degrees), and their sigmas."""
    value = np.concatenate(result.errors.at(strip, time), axis=1)
    spline, labels = result.errors.splines[strip], _knot_labels(result)
    _, weights = spline.all_weights(time)
    place = {path: k for k, path in enumerate(result.adjusted.structure.labels)}
    covariances, variance = np.asarray(result.covariance.matrix)[-len(place) :, -len(place) :], np.zeros_like(value)
    for c in range(value.shape[1]):
        # Fixed knots (-1) are not estimated: they add no variance.
        columns = np.array([place.get(labels[k][c], -1) for k in range(spline.first, spline.first + spline.size)])
        estimated, by = columns[columns >= 0], weights[:, columns >= 0]
        variance[:, c] = np.einsum("ni,ij,nj->n", by, covariances[np.ix_(estimated, estimated)], by)
    return value * _IN_FILES, np.sqrt(np.maximum(variance, 0.0)) * _IN_FILES


def _knot_labels(result: StripAdjustment) -> list[list[str]]:
    """Return the paths of the six components of every knot of all strips."""
    zero = np.zeros(3)
    knot = TrajectoryKnot(zero, zero)  # type: ignore[arg-type]
    return [list(knot.labels(owner)) for owner in result.adjusted.unknowns.more[TrajectoryKnot.kind]]


# Verdict ---------------------------------------------------------------------------------------------------------


def strips_verdict(result: StripAdjustment, tables: Tables | None) -> Verdict:
    """Assess a strip adjustment; `tables` contains its adjustment if it has images."""
    found = _sigma_naught(result) if tables is None else verdict_of(tables).findings
    return Verdict.of((*_steps(result), *_surveyed(result), *found))


def _steps(result: StripAdjustment) -> Iterator[Finding]:
    """Report missing convergence, and trajectories whose corrections are far above their standard deviations."""
    if not result.converged:
        n, change = len(result.rounds), result.rounds[-1].largest_change
        yield Finding("lookups_not_converged", "error", value=change, numbers={"n": n})
    for steps, errors, unit in (
        (PositionSteps, result.errors.position, "m"),
        (AttitudeSteps, np.rad2deg(result.errors.attitude), "degrees"),
    ):
        over_sigma = np.abs(result.adjusted.residuals.named.get(steps.group, np.zeros(1))).max()
        if over_sigma > _CONTRADICTS:
            largest = [np.abs(errors[s.first : s.first + s.size]).max() for s in result.errors.splines]
            k = int(np.argmax(largest))
            numbers = {"unit": unit, "change": over_sigma}
            yield Finding("strip_contradiction", "error", result.cloud.strips[k], float(largest[k]), numbers=numbers)


def _surveyed(result: StripAdjustment) -> Iterator[Finding]:
    """Compare gaps at control and check points with their expectation."""
    for what, of in surveyed_summary(result).items():
        rms, noise, planes = of["rms_m"], of["noise_m"], int(of["planes"])
        far = rms > max(_FAR, 1 + _BEYOND / np.sqrt(2 * planes)) * noise
        severity: Severity = "error" if rms > _CONTRADICTS * noise else "warning" if far else "note"
        table, worst = surveyed_table(result), ""
        if far:
            first = table[(table.role == "control") == (what == "control")].iloc[0]
            worst = f"; largest at {first.point}, {first.gap_m:+.3f} m on strip {first.strip} (w = {abs(first.w):.1f})"
        hint = "Check the points, their standard deviations and those of the trajectory" if far else ""
        numbers = {"planes": planes, "before": of["rms_before_m"], "worst": worst}
        yield Finding("surveyed_gap", severity, what.replace("_", " "), rms, noise, hint, numbers)


def surveyed_summary(result: StripAdjustment) -> dict[str, dict[str, float]]:
    """Summarise control and check points over all strips: planes, RMS of their gaps (m) before and after, noise."""
    summary: dict[str, dict[str, float]] = {}
    for what, rows in differences_table(result.differences).groupby("one"):
        if what in (CONTROL, CHECK):
            pooled = {
                name: float(np.sqrt(np.nansum(rows[name] ** 2 * rows[n]) / max(rows[n].sum(), 1)))
                for name, n in (("rms_before_m", "planes_before"), ("rms_m", "planes"), ("noise_m", "planes"))
            }
            summary[str(what).replace(" ", "_")] = {"planes": int(rows["planes"].sum()), **pooled}
    return summary


def _sigma_naught(result: StripAdjustment) -> Iterator[Finding]:
    """Report convergence and sigma naught of planes and trajectory."""
    if not bool(result.adjusted.converged):
        yield Finding("not_converged", "error", result.adjusted.outcome.value)
        return
    whole = global_test(result.adjusted)
    if whole.redundancy > 0 and whole.p_value < LEVEL:
        small = whole.factor < 1
        gaps = f"gaps of planes are {'smaller' if small else 'larger'} than expected by their roughness"
        if result.trajectory is None:
            hint = "" if small else "Add a trajectory (--trajectory) to estimate more than shifts"
        else:
            gaps += " and the trajectory's standard deviations"
            hint = "Reduce these" if small else "Increase these, or reduce the knot spacing"
        # Without a trajectory, shifts cannot model all errors: report only a warning.
        absurd = result.trajectory is not None and whole.factor > _CONTRADICTS**2
        severity: Severity = "error" if absurd else "warning"
        numbers = {"p": p_words(whole.p_value)}
        yield Finding("strips_sigma0", severity, gaps, whole.factor**0.5, 1.0, hint, numbers)


# Plots -----------------------------------------------------------------------------------------------------------

# Number of points of a curve per knot.
_PLACES = 12
_COMPONENTS = (("position (cm)", 100.0, ("X", "Y", "Z")), ("attitude (mdeg)", 1000.0, ("right", "forward", "up")))
# Okabe and Ito (2008): distinguishable by colour-blind readers.
_COLOURS = ("#0072B2", "#E69F00", "#009E73")


def plot_strip_differences(gaps: Raster, ax: Axes | None = None, *, limit_m: float | None = None) -> Axes:
    """Draw gaps of strips in plan (`lidar.strip_differences`); colours up to `limit_m` (default: 95 % of the gaps)."""
    ax, limit = axes_or_new(ax), 100 * (_limit(gaps) if limit_m is None else limit_m)
    (west, south), (east, north) = gaps.extent
    shown = ax.imshow(100 * gaps.heights, extent=(west, east, south, north), cmap="RdBu_r", vmin=-limit, vmax=limit)
    colour_bar(ax, shown, "later strip above earlier [cm]")
    title(ax, f"{100 * float(np.sqrt(np.nanmean(gaps.heights**2))):.2g} cm RMS")
    ax.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    ax.ticklabel_format(useOffset=False, style="plain")
    return ax


def _limit(gaps: Raster) -> float:
    """Return the 95 % quantile of the gaps (m)."""
    return float(np.nanpercentile(np.abs(gaps.heights), 95)) or 0.01


def plot_scanner_correlation(result: StripAdjustment, ax: Axes | None = None, *, itself: bool = False) -> Axes:
    """Draw correlations of the scanner with cameras and mounts, or with `itself`.

    Raises InputError if none of these are estimated.
    """
    rho = all_correlations(result)
    labels = [name for name in rho.index if not name.startswith(TrajectoryKnot.kind)]
    scanner = [name for name in labels if name.startswith("scanner")]
    columns = scanner if itself else [name for name in labels if name not in scanner]
    if not scanner or not columns:
        raise InputError(f"no parameters of {'the scanner' if not scanner else 'cameras and mounts'} are estimated")
    ax, name = axes_or_new(ax), f"scanner with {'itself' if itself else 'camera and mount'}"
    draw_matrix(ax, rho.loc[scanner, columns].to_numpy(), _short(scanner), _short(columns), name)
    return ax


def _short(labels: list[str]) -> list[str]:
    """Shorten parameter names: no units, owner's name only if a name repeats."""
    short = [name.split(".")[-1].removesuffix("_rad") for name in labels]
    owners = [name.rsplit(".", 1)[0].partition("[")[2].removesuffix("]") for name in labels]
    return [f"{o} {name}" if short.count(name) > 1 and o else name for o, name in zip(owners, short, strict=True)]


def plot_trajectory_errors(
    result: StripAdjustment, strip: str, ax: Axes | None = None, *, attitude: bool = False
) -> Axes:
    """Draw position errors (cm), or `attitude` errors (mdeg), along a strip, with bands of two sigmas.

    Raises InputError for an unknown strip.
    """
    if strip not in result.cloud.strips:
        raise InputError(f"unknown strip {strip!r}; use one of {', '.join(result.cloud.strips)}")
    ax, k, (unit, factor, names) = axes_or_new(ax), result.cloud.strips.index(strip), _COMPONENTS[attitude]
    spline = result.errors.splines[k]
    at = np.linspace(spline.times[0], spline.times[-1], _PLACES * spline.size)
    value, sigma = errors_along(result, k, at)
    for c, (axis, colour) in enumerate(zip(names, _COLOURS, strict=True), 3 * attitude):
        v, s = factor * value[:, c], 2 * factor * sigma[:, c]
        ax.fill_between(at, v - s, v + s, color=colour, alpha=0.18, lw=0)
        ax.plot(at, v, color=colour, lw=1.3, label=axis)
    ax.set_title(f"strip {label(strip)}", loc="left", fontsize=10)
    ax.set(xlabel="time (s)", ylabel=unit)
    ax.legend(fontsize=7)
    return ax


# Files and terminal ----------------------------------------------------------------------------------------------

# Columns of the strip shifts without a trajectory.
_SHIFTS = ["strip", "X_m", "Y_m", "Z_m", "sigma_X_m", "sigma_Y_m", "sigma_Z_m"]
# Decimal places of correlations; maximum number of surveyed points on the page.
_DIGITS, _SHOWN = 6, 20
_PATTERNS = {
    "line": "Angles are those of scan lines across the track.",
    "circle": "Angles are those of a scanner around its nadir; forward and backward looks are compared.",
}


def write_strips(
    result: StripAdjustment,
    tables: Tables | None,
    verdict: Verdict,
    gaps: tuple[Raster | None, Raster | None],
    directory: Path,
    write_corrected: Callable[[Path], None],
    record: CommandRecord,
) -> None:
    """Write tables, report.html, summary.json; with images also the folder `adjustment`.

    `tables` contains the adjustment if it has images, `gaps` the `strip_differences` before and after.
    `write_corrected` writes cloud and trajectory into the folder.
    """
    seconds = dict(result.adjusted.seconds)
    files = {
        "strips": differences_table(result.differences), "rounds": strip_rounds_table(result.rounds),
        "scanner": calibration_table(result), "trajectory_errors": trajectory_errors_table(result),
    }  # fmt: skip
    files |= {"surveyed_points": surveyed_table(result)} if result.surveyed else {}
    with whole_folder(directory) as work:
        if tables is not None:
            write_results(tables, verdict, work / "adjustment", seconds, record=record)
        all_correlations(result).round(_DIGITS).to_csv(work / "correlation.csv")
        write_corrected(work)
        before, after = gaps
        overlap = None if before is None or after is None else (before, after)
        if overlap:
            files["differences"] = gaps_table(*overlap)
        n = len(result.cloud.strips)
        name = f"{n} strip{'s' * (n > 1)}{' and photographs' if result.before else ''}: strip adjustment"
        summary = verdict.summary | {
            "rounds": len(result.rounds), "iteration_converged": result.converged,
            "sigma0": float(result.adjusted.sigma0),
            "pattern": result.errors.calibration.pattern, **surveyed_summary(result),
            "seconds": seconds,
        }  # fmt: skip
        top = files["scanner"] if len(files["scanner"]) else files["trajectory_errors"][_SHIFTS]
        pattern = _PATTERNS[result.errors.calibration.pattern]
        words = f"{about_sigma(result.adjusted)} {as_sentence(_iterations(result))}"
        if len(files["scanner"]):
            words += f" Each estimate with its most correlated parameter (with, rho). {pattern}"
        parts = [top, Paragraph(words), *verdict_parts(verdict), *_sections(result, files, overlap)]
        write_study(work, name, (verdict.headline, verdict.colour), parts, summary, record, files)


def _sections(
    result: StripAdjustment, files: dict[str, pd.DataFrame], gaps: tuple[Raster, Raster] | None
) -> Iterator[Part]:
    yield Heading("Strips before and after")
    yield _in_tenths_of_mm(files["strips"])
    if gaps is not None:
        yield [
            Plot(partial(plot_strip_differences, raster), f"gaps of strips over the ground, {when}", 4)
            for raster, when in zip(gaps, ("before", "after"), strict=True)
        ]
    if "surveyed_points" in files:
        yield Heading("Control and check points")
        yield Paragraph(
            f"Surveyed minus strip, over the plane of each strip: the {_SHOWN} largest w (normalised gaps; 1 of 1000 "
            "exceeds 3.3). surveyed_points.csv has all."
        )
        yield _in_tenths_of_mm(files["surveyed_points"].head(_SHOWN))
    if files["scanner"]["parameter"].str.startswith("scanner").any():
        yield Heading("Correlations of the scanner")
        yield Paragraph(
            "Parameters with correlations near 1 or -1 are not separable. correlation.csv has all unknowns."
        )
        names = result.adjusted.structure.labels
        yield [
            Plot(
                partial(plot_scanner_correlation, result, itself=itself), f"correlations of the scanner with {words}", 4
            )
            for itself, words in ((False, "camera and mount"), (True, "itself"))
            if itself or not all(name.startswith(("scanner", TrajectoryKnot.kind)) for name in names)
        ]
    if result.trajectory is None and len(files["scanner"]):
        yield Heading("Shifts of the strips")
        yield files["trajectory_errors"][_SHIFTS]
    elif result.trajectory is not None:
        yield Heading("Errors of the trajectory")
        yield Paragraph(
            "Trajectory errors along each strip with bands of two standard deviations. Most of this uncertainty is a "
            "common shift or rotation of all strips, which overlaps do not determine; differences between strips are "
            "determined far better."
        )
        yield [
            Plot(
                partial(plot_trajectory_errors, result, name, attitude=attitude),
                f"trajectory errors of strip {name}",
                2.6,
            )
            for name in result.cloud.strips
            for attitude in (False, True)
        ]
    yield Heading("Iterations")
    yield files["rounds"].rename(columns=ITERATIONS)


def _in_tenths_of_mm(table: pd.DataFrame) -> pd.DataFrame:
    """Round values to a tenth of a millimetre, without negative zeros."""
    numbers = table.select_dtypes(float).round(4) + 0.0
    return table.assign(**{str(name): numbers[name] for name in numbers})


def _iterations(result: StripAdjustment) -> str:
    """Summarise the iterations."""
    last = result.rounds[-1]
    end = f"{'' if result.converged else 'not '}converged after {last.number} iterations"
    ties = f" and {last.points} tie points on them" if last.points else ""
    ties += f" and {last.control} of control" if last.control else ""
    return f"{end}; {last.planes} planes{ties}, {last.left_out} rejected"


def print_strips(result: StripAdjustment, verdict: Verdict, console: Console) -> None:
    """Print the verdict, iterations, sigma naught, the estimates, and gaps of strips."""
    print_verdict(verdict, console)
    print_lines([_iterations(result)], console)
    print_sigma0(result.adjusted, console)
    if len(table := calibration_table(result)):
        console.print(to_rich(table, "scanner and cameras (a posteriori)"))
    if result.trajectory is None:
        console.print(to_rich(trajectory_errors_table(result)[_SHIFTS], "shifts of strips (a posteriori)"))
    gaps = _in_tenths_of_mm(differences_table(result.differences))
    console.print(to_rich(gaps[["one", "other", "planes", "rms_before_m", "rms_m", "noise_m"]], "gaps of strips"))
