"""The HTML report: one file that opens offline, judgement first, then tables and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.errors import camera_words
from jaxphoto.report.certificate_figures import draw_band, draw_curve
from jaxphoto.report.check_points import check_spread
from jaxphoto.report.convergence import convergence_section
from jaxphoto.report.correlation_tables import side_by_side
from jaxphoto.report.document import (
    BlockInSpace,
    DocumentPicture,
    Heading,
    Paragraph,
    Pictures,
    rows_of,
    verdict_paragraphs,
)
from jaxphoto.report.document_html import contents, html_of
from jaxphoto.report.error_ellipses import ellipses_figure
from jaxphoto.report.figures import curve_of
from jaxphoto.report.findings import Verdict, as_sentence
from jaxphoto.report.interactive import library
from jaxphoto.report.made import PROVENANCE, Made, made_section
from jaxphoto.report.maps import png_of
from jaxphoto.report.object_points import points_section
from jaxphoto.report.page_head import page_head
from jaxphoto.report.plots import (
    check_points_figure,
    correlation_figure,
    mean_residuals_figure,
    residuals_figure,
)
from jaxphoto.report.positional_accuracy import accuracy_sentences
from jaxphoto.report.recovery import recovery_spread
from jaxphoto.report.residual_plots import draw_residuals_by_radius, draw_station_residuals
from jaxphoto.report.sigma_map import sigma_map_figure, sigma_map_words
from jaxphoto.report.source_words import assumed_pixel_words, assumed_pixels, report_title
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import LEAST_CHECKED
from jaxphoto.statistics.block_geometry import format_coverage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = """{{ head(title) }}<body>
<h1>{{ title }}</h1>
{% for e in verdict %}{{ e }}{% endfor %}
<p>{{ outcome }} ({{ steps }} iterations)</p>
<p>&sigma;<sub>0</sub> = <b>{{ sigma0 }}</b>, redundancy {{ redundancy }}: {{ counts }}.
Standard deviations are a posteriori (times &sigma;<sub>0</sub>). Correlations refer to the rotations
{{ rotations }}.</p>
{{ contents }}
{% for heading, body in sections %}{{ heading }}
{{ body }}
{% endfor %}{{ library }}</body></html>
"""
_SIGMA_MAP = (
    "Standard deviation of where the calibrated camera says that a point is seen, interior and exterior orientation "
    "taken together, in the direction in which it is largest (sigma_map.csv). Of a direction the whole error of the "
    "principal distance counts; of a point as far away as those that were seen, only what its distance does not make "
    "good."
)
_DISTORTION = (
    "Measured minus ideal image coordinates along the radius, for the c that was found; the band of 95 % is of the "
    "covariance of all parameters."
)
_RECOVERY = (
    "Estimate minus truth in standard deviations (recovery.csv): about 1 in the root mean square, and 5 % beyond 2, "
    "where the model of the adjustment is that of the simulation."
)
_LARGEST_RHO = (
    "The largest correlation over the images, without its sign; the means are in the picture of the interior "
    "orientation, and both in correlation_summary.csv."
)
_LARGEST = 20
# Cameras of which there are pictures: seven each, a second of work and more.
_PICTURED = 6


def report_page(tables: Tables, verdict: Verdict, made: Made | None = None) -> str:
    """The whole report as HTML: pictures, and what makes them and the tables answer, inside."""
    a = tables.adjusted
    counts = [f"{n} observations of {group.replace('_', ' ')}" for group, n in a.n_observations.items() if n]
    counts += [f"{a.n_constraints} constraints of the datum"] if a.n_constraints else []
    sections = [(heading, Markup("\n").join(body)) for heading, body in _sections(tables)]
    if made:
        _, *body = made_section(made)
        if a.block.converted_from:
            said = f"The block was converted from {a.block.converted_from}. {assumed_pixel_words(a.block.sensors)}"
            body.append(Paragraph(said.strip()))
        sections.append((PROVENANCE, Markup("\n").join(map(html_of, body))))
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            head=page_head,
            title=report_title(a.block),
            outcome=as_sentence(a.outcome.value).removesuffix("."),
            steps=int(a.steps),
            sigma0=f"{float(a.sigma0):.6g}",
            redundancy=a.redundancy,
            counts=", ".join(counts) + f"; {sum(a.n_unknowns.values())} unknowns",
            rotations=tables.rotations.replace("_", ", "),
            verdict=[html_of(e) for e in verdict_paragraphs(verdict)],
            contents=contents([heading for heading, body in sections]),
            sections=[(html_of(Heading(heading)), body) for heading, body in sections],
            library=library([body for _, body in sections]),
        )
    )


def _sections(tables: Tables) -> Iterator[tuple[str, list[Markup]]]:
    """Headings with what is below them, of what there is."""
    check, pictured = tables.check_points, pictured_cameras(tables)
    yield "Interior orientation", _interior(tables, pictured)
    if mapped := [camera for camera in tables.sigma_maps if camera in pictured]:
        curves = (html_of(_distortion(tables, camera)) for camera in mapped)
        yield "Distortion", [_said(_DISTORTION), *curves]
        yield "How sure the camera is, over its format", [_said(_SIGMA_MAP), *_sigma_maps(tables, mapped)]
    if tables.truth:
        interior = tables.recovery[tables.recovery["parameter"].str.startswith("interior[")]
        yield (
            "Beside the truth of the simulation",
            [_said(_RECOVERY), _html(recovery_spread(tables.recovery)), _html(interior)],
        )
    if len(tables.georeferencing):
        yield "Mounts and strips", [_html(tables.georeferencing)]
    yield "Block", [html_of(BlockInSpace(tables))]
    yield "Residuals", _residuals(tables, pictured)
    _, *points = points_section(tables)
    yield "Object points", [html_of(element) for element in points]
    if len(check):
        accuracy = [_said(s) for s in accuracy_sentences(tables.tested_accuracy)]
        picture = _wide(_picture(check_points_figure({"": tables}), "discrepancies at check points"))
        body = [_html(check_spread(check)), *accuracy, _html(tables.positional_accuracy), picture, _html(check)]
        yield "Check points: surveyed minus computed", body
    ellipses = _picture(ellipses_figure(tables), "error ellipses of the projection centres in plan")
    yield "Exterior orientation", [ellipses, _html(tables.exterior)]
    # What is held moves with nothing.
    if len(summary := tables.correlation_summary):
        largest = side_by_side(summary, ["camera", "exterior"], "interior", "max_abs_rho")
        yield "Correlation of exterior and interior orientation over the images", [_said(_LARGEST_RHO), _html(largest)]
    ground = tables.correlation_ground
    if len(ground := ground[ground["sigma_m"] > 0]):
        ground = ground.assign(ground=ground["ground"].str.replace("_", " "))
        ground = side_by_side(ground, ["camera", "ground", "sigma_m"], "parameter", "rho")
        yield "Correlation of the interior orientation and the ground as a whole", [_html(ground)]
    if steps := list(convergence_section(tables.adjusted))[1:]:
        yield "Convergence", [html_of(element) for element in steps]


def pictured_cameras(tables: Tables) -> list[str]:
    """The cameras that pictures are of: all, or of many those with the most image points."""
    block, structure = tables.adjusted.block, tables.adjusted.structure
    cameras, of_image = list(tables.adjusted.unknowns.interior), np.array(block.image_camera)
    seen = np.bincount(structure.image, minlength=len(of_image))
    most = sorted(cameras, key=lambda camera: -int(seen[of_image == camera].sum()))[:_PICTURED]
    return [camera for camera in cameras if camera in most]


def _interior(tables: Tables, pictured: list[str]) -> list[Markup]:
    table = tables.interior
    alt = "correlations of the interior orientation with itself and with the exterior one"
    used = [c for c, corr in tables.correlations.items() if c in pictured and corr.parameters and corr.images]
    pictures = [_wide(_picture(correlation_figure(tables, c), alt)) for c in used]
    reach = [_said(_reach(tables, camera)) for camera in pictured]
    if (n := len(tables.adjusted.unknowns.interior)) > len(pictured):
        reach.append(
            _said(
                f"Pictures are of {len(pictured)} of {n} cameras, those with the most image points: "
                f"{', '.join(pictured)}. Tables have all; in Python plot_residuals and others draw any of them."
            )
        )
    assumed = map(html_of, assumed_pixels(tables.adjusted.block.sensors))
    return [_html(table[table["sigma"].notna() | (table["value"] != 0)]), *assumed, *reach, *pictures]


def _distortion(tables: Tables, camera: str) -> Pictures:
    curve, of = curve_of(tables, camera), f"of {camera_words(camera)} by distance"
    whole = DocumentPicture(partial(draw_curve, curve=curve, factor=1.0), f"distortion {of}")
    return Pictures((whole, DocumentPicture(partial(draw_band, curve=curve), f"half the width of its band {of}")))


def _reach(tables: Tables, camera: str) -> str:
    found = format_coverage(tables.adjusted, camera)
    if not len(found.images):
        return f"No image point is of {camera_words(camera)}."
    part = 100 * found.images
    return (
        f"Image points of {camera_words(camera)} reach {100 * found.whole:.0f} % of its format, those of an image "
        f"{np.median(part):.0f} % (median; {part.min():.0f} % at least): beyond, the distortion is an extrapolation."
    )


def _sigma_maps(tables: Tables, mapped: list[str]) -> Iterator[Markup]:
    for camera in mapped:
        words = sigma_map_words(tables.adjusted.block.sensors[camera], tables.sigma_maps[camera])
        yield _said(as_sentence(words))
        yield _wide(_picture(sigma_map_figure(tables, camera), words))


def _residuals(tables: Tables, pictured: list[str]) -> list[Markup]:
    figures = [
        _picture(figure(tables, c), f"{what} of {camera_words(c)} over its format")
        for c in pictured
        for figure, what in ((residuals_figure, "image residuals"), (mean_residuals_figure, "mean image residuals"))
    ]
    panels = [
        DocumentPicture(
            partial(draw_residuals_by_radius, tables=tables, camera=c), f"residuals of {camera_words(c)} by distance"
        )
        for c in pictured
        if c in tables.sigma_maps
    ]
    if len(tables.adjusted.block.stations.who):
        panels.append(DocumentPicture(partial(draw_station_residuals, tables=tables), "residuals of stations by time"))
    checked = tables.residuals["redundancy_number"] > LEAST_CHECKED
    largest = tables.residuals.loc[tables.residuals["w"].abs()[checked].nlargest(_LARGEST).index]
    title = Markup("<h3>{}</h3>").format
    trends = [title("Patterns: what the images have in common, and time and strips"), _html(tables.trends)]
    return [
        _html(tables.residual_spread),
        *figures,
        *([html_of(Pictures(tuple(panels)))] if panels else []),
        *(trends if len(tables.trends) else []),
        title("Largest normalised residuals"),
        _html(largest),
    ]


def _html(table: pd.DataFrame) -> Markup:
    return html_of(rows_of(table))


def _said(text: str) -> Markup:
    return html_of(Paragraph(text))


def _picture(figure: Figure, alt: str) -> Markup:
    return Markup('<img alt="{}" src="{}">').format(alt, png_of(figure)[1])


def _wide(picture: Markup) -> Markup:
    return Markup('<div class="wide">{}</div>').format(picture)
