"""The result folder of a strip adjustment: tables, map, report, and the adjustment of photographs in it."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from jaxphoto.lidar.raster import Raster
from jaxphoto.procedures.lidar import StripAdjustment
from jaxphoto.report.document import Heading, Paragraph, finding_paragraphs, rows_of
from jaxphoto.report.findings import Verdict
from jaxphoto.report.made import Made, made_section
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.strip_figures import differences_figure, scanner_correlation_figure, trajectory_errors_figure
from jaxphoto.report.strips import (
    all_correlations,
    calibration_table,
    differences_table,
    strip_rounds_table,
    surveyed_summary,
    surveyed_table,
    trajectory_errors_table,
)
from jaxphoto.report.study_page import StudyPart, WholePicture, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.writing import whole_folder

# Of correlations.
_DIGITS = 6
# Where there is no trajectory, and each strip has a shift.
_SHIFTS = ["strip", "X_m", "Y_m", "Z_m", "sigma_X_m", "sigma_Y_m", "sigma_Z_m"]
_TRAJECTORY = (
    "What the trajectory was off by along each strip, with two standard deviations to either side. For the most part "
    "they mean a shift or turn of all strips together, which overlaps do not show; between strips far less is open."
)
_CORRELATIONS = (
    "Correlations of what is estimated of the scanner. Near 1 or -1, two of them cannot be told apart by this flight; "
    "correlation.csv has them of all unknowns, those of the trajectory among them."
)
# Of surveyed points.
_SHOWN = 20
_SURVEYED = (
    "Surveyed less strip, of each point over the plane of each strip: those that are farthest off for the sigma of "
    f"their gap, {_SHOWN} at most; surveyed_points.csv has all. Where nothing is wrong 1 of 1000 has a w beyond 3.3."
)
_PATTERNS = {
    "line": "Angles are those of lines across the track.",
    "circle": "Angles are those of a scanner that looks all around its nadir; looks ahead and behind are compared.",
}


def write_strips(
    result: StripAdjustment,
    tables: Tables | None,
    verdict: Verdict,
    directory: Path,
    write_corrected: Callable[[Path], tuple[Raster, Raster] | None],
    made: Made,
) -> None:
    """Tables, differences.png, report.html, summary.json, of photographs `adjustment`, and what was corrected.

    `tables` are those of the adjustment where photographs are in it. `write_corrected` writes cloud and trajectory into
    the folder, while that is not yet in its place, and gives the gaps of the strips before and after. Raises InputError
    where `directory` holds what is not an earlier result.
    """
    began, seconds = time.perf_counter(), dict(result.adjusted.seconds)
    with whole_folder(directory) as work:
        if tables is not None:
            write_results(tables, verdict, work / "adjustment", seconds, made=made)
        differences_table(result.differences).to_csv(work / "strips.csv", index=False)
        strip_rounds_table(result.rounds).to_csv(work / "rounds.csv", index=False)
        if result.surveyed:
            surveyed_table(result).to_csv(work / "surveyed_points.csv", index=False)
        scanner = calibration_table(result)
        scanner.to_csv(work / "scanner.csv", index=False)
        trajectory_errors_table(result).to_csv(work / "trajectory_errors.csv", index=False)
        all_correlations(result).round(_DIGITS).to_csv(work / "correlation.csv")
        gaps, picture = write_corrected(work), None
        if gaps is not None:
            picture = WholePicture.of(differences_figure(*gaps), "gaps of strips over the ground, before and after")
            (work / "differences.png").write_bytes(picture.png)
        (work / "report.html").write_text(_page(result, scanner, verdict, picture, made), encoding="utf-8")
        told: dict[str, Any] = {"rounds": len(result.rounds), "came_to_rest": result.still}
        told |= {"sigma0": float(result.adjusted.sigma0), "pattern": result.errors.calibration.pattern}
        told |= surveyed_summary(result)
        times = {"seconds": seconds | {"write": time.perf_counter() - began}}
        write_summary(verdict.summary | told | times, work)


def _to_be_read(differences: pd.DataFrame) -> pd.DataFrame:
    """Gaps to the tenth of a millimetre: what is left of their means has no digits of its own."""
    gaps = differences.select_dtypes(float).round(4)
    # No minus sign before zeros.
    return differences.assign(**{str(name): gaps[name] + 0.0 for name in gaps})


def _page(
    result: StripAdjustment, scanner: pd.DataFrame, verdict: Verdict, gaps: WholePicture | None, made: Made
) -> str:
    parts: list[StudyPart] = [
        *finding_paragraphs(verdict),
        Heading("Strips before and after"),
        rows_of(_to_be_read(differences_table(result.differences))),
        *([gaps] if gaps else []),
    ]
    if result.surveyed:
        farthest = rows_of(_to_be_read(surveyed_table(result).head(_SHOWN)))
        parts += [Heading("Control and check points"), Paragraph(_SURVEYED), farthest]
    pattern = result.errors.calibration.pattern
    if len(scanner):
        parts += [
            Heading("Scanner and cameras" if result.before else "Scanner"),
            Paragraph(f"What was found, and what each is least told from (with, rho). {_PATTERNS[pattern]}"),
            rows_of(scanner),
        ]
    if scanner["parameter"].str.startswith("scanner").any():
        picture = WholePicture.of(scanner_correlation_figure(result), "correlations of the scanner")
        parts += [Heading("What cannot be told apart"), Paragraph(_CORRELATIONS), picture]
    if result.trajectory is None:
        shifts = trajectory_errors_table(result)[_SHIFTS]
        parts += [Heading("Shifts of the strips"), rows_of(shifts)]
    else:
        alt = "errors of the trajectory along each strip, with bands of two standard deviations"
        picture = WholePicture.of(trajectory_errors_figure(result), alt)
        parts += [Heading("Errors of the trajectory"), Paragraph(_TRAJECTORY), picture]
    parts += [Heading("Rounds"), rows_of(strip_rounds_table(result.rounds)), *made_section(made)]
    with_photographs = " and photographs" if result.before else ""
    number = len(result.cloud.strips)
    title = f"{number} strip{'s' * (number > 1)}{with_photographs}: strip adjustment"
    return study_page(title, (verdict.headline,), parts, verdict.colour)
