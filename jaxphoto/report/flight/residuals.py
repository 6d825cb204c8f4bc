"""Residuals of image points: by photograph, over the format, and by group of observations."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.findings import p_words
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.positions import name_ends
from jaxphoto.report.plots import draw_density, draw_mean_residuals, drawn
from jaxphoto.report.residual_findings import MOST_OF_IT
from jaxphoto.report.residual_plots import draw_residuals_by_radius
from jaxphoto.report.residual_table import in_file_unit
from jaxphoto.statistics import LEVEL, residual_spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NAMED = 3


def residuals_section(report: PartReport) -> Iterator[Element]:
    """By group of observations, by photograph, and what all photographs have in common over the format."""
    yield Heading("Residuals")
    yield _spread(report)
    table = report.images.sort_values("rms_px", ascending=False)
    worst = ", ".join(f"{n} {v:.2f} px" for n, v in zip(table["image"][:_NAMED], table["rms_px"][:_NAMED], strict=True))
    yield Paragraph(f"Of photographs the median is {table['rms_px'].median():.2f} px an axis; largest: {worst}.")
    (camera,) = report.part.adjusted.unknowns.interior
    yield Pictures(
        (
            DocumentPicture(partial(draw_by_photograph, report=report), f"Residuals by photograph; largest {worst}"),
            DocumentPicture(
                lambda axes: draw_density(axes, report.tables, camera), "Number of image points over the format"
            ),
            DocumentPicture(
                lambda axes: draw_mean_residuals(axes, report.tables, camera),
                "Arrows of mean residuals over the format: what all photographs have in common",
                3.8,
            ),
            DocumentPicture(
                lambda axes: draw_residuals_by_radius(axes, report.tables, camera),
                "Mean radial and tangential residuals by distance from the principal point",
            ),
        )
    )
    yield Paragraph(pattern_sentence(report, camera))


def pattern_sentence(report: PartReport, camera: str) -> str:
    """What the test says of the mean field: noise, or a pattern that the camera model lacks."""
    found = [
        t for t in report.tables.tested_trends if t.pattern.camera == camera and "over the format" in t.pattern.what
    ]
    if not found:
        return "No test of a pattern over the format: the adjustment did not converge."
    (trend,) = found
    pixel = report.part.adjusted.block.sensors[camera].pixel_mm
    size = f"{trend.size / pixel:.2g} px ({trend.size / trend.sigma:.2g} of the sigma of an image point)"
    if trend.p_value >= LEVEL:
        return f"The mean field is noise: the test for a pattern over the format has {p_words(trend.p_value, 2)}."
    most = next((h for h in trend.hints[:1] if h.share > MOST_OF_IT), None)
    hint = f", {100 * most.share:.0f} % of it {most.term.name}" if most else ", and no single usual term is most of it"
    return (
        f"The mean field is no noise ({p_words(trend.p_value)}, {trend.freedom} degrees of freedom): the camera model "
        f"lacks {size}{hint}. Neighbouring rays that err alike make p too small; the size in pixels says whether it "
        "matters."
    )


def _spread(report: PartReport) -> Rows:
    """Number, mean, root mean square and largest value by group and axis; of images in pixels."""
    (sensor,) = report.part.adjusted.block.sensors.values()
    rows = []
    for s in residual_spread(report.part.adjusted):
        factor, unit = (1 / sensor.pixel_mm, "px") if s.unit == "mm" else in_file_unit(s.unit)
        # What free unknowns take up is zero but for rounding.
        mean = s.mean if abs(s.mean) > 1e-6 * s.rmse else 0.0
        values = (f"{factor * v:.3g} {unit}" for v in (mean, s.rmse, s.max_abs))
        rows.append((s.group.replace("_", " "), s.axis, str(s.n), *values))
    return Rows(("residuals of", "axis", "n", "mean", "rms", "largest"), tuple(rows))


def draw_by_photograph(axes: Axes, report: PartReport) -> None:
    """Bars of the root mean square of each photograph; the largest are named."""
    rms = report.images["rms_px"].to_numpy(float)
    axes.bar(np.arange(len(rms)), rms, color="0.5")
    for k in np.argsort(-rms)[:_NAMED]:
        axes.annotate(drawn(report.images["image"].iloc[k]), (k, rms[k]), fontsize=6, ha="center", va="bottom")
    axes.set(ylabel="rms residual [px]")
    name_ends(axes, report.images["image"])
    axes.set_title("residuals by photograph", loc="left", fontsize=9)
