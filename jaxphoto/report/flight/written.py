"""The files of a flight: its page and summary, and a result folder for every part."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pandas as pd

from jaxphoto.procedures.flight import CalibratedFlight, FlightPart
from jaxphoto.report.alike import with_alike
from jaxphoto.report.control import control_summary, write_control
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.flight.coverage import flight_words
from jaxphoto.report.flight.page import flight_page
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.made import versions
from jaxphoto.report.orientation import write_orientation
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.weights import component_tables
from jaxphoto.writing import whole_folder


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
        used = "is not used: the reason is on" if lost == 1 else "are not used: each with the reason on"
        text = f"{lost} of {n + lost} photographs {used} the page"
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
    source: FlightSource,
    beside: Callable[[FlightPart, Path], None] = lambda part, folder: None,
) -> Verdict:
    """report.html, summary.json and images.csv, and a result folder for every part, into the folder `work`.

    `source` says where it comes from, and `beside` writes more into result folders.
    """
    verdict = flight_verdict(flight, reports, spoilt)
    for number, r in enumerate(reports, 1):
        times = {name: r.part.adjusted.seconds[name] for name in ("compile", "solve", "covariance")}
        with whole_folder(work / part_folder(number)) as folder:
            alike = r.part.oriented.report.alike
            own = {
                "sigma_factor": r.sigma_factor,
                "flight": flight_words(r.coverage, r.part.adjusted.block),
            }
            write_results(r.tables, r.verdict, folder, times, {**source.told, **own})
            with_alike(r.tables.interior, r.part.adjusted, alike).to_csv(folder / "interior_alike.csv", index=False)
            if r.part.controlled:
                write_control(r.part.controlled, folder)
            beside(r.part, folder)
            for name, table in (component_tables(r.part.components) if r.part.components else {}).items():
                table.to_csv(folder / f"{name}.csv", index=False)
    images = pd.concat([r.images.assign(part=k) for k, r in enumerate(reports, 1)], ignore_index=True)
    images.to_csv(work / "images.csv", index=False)
    folders = [part_folder(number) for number in range(1, len(reports) + 1)]
    page = flight_page(reports, flight.left_out, spoilt, verdict, source, folders)
    (work / "report.html").write_text(page, encoding="utf-8")
    summary = {
        **verdict.summary,
        "parts": [_summary(r, number) for number, r in enumerate(reports, 1)],
        "positions_from": list(source.positions_from),
        "not_used": {**spoilt, **flight.left_out},
        "versions": versions(),
    }
    write_summary(summary | dict(source.told), work)
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
