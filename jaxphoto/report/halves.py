"""A calibration judged by its halves: tables, maps over the format, a page and words in the terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.errors import camera_words
from jaxphoto.procedures.halves import Halves
from jaxphoto.report.document import Heading, Paragraph, rows_of, without_empty
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.maps import draw_format_map
from jaxphoto.report.plots import axes_or_new, new_figure
from jaxphoto.report.results import write_summary
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.report.study_page import WholePicture, study_page
from jaxphoto.stability import ALIGNED
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Below so many standard deviations from 1 a factor says nothing.
_SURE = 2.0
# One unit leads where more than this of the differences follows it, of so many cuts that this is no chance.
_LEADS, _ENOUGH_CUTS = 0.5, 16


def cell_table(found: Halves) -> pd.DataFrame:
    """A row each cell: x_mm, y_mm from the image centre; then, in pixels of the measured image, both axes together,

    promised_px (root mean square error by the covariance of the whole block), factor, halves_px (root mean square
    difference of two halves), halves_band_px and band_px: radii that hold 95 % of the differences of halves, and of the
    errors of the calibration by the whole block.
    """
    offsets = np.stack([cut.offsets_px for cut in found.cuts])
    columns = {
        "x_mm": found.cells_mm[:, 0],
        "y_mm": found.cells_mm[:, 1],
        "promised_px": found.promised_px,
        "factor": found.band.cell_factor,
        "halves_px": np.sqrt((offsets**2).sum(axis=2).mean(axis=0)),
        "halves_band_px": found.band.halves,
        "band_px": found.band.calibration,
    }
    return pd.DataFrame(columns)


def cut_table(found: Halves) -> pd.DataFrame:
    """A row each cut: cut, factor (of this cut alone), inside (part of the cells within the band that the others give),
    rms_px (of the difference over the format), sigma0_first, sigma0_second, problem, first: the units of one half.
    """
    by = found.adjusted.block.owners(found.by)
    both = [*found.cuts, *found.failed]
    rows = []
    for k, cut in enumerate(both):
        good = k < len(found.cuts)
        rms = float(np.sqrt((cut.offsets_px**2).sum(axis=1).mean())) if good else np.nan
        units = dict.fromkeys(unit for unit, first in zip(by, cut.first, strict=True) if first)
        row = {"cut": k + 1, "factor": found.band.of_cuts[k] if good else np.nan}
        row |= {"inside": found.band.inside[k] if good else np.nan, "rms_px": rms}
        row |= dict(zip(("sigma0_first", "sigma0_second"), cut.sigma0 or (np.nan, np.nan), strict=True))
        rows.append(row | {"problem": cut.problem, "first": " ".join(units)})
    return pd.DataFrame(rows)


def halves_verdict(found: Halves) -> list[str]:
    """What the halves say, in sentences."""
    band, n = found.band, len(found.cuts)
    off = (band.factor - 1) / band.sigma_factor
    how = f"{band.factor:.2f} +- {band.sigma_factor:.2f}"
    if off > _SURE:
        said = f"standard deviations of {camera_words(found.camera)} are too small by a factor of {how}"
    elif off < -_SURE:
        said = f"standard deviations of {camera_words(found.camera)} are too large: their factor is {how}"
    else:
        said = f"nothing speaks against the standard deviations of {camera_words(found.camera)}: their factor is {how}"
    cell, wide = band.cell_factor, band.calibration
    cuts = f"{n} cuts" if n > 1 else "1 cut"
    sentences = [
        f"{said} ({cuts} by {found.by}; bundles of rays {ALIGNED[found.method]})",
        f"over the format the factor is {cell.min():.2f} to {cell.max():.2f}; 95 % of the errors lie within "
        f"{wide.min():.3g} to {wide.max():.3g} px, by the covariances as they are it would be "
        f"{(wide / cell).min():.3g} to {(wide / cell).max():.3g} px",
    ]
    share, error = found.inside
    if np.isfinite(error):
        sentences.append(
            f"{100 * share:.1f} +- {100 * error:.1f} % of the cells differ by less than the band, each cut by the band "
            "that the others give"
        )
    unit, part = found.leading
    if n >= _ENOUGH_CUTS and part > _LEADS:
        sentences.append(
            f"{100 * part:.0f} % of the squares of all differences follow {found.by} {unit} alone: the half that it is "
            "in differs from the other, so it contradicts the others or decides what they cannot; look at it, and "
            "compare with a calibration without it"
        )
    if found.failed:
        sentences.append(
            f"{len(found.failed)} of {n + len(found.failed)} cuts could not be compared, the first of them: "
            f"{found.failed[0].problem}"
        )
    return [*sentences, "errors that both halves share, such as those of points held fixed, show in no difference"]


def halves_figure(found: Halves) -> Figure:
    """Both maps of `plot_halves`, one beside the other."""
    figure = new_figure(9.6, 3.9)
    for axes, band in zip(figure.subplots(1, 2), (False, True), strict=True):
        plot_halves(found, axes, band=band)
    return figure


def plot_halves(found: Halves, ax: Axes | None = None, *, band: bool = False) -> Axes:
    """The factor of the standard deviations over the format, or the radius of the `band` that holds 95 % (px)."""
    ax = axes_or_new(ax)
    name = "95 % of the errors are smaller [px]" if band else "factor of the standard deviations"
    values = found.band.calibration if band else found.band.cell_factor
    draw_format_map(ax, found.adjusted.block.sensors[found.camera], found.cells_mm, name, values)
    return ax


def print_halves(found: Halves, console: Console) -> None:
    """The sentences."""
    for sentence in halves_verdict(found):
        console.print(sentence, soft_wrap=True)


def write_halves(found: Halves, directory: Path, write_camera: Callable[[Path], object], made: Made) -> None:
    """cells.csv, cuts.csv, halves.png, report.html and summary.json; `write_camera` writes the camera beside them.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    cells, cuts, verdict = cell_table(found), cut_table(found), halves_verdict(found)
    title = f"{found.adjusted.block.title or 'block'}: halves"
    colour = "amber" if abs(found.band.factor - 1) > _SURE * found.band.sigma_factor else "green"
    alt = "maps over the format: the factor of the standard deviations, and the radius that holds 95 % of the errors"
    picture = WholePicture.of(halves_figure(found), alt)
    parts = (
        *(Paragraph(as_sentence(sentence)) for sentence in verdict[1:]),
        *assumed_pixels(found.adjusted.block.sensors),
        Heading("Over the format"),
        picture,
        Heading("Cuts"),
        rows_of(without_empty(cuts).rename(columns={"first": "first half"})),
        *made_section(made),
    )
    with whole_folder(directory) as work:
        cells.to_csv(work / "cells.csv", index=False)
        cuts.to_csv(work / "cuts.csv", index=False)
        write_camera(work)
        (work / "halves.png").write_bytes(picture.png)
        (work / "report.html").write_text(study_page(title, verdict[:1], parts, colour), encoding="utf-8")
        share, error = found.inside
        summary = {
            "title": found.adjusted.block.title,
            "verdict": verdict,
            "camera": found.camera,
            "by": found.by,
            "method": found.method,
            "factor": found.band.factor,
            "sigma_factor": found.band.sigma_factor,
            "inside": share if np.isfinite(share) else None,
            "sigma_inside": error if np.isfinite(error) else None,
            "n_cuts": len(found.cuts),
            "n_failed": len(found.failed),
            "versions": versions(),
        }
        write_summary(summary, work)
