"""Strip adjustment: verdict, tables of strips, scanner and trajectory, plots, result folder, terminal output."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
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
from jaxphoto.procedures.lidar.strip_adjustment import PHOTOGRAPHS
from jaxphoto.procedures.lidar.strip_control import CHECK, CONTROL, SurveyedGap
from jaxphoto.report.draws import in_degrees
from jaxphoto.report.findings import Finding, Severity, Verdict, p_words
from jaxphoto.report.formatting import label_unit, of_sigma, with_sigma
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot, verdict_parts
from jaxphoto.report.plots import axes_or_new, draw_matrix, label, new_figure
from jaxphoto.report.results import write_results, write_study
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_lines
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import LEVEL, correlation_matrix
from jaxphoto.statistics.global_test import global_test
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_OF_POINTS = (PHOTOGRAPHS, CONTROL, CHECK)
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

    Columns: parameter, value, sigma, with (the most correlated parameter), rho, unit.
    """
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
        rows.append((name, factor * value[k], factor * sigma[k], in_degrees(s.labels[other]), correlation, unit))
    return pd.DataFrame(rows, columns=["parameter", "value", "sigma", "with", "rho", "unit"])


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
    return Verdict.of((*_lookups(result), *_steps(result), *_surveyed(result), *found))


def _lookups(result: StripAdjustment) -> Iterator[Finding]:
    if not result.converged:
        n, change = len(result.rounds), result.rounds[-1].largest_change
        hint = "Increase the maximum number of iterations"
        yield Finding("lookups_not_converged", "error", value=change, hint=hint, numbers={"n": n})


def _steps(result: StripAdjustment) -> Iterator[Finding]:
    """Report trajectories whose corrections are far above their standard deviations."""
    for steps, errors, unit in (
        (PositionSteps, result.errors.position, "m"),
        (AttitudeSteps, np.rad2deg(result.errors.attitude), "degrees"),
    ):
        over_sigma = np.abs(result.adjusted.residuals.named.get(steps.group, np.zeros(1))).max()
        if over_sigma > _CONTRADICTS:
            largest = [np.abs(errors[s.first : s.first + s.size]).max() for s in result.errors.splines]
            k = int(np.argmax(largest))
            hint = "Check the heights, coordinate system and trajectory of this strip"
            numbers = {"unit": unit, "change": over_sigma}
            yield Finding(
                "strip_contradiction", "error", result.cloud.strips[k], float(largest[k]), hint=hint, numbers=numbers
            )


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
    for what in (CONTROL, CHECK):
        rows = [d for d in result.differences if d.one == what]
        if rows:
            now, then = ([getattr(d, name) for d in rows] for name in ("planes", "planes_before"))
            counts = {"rms_before_m": then, "rms_m": now, "noise_m": now}
            pooled = {name: _pooled([getattr(d, name) for d in rows], n) for name, n in counts.items()}
            summary[what.replace(" ", "_")] = {"planes": sum(now), **pooled}
    return summary


def _pooled(rms: Sequence[float], counts: Sequence[int]) -> float:
    """Return the RMS of several sets; NaN (empty set) is skipped."""
    return float(np.sqrt(np.nansum(np.square(rms) * counts) / max(sum(counts), 1)))


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

_GAP = "later strip above earlier (cm)"
# Number of points of a curve per knot; number of strips per row of panels.
_PLACES, _ABREAST = 12, 4
_COMPONENTS = (("position (cm)", 100.0, ("X", "Y", "Z")), ("attitude (mdeg)", 1000.0, ("right", "forward", "up")))
# Okabe and Ito (2008): distinguishable by colour-blind readers.
_COLOURS = ("#0072B2", "#E69F00", "#009E73")


def differences_figure(before: Raster, after: Raster) -> Figure:
    """Draw gaps of strips before and after; one colour scale spans 95 % of the gaps before."""
    figure = new_figure(10.0, 4.6)
    both = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, raster, name in zip(both, (before, after), ("before", "after"), strict=True):
        shown = _draw_differences(axes, raster, _limit(before))
        axes.set_title(f"{name}: {axes.get_title(loc='left')}", loc="left")
    figure.colorbar(shown, ax=list(both), label=_GAP, shrink=0.8)
    return figure


def plot_strip_differences(gaps: Raster, ax: Axes | None = None, *, limit_m: float | None = None) -> Axes:
    """Draw gaps of strips in plan (`lidar.strip_differences`); colours up to `limit_m` (default: 95 % of the gaps)."""
    ax = axes_or_new(ax)
    shown = _draw_differences(ax, gaps, _limit(gaps) if limit_m is None else 100 * limit_m)
    ax.figure.colorbar(shown, ax=ax, label=_GAP, shrink=0.8)
    return ax


def _limit(gaps: Raster) -> float:
    return 100 * float(np.nanpercentile(np.abs(gaps.heights), 95)) or 1.0


def _draw_differences(axes: Axes, gaps: Raster, limit: float) -> AxesImage:
    """Draw gaps and `limit` in centimetres."""
    (west, south), (east, north) = gaps.extent
    shown = axes.imshow(100 * gaps.heights, extent=(west, east, south, north), cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.set_title(f"{100 * float(np.sqrt(np.nanmean(gaps.heights**2))):.2g} cm RMS", loc="left")
    axes.set(xlabel="X (m)", ylabel="Y (m)", aspect="equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    return shown


def plot_scanner_correlation(result: StripAdjustment, ax: Axes | None = None, *, itself: bool = False) -> Axes:
    """Draw correlations of the scanner with cameras and mounts, or with `itself`.

    Raises InputError if none of these are estimated.
    """
    rho, scanner, others = _scanner_and_others(result)
    columns = scanner if itself else others
    if not scanner or not columns:
        raise InputError(f"no parameters of {'the scanner' if not scanner else 'cameras and mounts'} are estimated")
    ax, name = axes_or_new(ax), f"scanner with {'itself' if itself else 'camera and mount'}"
    draw_matrix(ax, rho.loc[scanner, columns].to_numpy(), _short(scanner), _short(columns), name)
    return ax


def scanner_correlation_figure(result: StripAdjustment) -> Figure:
    """Draw correlations of the scanner with cameras and mounts, and with itself."""
    _, scanner, others = _scanner_and_others(result)
    sets = [(itself, names) for itself, names in ((False, others), (True, scanner)) if names]
    figure = new_figure(3.4 + 0.52 * sum(len(names) for _, names in sets), 1.9 + 0.33 * len(scanner))
    panels = figure.subplots(1, len(sets), squeeze=False, width_ratios=[len(names) for _, names in sets])[0]
    for axes, (itself, _) in zip(panels, sets, strict=True):
        plot_scanner_correlation(result, axes, itself=itself)
    return figure


def _scanner_and_others(result: StripAdjustment) -> tuple[pd.DataFrame, list[str], list[str]]:
    """Return all correlations, the unknowns of the scanner, and the unknowns of cameras and mounts."""
    rho = all_correlations(result)
    labels = [name for name in rho.index if not name.startswith(TrajectoryKnot.kind)]
    scanner = [name for name in labels if name.startswith("scanner")]
    return rho, scanner, [name for name in labels if name not in scanner]


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


def trajectory_errors_figure(result: StripAdjustment) -> Figure:
    """Draw position and attitude errors along each strip."""
    names = result.cloud.strips
    rows, columns = 2 * -(-len(names) // _ABREAST), min(len(names), _ABREAST)
    figure = new_figure(1.2 + 2.6 * columns, 0.6 + 1.9 * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for k, name in enumerate(names):
        for part in (False, True):
            panel = panels[2 * (k // _ABREAST) + part, k % _ABREAST]
            plot_trajectory_errors(result, name, panel, attitude=part)
            panel.tick_params(labelsize=7)
    for panel in panels.flat:
        panel.set_visible(panel.has_data())
    return figure


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
    """Write tables, differences.png, report.html, summary.json; with images also the folder `adjustment`.

    `tables` contains the adjustment if it has images, `gaps` the `strip_differences` before and after.
    `write_corrected` writes cloud and trajectory into the folder. Raises InputError if `directory` contains anything
    but an earlier result.
    """
    began, seconds = time.perf_counter(), dict(result.adjusted.seconds)
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
        figures = {}
        if before is not None and after is not None:
            figures["differences"] = differences_figure(before, after)
            files["differences"] = gaps_table(before, after)
        n = len(result.cloud.strips)
        name = f"{n} strip{'s' * (n > 1)}{' and photographs' if result.before else ''}: strip adjustment"
        summary = verdict.summary | {
            "rounds": len(result.rounds), "iteration_converged": result.converged,
            "sigma0": float(result.adjusted.sigma0),
            "pattern": result.errors.calibration.pattern, **surveyed_summary(result),
            "seconds": seconds | {"write": time.perf_counter() - began},
        }  # fmt: skip
        parts = [*verdict_parts(verdict), *_sections(result, files, figures.get("differences"))]
        write_study(work, name, (verdict.headline, verdict.colour), parts, summary, record, files, figures)


def _sections(result: StripAdjustment, files: dict[str, pd.DataFrame], gaps: Figure | None) -> Iterator[Part]:
    yield Heading("Strips before and after")
    yield _in_tenths_of_mm(files["strips"])
    if gaps is not None:
        yield Plot(gaps, "gaps of strips over the ground, before and after")
    if "surveyed_points" in files:
        yield Heading("Control and check points")
        yield Paragraph(
            f"Surveyed minus strip, over the plane of each strip: the {_SHOWN} largest w (normalised gaps; 1 of 1000 "
            "exceeds 3.3). surveyed_points.csv has all."
        )
        yield _in_tenths_of_mm(files["surveyed_points"].head(_SHOWN))
    if len(scanner := files["scanner"]):
        yield Heading("Scanner and cameras" if result.before else "Scanner")
        pattern = _PATTERNS[result.errors.calibration.pattern]
        yield Paragraph(f"Estimates, each with its most correlated parameter (with, rho). {pattern}")
        yield scanner
    if scanner["parameter"].str.startswith("scanner").any():
        yield Heading("Correlations of the scanner")
        yield Paragraph(
            "Parameters with correlations near 1 or -1 are not separable. correlation.csv has all unknowns."
        )
        yield Plot(scanner_correlation_figure(result), "correlations of the scanner")
    if result.trajectory is None:
        yield Heading("Shifts of the strips")
        yield files["trajectory_errors"][_SHIFTS]
    else:
        yield Heading("Errors of the trajectory")
        yield Paragraph(
            "Trajectory errors along each strip with bands of two standard deviations. Most of these is a common shift "
            "or rotation of all strips, which overlaps do not determine; between strips far less is undetermined."
        )
        yield Plot(trajectory_errors_figure(result), "errors of the trajectory along each strip")
    yield Heading("Iterations")
    yield files["rounds"]


def _in_tenths_of_mm(table: pd.DataFrame) -> pd.DataFrame:
    """Round values to a tenth of a millimetre, without negative zeros."""
    numbers = table.select_dtypes(float).round(4) + 0.0
    return table.assign(**{str(name): numbers[name] for name in numbers})


def print_strips(result: StripAdjustment, console: Console) -> None:
    """Print iterations, gaps of strips, and the scanner."""
    last = result.rounds[-1]
    end = f"{'' if result.converged else 'not '}converged after {last.number} iterations"
    ties = f" and {last.points} tie points on them" if last.points else ""
    ties += f" and {last.control} of control" if last.control else ""
    lines = [f"{end}; {last.planes} planes{ties}, {last.left_out} rejected"]
    for d in result.differences:
        before = f"{d.rms_before_m:.3f} m" if np.isfinite(d.rms_before_m) else "unknown"
        pair = f"{d.one} and strip {d.other}" if d.one in _OF_POINTS else f"strips {d.one} and {d.other}"
        lines.append(
            f"  {pair}: gap {before} before, {d.rms_m:.3f} m after (RMS of {d.planes} planes, noise {d.noise_m:.3f} m)"
        )
    if result.trajectory is None:
        for one in trajectory_errors_table(result).to_dict("records"):
            estimated = [(a, one[f"{a}_m"], one[f"sigma_{a}_m"]) for a in "XYZ" if one[f"sigma_{a}_m"] > 0]
            shift = ", ".join(f"{a} {with_sigma(v, s)} m (sigma {of_sigma(s)})" for a, v, s in estimated)
            lines.append(f"  strip {one['strip']}: {'shift ' + shift if shift else 'fixed'}")
    for parameter, value, sigma in calibration_table(result)[["parameter", "value", "sigma"]].itertuples(index=False):
        lines.append(f"  {parameter}: {with_sigma(value, sigma)} (sigma {of_sigma(sigma)})")
    print_lines(lines, console)
