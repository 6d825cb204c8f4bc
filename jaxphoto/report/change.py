"""Two calibrations of a camera compared: tables, maps, a page and words in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from jaxphoto.camera import Sensor
from jaxphoto.report.digits import of_p, of_sigma, with_sigma
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.findings import as_sentence, p_words
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.maps import draw_format_map
from jaxphoto.report.plots import axes_or_new, new_figure
from jaxphoto.report.results import write_summary
from jaxphoto.report.stability import Compared, about_sets
from jaxphoto.report.study_page import WholePicture, study_page
from jaxphoto.stability import ALIGNED, LEVEL, Change
from jaxphoto.stability.comparison import change_meaning
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def parameter_changes(found: Change) -> pd.DataFrame:
    """parameter, first, second, difference (second minus first), sigma (of it), ratio, p_value, unit; none of two
    models."""
    columns = ["parameter", "first", "second", "difference", "sigma", "p_value", "unit"]
    table = pd.DataFrame(found.parameters, columns=columns)
    known = table["sigma"] > 0
    table.insert(5, "ratio", table["difference"].where(known) / table["sigma"].where(known))
    return table


def change_cells(found: Change, sensor: Sensor) -> pd.DataFrame:
    """A row each point of the format: x_mm, y_mm; dx_px, dy_px (first minus second bundle, aligned, in the measured
    image), offset_px (its length), limit_px (95 % of two calibrations of one camera), beyond.
    """
    v = found.field.offsets
    columns = ["x_mm", "y_mm", "dx_px", "dy_px"]
    table = pd.DataFrame(np.hstack([v.points, np.asarray(v.measured) / sensor.pixel_mm]), columns=columns)
    return table.assign(
        offset_px=found.offset_mm / sensor.pixel_mm, limit_px=found.limit_mm / sensor.pixel_mm, beyond=found.beyond
    )


def change_verdict(found: Change, sensor: Sensor) -> list[str]:
    """What the tests say, in sentences."""
    said = []
    if found.degrees_of_freedom:
        said.append(
            f"by its parameters: chi-square {found.chi_square:.1f} of {found.degrees_of_freedom}, "
            f"{p_words(found.p_parameters, 2)}: {change_meaning(found.p_parameters)}"
        )
    elif not found.parameters:
        said.append("the calibrations are of different models, so their parameters are not compared")
    held = [one.parameter for one in found.parameters if one.sigma == 0 and one.difference != 0]
    if held:
        said.append(f"held at different values, and in no test of parameters: {', '.join(held)}")
    known = found.field.uncertainty
    rmse = float(found.field.offsets.rmse_measured_mm) / sensor.pixel_mm
    if known is not None:
        said.append(
            f"by its bundle of rays, {ALIGNED[found.field.method]}: {rmse:.3g} px root mean square over the format, "
            f"{p_words(known.p_value, 2)}: {change_meaning(known.p_value)}"
        )
    worst = int(np.argmax(found.offset_mm / found.limit_mm))
    x, y = np.asarray(found.field.offsets.points)[worst]
    n = len(found.limit_mm)
    said.append(
        f"at {found.beyond.sum()} of {n} points the offset is beyond what {100 * LEVEL:.0f} % of calibrations of one "
        f"camera stay below ({(1 - LEVEL) * n:.0f} would be usual); farthest at x {x:.3g}, y {y:.3g} mm: "
        f"{found.offset_mm[worst] / sensor.pixel_mm:.3g} px, where {found.limit_mm[worst] / sensor.pixel_mm:.3g} px is "
        "the limit"
    )
    return said


def change_headline(found: Change) -> str:
    """What both tests come to: a camera that one of them says has changed has, whatever the other says."""
    return change_meaning(float(np.nanmin([found.p_parameters, found.p_field])))


def change_figure(found: Change, sensor: Sensor) -> Figure:
    """Both maps of `plot_change`, one beside the other."""
    figure = new_figure(9.6, 3.9)
    for axes, usual in zip(figure.subplots(1, 2), (False, True), strict=True):
        plot_change(found, sensor, axes, over_usual=usual)
    return figure


def plot_change(found: Change, sensor: Sensor, ax: Axes | None = None, *, over_usual: bool = False) -> Axes:
    """Offsets of the rays of two calibrations over the format (px), or those over what is usual of one camera."""
    ax = axes_or_new(ax)
    name = f"offset over what {100 * LEVEL:.0f} % stay below" if over_usual else "offset [px]"
    values = found.offset_mm / (found.limit_mm if over_usual else sensor.pixel_mm)
    draw_format_map(ax, sensor, np.asarray(found.field.offsets.points), name, values)
    return ax


def print_change(found: Change, sets: tuple[Compared, Compared], sensor: Sensor, console: Console) -> None:
    """Both calibrations, the table of parameters and the sentences."""
    for line in about_sets(sets):
        console.print(line, soft_wrap=True)
    if found.parameters:
        table = Table("parameter", "A", "B", "B - A", "sigma", "unit", "p")
        for one in found.parameters:
            if one.sigma > 0 or one.first or one.second:
                p = of_p(one.p_value) if one.sigma > 0 else "held"
                values = (with_sigma(v, one.sigma) for v in (one.first, one.second, one.difference))
                table.add_row(one.parameter, *values, of_sigma(one.sigma), one.unit, p)
        console.print(table)
    for sentence in change_verdict(found, sensor):
        console.print(sentence, soft_wrap=True)


def write_change(found: Change, sets: tuple[Compared, Compared], sensor: Sensor, directory: Path, made: Made) -> None:
    """parameters.csv, cells.csv, change.png, report.html and summary.json.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    parameters, verdict = parameter_changes(found), change_verdict(found, sensor)
    alt = "maps over the format of the camera: offsets of rays (px), and offsets over what is usual"
    picture = WholePicture.of(change_figure(found, sensor), alt)
    parts = [
        *(Paragraph(as_sentence(sentence)) for sentence in verdict),
        *map(Paragraph, about_sets(sets)),
        Heading("Over the format"),
        picture,
        Heading("Parameters"),
        rows_of(parameters),
        *made_section(made),
    ]
    with whole_folder(directory) as work:
        parameters.to_csv(work / "parameters.csv", index=False)
        change_cells(found, sensor).to_csv(work / "cells.csv", index=False)
        (work / "change.png").write_bytes(picture.png)
        page = study_page("Change of a camera", [change_headline(found)], parts, "amber" if found.changed else "green")
        (work / "report.html").write_text(page, encoding="utf-8")
        write_summary(change_summary(found, sensor) | {"versions": versions()}, work)


def change_summary(found: Change, sensor: Sensor) -> dict[str, Any]:
    """The comparison in numbers."""
    known = found.field.uncertainty
    return {
        "verdict": change_verdict(found, sensor),
        "method": found.field.method,
        "chi_square": found.chi_square if found.degrees_of_freedom else None,
        "degrees_of_freedom": found.degrees_of_freedom,
        "p_parameters": found.p_parameters if found.degrees_of_freedom else None,
        "p_field": None if known is None else known.p_value,
        "n_beyond": int(found.beyond.sum()),
        "n_points": len(found.limit_mm),
    }
