"""A stability analysis as a table, a map of the offsets over the image, a page, and a screen of text."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.maps import outline
from jaxphoto.report.plots import axes_or_new, new_figure
from jaxphoto.report.results import write_summary
from jaxphoto.report.source_words import assumed_pixel_words
from jaxphoto.report.study_page import WholePicture, study_page
from jaxphoto.stability import ALIGNED, Analysis, Method
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The largest offset has the colour of the middle of the scale, or a little more.
_LIGHT = 1.7


class Compared(NamedTuple):
    """Which of the two sets is meant, for tables and pictures."""

    name: str
    interior: InteriorOrientation
    known: bool
    """Whether its covariance is known."""
    sensor: Sensor

    def __str__(self) -> str:
        model, how = type(self.interior.distortion).__name__, "with" if self.known else "WITHOUT"
        return f"{self.name}: {model}, c = {float(self.interior.c):.6g} mm, {how} covariance"


def stability_table(analyses: Mapping[Method, Analysis], pixel_mm: float, noise_mm: float) -> pd.DataFrame:
    """One row a method: method, unknowns, rmse_offset_mm, rmse_offset_px, rmse_measured_mm, largest_mm, similar, ...

    The uncertainty follows (sigma_mm to unexplained_mm, see `OffsetUncertainty`), empty where no covariance is known,
    then the alignment: rotations in degrees, positions as parts of the object's distance.
    """
    rows = []
    for method, one in analyses.items():
        v = one.offsets
        alignment = np.full(6, np.nan)
        alignment[: len(v.alignment)] = v.alignment
        row = {
            "method": method,
            "unknowns": len(v.alignment),
            "rmse_offset_mm": float(v.rmse_mm),
            "rmse_offset_px": float(v.rmse_mm) / pixel_mm,
            "rmse_measured_mm": float(v.rmse_measured_mm),
            "largest_mm": float(np.linalg.norm(v.offsets, axis=1).max()),
            "similar": one.similar(noise_mm),
        }
        row |= one.uncertainty._asdict() if one.uncertainty is not None else {}
        row |= dict(zip(("rx_deg", "ry_deg", "rz_deg"), np.rad2deg(alignment[:3]), strict=True))
        row |= dict(zip(("X_of_distance", "Y_of_distance", "Z_of_distance"), alignment[3:], strict=True))
        rows.append(row | {"converged": bool(v.converged)})
    return pd.DataFrame(rows)


def offsets_table(analysis: Analysis) -> pd.DataFrame:
    """x_mm, y_mm of the grid, dx_mm, dy_mm on the virtual image plane, and in the image as it is measured."""
    v = analysis.offsets
    columns = ["x_mm", "y_mm", "dx_mm", "dy_mm", "dx_measured_mm", "dy_measured_mm"]
    return pd.DataFrame(np.hstack([v.points, v.offsets, v.measured]), columns=columns)


def offsets_figure(analysis: Analysis, sensor: Sensor) -> Figure:
    """The map of RMSE_offset, as `plot_ray_offsets` draws it."""
    figure = new_figure(7.2, 5.4)
    plot_ray_offsets(analysis, sensor, figure.subplots())
    return figure


def plot_ray_offsets(analysis: Analysis, sensor: Sensor, ax: Axes | None = None) -> Axes:
    """Offsets of corresponding rays over the format of a camera (um): their size as colour, themselves as arrows."""
    ax = axes_or_new(ax)
    points, v = np.asarray(analysis.offsets.points), 1e3 * np.asarray(analysis.offsets.offsets)
    size = np.linalg.norm(v, axis=1)
    if size.max() > 0:
        # Light colours, on which dark arrows are seen.
        shown = ax.tricontourf(
            points[:, 0], points[:, 1], size, levels=12, cmap="YlGnBu", vmin=0.0, vmax=_LIGHT * size.max()
        )
        ax.figure.colorbar(shown, ax=ax, label="offset of corresponding rays [µm]", shrink=0.85)
    arrows = ax.quiver(*points.T, *v.T, angles="xy", color="0.15", width=0.0025)
    key = float(f"{max(size.mean(), 1e-12):.0e}")
    ax.quiverkey(arrows, 0.86, 1.03, key, f"{key:g} µm", labelpos="E")
    outline(ax, sensor)
    rmse = 1e3 * float(analysis.offsets.rmse_mm)
    ax.set_title(f"{analysis.method}: RMSE_offset {rmse:.3g} µm", loc="left", fontsize=10)
    return ax


def print_stability(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], pixel_mm: float, noise_mm: float,
    method: Method, console: Console,
) -> None:  # fmt: skip
    """Both sets, a column for each method in micrometres, and the verdict by `method`."""
    for line in about_sets(sets):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    table = Table(title=f"stability (um); noise {1e3 * noise_mm:.4g} um = {noise_mm / pixel_mm:.4g} px")
    table.add_column("", no_wrap=True)
    for name in analyses:
        table.add_column(name, justify="right", no_wrap=True)
    shown = [_shown(row) for row in stability_table(analyses, pixel_mm, noise_mm).to_dict("records")]
    # A method a column: with a row each, a screen of 80 characters would cut the numbers off.
    for measure in shown[0]:
        table.add_row(measure, *(of_method[measure] for of_method in shown))
    console.print(table)
    chosen = analyses[method]
    colour = "green" if chosen.similar(noise_mm) else "red"
    verdict = chosen.verdict(noise_mm)
    console.print(f"{method}: {verdict}", style=colour, highlight=False, markup=False, soft_wrap=True)


def _shown(row: Mapping[Hashable, Any]) -> dict[str, str]:
    """A row of `stability_table` in micrometres; what needs a covariance is empty without."""
    um = lambda name, digits: f"{1e3 * row[name]:.{digits}g}"  # noqa: E731
    found = {
        "RMSE_offset": um("rmse_offset_mm", 4),
        "in pixels": f"{row['rmse_offset_px']:.4g}",
        "as measured": um("rmse_measured_mm", 4),
        "largest": um("largest_mm", 4),
    }
    if "sigma_mm" not in row:
        return found | dict.fromkeys(("sigma", "95 %", "of one camera", "p"), "")
    return found | {
        "sigma": um("sigma_mm", 3),
        "95 %": f"{um('low_mm', 3)}-{um('high_mm', 3)}",
        "of one camera": um("expected_of_one_mm", 3),
        "p": f"{row['p_value']:.2g}",
    }


def write_stability(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], sensor: Sensor, noise_mm: float,
    method: Method, directory: Path, made: Made,
) -> None:  # fmt: skip
    """stability.csv, and of `method` offsets.csv and offsets.png; report.html and summary.json of it all.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    table = stability_table(analyses, sensor.pixel_mm, noise_mm)
    chosen = analyses[method]
    picture = WholePicture.of(offsets_figure(chosen, sensor), "offsets of the two bundles over the image")
    methods = "The bundles of rays are compared " + "; ".join(f"{ALIGNED[name]} ({name})" for name in analyses) + "."
    parts = [
        *map(Paragraph, about_sets(sets)),
        Heading("By method"),
        Paragraph(methods),
        rows_of(table),
        picture,
        *made_section(made),
    ]
    colour = "green" if chosen.similar(noise_mm) else "amber"
    # A terminal may not have the letter.
    said = [f"Bundles {ALIGNED[method]} ({method}): {chosen.verdict(noise_mm)}".replace(" um", " µm")]
    with whole_folder(directory) as work:
        table.to_csv(work / "stability.csv", index=False)
        offsets_table(chosen).to_csv(work / "offsets.csv", index=False)
        (work / "offsets.png").write_bytes(picture.png)
        page = study_page("Stability of interior orientation", said, parts, colour)
        (work / "report.html").write_text(page, encoding="utf-8")
        write_summary(stability_summary(analyses, sets, noise_mm, method) | {"versions": versions()}, work)


def stability_summary(
    analyses: Mapping[Method, Analysis], sets: tuple[Compared, Compared], noise_mm: float, method: Method
) -> dict[str, Any]:
    """The comparison in numbers."""
    chosen = analyses[method]
    return {
        "verdict": f"{method}: {chosen.verdict(noise_mm)}",
        "method": method,
        "similar": chosen.similar(noise_mm),
        "noise_mm": noise_mm,
        "rmse_offset_mm": {name: float(one.offsets.rmse_mm) for name, one in analyses.items()},
        "n_points": len(chosen.offsets.points),
        "covariance": {"A": sets[0].known, "B": sets[1].known},
    }


def about_sets(sets: tuple[Compared, Compared]) -> list[str]:
    """What both sets are, what the uncertainty is made of, and whose pixel was assumed."""
    assumed = assumed_pixel_words({one.name: one.sensor for one in sets})
    return [str(sets[0]), str(sets[1]), missing_covariances(sets), *([assumed] if assumed else [])]


def missing_covariances(sets: tuple[Compared, Compared]) -> str:
    """What the uncertainty is made of."""
    without = [one.name for one in sets if not one.known]
    if len(without) == 2:
        return "Neither set has a covariance: no uncertainty is given."
    if without:
        return f"{without[0]} has no covariance and is taken as exact: the uncertainty is that of the other set alone."
    return "Uncertainty by the covariances of both sets, which are taken to be of different images."
