"""Comparison of two calibrations of a camera: stability of the ray bundle, change of parameters and rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import camera_words, counted
from jaxphoto.procedures.compare import Halves
from jaxphoto.report.findings import as_sentence, p_words
from jaxphoto.report.formatting import in_figures, of_p, of_sigma, symbol, to_rich, with_sigma, without_empty
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot
from jaxphoto.report.plots import arrow_key, axes_or_new, colour_bar, draw_format, draw_format_map, title
from jaxphoto.report.results import assumed_pixel_words, assumed_pixels, write_study
from jaxphoto.report.tables import Tables, estimates_table
from jaxphoto.report.terminal import headline, plain, print_lines, print_sigma0
from jaxphoto.stability import ALIGNED, LEVEL, Analysis, Change, Method
from jaxphoto.stability.comparison import SIGNIFICANT_P, change_meaning
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Ratio of the colour scale range to the largest offset: arrows remain visible on light colours.
_LIGHT = 1.7


class Compared(NamedTuple):
    """One of the two calibrations."""

    name: str
    interior: InteriorOrientation
    known: bool
    """True if its covariance is known."""
    sensor: Sensor

    def __str__(self) -> str:
        model, how = type(self.interior.distortion).__name__, "with" if self.known else "WITHOUT"
        return f"{self.name}: {model}, c = {float(self.interior.c):.6g} mm, {how} covariance"


def about_sets(sets: tuple[Compared, Compared]) -> list[str]:
    """Describe both calibrations, the source of the uncertainty, and assumed pixel sizes."""
    without = [one.name for one in sets if not one.known]
    exact = f"{' '.join(without)} has no covariance and is assumed exact: the uncertainty is that of the other set."
    uncertainty = {
        0: "Uncertainty from the covariances of both sets, assuming different images.", 1: exact,
        2: "Neither set has a covariance: no uncertainty is given.",
    }[len(without)]  # fmt: skip
    assumed = assumed_pixel_words({one.name: one.sensor for one in sets})
    return [str(sets[0]), str(sets[1]), uncertainty, *([assumed] if assumed else [])]


# Stability -------------------------------------------------------------------------------------------------------


def stability_table(analyses: Mapping[Method, Analysis], pixel_mm: float, noise_mm: float) -> pd.DataFrame:
    """Tabulate the comparison, one row per method.

    Columns: method, unknowns, rmse_offset_mm, rmse_offset_px, rmse_measured_mm, largest_mm, similar. If a covariance is
    known, the uncertainty follows (sigma_mm to unexplained_mm, see `OffsetUncertainty`). The last columns are the
    alignment: rotations in degrees, positions as fractions of the object distance.
    """
    rows = []
    for method, one in analyses.items():
        v = one.offsets
        alignment = np.full(6, np.nan)
        alignment[: len(v.alignment)] = v.alignment
        row = {
            "method": method, "unknowns": len(v.alignment), "rmse_offset_mm": float(v.rmse_mm),
            "rmse_offset_px": float(v.rmse_mm) / pixel_mm, "rmse_measured_mm": float(v.rmse_measured_mm),
            "largest_mm": float(np.linalg.norm(v.offsets, axis=1).max()), "similar": one.similar(noise_mm),
        }  # fmt: skip
        row |= one.uncertainty._asdict() if one.uncertainty is not None else {}
        row |= dict(zip(("rx_deg", "ry_deg", "rz_deg"), np.rad2deg(alignment[:3]), strict=True))
        row |= dict(zip(("X_of_distance", "Y_of_distance", "Z_of_distance"), alignment[3:], strict=True))
        rows.append(row | {"converged": bool(v.converged)})
    return pd.DataFrame(rows)


def by_method(analyses: Mapping[Method, Analysis], pixel_mm: float, noise_mm: float) -> pd.DataFrame:
    """Tabulate the comparison as text, one column per method; lengths in micrometres."""
    columns = {}
    for row in stability_table(analyses, pixel_mm, noise_mm).to_dict("records"):
        um = {str(k)[:-3]: 1e3 * value for k, value in row.items() if str(k).endswith("_mm")}
        cells = {"RMSE_offset [um]": in_figures(um["rmse_offset"], 3)}
        if "sigma" in um:
            cells |= {
                "RMSE_offset [um]": with_sigma(um["rmse_offset"], um["sigma"]), "sigma [um]": of_sigma(um["sigma"]),
                "95 % interval [um]": f"{in_figures(um['low'], 2)} to {in_figures(um['high'], 2)}",
                "expected of an unchanged camera [um]": with_sigma(um["expected_of_one"], um["sigma"]),
                "p of an unchanged camera": of_p(row["p_value"]),
            }  # fmt: skip
        cells |= {
            "in pixels": in_figures(row["rmse_offset_px"], 2),
            "largest offset [um]": in_figures(um["largest"], 2),
            "RMSE in the measured image [um]": in_figures(um["rmse_measured"], 2),
            "within the noise": "yes" if row["similar"] else "no",
        }  # fmt: skip
        columns[row["method"]] = cells
    return pd.DataFrame(columns).reset_index(names="quantity")


def plot_ray_offsets(analysis: Analysis, sensor: Sensor, ax: Axes | None = None) -> Axes:
    """Draw offsets of corresponding rays over the image format (um): size as colour, vectors as arrows."""
    ax = axes_or_new(ax)
    points, v = np.asarray(analysis.offsets.points), 1e3 * np.asarray(analysis.offsets.offsets)
    size = np.linalg.norm(v, axis=1)
    if size.max() > 0:
        colours: dict[str, Any] = {"levels": 12, "cmap": "YlGnBu", "vmin": 0.0, "vmax": _LIGHT * size.max()}
        filled = ax.tricontourf(points[:, 0], points[:, 1], size, **colours)
        colour_bar(ax, filled, "offset of corresponding rays [µm]")
    arrows = ax.quiver(*points.T, *v.T, angles="xy", color="0.15", width=0.0025)
    key = float(f"{max(size.mean(), 1e-12):.0e}")
    arrow_key(ax, arrows, key, f"{key:g} µm")
    draw_format(ax, sensor)
    title(ax, f"{analysis.method}: RMSE_offset {1e3 * float(analysis.offsets.rmse_mm):.3g} µm")
    return ax


def print_stability(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], pixel_mm: float, noise_mm: float,
    method: Method, console: Console,
) -> None:  # fmt: skip
    """Print the verdict by `method`, one column per method, and both calibrations."""
    colour = "green" if analyses[method].similar(noise_mm) else "amber"
    console.print(headline(f"{method}: {analyses[method].verdict(noise_mm)}", colour), soft_wrap=True)
    name = f"stability; noise {1e3 * noise_mm:.4g} um = {noise_mm / pixel_mm:.4g} px"
    console.print(to_rich(by_method(analyses, pixel_mm, noise_mm), name))
    print_lines(about_sets(sets), console)


def write_stability(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], sensor: Sensor, noise_mm: float,
    method: Method, directory: Path, record: CommandRecord,
) -> None:  # fmt: skip
    """Write stability.csv, report.html and summary.json, and offsets.csv of `method`."""
    chosen = analyses[method]
    methods = "The bundles of rays are " + "; ".join(f"{ALIGNED[name]} ({name})" for name in analyses) + "."
    # Write µm only in the report: a terminal may be unable to display it.
    table = by_method(analyses, sensor.pixel_mm, noise_mm)
    parts: list[Part] = [
        table.assign(quantity=table["quantity"].str.replace("[um]", "[µm]")), Paragraph(methods),
        *map(Paragraph, about_sets(sets)), Heading("Offsets over the image"),
        Plot(partial(plot_ray_offsets, chosen, sensor), "offsets of the two bundles over the image", 4),
    ]  # fmt: skip
    verdict = f"Bundles {ALIGNED[method]} ({method}): {chosen.verdict(noise_mm)}".replace(" um", " µm")
    v = chosen.offsets
    columns = ["x_mm", "y_mm", "dx_mm", "dy_mm", "dx_measured_mm", "dy_measured_mm"]
    offsets = pd.DataFrame(np.hstack([v.points, v.offsets, v.measured]), columns=columns)
    tables = {"stability": stability_table(analyses, sensor.pixel_mm, noise_mm), "offsets": offsets}
    colour = "green" if chosen.similar(noise_mm) else "amber"
    summary = stability_summary(analyses, sets, noise_mm, method)
    with whole_folder(directory) as work:
        write_study(work, "Stability of interior orientation", (verdict, colour), parts, summary, record, tables)


def stability_summary(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], noise_mm: float, method: Method
) -> dict[str, Any]:
    """Return the comparison for summary.json."""
    chosen = analyses[method]
    return {
        "verdict": f"{method}: {chosen.verdict(noise_mm)}", "method": method, "similar": chosen.similar(noise_mm),
        "noise_mm": noise_mm, "rmse_offset_mm": {name: float(one.offsets.rmse_mm) for name, one in analyses.items()},
        "n_points": len(chosen.offsets.points), "covariance": {"A": sets[0].known, "B": sets[1].known},
    }  # fmt: skip


# Change ----------------------------------------------------------------------------------------------------------


def parameter_changes(change: Change) -> pd.DataFrame:
    """Tabulate the differences of the parameters; empty if the distortion models differ.

    Columns: parameter, first, second, difference (second minus first), sigma (of the difference), ratio, p_value, unit.
    """
    columns = ["parameter", "first", "second", "difference", "sigma", "p_value", "unit"]
    table = pd.DataFrame(change.parameters, columns=columns)
    estimated = table["sigma"] > 0
    table.insert(5, "ratio", table["difference"].where(estimated) / table["sigma"].where(estimated))
    return table


def change_cells(change: Change, sensor: Sensor) -> pd.DataFrame:
    """Tabulate the differences of the ray bundles, one row per point of the format.

    Columns: x_mm, y_mm; dx_px, dy_px (first minus second bundle, aligned, in the measured image), offset_px, limit_px
    (95 % for two calibrations of an unchanged camera), beyond.
    """
    v = change.field.offsets
    columns = ["x_mm", "y_mm", "dx_px", "dy_px"]
    table = pd.DataFrame(np.hstack([v.points, np.asarray(v.measured) / sensor.pixel_mm]), columns=columns)
    return table.assign(
        offset_px=change.offset_mm / sensor.pixel_mm, limit_px=change.limit_mm / sensor.pixel_mm, beyond=change.beyond
    )


def change_verdict(change: Change, sensor: Sensor) -> list[str]:
    """Summarise the tests in sentences."""
    sentences = []
    if change.degrees_of_freedom:
        sentences.append(
            f"parameters: chi-square {change.chi_square:.1f} with {change.degrees_of_freedom} degrees of freedom, "
            f"{p_words(change.p_parameters, 2)}: {change_meaning(change.p_parameters)}"
        )
    elif not change.parameters:
        sentences.append("parameters are not compared: the calibrations have different models")
    if tested := [one for one in change.parameters if one.sigma > 0]:
        least, limit = min(tested, key=lambda one: one.p_value), SIGNIFICANT_P / len(tested)
        sentences.append(
            f"single parameters: smallest {p_words(least.p_value, 2)} ({symbol(least.parameter)}), "
            f"{'' if least.p_value < limit else 'not '}significant: the limit for {counted(len(tested), 'test')} is "
            f"{limit:.2g} (Bonferroni)"
        )
    if held := [one.parameter for one in change.parameters if one.sigma == 0 and one.difference != 0]:
        sentences.append(f"fixed at different values and not tested: {', '.join(held)}")
    field = change.field.uncertainty
    if field is not None:
        rmse = float(change.field.offsets.rmse_measured_mm) / sensor.pixel_mm
        sentences.append(
            f"bundle of rays, {ALIGNED[change.field.method]}: RMS {rmse:.3g} px over the format, "
            f"{p_words(field.p_value, 2)}: {change_meaning(field.p_value)}"
        )
    worst = int(np.argmax(change.offset_mm / change.limit_mm))
    x, y = np.asarray(change.field.offsets.points)[worst]
    offset, limit = (v[worst] / sensor.pixel_mm for v in (change.offset_mm, change.limit_mm))
    n = len(change.limit_mm)
    sentences.append(
        f"the offset exceeds the {100 * LEVEL:.0f} % limit for one camera at {change.beyond.sum()} of {n} points "
        f"(expected {(1 - LEVEL) * n:.0f}); largest at x {x:.3g}, y {y:.3g} mm: {offset:.3g} px, limit {limit:.3g} px"
    )
    return sentences


def change_headline(change: Change) -> str:
    """Return the result of both tests: the camera has changed if at least one is significant."""
    return change_meaning(float(np.nanmin([change.p_parameters, change.p_field])))


def plot_change(change: Change, sensor: Sensor, ax: Axes | None = None, *, over_usual: bool = False) -> Axes:
    """Draw offsets of the rays of two calibrations over the format (px), or their ratio to the limit."""
    ax, name = axes_or_new(ax), f"offset over its {100 * LEVEL:.0f} % limit" if over_usual else "offset [px]"
    values = change.offset_mm / (change.limit_mm if over_usual else sensor.pixel_mm)
    draw_format_map(ax, sensor, np.asarray(change.field.offsets.points), name, values)
    return ax


def print_change(change: Change, sets: tuple[Compared, Compared], sensor: Sensor, console: Console) -> None:
    """Print the verdict, the parameters, the tests and both calibrations."""
    console.print(headline(change_headline(change), "amber" if change.changed else "green"), soft_wrap=True)
    table = parameter_changes(change).drop(columns="ratio")
    if len(table := table[(table["sigma"] > 0) | (table["first"] != 0) | (table["second"] != 0)]):
        console.print(to_rich(table.rename(columns={"first": "A", "second": "B", "difference": "B - A"})))
    print_lines([*change_verdict(change, sensor), *about_sets(sets)], console)


def write_change(
    change: Change, sets: tuple[Compared, Compared], sensor: Sensor, directory: Path, record: CommandRecord
) -> None:
    """Write parameters.csv, cells.csv, report.html and summary.json."""
    parameters = parameter_changes(change)
    names = {False: "offsets of rays [px]", True: "offsets over their limit"}
    shown = parameters.rename(columns={"first": "A", "second": "B", "difference": "B - A"})
    parts: list[Part] = [
        shown,
        *(Paragraph(as_sentence(sentence)) for sentence in change_verdict(change, sensor)),
        *map(Paragraph, about_sets(sets)),
        Heading("Over the format"),
        [Plot(partial(plot_change, change, sensor, over_usual=u), f"map of {name}") for u, name in names.items()],
    ]
    tables = {"parameters": parameters, "cells": change_cells(change, sensor)}
    verdict, summary = (change_headline(change), "amber" if change.changed else "green"), change_summary(change, sensor)
    with whole_folder(directory) as work:
        write_study(work, "Change of a camera", verdict, parts, summary, record, tables)


def change_summary(change: Change, sensor: Sensor) -> dict[str, Any]:
    """Return the comparison for summary.json."""
    field, tested = change.field.uncertainty, bool(change.degrees_of_freedom)
    return {
        "verdict": change_verdict(change, sensor), "method": change.field.method,
        "chi_square": change.chi_square if tested else None, "degrees_of_freedom": change.degrees_of_freedom,
        "p_parameters": change.p_parameters if tested else None, "p_field": None if field is None else field.p_value,
        "n_beyond": int(change.beyond.sum()), "n_points": len(change.limit_mm),
    }  # fmt: skip


# Halves ----------------------------------------------------------------------------------------------------------

# Deviation of a factor from 1 in standard deviations above which it is significant.
_SURE = 2.0
# Fraction of the squared differences above which one unit explains them; minimum number of splits for this test.
_LEADS, _ENOUGH_CUTS = 0.5, 16


def cell_table(halves: Halves) -> pd.DataFrame:
    """Tabulate the assessment, one row per cell of the format.

    Columns: x_mm, y_mm from the image centre; then, in pixels of the measured image, promised_px (RMS error by the
    covariance of the whole block), factor, halves_px (RMS difference of two halves), halves_band_px and band_px (radii
    that contain 95 % of the differences of halves, and of the errors of the calibration).
    """
    offsets = np.stack([cut.offsets_px for cut in halves.cuts])
    columns = {
        "x_mm": halves.cells_mm[:, 0], "y_mm": halves.cells_mm[:, 1], "promised_px": halves.promised_px,
        "factor": halves.band.cell_factor, "halves_px": np.sqrt((offsets**2).sum(axis=2).mean(axis=0)),
        "halves_band_px": halves.band.halves, "band_px": halves.band.calibration,
    }  # fmt: skip
    return pd.DataFrame(columns)


def cut_table(halves: Halves) -> pd.DataFrame:
    """Tabulate the splits.

    Columns: cut, factor, inside (fraction of cells within the band of the other splits), rms_px (of the difference over
    the format), sigma0_first, sigma0_second, problem, first (units of the first half).
    """
    by, rows, band = halves.adjusted.block.owners(halves.by), [], halves.band
    for k, cut in enumerate([*halves.cuts, *halves.failed]):
        values, sigma0 = (np.nan,) * 3, cut.sigma0 or (np.nan, np.nan)
        if k < len(halves.cuts):
            values = band.of_cuts[k], band.inside[k], float(np.sqrt((cut.offsets_px**2).sum(axis=1).mean()))
        units = dict.fromkeys(unit for unit, first in zip(by, cut.first, strict=True) if first)
        rows.append((k + 1, *values, *sigma0, cut.problem, " ".join(units)))
    columns = ["cut", "factor", "inside", "rms_px", "sigma0_first", "sigma0_second", "problem", "first"]
    return pd.DataFrame(rows, columns=columns)


def halves_verdict(halves: Halves) -> list[str]:
    """Summarise the result in sentences."""
    band, n, camera = halves.band, len(halves.cuts), camera_words(halves.camera)
    deviation, factor = (band.factor - 1) / band.sigma_factor, f"{band.factor:.2f} +- {band.sigma_factor:.2f}"
    size = "too small" if deviation > _SURE else "too large" if deviation < -_SURE else "consistent with the halves"
    cell, wide = band.cell_factor, band.calibration
    sentences = [
        f"standard deviations of {camera} are {size}: factor {factor} ({n} splits by {halves.by}; bundles of rays "
        f"{ALIGNED[halves.method]})",
        f"over the format the factor is {cell.min():.2f} to {cell.max():.2f}; 95 % of the errors are within "
        f"{wide.min():.3g} to {wide.max():.3g} px, by the covariances alone {(wide / cell).min():.3g} to "
        f"{(wide / cell).max():.3g} px",
    ]
    inside, sigma = halves.inside
    if np.isfinite(sigma):
        sentences.append(
            f"{100 * inside:.1f} +- {100 * sigma:.1f} % of the cells differ by less than the band of the other splits"
        )
    unit, fraction = halves.leading
    if n >= _ENOUGH_CUTS and fraction > _LEADS:
        sentences.append(
            f"{100 * fraction:.0f} % of the squared differences are caused by {halves.by} {unit} alone: it contradicts "
            "the others or determines more than they do; compare with a calibration without it"
        )
    if halves.failed:
        sentences.append(
            f"{len(halves.failed)} of {n + len(halves.failed)} splits could not be compared, the first: "
            f"{halves.failed[0].problem}"
        )
    if halves.weights:
        sentences.append(halves.weights.words)
    return [*sentences, "errors common to both halves, such as those of fixed points, are undetectable"]


def _estimates(halves: Halves) -> pd.DataFrame:
    """Return the estimates of the camera with the standard deviations of `Halves.widened`."""
    table = estimates_table(Tables(halves.adjusted))
    table = table[table["parameter"].str.startswith(f"interior[{halves.camera}].")]
    return table.assign(sigma=max(halves.band.factor, 1.0) * table["sigma"])


def _factor_words(halves: Halves) -> str:
    return f"a posteriori, times {max(halves.band.factor, 1.0):.2f} by the halves"


def print_halves(halves: Halves, console: Console) -> None:
    """Print the verdict, sigma naught and the estimates with their enlarged standard deviations."""
    verdict = halves_verdict(halves)
    console.print(plain(halves.adjusted.block.title or "block"), style="bold")
    console.print(headline(verdict[0], _colour(halves)), soft_wrap=True)
    print_sigma0(halves.adjusted, console)
    console.print(to_rich(_estimates(halves), f"estimates ({_factor_words(halves)})"))
    print_lines(verdict[1:], console)


def _colour(halves: Halves) -> str:
    return "amber" if abs(halves.band.factor - 1) > _SURE * halves.band.sigma_factor else "green"


def plot_halves(halves: Halves, ax: Axes | None = None, *, band: bool = False) -> Axes:
    """Draw the factor of the standard deviations over the format, or the radius of the 95 % `band` (px)."""
    ax = axes_or_new(ax)
    name = "95 % of the errors are smaller [px]" if band else "factor of the standard deviations"
    values = halves.band.calibration if band else halves.band.cell_factor
    draw_format_map(ax, halves.adjusted.block.sensors[halves.camera], halves.cells_mm, name, values)
    return ax


def write_halves(
    halves: Halves, directory: Path, write_camera: Callable[[Path], object], record: CommandRecord
) -> None:
    """Write cells.csv, cuts.csv, report.html, summary.json, and the camera by `write_camera`."""
    cuts, verdict, block = cut_table(halves), halves_verdict(halves), halves.adjusted.block
    names = {False: "factor of the standard deviations", True: "radius that holds 95 % of the errors"}
    parts: list[Part] = [
        _estimates(halves),
        Paragraph(
            f"Standard deviations are {_factor_words(halves)} (sigma naught {float(halves.adjusted.sigma0):.4f}, "
            f"redundancy {halves.adjusted.redundancy}), as in camera.toml."
        ),
        *(Paragraph(as_sentence(sentence)) for sentence in verdict[1:]),
        *assumed_pixels(block.sensors),
        Heading("Over the format"),
        [Plot(partial(plot_halves, halves, band=band), f"map of the {name}") for band, name in names.items()],
        Heading("Splits"),
        without_empty(cuts).rename(columns={"cut": "split", "first": "first half"}),
    ]
    inside, sigma = halves.inside
    summary = {
        "title": block.title, "verdict": verdict, "camera": halves.camera, "by": halves.by,
        "method": halves.method, "factor": halves.band.factor, "sigma_factor": halves.band.sigma_factor,
        "inside": inside if np.isfinite(inside) else None, "sigma_inside": sigma if np.isfinite(sigma) else None,
        "n_cuts": len(halves.cuts), "n_failed": len(halves.failed),
    }  # fmt: skip
    with whole_folder(directory) as work:
        write_camera(work)
        tables = {"cells": cell_table(halves), "cuts": cuts}
        write_study(
            work, f"{block.title or 'block'}: halves", (verdict[0], _colour(halves)), parts, summary, record, tables
        )  # fmt: skip
