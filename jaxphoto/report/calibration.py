"""The results of a calibration with targets: those of its adjustment, and what became of every photograph."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console

from jaxphoto.camera import Sensor
from jaxphoto.errors import counted
from jaxphoto.procedures.calibration import Calibration, Detection, rms_px
from jaxphoto.report.document import Heading, rows_of
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.made import Made
from jaxphoto.report.plots import drawn, new_figure
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.study_page import PageLink, PictureFile, StudyPart, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

PICTURES = "photographs"
_WIDTH_INCHES = 6.4
# Of the width of the picture: how long the arrow of a typical residual is drawn.
_ARROW = 0.03
_SHOWN = 4
# What adds so many times the measurement's standard deviation deserves a look.
_MISFIT = 2.0
# Characters of a line of a title.
_LINE = 80


def photographs_table(calibration: Calibration) -> pd.DataFrame:
    """image, used, n_points, rms_px, max_px, reason: every photograph, those left out last."""
    rows, residuals = calibration.measured, calibration.residuals_px
    lines: list[tuple] = []
    for k, name in enumerate(rows.images):
        own = residuals[rows.image == k]
        lines.append((name, True, len(own), rms_px(own), float(np.linalg.norm(own, axis=1).max()), ""))
    lines += [(name, False, 0, np.nan, np.nan, reason) for name, reason in calibration.left_out.items()]
    return pd.DataFrame(lines, columns=["image", "used", "n_points", "rms_px", "max_px", "reason"])


def targets_figure(calibration: Calibration, image: str, picture: np.ndarray | None = None) -> Figure:
    """The targets of one photograph, over its grey values where they are given, with residual vectors, enlarged."""
    rows, sensor = calibration.measured, calibration.sensor
    own = rows.image == rows.images.index(image)
    place, v = sensor.px_from_mm(rows.xy_mm[own]), calibration.residuals_px[own]
    typical = max(rms_px(calibration.residuals_px), 1e-12)
    scale = _ARROW * sensor.width_px / typical
    figure = _photograph_figure(
        sensor, picture, f"{image}: RMS {rms_px(v):.3f} px, residuals {scale:.0f} times enlarged"
    )
    (axes,) = figure.axes
    axes.plot(*place.T, "+", ms=5, color="tab:cyan")
    axes.quiver(
        *place.T, *(scale * v).T, color="tab:red", angles="xy", scale_units="xy", scale=1, width=0.003, headwidth=4
    )
    return figure


def left_out_figure(
    calibration: Calibration, image: str, picture: np.ndarray | None = None, found: Detection | None = None
) -> Figure:
    """A photograph that is not used, with the reason and the targets that were `found` in it nevertheless."""
    place = np.zeros((0, 2)) if found is None else found.column_row
    title = f"{image}: not used, {calibration.left_out[image]}"
    figure = _photograph_figure(calibration.sensor, picture, title)
    (axes,) = figure.axes
    axes.plot(*place.T, "x", ms=5, color="tab:orange")
    return figure


def _photograph_figure(sensor: Sensor, picture: np.ndarray | None, title: str) -> Figure:
    """The format in pixels, grey values in it where they are given."""
    figure = new_figure(_WIDTH_INCHES, _WIDTH_INCHES * sensor.height_px / sensor.width_px + 0.6)
    axes = figure.subplots()
    if picture is not None:
        step = max(1, sensor.width_px // 1000)
        extent = (0, sensor.width_px, sensor.height_px, 0)
        axes.imshow(picture[::step, ::step], cmap="gray", extent=extent, vmin=0, vmax=255)
    axes.set(xlim=(0, sensor.width_px), ylim=(sensor.height_px, 0), xlabel="column [px]", ylabel="row [px]")
    axes.set_title("\n".join(map(drawn, wrap(title, _LINE))), fontsize=10)
    axes.set_aspect("equal")
    return figure


def findings(calibration: Calibration) -> list[str]:
    """What a person should know of the rounds and the photographs, in sentences."""
    found = []
    if not calibration.settled:
        found.append(
            "the rounds of adjusting and taking out blunders did not come to rest, and the results are those of the "
            "last one: look at the photographs with the largest residuals, and leave them out"
        )
    if calibration.left_out:
        some = [f"{name} ({reason})" for name, reason in list(calibration.left_out.items())[:_SHOWN]]
        more = ", ..." if len(calibration.left_out) > _SHOWN else ""
        n = len(calibration.left_out)
        found.append(f"{n} photograph{'s are' if n > 1 else ' is'} not used: {', '.join(some)}{more}")
    if calibration.removed:
        some = [f"{point} in {image}" for image, point in calibration.removed[:_SHOWN]]
        more = ", ..." if len(calibration.removed) > _SHOWN else ""
        n = len(calibration.removed)
        count = "1 image point is" if n == 1 else f"{n} image points are"
        found.append(f"{count} off by over five times what is usual here and not used: {', '.join(some)}{more}")
    measured = float(np.median(calibration.measured.sigma_mm)) / calibration.sensor.pixel_mm
    if calibration.added_sigma_px > _MISFIT * measured:
        found.append(
            f"the targets are measured to {measured:.3f} px, but fit to {calibration.added_sigma_px:.3f} px only, "
            "an axis: look at the residuals of the photographs for a board that is not flat (--board-sigma-mm lets "
            "the adjustment find its shape), a rolling shutter or a model too simple"
        )
    return found


def write_calibration(
    calibration: Calibration,
    directory: Path,
    seconds: dict[str, float],
    pictures: Mapping[str, Callable[[], np.ndarray]],
    beside: Callable[[Path], None] = lambda folder: None,
    *,
    detections: Sequence[Detection] = (),
    made: Made,
    start: str = "",
    notes: Sequence[str] = (),
) -> Tables:
    """Write what `jaxphoto adjust` writes, and photographs.csv, photographs.html and a picture of each photograph.

    summary.json gains rms_px, n_images_used, n_image_points, added_sigma_px, settled, left_out, removed and `start`, a
    sentence that says where the camera began. `pictures` read the grey values of photographs by their names, also of
    those left out, of which `detections` say what was found in them; `notes` are sentences that report.html begins
    with, and at its end how results were `made`; `beside` may write more into the folder before it is done. Raises
    InputError where `directory` holds something that is not an earlier result.
    """
    began = time.perf_counter()
    tables = Tables(calibration.adjusted)
    said = [Finding(Level.INFORMATION, text) for text in (*notes, *findings(calibration))]
    verdict = Verdict.of([*said, *verdict_of(tables).findings])
    times = calibration.adjusted.seconds
    with whole_folder(directory) as work:
        spent = seconds | {k: times[k] for k in ("compile", "solve", "covariance")}
        write_results(tables, verdict, work, spent, made=made)
        photographs = photographs_table(calibration)
        photographs.to_csv(work / "photographs.csv", index=False)
        (work / PICTURES).mkdir()
        found = {detection.image: detection for detection in detections}
        shown = [name for name in photographs["image"] if name in calibration.measured.images or name in pictures]
        for name in shown:
            picture = pictures[name]() if name in pictures else None
            figure = (
                left_out_figure(calibration, name, picture, found.get(name))
                if name in calibration.left_out
                else targets_figure(calibration, name, picture)
            )
            figure.savefig(work / PICTURES / f"{name}.png")
        page = _photographs_page(calibration, photographs, shown)
        (work / "photographs.html").write_text(page, encoding="utf-8")
        beside(work)
        summary = json.loads((work / "summary.json").read_text(encoding="utf-8"))
        summary["seconds"]["write"] = round(time.perf_counter() - began, 6)
        write_summary(summary | calibration_summary(calibration) | {"start": start}, work)
    return tables


def _photographs_page(calibration: Calibration, photographs: pd.DataFrame, shown: Sequence[str]) -> str:
    """Every photograph with its targets, the worst first, those left out last."""
    order = photographs.sort_values("rms_px", ascending=False, kind="stable")
    parts: list[StudyPart] = [PageLink("all results", "report.html"), Heading("Residuals"), rows_of(order)]
    for name in (name for name in order["image"] if name in shown):
        alt = f"targets of {name} and their residuals"
        parts += [Heading(name), PictureFile(alt, f"{PICTURES}/{name}.png")]
    n = len(calibration.measured.images)
    said = f"{counted(n, 'photograph')} used, {len(calibration.left_out)} not"
    return study_page(f"{calibration.adjusted.block.title or 'calibration'}: photographs", [said], parts)


def calibration_summary(calibration: Calibration) -> dict:
    """What summary.json says beyond the adjustment."""
    return {
        "rms_px": calibration.rms_px,
        "n_images_used": len(calibration.measured.images),
        "n_image_points": len(calibration.residuals_px),
        "added_sigma_px": calibration.added_sigma_px,
        "settled": calibration.settled,
        "left_out": calibration.left_out,
        "removed": [f"{point} in {image}" for image, point in calibration.removed],
    }


def print_calibration(calibration: Calibration, console: Console) -> None:
    """Print what became of the photographs."""
    console.print(
        f"{len(calibration.measured.images)} photographs used, {len(calibration.residuals_px)} image points, RMS "
        f"{calibration.rms_px:.3f} px",
        highlight=False,
    )
    for finding in findings(calibration):
        console.print(f"  - {finding}", highlight=False, markup=False)
