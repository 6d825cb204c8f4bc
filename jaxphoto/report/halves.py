"""A calibration validated by random halves: tables, maps over the image format, page and terminal output."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.errors import camera_words
from jaxphoto.procedures.halves import Halves
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.formatting import without_empty
from jaxphoto.report.page import Heading, Made, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, draw_format_map, new_figure
from jaxphoto.report.results import assumed_pixels, write_study
from jaxphoto.report.terminal import print_lines
from jaxphoto.stability import ALIGNED
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Sigmas from 1 from which on a factor is significant.
_SURE = 2.0
# Fraction of the squared differences that one unit explains, and the number of splits that makes it significant.
_LEADS, _ENOUGH_CUTS = 0.5, 16


def cell_table(halves: Halves) -> pd.DataFrame:
    """One row per cell: x_mm, y_mm from the image centre; then, in pixels of the measured image,

    promised_px (RMS error by the covariance of the whole block), factor, halves_px (RMS difference of two halves),
    halves_band_px and band_px: radii that hold 95 % of the differences of halves, and of the errors of the calibration.
    """
    offsets = np.stack([cut.offsets_px for cut in halves.cuts])
    columns = {
        "x_mm": halves.cells_mm[:, 0],
        "y_mm": halves.cells_mm[:, 1],
        "promised_px": halves.promised_px,
        "factor": halves.band.cell_factor,
        "halves_px": np.sqrt((offsets**2).sum(axis=2).mean(axis=0)),
        "halves_band_px": halves.band.halves,
        "band_px": halves.band.calibration,
    }
    return pd.DataFrame(columns)


def cut_table(halves: Halves) -> pd.DataFrame:
    """One row per split: cut, factor, inside (fraction of cells within the band of the other splits), rms_px (of the
    difference over the format), sigma0_first, sigma0_second, problem, first (units of one half)."""
    by, rows = halves.adjusted.block.owners(halves.by), []
    for k, cut in enumerate([*halves.cuts, *halves.failed]):
        good = k < len(halves.cuts)
        units = dict.fromkeys(unit for unit, first in zip(by, cut.first, strict=True) if first)
        sigma0 = cut.sigma0 or (np.nan, np.nan)
        rows.append({
            "cut": k + 1,
            "factor": halves.band.of_cuts[k] if good else np.nan,
            "inside": halves.band.inside[k] if good else np.nan,
            "rms_px": float(np.sqrt((cut.offsets_px**2).sum(axis=1).mean())) if good else np.nan,
            "sigma0_first": sigma0[0], "sigma0_second": sigma0[1], "problem": cut.problem, "first": " ".join(units),
        })  # fmt: skip
    return pd.DataFrame(rows)


def halves_verdict(halves: Halves) -> list[str]:
    """The result in sentences."""
    band, n, camera = halves.band, len(halves.cuts), camera_words(halves.camera)
    off, factor = (band.factor - 1) / band.sigma_factor, f"{band.factor:.2f} +- {band.sigma_factor:.2f}"
    size = "too small" if off > _SURE else "too large" if off < -_SURE else "consistent with the halves"
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
            f"{100 * fraction:.0f} % of the squared differences follow {halves.by} {unit} alone: it contradicts the "
            "others or determines what they cannot; compare with a calibration without it"
        )
    if halves.failed:
        sentences.append(
            f"{len(halves.failed)} of {n + len(halves.failed)} splits could not be compared, the first: "
            f"{halves.failed[0].problem}"
        )
    return [*sentences, "errors common to both halves, such as those of fixed points, show in no difference"]


def plot_halves(halves: Halves, ax: Axes | None = None, *, band: bool = False) -> Axes:
    """The factor of the standard deviations over the format, or the radius of the `band` that holds 95 % (px)."""
    ax = axes_or_new(ax)
    name = "95 % of the errors are smaller [px]" if band else "factor of the standard deviations"
    values = halves.band.calibration if band else halves.band.cell_factor
    draw_format_map(ax, halves.adjusted.block.sensors[halves.camera], halves.cells_mm, name, values)
    return ax


def halves_figure(halves: Halves) -> Figure:
    """Both maps of `plot_halves` side by side."""
    figure = new_figure(9.6, 3.9)
    for axes, band in zip(figure.subplots(1, 2), (False, True), strict=True):
        plot_halves(halves, axes, band=band)
    return figure


def print_halves(halves: Halves, console: Console) -> None:
    """Print the result."""
    print_lines(halves_verdict(halves), console)


def write_halves(halves: Halves, directory: Path, write_camera: Callable[[Path], object], made: Made) -> None:
    """cells.csv, cuts.csv, halves.png, report.html and summary.json; `write_camera` writes the camera as well.

    Raises InputError if `directory` holds something else than an earlier result.
    """
    cells, cuts, verdict, figure = cell_table(halves), cut_table(halves), halves_verdict(halves), halves_figure(halves)
    colour = "amber" if abs(halves.band.factor - 1) > _SURE * halves.band.sigma_factor else "green"
    parts: list[Part] = [
        *(Paragraph(as_sentence(sentence)) for sentence in verdict[1:]),
        *assumed_pixels(halves.adjusted.block.sensors),
        Heading("Over the format"),
        Plot(figure, "maps over the format: factor of the standard deviations, radius that holds 95 % of the errors"),
        Heading("Splits"),
        without_empty(cuts).rename(columns={"cut": "split", "first": "first half"}),
    ]
    inside, sigma = halves.inside
    summary = {
        "title": halves.adjusted.block.title,
        "verdict": verdict,
        "camera": halves.camera,
        "by": halves.by,
        "method": halves.method,
        "factor": halves.band.factor,
        "sigma_factor": halves.band.sigma_factor,
        "inside": inside if np.isfinite(inside) else None,
        "sigma_inside": sigma if np.isfinite(sigma) else None,
        "n_cuts": len(halves.cuts),
        "n_failed": len(halves.failed),
    }
    with whole_folder(directory) as work:
        write_camera(work)
        write_study(
            work, f"{halves.adjusted.block.title or 'block'}: halves", (verdict[0], colour), parts, summary, made,
            {"cells": cells, "cuts": cuts}, {"halves": figure},
        )  # fmt: skip
