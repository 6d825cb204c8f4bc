"""Results of point clouds and images: heights as vertical control, and simultaneous adjustment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.errors import InputError
from jaxphoto.lidar import HeightFlag
from jaxphoto.observations import AXES
from jaxphoto.procedures.lidar import LidarControl, RoofControl, Round, Simultaneous
from jaxphoto.procedures.lidar.vertical_control import flag_counts
from jaxphoto.report.findings import Verdict, as_sentence
from jaxphoto.report.formatting import in_figures, label_unit, to_rich, without_empty
from jaxphoto.report.page import CommandRecord, Heading, Link, Paragraph, Part, Plot, page, provenance, verdict_parts
from jaxphoto.report.plots import axes_or_new, colour_bar, title
from jaxphoto.report.results import summary_of, write_results, write_study
from jaxphoto.report.tables import Tables, about_sigma, estimates_table
from jaxphoto.report.terminal import plain, print_lines, print_sigma0, print_verdict
from jaxphoto.statistics import Covariance, angle_differences, correlation_matrix
from jaxphoto.unknowns import Unknowns
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ITERATIONS = {"round": "iteration", "observed": "observations", "left_out": "rejected", "moved_m": "rms_motion_m"}
"""Heads of the columns of iterations on a page."""
_AXES = ("X, omega", "Y, phi", "Z, kappa")
_CHANGES = "RMS changes; images and points relative to the adjustment without the cloud, with fixed initial cameras"
# Maximum number of rows of a long table on a page.
_ROWS = 30


def rounds_table(rounds: Sequence[Round]) -> pd.DataFrame:
    """Tabulate the iterations: round, observed, left_out, moved_m, largest_change (in standard deviations), rmse_m."""
    return pd.DataFrame(rounds, columns=["round", *Round._fields[1:]])


def heights_table(control: LidarControl) -> pd.DataFrame:
    """Tabulate the control heights at tie points.

    Columns: point, X_m, Y_m, Z_m (adjusted), height_m (of the cloud), sigma_m, flags, used.
    """
    points = np.asarray(control.adjusted.unknowns.points)[control.points]
    names = np.array(control.block.points, object)[control.points]
    flags = [" ".join(f.name.lower() for f in HeightFlag if f and f & int(flag) and f.name) for flag in control.flag]
    columns = {"point": names, **{f"{axis}_m": points[:, k] for k, axis in enumerate(AXES)}}
    columns |= {"height_m": control.height, "sigma_m": control.sigma, "flags": flags, "used": control.used}
    return pd.DataFrame(columns)


def surfaces_table(result: Simultaneous) -> pd.DataFrame:
    """Tabulate heights of object points above the surface (m), before and after the adjustment.

    Columns: point, strip, X_m, Y_m, Z_m, above_before_m, above_m.
    """
    points = np.asarray(result.adjusted.unknowns.points)[result.points]
    columns = {"point": np.array(result.adjusted.block.points, object)[result.points]}
    columns |= {"strip": np.array(tuple(result.scanner.shifts), object)[result.strip]}
    columns |= {f"{axis}_m": points[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(columns | {"above_before_m": result.apart_before, "above_m": result.apart})


def moved_table(result: Simultaneous, tables: Tables | None = None) -> pd.DataFrame:
    """Tabulate the changes of the parameters of cameras, scanner, mounts and strips.

    Columns: what, before, after, moved, sigma (a posteriori), unit. The last rows are RMS changes of camera stations,
    rotations, object points and laser points, and the RMS height of points above the surface. `tables`: of the result,
    if already computed.
    """
    after, before = result.adjusted, result.before
    # Only scanner parameters have no value before the adjustment; use zero.
    then, now = (dict(zip(a.parameters, np.asarray(a.values.shared).tolist(), strict=True)) for a in (before, after))
    rows: list[tuple] = []
    sigma = np.asarray((tables or Tables(after)).covariance.shared_sigma)
    for path, s in zip(after.structure.labels, sigma, strict=True):
        name, factor = path.replace("_rad", "_deg"), 180 / np.pi if path.endswith("_rad") else 1.0
        old, new = factor * then.get(path, 0.0), factor * now[path]
        rows.append((name, old, new, new - old, factor * float(s), label_unit(name, after.unknowns.interior)))
    exterior = np.asarray(after.unknowns.exterior.position) - np.asarray(before.unknowns.exterior.position)
    points = np.asarray(after.unknowns.points) - np.asarray(before.unknowns.points)
    angles = np.rad2deg(angle_differences(after, before)[1])
    for what, names, values, unit in (
        ("camera stations", AXES, exterior, "m"), ("images", ("omega", "phi", "kappa"), angles, "deg"),
        ("object points", AXES, points, "m"), ("laser points", AXES, np.atleast_2d(result.moved_cloud), "m"),
    ):  # fmt: skip
        rows += [(f"{what}, {n}", np.nan, np.nan, _rms(values[:, k]), np.nan, unit) for k, n in enumerate(names)]
    both = [_rms(v) for v in (result.apart_before, result.apart)]
    rows.append(("points above the surface, RMSE", *both, both[1] - both[0], np.nan, "m"))
    return pd.DataFrame(rows, columns=["what", "before", "after", "moved", "sigma", "unit"])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(values) ** 2)))


def _estimates(moved: pd.DataFrame) -> pd.DataFrame:
    """Return the parameters of `moved_table`: parameter, initial, value, sigma, unit."""
    names = {"what": "parameter", "before": "initial", "after": "value"}
    return moved[moved["sigma"].notna()].rename(columns=names).drop(columns="moved")


def _root_mean_squares(moved: pd.DataFrame) -> pd.DataFrame:
    """Return the RMS changes of `moved_table` by group as text, one column for each axis and its rotation."""
    rows = moved[moved["before"].isna()]
    group = rows["what"].str.partition(",")[0].replace("images", "rotations")
    return pd.DataFrame([
        {"RMS change of": name, **dict(zip(_AXES, (in_figures(v, 3) for v in of["moved"]), strict=True)), "unit": unit}
        for (name, unit), of in rows.groupby([group, "unit"], sort=False)
    ])  # fmt: skip


def scanner_correlations(covariance: Covariance) -> pd.DataFrame:
    """Tabulate correlations of boresight and scanner shifts with each other and with the cameras.

    Columns: parameter_a, parameter_b, rho.
    """
    first = 6 * covariance.n_images
    rho, paths = correlation_matrix(covariance)[first:, first:], covariance.labels[first:]
    scanner = [k for k, path in enumerate(paths) if path.startswith("scanner")]
    rows = [(paths[a], paths[b], rho[a, b]) for a in scanner for b in range(len(paths)) if a != b]
    return pd.DataFrame(rows, columns=["parameter_a", "parameter_b", "rho"])


def plot_above(result: Simultaneous, ax: Axes | None = None, *, before: bool = False) -> Axes:
    """Draw heights of points above the surface of the cloud (m), after the adjustment or `before` it.

    The colour scale spans 95 % of them.
    """
    ax, values = axes_or_new(ax), result.apart_before if before else result.apart
    points = np.asarray(result.adjusted.unknowns.points)[result.points]
    name = f"{'before' if before else 'after'}: RMSE {_rms(values):.3f} m"
    _draw_heights(ax, points, values, "point above the surface [m]", name)
    return ax


def plot_lidar_heights(control: LidarControl, ax: Axes | None = None, *, residuals: bool = False) -> Axes:
    """Draw heights of a cloud that are control, rejected or unavailable; or the `residuals` of control (m).

    Residuals are cloud minus adjusted heights. Raises InputError if residuals are requested but no height is control.
    """
    points, used = np.asarray(control.adjusted.unknowns.points)[control.points], control.used
    if residuals and not used.any():
        raise InputError("no height of the cloud is used as control: no residuals to draw")
    ax, missing = axes_or_new(ax), ~np.isfinite(control.height)
    if residuals:
        v = (control.height - points[:, 2])[used]
        name = f"cloud minus adjusted: RMSE {_rms(v):.3f} m"
        _draw_heights(ax, points[used], v, "cloud minus adjusted height [m]", name)
        return ax
    sets = ((missing, "no height", "0.6", "+"), (used, "control", "tab:blue", "o"))
    for chosen, words, colour, marker in (*sets, (~used & ~missing, "rejected", "#D55E00", "x")):
        ax.plot(*points[chosen, :2].T, marker, ms=5, color=colour, ls="none", label=f"{words} ({chosen.sum()})")
    ax.legend(loc="best", fontsize=8)
    ax.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    title(ax, "heights of the cloud")
    return ax


def _draw_heights(axes: Axes, points: np.ndarray, values: np.ndarray, words: str, name: str) -> None:
    """Draw values in plan; the colour scale spans 95 % of them."""
    limit = float(np.nanpercentile(np.abs(values), 95)) or 1.0
    colours: dict[str, Any] = {"c": values, "cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    shown = axes.scatter(points[:, 0], points[:, 1], s=18, edgecolor="0.6", **colours)
    colour_bar(axes, shown, words)
    axes.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    title(axes, name)


@contextmanager
def write_simultaneous(
    result: Simultaneous, tables: Tables, verdict: Verdict, directory: Path, seconds: dict[str, float],
    record: CommandRecord,
) -> Iterator[Path]:  # fmt: skip
    """Write the tables of iterations, changes, surfaces and correlations, the report and the folder `adjustment`.

    `tables` contains the adjustment of the result. Yields the temporary folder so that the caller can add files.
    """
    with whole_folder(directory) as work:
        times = tables.adjusted.seconds
        spent = {name: times[name] for name in ("compile", "solve", "covariance")}
        write_results(tables, verdict, work / "adjustment", spent, record=record)
        rounds, moved = rounds_table(result.rounds), moved_table(result, tables)
        correlations = scanner_correlations(tables.covariance)
        iterations = rounds_words(result.rounds, result.converged)
        parts: list[Part] = [
            _estimates(moved), Paragraph(about_sigma(tables.adjusted)), *map(Paragraph, map(as_sentence, iterations)),
            *verdict_parts(verdict), Link("all results of the images", "adjustment/report.html"),
            Heading("Points and surface of the cloud"),
            [Plot(partial(plot_above, result, before=b), f"points above the cloud {w}", 4)
             for b, w in ((True, "before"), (False, "after"))],
            Paragraph(as_sentence(_CHANGES)), _root_mean_squares(moved),
            Heading("Iterations"), rounds.replace(np.inf, np.nan).rename(columns=ITERATIONS),
            Heading("Correlations of the scanner"),
            Paragraph("The strongest; all are in scanner_correlation.csv."), _strongest(correlations),
        ]  # fmt: skip
        files = {
            "rounds": rounds,
            "moved": moved,
            "surfaces": surfaces_table(result),
            "scanner_correlation": correlations,
        }
        summary = summary_of(tables, verdict, seconds)
        write_study(
            work, f"{tables.adjusted.block.title or 'Block'} and cloud, adjusted together",
            (verdict.headline, verdict.colour), parts,
            summary | {"rounds": len(result.rounds), "iteration_converged": result.converged}, record, files,
        )  # fmt: skip
        yield work


def print_simultaneous(result: Simultaneous, tables: Tables, verdict: Verdict, console: Console) -> None:
    """Print the verdict, sigma naught, the iterations, the estimates and RMS changes."""
    console.print(plain(tables.adjusted.block.title or "block"), style="bold")
    print_verdict(verdict, console)
    print_sigma0(tables.adjusted, console)
    print_lines(rounds_words(result.rounds, result.converged), console)
    moved = moved_table(result, tables)
    console.print(to_rich(_estimates(moved), "estimates (a posteriori)"))
    console.print(to_rich(_root_mean_squares(moved), _CHANGES))


def print_control(control: LidarControl | RoofControl, start: Unknowns, console: Console) -> None:
    """Print the iterations, sigma naught and the estimates of an adjustment with control from a cloud.

    `start`: unknowns of the block before.
    """
    console.print(plain(control.block.title or "block"), style="bold")
    print_lines(rounds_words(control.rounds, control.converged), console)
    print_sigma0(control.adjusted, console)
    if len(table := estimates_table(Tables(control.adjusted), start)):
        console.print(to_rich(table, "estimates (a posteriori)"))


def _strongest(correlations: pd.DataFrame) -> pd.DataFrame:
    """Return the strongest correlations, each pair only once."""
    names = ["parameter_a", "parameter_b"]
    repeated = pd.DataFrame(np.sort(correlations[names].to_numpy(str), axis=1), correlations.index).duplicated()
    strongest = correlations[~repeated].sort_values("rho", key=np.abs, ascending=False, kind="stable")[:_ROWS]
    return strongest.assign(**{name: strongest[name].str.replace("_rad", "_deg") for name in names})


def rounds_words(rounds: Sequence[Round], converged: bool) -> tuple[str, str]:
    """Summarise the outer iterations in two sentences."""
    last = rounds[-1]
    end = f"converged after {len(rounds)} iterations" if converged else f"not converged after {len(rounds)} iterations"
    return (
        f"{end} (largest change {last.largest_change:.2g} standard deviations); {last.observed} observations of the "
        f"cloud, {last.left_out} rejected",
        f"points lie on the cloud's surface with an RMSE of {last.rmse_m:.3f} m",
    )


def heights_page(control: LidarControl, start: Unknowns, record: CommandRecord) -> str:
    """Return the page of cloud heights as control: estimates, iterations, flags, plots, and the largest differences.

    `start`: unknowns of the block before.
    """
    heights = heights_table(control)
    heights.insert(5, "difference_m", heights["height_m"] - heights["Z_m"])
    largest = heights.sort_values("difference_m", key=np.abs, ascending=False, kind="stable")[:_ROWS]
    words = rounds_words(control.rounds, control.converged)
    used = f"{int(control.used.sum())} of {len(control.points)} tie points have a control height"
    plots = [
        Plot(partial(plot_lidar_heights, control, residuals=r), name, 4)
        for r, name in ((False, "heights of the cloud as control"), (True, "residuals of the control heights"))
        if control.used.any() or not r
    ]
    parts: list[Part] = [
        estimates_table(Tables(control.adjusted), start),
        *(Paragraph(as_sentence(text)) for text in (about_sigma(control.adjusted), words[1], used)),
        Heading("Over the ground"),
        plots,
    ]
    parts += [Heading("Iterations"), rounds_table(control.rounds).replace(np.inf, np.nan).rename(columns=ITERATIONS)]
    if flags := flag_counts(control.flag):
        parts.append(pd.DataFrame({"flag": [name.lower() for name in flags], "heights": list(flags.values())}))
    parts += [Heading("Largest differences"), without_empty(largest.round(3))]
    parts += [Paragraph("All heights are in lidar_heights.csv."), *provenance(record)]
    name = f"{control.block.title or 'Block'}: heights of a cloud as control"
    return page(name, parts, (words[0], "green" if control.converged else "red"))
