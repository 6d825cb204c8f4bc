"""Report of a flight: one page for all parts, and one result folder per part."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation
from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import few
from jaxphoto.observations import AXES
from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.procedures.flight import CalibratedFlight, FlightPart
from jaxphoto.procedures.rolling_shutter import GAP, Moment
from jaxphoto.report.certificate import dates, known_conditions
from jaxphoto.report.control import control_findings, control_summary, rmse, surveyed_points, write_control
from jaxphoto.report.findings import Finding, Verdict, as_sentence, symbol
from jaxphoto.report.flight_plots import (
    PartReport,
    TimeLine,
    plot_photograph_residuals,
    plot_position_offsets,
    plot_time_line,
    quantities_in_time,
    time_line,
)
from jaxphoto.report.formatting import plus_minus, without_empty
from jaxphoto.report.orientation import CORRELATED, orientation_sentences, write_orientation
from jaxphoto.report.page import (
    Heading,
    Link,
    Paragraph,
    Part,
    Plot,
    hash_table,
    option_word,
    page,
    verdict_parts,
    versions,
)
from jaxphoto.report.plots import WEAKEST, plot_link_strength, plot_links, plot_overlap
from jaxphoto.report.residual_findings import component_findings, component_tables
from jaxphoto.report.results import (
    adjustment_sections,
    class_sentences,
    interior_table,
    summary_table,
    write_results,
    write_summary,
)
from jaxphoto.report.tables import Tables, with_correlated_sigma
from jaxphoto.report.verdict import lens_findings, shutter_findings, verdict_of
from jaxphoto.statistics.block_geometry import Coverage, coverage, image_links, weak_links
from jaxphoto.writing import InputFile, digest_of_all, whole_folder

# Maximum number of images in the table on the page; number of images with the largest residuals that a longer table is
# reduced to.
_MOST, _WORST = 150, 50
# Minimum numbers of covering images in the table of areas.
_COVERED_BY = (1, 2, 3, 5, 9)
_HECTARE = 1e4
# Probabilities (%) that a normally distributed error is within k standard deviations.
_WITHIN = ((1, 68.3), (2, 95.4), (3, 99.7))


class FlightSource(NamedTuple):
    """Optional information on a flight in addition to its adjustment."""

    positions_from: Sequence[str] = ()
    """Sentences on the source of the positions."""
    camera_from: str = ""
    """Sentence on the source of the initial camera."""
    start: InteriorOrientation | None = None
    """Initial camera."""
    taken: Mapping[str, Moment] = MappingProxyType({})
    """Exposure times by image."""
    conditions: Sequence[Conditions] = ()
    inputs: Sequence[InputFile] = ()
    entries: Mapping[str, Any] = MappingProxyType({})
    """Additional entries of summary.json: options and inputs."""
    written: str = ""
    """Creation date of the results."""
    command: str = ""
    """Command line."""


# Judgement -------------------------------------------------------------------------------------------------------


def report_of(part: FlightPart) -> PartReport:
    """Assess a part: adjustment, weights, lens, positions, control and correlated residuals."""
    tables = Tables(part.adjusted)
    found = [*verdict_of(tables).findings, *(component_findings(part.components) if part.components else [])]
    verdict = Verdict.of([*found, *lens_findings(tables), *_findings(part)])
    metric = part.placed or part.controlled
    return PartReport(part, tables, verdict, _images(part), coverage(part.adjusted) if metric else None)


def _findings(part: FlightPart) -> Iterator[Finding]:
    report = part.oriented.report
    if not report.converged:
        yield Finding("orientation_not_converged", "error", hint="See the section on the orientation")
    if part.why_no_shutter:
        yield Finding("message", "warning", part.why_no_shutter)
    if part.no_control:
        yield Finding("control_unused", "error", part.no_control)
    if part.controlled:
        yield from control_findings(part.controlled)
    if part.why_not and not part.controlled:
        frame = "is placed by its positions, but not constrained by them" if part.placed else "has an arbitrary frame"
        yield Finding("own_frame", "warning", part.why_not, numbers={"frame": frame})
    if part.placed and not part.placed.used.all():
        used = part.placed.used
        yield Finding("positions_rejected", "warning", value=int((~used).sum()), numbers={"n": len(used)})
    if report.alike > CORRELATED:
        hint = "Run jaxphoto halves on the block for a better factor"
        yield Finding("correlated_residuals", "warning", value=report.alike, limit=CORRELATED, hint=hint)


def _images(part: FlightPart) -> pd.DataFrame:
    a = part.adjusted
    block, n = a.block, len(a.block.images)
    pixel = np.array([block.sensors[c].pixel_mm for c in block.image_camera])
    v = np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy)
    count = np.bincount(a.structure.image, minlength=n)
    square = np.bincount(a.structure.image, (v**2).sum(axis=0), minlength=n)
    offset, position = np.full((n, 3), np.nan), np.full(n, "none", object)
    if part.placed:
        at = [block.images.index(name) for name in part.placed.images]
        start = np.asarray(part.placed.block.start.unknowns.exterior.position)[at]
        offset[at] = part.placed.offsets_m + start - np.asarray(a.unknowns.exterior.position)[at]
        position[at] = np.where(part.placed.used, "used", "left out")
    rms = np.sqrt(square / np.maximum(2 * count, 1)) / pixel
    columns = {"image": block.images, "n_image_points": count, "rms_px": rms}
    columns |= {f"d{axis}_m": offset[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(columns | {"position": position})


def flight_verdict(flight: CalibratedFlight, reports: Sequence[PartReport], spoilt: Mapping[str, str]) -> Verdict:
    """Return the verdict on the largest part, with unconnected parts and unused images as additional findings."""
    unused, found = len(flight.left_out) + len(spoilt), list(reports[0].verdict.findings)
    sizes = [len(r.part.oriented.block.images) for r in reports]
    if len(reports) > 1:
        found.append(Finding("several_parts", "warning", ", ".join(map(str, sizes)), len(sizes)))
    if unused:
        numbers = {"n": sum(sizes) + unused}
        found.append(Finding("unused_images", "warning", value=unused, hint="See their table", numbers=numbers))
    return Verdict.of(found)


def camera_sentences(report: PartReport) -> Iterator[str]:
    """Yield sentences on c, x_p and y_p with their standard deviations, and on the rolling-shutter readout."""
    table = report.tables.interior
    estimated = table[table["sigma"].notna() & table["parameter"].isin(("c_mm", "xp_mm", "yp_mm"))]
    each = zip(estimated["parameter"], estimated["value"], estimated["sigma"], strict=True)
    if values := [f"{symbol(name)} = {plus_minus(value, sigma)}" for name, value, sigma in each]:
        yield f"{', '.join(values)} mm"
    yield from (finding.text for finding in shutter_findings(report.tables))


# Page ------------------------------------------------------------------------------------------------------------


def flight_page(
    reports: Sequence[PartReport],
    left_out: Mapping[str, str],
    spoilt: Mapping[str, str],
    verdict: Verdict,
    source: FlightSource,
    folders: Sequence[str],
) -> str:
    """Return the page as HTML, with the largest part in full. `folders`: result folders of the parts."""
    n_images = sum(len(r.images) for r in reports) + len(left_out) + len(spoilt)
    parts: list[Part] = [flight_summary(reports, n_images), *verdict_parts(verdict)]
    parts += _unused(left_out, spoilt)
    first, *others = reports
    for sections in (coverage_section(first), positions_section(first, source), surveyed_section(first)):
        parts += sections
    if source.camera_from:
        parts.append(Paragraph(source.camera_from))
    parts += [Paragraph(as_sentence(s)) for s in first.part.lens]
    parts += adjustment_sections(first.tables, source.start, first.sigma_factor, first.unit)
    for sections in (links_section(first), time_section(first, source.taken), weights_section(first)):
        parts += sections
    parts += [Heading("Orientation"), *_orientation(first)]
    for number, report in enumerate(others, 2):
        parts += _smaller_part(report, number, source)
    parts += images_section(reports)
    parts += provenance_section(source)
    parts.append(Heading("Files"))
    parts += [Link(f"{folder}/report.html: all tables and plots", f"{folder}/report.html") for folder in folders]
    parts += [Link("images.csv", "images.csv"), Link("summary.json", "summary.json")]
    return page(f"Flight report: {first.part.adjusted.block.title}", parts, (verdict.headline, verdict.colour))


def flight_summary(reports: Sequence[PartReport], n_images: int) -> pd.DataFrame:
    """Tabulate the summary of each part. `n_images`: total number of images."""
    columns = {}
    for number, r in enumerate(reports, 1):
        adjusted, used = r.part.adjusted, r.images[r.images["position"] == "used"]
        rms = ", ".join(f"{float(np.sqrt((used[f'd{axis}_m'] ** 2).mean())):.3g}" for axis in AXES)
        state = r.part.controlled.state if r.part.controlled else ()
        rows = {"images oriented": f"{len(adjusted.block.images)} of {n_images}"} | summary_table(r.tables)
        del rows["images"]
        rows |= flight_words(r.coverage, adjusted.block)
        rows["recorded positions"] = f"{len(used)} used, RMS difference {rms} m (X, Y, Z)" if len(used) else "none used"
        rows["surveyed points"] = f"{state.count('control')} control, {state.count('check')} check"
        if classes := class_sentences(r.tables.tested_accuracy)[:2]:
            rows["accuracy"] = " ".join(classes)
        columns[f"part {number}" if len(reports) > 1 else "value"] = pd.Series(rows)
    return pd.DataFrame(columns).fillna("").reset_index(names="quantity")


def flight_words(cover: Coverage | None, block: Block) -> dict[str, str]:
    """Return map system, height over ground and area. `cover` is None for a block without metric scale."""
    if cover is None:
        return {"map system": "none: arbitrary frame and scale"}
    code = block.frame.code
    return {
        "map system": f"EPSG:{code}, adjusted in a local frame" if code else "the local system of the control",
        "height over ground": f"{np.nanmedian(cover.height_m):.4g} m (median), ground sample distance "
        f"{100 * np.nanmedian(cover.gsd_m):.3g} cm",
        "area": f"{cover.area_m2(2) / _HECTARE:.3g} ha covered by two images or more",
    }


def _unused(left_out: Mapping[str, str], spoilt: Mapping[str, str]) -> list[Part]:
    rows = [(name, why.removeprefix(f"{name}: ")) for name, why in {**spoilt, **left_out}.items()]
    return [Heading("Unused images"), pd.DataFrame(rows, columns=["image", "reason"])] if rows else []


def coverage_section(report: PartReport) -> Iterator[Part]:
    """Yield heights, ground sample distances, areas by overlap, and a map of the overlap."""
    cover = report.coverage
    if cover is None:
        return
    yield Heading("Coverage and overlap")
    low, middle, high = np.nanpercentile(cover.height_m, [0, 50, 100])
    gsd = 100 * np.nanpercentile(cover.gsd_m, [0, 50, 100])
    yield Paragraph(
        f"Height over ground {middle:.4g} m (median; {low:.4g} to {high:.4g} m), ground sample distance {gsd[1]:.3g} "
        f"cm ({gsd[0]:.3g} to {gsd[2]:.3g} cm)."
    )
    areas = [(f"{n} or more", f"{cover.area_m2(n) / _HECTARE:.3g}") for n in _COVERED_BY]
    yield pd.DataFrame(areas, columns=["images per place", "area [ha]"])
    alt = f"Overlap: number of images per place of the ground, at most {cover.seen_by.max()}"
    yield [Plot(partial(plot_overlap, report.tables), alt, 4.2)]


def positions_section(report: PartReport, source: FlightSource) -> Iterator[Part]:
    """Yield recorded minus adjusted positions: statistics, plots, and residuals compared with their sigmas."""
    part, table = report.part, report.images
    yield Heading("Recorded positions")
    yield from (Paragraph(as_sentence(s)) for s in source.positions_from)
    if not part.placed:
        yield Paragraph(f"No recorded position is used: {part.why_not or 'none was read'}.")
        return
    if part.why_not:
        yield Paragraph(f"They place the block, but are not observed: {part.why_not}.")
    used, n = table[table["position"] == "used"], table["position"].value_counts()
    ordered, order = in_order(used, source.taken)
    yield Paragraph(
        f"Recorded minus adjusted, X east, Y north, Z up. Used: {len(used)}; rejected: {n.get('left out', 0)}; images "
        f"without a position: {n.get('none', 0)}. The RMS of steps is that of differences of successive images "
        f"({order}) over the square root of 2: if far below sd, offsets drift."
    )
    yield offset_statistics(ordered)
    yield [
        Plot(partial(plot_position_offsets, report), "Recorded minus adjusted positions in plan", 4.2),
        Plot(partial(plot_position_offsets, report, upright=True), "Recorded minus adjusted heights", 4.2),
    ]
    rows, residuals = [], report.tables.residuals
    for group in ("stations", "attitudes"):
        for axis, of in residuals[residuals["group"] == group].groupby("axis", sort=False, observed=True):
            w = (of["residual"] / of["sigma"]).abs()
            rms, unit = float(np.sqrt((of["residual"] ** 2).mean())), of["unit"].iloc[0]
            inside = {f"within {k} sigma ({p:g} %)": f"{100 * (w <= k).mean():.0f} %" for k, p in _WITHIN}
            sizes = {"rms": f"{rms:.3g} {unit}", "sigma (median)": f"{of['sigma'].median():.3g} {unit}"}
            rows.append({"residuals of": group, "axis": str(axis), "n": len(of), **sizes, **inside})
    if rows:
        yield pd.DataFrame(rows)


def in_order(table: pd.DataFrame, taken: Mapping[str, Moment]) -> tuple[pd.DataFrame, str]:
    """Sort images by time if all times are known. Return them with the name of the order."""
    if not all(name in taken for name in table["image"]):
        return table, "in the order of the block"
    at = np.array([taken[name][0] for name in table["image"]])
    return table.iloc[np.argsort(at, kind="stable")], "by time"


def offset_statistics(table: pd.DataFrame) -> pd.DataFrame:
    """Compute statistics by axis of the position offsets of images in their order.

    Columns: axis, n, mean_m, sd_m, rms_m, rms_of_steps_m, largest_m, image.
    """
    rows = []
    for axis in AXES:
        with_offset = table[table[f"d{axis}_m"].notna()]
        d = with_offset[f"d{axis}_m"].to_numpy(float)
        if not len(d):
            continue
        sd = float(np.std(d, ddof=1)) if len(d) > 1 else np.nan
        step = float(np.sqrt(np.mean(np.diff(d) ** 2) / 2)) if len(d) > 1 else np.nan
        k = int(np.abs(d).argmax())
        rows.append(
            (axis, len(d), d.mean(), sd, float(np.sqrt(np.mean(d**2))), step, d[k], with_offset["image"].iloc[k])
        )
    columns = ["axis", "n", "mean_m", "sd_m", "rms_m", "rms_of_steps_m", "largest_m", "image"]
    return pd.DataFrame(rows, columns=columns).round(3)


def surveyed_section(report: PartReport) -> Iterator[Part]:
    """Yield statistics of control and check points, and a table of all surveyed points."""
    yield Heading("Surveyed points")
    if report.part.controlled:
        yield from surveyed_parts(report.part.controlled)
        return
    why = f" ({report.part.no_control})" if report.part.no_control else ""
    yield Paragraph(
        f"No surveyed points are used{why}: the block is not checked by external observations. Add independent points "
        "(--control, role check)."
    )


def surveyed_parts(control: ControlledBlock) -> Iterator[Part]:
    """Yield the section of surveyed points without its heading."""
    state, rows = np.array(control.state, object), []
    for what in ("control", "check"):
        discrepancy = control.off_m[state == what]
        if len(discrepancy):
            cells = {
                f"d{axis}: mean / sd / rms [m]": axis_cell(d, r)
                for axis, d, r in zip(AXES, discrepancy.T, rmse(control, what), strict=True)
            }
            rows.append({"points": what, "n": len(discrepancy), **cells})
    yield pd.DataFrame(rows)
    if control.sentences:
        yield Paragraph(" ".join(map(as_sentence, control.sentences)))
    table = surveyed_points(control)
    marks = [control.marks_px[control.marks.point == k] for k in range(len(table))]
    table["marks_rms_px"] = [float(np.sqrt(np.mean(m**2))) if len(m) else np.nan for m in marks]
    table["largest_w"] = table[[f"w_{axis}" for axis in AXES]].max(axis=1)
    columns = ["point", "role", "state", "n_marks", *(f"d{axis}_m" for axis in AXES), "largest_w", "marks_rms_px"]
    yield table[columns].round(3)


def axis_cell(off_m: np.ndarray, rms_m: float) -> str:
    """Format mean, standard deviation and RMS of the points with this axis; "-" if undefined."""
    values = off_m[np.isfinite(off_m)]
    if not len(values):
        return ""
    sd = f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else "-"
    return f"{values.mean():+.3f} / {sd} / {rms_m:.3f}"


def links_section(report: PartReport) -> Iterator[Part]:
    """Yield the image network (common points) and its weakest links."""
    adjusted, images = report.part.adjusted, report.part.adjusted.block.images
    links = image_links(adjusted)
    of_image = np.bincount(np.concatenate([links.first, links.second]), minlength=len(images))
    yield Heading("Links between images")
    yield Paragraph(
        f"{len(links.common)} pairs of images have common points (median {np.median(links.common):.0f}); an image is "
        f"linked with {np.median(of_image):.0f} others, {images[int(of_image.argmin())]} with the fewest "
        f"({of_image.min()})."
    )
    yield [
        Plot(partial(plot_links, report.tables, unit=report.unit), "Network of images by common points", 4.4),
        Plot(partial(plot_link_strength, report.tables), "Number of links by common points"),
    ]
    yield Paragraph(
        "Weakest links of the maximum spanning tree: no other pair across has more common points; points on both sides "
        "are those of all pairs across."
    )
    rows = [
        (images[w.first], images[w.second], w.common, w.across, few([images[k] for k in w.side]))
        for w in weak_links(adjusted, links, WEAKEST)
    ]
    yield pd.DataFrame(rows, columns=["image", "second image", "common points", "points on both sides", "smaller side"])


def time_section(report: PartReport, taken: Mapping[str, Moment]) -> Iterator[Part]:
    """Yield gaps, speed, and plots over time."""
    line = time_line(report, taken)
    yield Heading("Time line")
    yield Paragraph(" ".join(time_sentences(line, report.part.adjusted.block.images)))
    yield [
        Plot(partial(plot_time_line, report, what, taken=taken), f"{what} by time", 2.6)
        for what in quantities_in_time(report, line)
    ]


def time_sentences(line: TimeLine, images: Sequence[str]) -> Iterator[str]:
    """Yield sentences on duration, gaps and speed."""
    if not line.timed:
        yield "No times are known: images are in the order of the block, without speeds or gaps."
        return
    usual = f", usual interval {line.usual:.3g} s" if np.isfinite(line.usual) else ""
    yield f"Duration {line.since[-1]:.0f} s{usual}."
    gaps = [
        f"{later:.3g} s from {images[line.order[k]]} to {images[line.order[k + 1]]}"
        for k, later in enumerate(np.diff(line.since))
        if line.gap[k]
    ]
    number = f"Gaps of more than {GAP:g} intervals (grey): {len(gaps)}"
    yield f"{number}: {few(gaps, '; ')}." if gaps else f"{number}."
    if np.isfinite(line.speed).any():
        low, middle, high = np.nanpercentile(line.speed, [0, 50, 100])
        yield f"Speed {middle:.3g} m/s (median; {low:.3g} to {high:.3g} m/s), from adjusted positions."
    if without := len(images) - len(line.order):
        yield f"{without} images without a time are not shown."


def weights_section(report: PartReport) -> Iterator[Part]:
    """Yield the variance components."""
    if report.part.components:
        yield Heading("Variance components")
        table = component_tables(report.part.components)["variance_components"]
        yield table[["group", "observations", "redundancy", "factor", "sigma_factor", "supported"]]


def _orientation(report: PartReport) -> Iterator[Part]:
    part = report.part
    counts = {
        "features per image": np.array([len(xy) for xy in part.matched.xy_mm]),
        "image points per image": report.images["n_image_points"].to_numpy(),
        "matches per pair": np.array([len(p.features) for p in part.matched.pairs]),
    }
    rows = [
        {"number of": name, "n": len(n), "least": n.min(), "median": np.median(n), "most": n.max()}
        for name, n in counts.items()
        if len(n)
    ]
    yield pd.DataFrame(rows)
    sentences = [*orientation_sentences(part.oriented.report), *(part.placed.sentences if part.placed else ())]
    yield from (Paragraph(as_sentence(s)) for s in sentences)


def _smaller_part(report: PartReport, number: int, source: FlightSource) -> Iterator[Part]:
    """Yield findings, camera, offsets, surveyed points and orientation of a part."""
    yield Heading(f"Part {number}")
    yield Paragraph(as_sentence(report.verdict.headline), f"verdict {report.verdict.colour}")
    yield from verdict_parts(report.verdict)
    yield interior_table(report.tables, source.start, report.sigma_factor)
    yield from (Paragraph(as_sentence(s)) for s in report.part.lens)
    used = report.images[report.images["position"] == "used"]
    if len(used):
        yield offset_statistics(in_order(used, source.taken)[0])
    if report.part.controlled:
        yield from surveyed_parts(report.part.controlled)
    yield from _orientation(report)


def images_section(reports: Sequence[PartReport]) -> Iterator[Part]:
    """Yield a table of the images: image points, residual, position offset, height, ground sample distance, part."""
    yield Heading("All images")
    tables = []
    for number, r in enumerate(reports, 1):
        height, gsd = (r.coverage.height_m, 100 * r.coverage.gsd_m) if r.coverage else (np.nan, np.nan)
        tables.append(r.images.assign(height_m=height, gsd_cm=gsd, part=number))
    table = pd.concat(tables, ignore_index=True)
    if len(table) > _MOST:
        yield Paragraph(f"The {_WORST} of {len(table)} with the largest residuals; images.csv has all.")
        table = table.nlargest(_WORST, "rms_px")
    unknown = ["position"] if (table["position"] == "none").all() else []
    yield without_empty(table.drop(columns=[*unknown, *([] if len(reports) > 1 else ["part"])])).round(3)
    yield [
        Plot(partial(plot_photograph_residuals, r), "Residuals by image; the largest are named") for r in reports[:1]
    ]


def provenance_section(source: FlightSource) -> Iterator[Part]:
    """Yield dates, camera, conditions, command, options, versions, and hashes of all input files except images."""
    rows, conditions = {"computed": source.written}, source.conditions
    if any(c.time for c in conditions):
        rows["images taken"] = dates(conditions)
    for name, field in (("camera", "camera"), ("aircraft", "drone")):
        rows[name] = ", ".join(dict.fromkeys(v for c in conditions if (v := getattr(c, field))))
    rows |= dict(known_conditions(conditions))
    rows["command"] = source.command
    method = {k: v for k, v in dict(source.entries.get("method", {})).items() if k != "command" and v is not None}
    rows["options as used"] = ", ".join(f"{k} {option_word(v)}" for k, v in method.items())
    rows["versions"] = ", ".join(f"{name} {number}" for name, number in versions().items())
    if source.inputs:
        rows[f"SHA-256 of all {len(source.inputs)} inputs"] = digest_of_all(source.inputs)
    yield Heading("Provenance")
    yield {name: value for name, value in rows.items() if value}
    images = {c.file for c in conditions}
    if others := [f for f in source.inputs if f.file not in images]:
        yield hash_table(others)
    if source.inputs:
        yield Paragraph(
            "result/inputs.csv has the SHA-256 of every file; certificate.html is the document to sign. Equal inputs, "
            "options and versions give equal numbers."
        )


# Files -----------------------------------------------------------------------------------------------------------


def part_folder(number: int) -> str:
    """Return the result folder of a part; the largest is number 1."""
    return "result" if number == 1 else f"result_{number}"


def block_folder(number: int) -> str:
    """Return the block folder of a part."""
    return "block" if number == 1 else f"block_{number}"


def write_flight(
    flight: CalibratedFlight,
    reports: Sequence[PartReport],
    spoilt: Mapping[str, str],
    work: Path,
    source: FlightSource,
    beside: Callable[[FlightPart, Path], None] = lambda part, folder: None,
) -> Verdict:
    """Write report.html, summary.json, images.csv and one result folder per part into the folder `work`.

    `beside` writes additional files into each result folder.
    """
    verdict, folders = flight_verdict(flight, reports, spoilt), [part_folder(k) for k in range(1, len(reports) + 1)]
    for folder_name, r in zip(folders, reports, strict=True):
        times = {name: r.part.adjusted.seconds[name] for name in ("compile", "solve", "covariance")}
        with whole_folder(work / folder_name) as folder:
            entries = {"sigma_factor": r.sigma_factor, "flight": flight_words(r.coverage, r.part.adjusted.block)}
            write_results(r.tables, r.verdict, folder, times, {**source.entries, **entries})
            correlated = with_correlated_sigma(r.tables.interior, r.part.adjusted, r.part.oriented.report.alike)
            correlated.to_csv(folder / "interior_correlated.csv", index=False)
            if r.part.controlled:
                write_control(r.part.controlled, folder)
            beside(r.part, folder)
            for name, table in (component_tables(r.part.components) if r.part.components else {}).items():
                table.to_csv(folder / f"{name}.csv", index=False)
    images = pd.concat([r.images.assign(part=k) for k, r in enumerate(reports, 1)], ignore_index=True)
    images.to_csv(work / "images.csv", index=False)
    text = flight_page(reports, flight.left_out, spoilt, verdict, source, folders)
    (work / "report.html").write_text(text, encoding="utf-8")
    summary = {
        **verdict.summary,
        "parts": [_summary(r, number) for number, r in enumerate(reports, 1)],
        "positions_from": list(source.positions_from),
        "not_used": {**spoilt, **flight.left_out},
        "versions": versions(),
    }
    write_summary(summary | dict(source.entries), work)
    return verdict


def write_part_orientation(part: FlightPart, folder: Path) -> None:
    """Write the orientation files of `jaxphoto orient` into a block folder."""
    write_orientation(part.oriented, folder, n_gross=part.matched.n_gross, sigma_factor=part.matched.sigma_factor)


def _summary(r: PartReport, number: int) -> dict:
    report, placed = r.part.oriented.report, r.part.placed
    return {
        "verdict": r.verdict.colour, "block": block_folder(number), "result": part_folder(number),
        "n_images": len(r.part.adjusted.block.images), "n_image_points": report.n_image_points,
        "n_points": report.n_points, "mean_px": report.mean_px, "alike": report.alike,
        "epsg": r.part.adjusted.block.frame.code, "positions_used": int(placed.used.sum()) if placed else 0,
        "positions_left_out": [n for n, u in zip(placed.images, placed.used, strict=True) if not u] if placed else [],
        "sigma0": float(r.part.adjusted.sigma0),
        "control": control_summary(r.part.controlled) if r.part.controlled else None,
    }  # fmt: skip
