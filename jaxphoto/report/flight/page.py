"""The page of a flight: the verdict, a list of contents, and a section for each thing that one asks of it."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from jinja2 import Environment

from jaxphoto.report.alike import with_alike
from jaxphoto.report.convergence import convergence_section
from jaxphoto.report.document import BlockInSpace, Element, Heading, Paragraph, Rows, verdict_paragraphs
from jaxphoto.report.document_html import contents, html_of
from jaxphoto.report.findings import Verdict, as_sentence
from jaxphoto.report.flight.camera import camera_section, interior_rows
from jaxphoto.report.flight.coverage import coverage_section, flight_words
from jaxphoto.report.flight.links import links_section
from jaxphoto.report.flight.oriented import orientation_section, weights_section
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.photographs import exterior_section, lost_section, photographs_section
from jaxphoto.report.flight.positions import in_order, offset_rows, offset_statistics, positions_section
from jaxphoto.report.flight.provenance import provenance_section
from jaxphoto.report.flight.residuals import residuals_section
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.flight.surveyed import surveyed_elements, surveyed_section
from jaxphoto.report.flight.time_line import time_section
from jaxphoto.report.interactive import library
from jaxphoto.report.object_points import points_section
from jaxphoto.report.orientation import orientation_sentences
from jaxphoto.report.page_head import page_head
from jaxphoto.report.positional_accuracy import class_sentences

_PAGE = """{{ head(title) }}<body>
<h1>{{ title }}</h1>
{% for e in verdict %}{{ e }}{% endfor %}
{{ contents }}
{% for e in elements %}{{ e }}
{% endfor %}
<h2 id="files">Files</h2>
<ul>{% for f in folders %}<li><a href="{{ f }}/report.html">{{ f }}/report.html</a>: all tables and pictures of the
adjustment{% if folders|length > 1 %} of part {{ loop.index }}{% endif %}</li>{% endfor %}
<li><a href="images.csv">images.csv</a>, <a href="summary.json">summary.json</a>: this page in numbers</li></ul>
{{ library }}</body></html>
"""


def flight_page(
    reports: list[PartReport],
    left_out: Mapping[str, str],
    spoilt: Mapping[str, str],
    verdict: Verdict,
    source: FlightSource,
    folders: list[str],
) -> str:
    """The page as HTML with its pictures inside; `folders` have the results of the parts.

    The largest part is told in full, the others in short.
    """
    elements = list(_elements(reports, left_out, spoilt, source))
    headings = [e.text for e in elements if isinstance(e, Heading)]
    body = [html_of(e) for e in elements]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            head=page_head,
            title=f"Flight report: {reports[0].part.adjusted.block.title}",
            verdict=[html_of(e) for e in verdict_paragraphs(verdict)],
            contents=contents([*headings, "Files"]),
            elements=body,
            library=library(body),
            folders=folders,
        )
    )


def _elements(
    reports: list[PartReport], left_out: Mapping[str, str], spoilt: Mapping[str, str], source: FlightSource
) -> Iterator[Element]:
    first, *others = reports
    yield from summary_section(reports, sum(len(r.images) for r in reports) + len(left_out) + len(spoilt))
    yield from lost_section(left_out, spoilt)
    yield Heading("Block")
    yield BlockInSpace(first.tables)
    yield from coverage_section(first)
    yield from positions_section(first, source.taken)
    yield from (Paragraph(as_sentence(s)) for s in source.positions_from)
    yield from surveyed_section(first)
    yield from camera_section(first, source)
    yield from residuals_section(first)
    yield from links_section(first)
    yield from points_section(first.tables, first.unit)
    yield from exterior_section(first)
    yield from time_section(first, source.taken)
    yield from weights_section(first)
    yield from orientation_section(first)
    yield from convergence_section(first.part.adjusted)
    for number, report in enumerate(others, 2):
        yield from _short(report, number, source)
    yield from photographs_section(reports)
    yield from provenance_section(source)


def summary_section(reports: list[PartReport], given: int) -> Iterator[Element]:
    """The numbers that one asks for first, of each part of the photographs that were `given`."""
    yield Heading("Summary")
    told = [_summary(r, given) for r in reports]
    rows = [(name, *(t.get(name, "") for t in told)) for name in dict.fromkeys(n for t in told for n in t)]
    columns = ("", *(f"part {k}" for k in range(1, len(reports) + 1))) if len(reports) > 1 else ("", "")
    yield Rows(columns, tuple(rows))


def _summary(report: PartReport, given: int) -> dict[str, str]:
    part, adjusted = report.part, report.part.adjusted
    ((camera, interior),) = adjusted.unknowns.interior.items()
    sensor, alike = adjusted.block.sensors[camera], part.oriented.report.alike
    v = np.asarray(adjusted.residuals.image) * np.asarray(adjusted.values.sigma_xy) / sensor.pixel_mm
    length = np.hypot(*v)
    sigmas = with_alike(report.tables.interior, adjusted, alike).set_index("parameter")["sigma_alike"]
    sigma = sigmas.get("c_mm", np.nan)
    told = {
        "photographs oriented": f"{len(adjusted.block.images)} of {given}",
        "image points": f"{len(length)}, of {len(adjusted.block.points)} object points",
        "residual of image points": f"{length.mean():.2f} px on average, rms {np.sqrt(np.mean(length**2)):.2f} px, "
        f"largest {length.max():.1f} px",
        "principal distance": f"{float(interior.c):.5g} mm = {float(interior.c) / sensor.pixel_mm:.2f} px"
        + (f" +- {sigma / sensor.pixel_mm:.2g} px" if np.isfinite(sigma) else ", held"),
        **flight_words(report.coverage, adjusted.block),
    }
    used = report.images[report.images["position"] == "used"]
    rms = [f"{float(np.sqrt((used[f'd{axis}_m'] ** 2).mean())):.3g}" for axis in "XYZ"] if len(used) else []
    told["positions"] = (
        f"{len(used)} used, rms of recorded minus adjusted {', '.join(rms)} m (X, Y, Z)" if rms else "none used"
    )
    state = part.controlled.state if part.controlled else ()
    told["surveyed points"] = f"{state.count('control')} control, {state.count('check')} check"
    # Horizontal and vertical; the three-dimensional follows from both.
    if classes := class_sentences(report.tables.tested_accuracy)[:2]:
        told["accuracy"] = " ".join(classes)
    return told


def _short(report: PartReport, number: int, source: FlightSource) -> Iterable[Element]:
    """A smaller part: findings, camera, offsets, surveyed points, and how it was oriented."""
    part = report.part
    yield Heading(f"Part {number}")
    yield from verdict_paragraphs(report.verdict)
    yield interior_rows(report, source.start)
    yield from (Paragraph(as_sentence(s)) for s in part.lens)
    used = report.images[report.images["position"] == "used"]
    if len(used):
        yield offset_rows(offset_statistics(in_order(used, source.taken)[0]))
    if part.controlled:
        yield from surveyed_elements(part.controlled, report.tables)
    said = [*orientation_sentences(part.oriented.report), *(part.placed.sentences if part.placed else ())]
    yield from (Paragraph(as_sentence(s)) for s in said)
