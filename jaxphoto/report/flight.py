"""What came of a flight: photographs used and lost, positions against the network, and the calibration of each part."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.procedures.flight import CalibratedFlight, FlightPart
from jaxphoto.report.alike import with_alike
from jaxphoto.report.control import control_findings, control_summary, surveyed_points, write_control
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.flight_coverage import coverage_figure, flight_words
from jaxphoto.report.lens import lens_findings
from jaxphoto.report.maps import png_of
from jaxphoto.report.orientation import ALIKE, orientation_sentences, write_orientation
from jaxphoto.report.page import STYLE
from jaxphoto.report.plots import drawn, new_figure
from jaxphoto.report.results import versions, write_results, write_summary
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.report.weights import component_findings, component_tables
from jaxphoto.statistics.coverage import Coverage, coverage
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{{ title }}</title><style>{{ style }}</style></head><body>
<h1>{{ title }}</h1>
<p class="verdict {{ verdict.colour }}"><b>{{ verdict.headline }}</b></p>
{% for f in verdict.findings %}<p class="{{ f.level.name.lower() }}">{{ f.text }}</p>{% endfor %}
<h2>Parts</h2>{{ parts }}
{% for p in each %}
<h2>{{ p.title }}</h2>
<p><a href="{{ p.folder }}/report.html">All tables and pictures of its adjustment</a></p>
<h3>Interior orientation</h3>{{ p.interior }}
{% if p.alike %}<p>{{ p.alike }}</p>{% endif %}
{% if p.lens %}<h3>What was known of the lens</h3><ul>{% for s in p.lens %}<li>{{ s }}</li>{% endfor %}</ul>{% endif %}
{% if p.control %}<h3>Control</h3>{{ p.control }}<ul>{% for s in p.said %}<li>{{ s }}</li>{% endfor %}</ul>{% endif %}
<h3>The ground</h3>{% if p.overlap %}<img alt="map of how many photographs see each place of the ground, and number of
points by number of rays" src="{{ p.overlap }}">{% endif %}
<ul>{% for what, words in p.ground.items() %}<li>{{ what }}: {{ words }}</li>{% endfor %}</ul>
<h3>How it was oriented</h3><ul>{% for s in p.sentences %}<li>{{ s }}</li>{% endfor %}</ul>
<h3>Photographs</h3>{% if p.picture %}<img alt="recorded positions minus those of the adjustment, in plan and in height,
and residuals by photograph" src="{{ p.picture }}">{% endif %}{{ p.images }}
{% endfor %}
{% if positions_from %}<h2>Where positions come from</h2>
<ul>{% for s in positions_from %}<li>{{ s }}</li>{% endfor %}</ul>{% endif %}
{% if lost %}<h2>Photographs that are not used</h2>
<ul>{% for s in lost %}<li>{{ s }}</li>{% endfor %}</ul>{% endif %}
</body></html>
"""


class PartReport(NamedTuple):
    """A part, its tables and what is to be said of it."""

    part: FlightPart
    tables: Tables
    verdict: Verdict
    images: pd.DataFrame
    """image, oriented, n_image_points, rms_px, dX_m to dZ_m (recorded minus adjusted position), position (used, left
    out, none)."""
    coverage: Coverage | None
    """None where the block has no metres."""
    """What the photographs show of the ground; in the block's own scale where it has no positions."""


def report_of(part: FlightPart) -> PartReport:
    """Judge a part: what its adjustment says, its weights, its positions, and how far its rays are independent."""
    tables = Tables(part.adjusted)
    found = [*verdict_of(tables).findings, *(component_findings(part.components) if part.components else [])]
    judged = Verdict.of([*found, *lens_findings(tables), *_findings(part)])
    metric = part.placed or part.controlled
    return PartReport(part, tables, judged, _images(part), coverage(part.adjusted) if metric else None)


def _findings(part: FlightPart) -> Iterator[Finding]:
    report = part.oriented.report
    if not report.converged:
        yield Finding(Level.ALARM, "the orientation of the photographs did not settle: see how it was oriented")
    if part.why_still:
        yield Finding(Level.WARNING, part.why_still)
    if part.no_control:
        yield Finding(Level.ALARM, f"the control is not used: {part.no_control}")
    if part.controlled:
        yield from control_findings(part.controlled)
    if part.why_not and not part.controlled:
        yield Finding(Level.WARNING, f"the block has a frame and a scale of its own: {part.why_not}")
    if part.placed and not part.placed.used.all():
        n = int((~part.placed.used).sum())
        yield Finding(Level.WARNING, f"{n} of {len(part.placed.used)} recorded positions contradict the others")
    if report.alike > ALIKE:
        text = (
            f"neighbouring rays err alike: multiply the standard deviations of the camera by {report.alike:.2g}; "
            "jaxphoto halves on the block tells it better"
        )
        yield Finding(Level.WARNING, text)


def _position_sentences(part: FlightPart) -> tuple[str, ...]:
    return part.placed.sentences if part.placed else (f"positions: {part.why_not}",)


def _images(part: FlightPart) -> pd.DataFrame:
    a = part.adjusted
    block, n = a.block, len(a.block.images)
    pixel = np.array([block.sensors[c].pixel_mm for c in block.image_camera])
    v = np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy)
    count = np.bincount(a.structure.image, minlength=n)
    square = np.bincount(a.structure.image, (v**2).sum(axis=0), minlength=n)
    off, position = np.full((n, 3), np.nan), np.full(n, "none", object)
    if part.placed:
        at = [block.images.index(name) for name in part.placed.images]
        start = np.asarray(part.placed.block.start.unknowns.exterior.position)[at]
        off[at] = part.placed.offsets_m + start - np.asarray(a.unknowns.exterior.position)[at]
        position[at] = np.where(part.placed.used, "used", "left out")
    rms = np.sqrt(square / np.maximum(2 * count, 1)) / pixel
    columns = {"image": block.images, "n_image_points": count, "rms_px": rms}
    columns |= {f"d{axis}_m": off[:, k] for k, axis in enumerate("XYZ")}
    return pd.DataFrame(columns | {"position": position})


def positions_figure(report: PartReport) -> Figure:
    """Recorded minus adjusted positions as arrows in plan and bars in height, and residuals, by photograph."""
    table, station = report.images, np.asarray(report.part.adjusted.unknowns.exterior.position)
    d = table[["dX_m", "dY_m", "dZ_m"]].to_numpy()
    has = np.isfinite(d).all(axis=1)
    used = has & (table["position"] == "used").to_numpy()
    figure = new_figure(9.6, 7.0)
    panels = figure.subplot_mosaic([["plan", "height"], ["plan", "residual"]])
    plan, height, residual = (panels[name] for name in ("plan", "height", "residual"))
    plan.plot(station[:, 0], station[:, 1], "+", color="0.4", ms=6)
    if has.any():
        size = float(f"{max(np.median(np.hypot(*d[has, :2].T)), 1e-3):.0e}")
        wide = max(np.ptp(station[:, :2], axis=0).max(), 1e-9)
        for rows, colour, label in ((used, "tab:blue", "used"), (has & ~used, "tab:red", "left out")):
            if rows.any():
                arrows = plan.quiver(
                    *station[rows, :2].T, *d[rows, :2].T, angles="xy", scale_units="xy", scale=15 * size / wide,
                    color=colour, width=0.004, label=label,
                )  # fmt: skip
        plan.quiverkey(arrows, 0.08, 0.04, size, f"{size:g} m", labelpos="E")
        plan.legend(fontsize=8)
    plan.set(xlabel="X [m]", ylabel="Y [m]")
    plan.set_title("recorded minus adjusted", loc="left", fontsize=10)
    plan.set_aspect("equal", adjustable="datalim")
    number = np.arange(len(table))
    height.bar(number[has], d[has, 2], color=np.where(used[has], "tab:blue", "tab:red"))
    height.set(ylabel="dZ [m]")
    height.set_title("in height, by photograph", loc="left", fontsize=10)
    residual.bar(number, table["rms_px"], color="0.5")
    names = [drawn(n) for n in table["image"].iloc[[0, -1]]]
    residual.set_xticks([0, len(table) - 1], names, fontsize=8)
    residual.set(ylabel="RMS residual [px]")
    return figure


def flight_verdict(flight: CalibratedFlight, reports: list[PartReport], spoilt: Mapping[str, str]) -> Verdict:
    """That of the largest part, and what there is besides it."""
    lost = len(flight.left_out) + len(spoilt)
    n = sum(len(r.part.oriented.block.images) for r in reports)
    found = list(reports[0].verdict.findings)
    if len(reports) > 1:
        sizes = ", ".join(str(len(r.part.oriented.block.images)) for r in reports)
        text = f"nothing joins the photographs to one block: {len(reports)} parts of {sizes}; judged is the largest"
        found.append(Finding(Level.WARNING, text))
    if lost:
        text = f"{lost} of {n + lost} photographs are not used: see the end of the page"
        found.append(Finding(Level.WARNING, text))
    return Verdict.of(found)


def part_folder(number: int) -> str:
    """Where the results of a part are, the largest being number 1."""
    return "result" if number == 1 else f"result_{number}"


def block_folder(number: int) -> str:
    """Where its block is."""
    return "block" if number == 1 else f"block_{number}"


def write_flight(
    flight: CalibratedFlight,
    reports: list[PartReport],
    spoilt: Mapping[str, str],
    work: Path,
    positions_from: Sequence[str] = (),
    told: Mapping[str, Any] = MappingProxyType({}),
    beside: Callable[[FlightPart, Path], None] = lambda part, folder: None,
) -> Verdict:
    """report.html, summary.json and images.csv, and a result folder for every part, into the folder `work`.

    `positions_from` says where positions come from. What is `told` of how the results came about goes into the
    summaries, and `beside` writes more into result folders.
    """
    verdict = flight_verdict(flight, reports, spoilt)
    for number, r in enumerate(reports, 1):
        times = {name: r.part.adjusted.seconds[name] for name in ("compile", "solve", "covariance")}
        with whole_folder(work / part_folder(number)) as folder:
            alike = r.part.oriented.report.alike
            own = {
                "sigma_factor": alike if alike > ALIKE else 1.0,
                "flight": flight_words(r.coverage, r.part.adjusted.block),
            }
            write_results(r.tables, r.verdict, folder, times, {**told, **own})
            with_alike(r.tables.interior, r.part.adjusted, alike).to_csv(folder / "interior_alike.csv", index=False)
            if r.part.controlled:
                write_control(r.part.controlled, folder)
            beside(r.part, folder)
            for name, table in (component_tables(r.part.components) if r.part.components else {}).items():
                table.to_csv(folder / f"{name}.csv", index=False)
    images = pd.concat([r.images.assign(part=k) for k, r in enumerate(reports, 1)], ignore_index=True)
    images.to_csv(work / "images.csv", index=False)
    (work / "report.html").write_text(_page(flight, reports, spoilt, verdict, positions_from), encoding="utf-8")
    summary = {
        **verdict.summary,
        "parts": [_summary(r, number) for number, r in enumerate(reports, 1)],
        "positions_from": list(positions_from),
        "not_used": {**spoilt, **flight.left_out},
        "versions": versions(),
    }
    write_summary(summary | dict(told), work)
    return verdict


def write_part_orientation(part: FlightPart, folder: Path) -> None:
    """What `jaxphoto orient` writes beside a block."""
    write_orientation(part.oriented, folder, n_gross=part.matched.n_gross, sigma_factor=part.matched.sigma_factor)


def _summary(r: PartReport, number: int) -> dict:
    report, placed = r.part.oriented.report, r.part.placed
    return {
        "verdict": r.verdict.colour,
        "block": block_folder(number),
        "result": part_folder(number),
        "n_images": len(r.part.adjusted.block.images),
        "n_image_points": report.n_image_points,
        "n_points": report.n_points,
        "mean_px": report.mean_px,
        "alike": report.alike,
        "epsg": r.part.adjusted.block.frame.code,
        "positions_used": int(placed.used.sum()) if placed else 0,
        "positions_left_out": [n for n, u in zip(placed.images, placed.used, strict=True) if not u] if placed else [],
        "sigma0": float(r.part.adjusted.sigma0),
        "control": control_summary(r.part.controlled) if r.part.controlled else None,
    }


def _page(
    flight: CalibratedFlight,
    reports: list[PartReport],
    spoilt: Mapping[str, str],
    verdict: Verdict,
    positions_from: Sequence[str],
) -> str:
    each = []
    for number, r in enumerate(reports, 1):
        report = r.part.oriented.report
        interior = with_alike(r.tables.interior, r.part.adjusted, report.alike)
        interior = interior[interior["sigma"].notna() | (interior["value"] != 0)]
        each.append(
            {
                "title": f"Part {number}" if len(reports) > 1 else "The block",
                "folder": part_folder(number),
                "interior": _table(interior.replace({True: "yes", False: "no", None: ""}), "{:.6g}"),
                "alike": f"Neighbouring rays err alike: sigma_alike is sigma with what the rays say of it times "
                f"{report.alike:.2g}.",
                "lens": r.part.lens,
                "sentences": [*orientation_sentences(report), *_position_sentences(r.part)],
                "control": _table(surveyed_points(r.part.controlled), "{:.3g}") if r.part.controlled else "",
                "said": r.part.controlled.sentences if r.part.controlled else (),
                "ground": flight_words(r.coverage, r.part.adjusted.block),
                "overlap": png_of(coverage_figure(r.coverage, r.part.adjusted))[1] if r.coverage else "",
                "picture": png_of(positions_figure(r))[1],
                "images": _table(r.images, "{:.3g}"),
            }
        )
    lost = [*spoilt.values(), *(f"{name}: {why}" for name, why in flight.left_out.items())]
    columns = ("n_images", "n_image_points", "n_points", "mean_px", "positions_used", "epsg", "sigma0", "verdict")
    parts = pd.DataFrame([{c: _summary(r, k)[c] for c in columns} for k, r in enumerate(reports, 1)])
    page = Environment(autoescape=True).from_string(_PAGE)
    return page.render(
        style=STYLE,
        title="Flight",
        verdict=verdict,
        parts=_table(parts, "{:.3g}"),
        each=each,
        positions_from=positions_from,
        lost=lost,
    )


def _table(table: pd.DataFrame, digits: str) -> Markup:
    page = table.to_html(index=False, border=0, na_rep="", float_format=digits.format)
    return Markup(f'<div class="wide">{page}</div>')
