"""Report of a flight: one page for all parts, and one result folder per part."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.camera import InteriorOrientation
from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.procedures.flight import CalibratedFlight, FlightPart
from jaxphoto.report.certificate import known_conditions
from jaxphoto.report.findings import Finding, Verdict, as_sentence
from jaxphoto.report.formatting import to_rich, without_empty
from jaxphoto.report.page import (
    CommandRecord,
    Heading,
    Link,
    Paragraph,
    Part,
    Plot,
    option_word,
    page,
    provenance,
    verdict_parts,
    versions,
)
from jaxphoto.report.photographs import (
    CORRELATED,
    control_findings,
    control_summary,
    orientation_sentences,
    rmse,
    surveyed_points,
    write_control,
)
from jaxphoto.report.plots import arrow_key, axes_or_new, label, plot_links, title
from jaxphoto.report.residual_findings import component_findings, component_tables
from jaxphoto.report.results import adjustment_sections, coverage_words, summary_table, write_results, write_summary
from jaxphoto.report.tables import Tables, estimates_table
from jaxphoto.report.terminal import print_lines, print_sigma0, print_verdict
from jaxphoto.report.verdict import lens_findings, shutter_findings, verdict_of
from jaxphoto.writing import InputFile, digest_of_all, whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Maximum number of images in the table on the page; number of images with the largest residuals that a longer table is
# reduced to; number of images labelled in a plot.
_MOST, _WORST, _NAMED = 150, 50, 3
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
    conditions: Sequence[Conditions] = ()
    inputs: Sequence[InputFile] = ()
    entries: Mapping[str, Any] = MappingProxyType({})
    """Additional entries of summary.json: options and inputs."""
    command: str = ""
    """Command line."""


class PartReport(NamedTuple):
    """A part of a flight (connected images) with its tables and verdict."""

    part: FlightPart
    tables: Tables
    verdict: Verdict
    images: pd.DataFrame
    """Columns: image, n_image_points, rms_px, dX_m to dZ_m (recorded minus adjusted position), position (used, left
    out, none).
    """


# Judgement -------------------------------------------------------------------------------------------------------


def report_of(part: FlightPart) -> PartReport:
    """Assess a part: adjustment, weights, lens, positions, control and correlated residuals.

    Standard deviations of the camera and of other shared unknowns are those of correlated errors.
    """
    tables = Tables(part.adjusted)
    if part.noise is not None:
        tables = Tables(part.adjusted, known=part.noise.widened(tables.covariance))
    found = [*verdict_of(tables).findings, *(component_findings(part.components) if part.components else [])]
    verdict = Verdict.of([*found, *lens_findings(tables), *_findings(part)])
    return PartReport(part, tables, verdict, _images(part))


def _findings(part: FlightPart) -> Iterator[Finding]:
    report = part.oriented.report
    if not report.converged:
        yield Finding("orientation_not_converged", "error")
    if part.why_no_shutter:
        yield Finding("message", "warning", part.why_no_shutter)
    if part.no_control:
        yield Finding("control_unused", "error", part.no_control)
    if part.controlled:
        yield from control_findings(part.controlled)
    if part.why_not and not part.controlled:
        frame = "is placed by its positions, which are not observations" if part.placed else "has an arbitrary frame"
        yield Finding("own_frame", "warning", part.why_not, numbers={"frame": frame})
    if part.placed and not part.placed.used.all():
        used = part.placed.used
        yield Finding("positions_rejected", "warning", value=int((~used).sum()), numbers={"n": len(used)})
    factors = _camera_factors(part)
    if max(factors, default=1.0) > CORRELATED:
        yield Finding("correlated_residuals", "warning", f"{min(factors):.2g} to {max(factors):.2g}", max(factors))
    for one in part.lens_rejected:
        yield Finding("lens_prior_rejected", "warning", one.words)


def _camera_factors(part: FlightPart) -> list[float]:
    """Return the factors of the camera's standard deviations for correlated errors."""
    factors = part.noise.factors if part.noise else {}
    return [factor for label, factor in factors.items() if label.startswith("interior[")]


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
        found.append(Finding("unused_images", "warning", value=unused, numbers=numbers))
    return Verdict.of(found)


def flight_estimates(report: PartReport, start: InteriorOrientation | None) -> pd.DataFrame:
    """Tabulate the estimates of a part: parameter, initial (of the camera `start`), value, sigma, unit."""
    unknowns = report.part.adjusted.block.start.unknowns
    if start is not None:
        unknowns = dataclasses.replace(unknowns, interior=dict.fromkeys(unknowns.interior, start))
    return estimates_table(report.tables, unknowns)


def sigma_words(report: PartReport) -> str:
    """Describe the standard deviations of the camera."""
    correlated = max(_camera_factors(report.part), default=1.0) > CORRELATED
    return "a posteriori" + (", for spatially correlated residuals" if correlated else "")


def print_flight(
    flight: CalibratedFlight, reports: Sequence[PartReport], verdict: Verdict, start: InteriorOrientation | None,
    console: Console,
) -> None:  # fmt: skip
    """Print the verdict, then size, sigma naught, estimates and position of each part, and unused images."""
    print_verdict(Verdict(tuple(finding for finding in verdict.findings if finding.severity != "note")), console)
    for k, report in enumerate(reports, 1):
        part, oriented = report.part, report.part.oriented.report
        size = f"{len(oriented.order)} photographs, {oriented.n_image_points} image points, {oriented.mean_px:.2f} px"
        print_lines([f"part {k}: {size}"], console)
        print_sigma0(part.adjusted, console)
        console.print(to_rich(flight_estimates(report, start), f"estimates ({sigma_words(report)})"))
        sentences = [finding.text for finding in shutter_findings(report.tables)]
        sentences += part.placed.sentences if part.placed else (part.why_not,)
        sentences += part.controlled.sentences if part.controlled else ()
        print_lines((f"  {text}" for text in sentences), console)
    print_lines((f"{name} is not used: {reason}" for name, reason in flight.left_out.items()), console)


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
    first, *others = reports
    sigmas = f"Standard deviations are {sigma_words(first)} (sigma naught {float(first.part.adjusted.sigma0):.4f})."
    parts: list[Part] = [flight_estimates(first, source.start), Paragraph(sigmas), flight_summary(reports, n_images)]
    parts += verdict_parts(verdict)
    if unused := [(name, why.removeprefix(f"{name}: ")) for name, why in {**spoilt, **left_out}.items()]:
        parts += [Heading("Unused images"), pd.DataFrame(unused, columns=["image", "reason"])]
    parts += [*positions_section(first, source), *surveyed_section(first)]
    parts += [Paragraph(as_sentence(s)) for s in (source.camera_from, *first.part.lens) if s]
    parts += adjustment_sections(first.tables, source.start)
    parts += [
        Heading("Links between images"),
        [Plot(partial(plot_links, first.tables), "Network of images by common points", 4.4)],
    ]
    if first.part.components:
        table = component_tables(first.part.components)["variance_components"]
        parts += [Heading("Variance components"), table.drop(columns="degrees_of_freedom")]
    parts.append(Heading("Orientation"))
    placed = first.part.placed.sentences if first.part.placed else ()
    parts += [Paragraph(as_sentence(s)) for s in (*orientation_sentences(first.part.oriented.report), *placed)]
    for number, (report, folder) in enumerate(zip(others, folders[1:], strict=True), 2):
        headline = Paragraph(as_sentence(report.verdict.headline), f"verdict {report.verdict.colour}")
        parts += [Heading(f"Part {number}"), headline, *verdict_parts(report.verdict)]
        parts += [Paragraph(as_sentence(s)) for s in report.part.lens]
        parts += surveyed_section(report)[1:] if report.part.controlled else []
        parts.append(Link(f"all tables and plots of part {number}", f"{folder}/report.html"))
    parts += [*images_section(reports), *provenance_section(source), Heading("Files")]
    parts.append(Link(f"{folders[0]}/report.html: all tables and plots", f"{folders[0]}/report.html"))
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
        rows["recorded positions"] = f"{len(used)} used, RMS difference {rms} m (X, Y, Z)" if len(used) else "none used"
        rows["surveyed points"] = f"{state.count('control')} control, {state.count('check')} check"
        columns[f"part {number}" if len(reports) > 1 else "value"] = pd.Series(rows)
    return pd.DataFrame(columns).fillna("").reset_index(names="quantity")


def positions_section(report: PartReport, source: FlightSource) -> Iterator[Part]:
    """Yield recorded minus adjusted positions: statistics, plot, and residuals compared with their sigmas."""
    part, table = report.part, report.images
    yield Heading("Recorded positions")
    yield from (Paragraph(as_sentence(s)) for s in source.positions_from)
    if not part.placed:
        yield Paragraph(f"No recorded position is used: {part.why_not or 'none was read'}.")
        return
    if part.why_not:
        yield Paragraph(f"They define the frame of the block, but are not observations: {part.why_not}.")
    n = table["position"].value_counts()
    yield Paragraph(
        f"Recorded minus adjusted, X east, Y north, Z up. Used: {n.get('used', 0)}; rejected: {n.get('left out', 0)}; "
        f"images without a position: {n.get('none', 0)}."
    )
    yield offset_statistics(table[table["position"] == "used"])
    yield [Plot(partial(plot_position_offsets, report), "Recorded minus adjusted positions in plan", 4.2)]
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


def offset_statistics(table: pd.DataFrame) -> pd.DataFrame:
    """Compute statistics by axis of position offsets: axis, n, mean_m, sd_m, rms_m, largest_m, image."""
    rows = []
    for axis in AXES:
        d = table.set_index("image")[f"d{axis}_m"].dropna().astype(float)
        if len(d):
            k = int(d.abs().argmax())
            rows.append((axis, len(d), d.mean(), d.std(), np.sqrt((d**2).mean()), d.iloc[k], d.index[k]))
    return pd.DataFrame(rows, columns=["axis", "n", "mean_m", "sd_m", "rms_m", "largest_m", "image"]).round(3)


def plot_position_offsets(report: PartReport, ax: Axes | None = None) -> Axes:
    """Draw recorded minus adjusted positions in plan, without the mean of the used ones (a possible receiver shift).

    Raises InputError if the part has no recorded positions.
    """
    if not report.part.placed:
        raise InputError(f"no recorded position of this part is used: {report.part.why_not or 'none was read'}")
    ax, d = axes_or_new(ax), report.images[["dX_m", "dY_m"]].to_numpy(float)
    has = np.isfinite(d).all(axis=1)
    used = has & (report.images["position"] == "used").to_numpy()
    d = d - (d[used].mean(axis=0) if used.any() else 0.0)
    station = np.asarray(report.part.adjusted.unknowns.exterior.position)[:, :2]
    ax.plot(*station.T, "+", color="0.4", ms=5)
    if has.any():
        size = float(f"{max(np.median(np.hypot(*d[has].T)), 1e-3):.0e}")
        scale = 15 * size / max(np.ptp(station, axis=0).max(), 1e-9)
        for rows, colour, name in ((has & ~used, "tab:red", "rejected"), (used, "tab:blue", "used")):
            style = {"angles": "xy", "scale_units": "xy", "scale": scale, "color": colour, "width": 0.005}
            arrows = ax.quiver(*station[rows].T, *d[rows].T, label=name, **style)
        arrow_key(ax, arrows, size, f"{size:g} m")
        ax.legend(fontsize=7)
        largest = np.argsort(-np.where(has, np.hypot(*np.nan_to_num(d).T), -1.0))
        for k in largest[: min(_NAMED, has.sum())]:
            ax.annotate(label(report.images["image"].iloc[k]), tuple(station[k]), fontsize=6, color="0.3")
        ax.update_datalim(station[used] + d[used] / scale)
        ax.autoscale_view()
    ax.set(xlabel="X [m]", ylabel="Y [m]")
    title(ax, "plan offsets, without their mean")
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def surveyed_section(report: PartReport) -> list[Part]:
    """Return statistics of control and check points, and a table of all surveyed points."""
    control = report.part.controlled
    if not control:
        why = f" ({report.part.no_control})" if report.part.no_control else ""
        words = (
            f"No surveyed points are used{why}: the block is not checked by external observations. Add independent "
            "points (--control, role check)."
        )
        return [Heading("Surveyed points"), Paragraph(words)]
    state, rows = np.array(control.state, object), []
    for what in ("control", "check"):
        discrepancy = control.off_m[state == what]
        if len(discrepancy):
            cells = {
                f"d{axis}: mean / sd / rms [m]": axis_cell(d, r)
                for axis, d, r in zip(AXES, discrepancy.T, rmse(control, what), strict=True)
            }
            rows.append({"points": what, "n": len(discrepancy), **cells})
    table = surveyed_points(control)
    marks = [control.marks_px[control.marks.point == k] for k in range(len(table))]
    table["marks_rms_px"] = [float(np.sqrt(np.mean(m**2))) if len(m) else np.nan for m in marks]
    table["largest_w"] = table[[f"w_{axis}" for axis in AXES]].max(axis=1)
    columns = ["point", "role", "state", "n_marks", *(f"d{axis}_m" for axis in AXES), "largest_w", "marks_rms_px"]
    said: list[Part] = [Paragraph(" ".join(map(as_sentence, control.sentences)))] if control.sentences else []
    return [Heading("Surveyed points"), pd.DataFrame(rows), *said, table[columns].round(3)]


def axis_cell(off_m: np.ndarray, rms_m: float) -> str:
    """Format mean, standard deviation and RMS of the points with this axis; "-" if undefined."""
    values = off_m[np.isfinite(off_m)]
    if not len(values):
        return ""
    sd = f"{np.std(values, ddof=1):.3f}" if len(values) > 1 else "-"
    return f"{values.mean():+.3f} / {sd} / {rms_m:.3f}"


def images_section(reports: Sequence[PartReport]) -> Iterator[Part]:
    """Yield a table of the images: image points, residual, position offset, height, ground sample distance, part."""
    yield Heading("All images")
    tables = []
    for number, r in enumerate(reports, 1):
        cover = r.tables.coverage
        height, gsd = (cover.height_m, 100 * cover.gsd_m) if cover else (np.nan, np.nan)
        tables.append(r.images.assign(height_m=height, gsd_cm=gsd, part=number))
    table = pd.concat(tables, ignore_index=True)
    if len(table) > _MOST:
        yield Paragraph(f"The {_WORST} of {len(table)} with the largest residuals; images.csv has all.")
        table = table.nlargest(_WORST, "rms_px")
    unknown = ["position"] if (table["position"] == "none").all() else []
    yield without_empty(table.drop(columns=[*unknown, *([] if len(reports) > 1 else ["part"])])).round(3)


def provenance_section(source: FlightSource) -> list[Part]:
    """Return conditions, command, options, versions, and hashes of all input files except images."""
    images = {c.file for c in source.conditions}
    others = [f for f in source.inputs if f.file not in images]
    method = {k: v for k, v in dict(source.entries.get("method", {})).items() if k != "command" and v is not None}
    rows = known_conditions(source.conditions)
    rows["options as used"] = ", ".join(f"{k} {option_word(v)}" for k, v in method.items())
    if source.inputs:
        rows[f"SHA-256 of all {len(source.inputs)} inputs (result/inputs.csv)"] = digest_of_all(source.inputs)
    heading, about, *hashes = provenance(CommandRecord(source.command, others))
    return [heading, {**about, **rows}, *hashes]  # type: ignore[dict-item]


# Files -----------------------------------------------------------------------------------------------------------


def part_folder(number: int, name: str = "result") -> str:
    """Return the result folder of a part, or its folder `name`; the largest is number 1."""
    return name if number == 1 else f"{name}_{number}"


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
            entries = {**source.entries, "flight": coverage_words(r.tables)}
            write_results(r.tables, r.verdict, folder, times, entries, components=r.part.components)
            if r.part.controlled:
                write_control(r.part.controlled, folder)
            beside(r.part, folder)
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


def _summary(r: PartReport, number: int) -> dict:
    report, placed = r.part.oriented.report, r.part.placed
    return {
        "verdict": r.verdict.colour, "block": part_folder(number, "block"), "result": part_folder(number),
        "n_images": len(r.part.adjusted.block.images), "n_image_points": report.n_image_points,
        "n_points": report.n_points, "mean_px": report.mean_px,
        "sigma_factors": r.part.noise.factors if r.part.noise else {},
        "epsg": r.part.adjusted.block.frame.code, "positions_used": int(placed.used.sum()) if placed else 0,
        "positions_left_out": [n for n, u in zip(placed.images, placed.used, strict=True) if not u] if placed else [],
        "sigma0": float(r.part.adjusted.sigma0),
        "control": control_summary(r.part.controlled) if r.part.controlled else None,
    }  # fmt: skip
