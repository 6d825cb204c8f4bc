"""Results of a calibration with targets: those of its adjustment, and the residuals of every image."""

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
from jaxphoto.report.findings import Finding, Verdict
from jaxphoto.report.page import CommandRecord, Heading, Link, Part, PictureFile, page
from jaxphoto.report.plots import label, new_figure
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_lines
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

PICTURES = "photographs"
_WIDTH_INCHES = 6.4
# Length of the arrow of an RMS residual as a fraction of the width of the picture.
_ARROW = 0.03
_SHOWN = 4
# Misfit over measurement sigma that is reported.
_MISFIT = 2.0


def photographs_table(calibration: Calibration) -> pd.DataFrame:
    """image, used, n_points, rms_px, max_px, reason: every image, skipped ones last."""
    rows, residuals = calibration.measured, calibration.residuals_px
    lines: list[tuple] = []
    for k, name in enumerate(rows.images):
        v = residuals[rows.image == k]
        lines.append((name, True, len(v), rms_px(v), float(np.linalg.norm(v, axis=1).max()), ""))
    lines += [(name, False, 0, np.nan, np.nan, reason) for name, reason in calibration.left_out.items()]
    return pd.DataFrame(lines, columns=["image", "used", "n_points", "rms_px", "max_px", "reason"])


def targets_figure(calibration: Calibration, image: str, picture: np.ndarray | None = None) -> Figure:
    """The targets of one image, over its grey values if given, with enlarged residual vectors."""
    rows, sensor = calibration.measured, calibration.sensor
    of_image = rows.image == rows.images.index(image)
    place, v = sensor.px_from_mm(rows.xy_mm[of_image]), calibration.residuals_px[of_image]
    scale = _ARROW * sensor.width_px / max(rms_px(calibration.residuals_px), 1e-12)
    figure = _image_figure(sensor, picture, f"{image}: RMS {rms_px(v):.3f} px, residuals {scale:.0f} times enlarged")
    (axes,) = figure.axes
    axes.plot(*place.T, "+", ms=5, color="tab:cyan")
    axes.quiver(*place.T, *(scale * v).T, color="tab:red", angles="xy", scale_units="xy", scale=1, width=0.003)
    return figure


def left_out_figure(
    calibration: Calibration, image: str, picture: np.ndarray | None = None, found: Detection | None = None
) -> Figure:
    """A skipped image with the reason and the targets that were detected in it."""
    place = np.zeros((0, 2)) if found is None else found.column_row
    figure = _image_figure(calibration.sensor, picture, f"{image}: not used, {calibration.left_out[image]}")
    figure.axes[0].plot(*place.T, "x", ms=5, color="tab:orange")
    return figure


def _image_figure(sensor: Sensor, picture: np.ndarray | None, title: str) -> Figure:
    """The image format in pixels, with grey values if given."""
    figure = new_figure(_WIDTH_INCHES, _WIDTH_INCHES * sensor.height_px / sensor.width_px + 0.6)
    axes = figure.subplots()
    if picture is not None:
        step = max(1, sensor.width_px // 1000)
        extent = (0, sensor.width_px, sensor.height_px, 0)
        axes.imshow(picture[::step, ::step], cmap="gray", extent=extent, vmin=0, vmax=255)
    axes.set(xlim=(0, sensor.width_px), ylim=(sensor.height_px, 0), xlabel="column [px]", ylabel="row [px]")
    axes.set_title("\n".join(map(label, wrap(title, 80))), fontsize=10)
    axes.set_aspect("equal")
    return figure


def findings(calibration: Calibration) -> list[str]:
    """Sentences on convergence, skipped images, rejected image points and misfit."""

    def some(names: Sequence[str]) -> str:
        return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")

    sentences = []
    if not calibration.settled:
        sentences.append(
            "blunder rejection did not converge, the results are those of the last iteration: remove the images with "
            "the largest residuals"
        )
    if skipped := [f"{name} ({reason})" for name, reason in calibration.left_out.items()]:
        sentences.append(f"{counted(len(skipped), 'image')} not used: {some(skipped)}")
    if removed := [f"{point} in {image}" for image, point in calibration.removed]:
        sentences.append(f"{counted(len(removed), 'image point')} rejected (over 5 sigma): {some(removed)}")
    measured = float(np.median(calibration.measured.sigma_mm)) / calibration.sensor.pixel_mm
    if calibration.added_sigma_px > _MISFIT * measured:
        sentences.append(
            f"targets are measured to {measured:.3f} px but fit to {calibration.added_sigma_px:.3f} px per axis only: "
            "check for a board that is not flat (--board-sigma-mm estimates its shape), a rolling shutter or an "
            "incomplete distortion model"
        )
    return sentences


def write_calibration(
    calibration: Calibration,
    directory: Path,
    seconds: dict[str, float],
    pictures: Mapping[str, Callable[[], np.ndarray]],
    beside: Callable[[Path], None] = lambda folder: None,
    *,
    detections: Sequence[Detection] = (),
    record: CommandRecord,
    start: str = "",
    notes: Sequence[str] = (),
) -> Tables:
    """Write the results of the adjustment, photographs.csv, photographs.html and a picture of each image.

    summary.json gains rms_px, n_images_used, n_image_points, added_sigma_px, settled, left_out, removed and `start`, a
    sentence on the initial camera. `pictures` read the grey values of images by name, including skipped ones, of which
    `detections` are the detected targets; `notes` become findings; `beside` writes further files into the folder.
    Raises InputError if `directory` holds something else than an earlier result.
    """
    began = time.perf_counter()
    tables = Tables(calibration.adjusted)
    noted = [Finding("message", "note", text) for text in (*notes, *findings(calibration))]
    verdict = Verdict.of([*noted, *verdict_of(tables).findings])
    times = calibration.adjusted.seconds
    with whole_folder(directory) as work:
        spent = seconds | {k: times[k] for k in ("compile", "solve", "covariance")}
        write_results(tables, verdict, work, spent, record=record)
        photographs = photographs_table(calibration)
        photographs.to_csv(work / "photographs.csv", index=False)
        (work / PICTURES).mkdir()
        detected = {detection.image: detection for detection in detections}
        shown = [name for name in photographs["image"] if name in calibration.measured.images or name in pictures]
        for name in shown:
            picture = pictures[name]() if name in pictures else None
            if name in calibration.left_out:
                figure = left_out_figure(calibration, name, picture, detected.get(name))
            else:
                figure = targets_figure(calibration, name, picture)
            figure.savefig(work / PICTURES / f"{name}.png")
        (work / "photographs.html").write_text(_images_page(calibration, photographs, shown), encoding="utf-8")
        beside(work)
        summary = json.loads((work / "summary.json").read_text(encoding="utf-8"))
        summary["seconds"]["write"] = round(time.perf_counter() - began, 6)
        write_summary(summary | calibration_summary(calibration) | {"start": start}, work)
    return tables


def _images_page(calibration: Calibration, photographs: pd.DataFrame, shown: Sequence[str]) -> str:
    """Every image with its targets, the worst first, skipped ones last."""
    order = photographs.sort_values("rms_px", ascending=False, kind="stable")
    parts: list[Part] = [Link("all results", "report.html"), Heading("Residuals"), order]
    for name in (name for name in order["image"] if name in shown):
        parts += [Heading(name), PictureFile(f"targets of {name} and their residuals", f"{PICTURES}/{name}.png")]
    n = len(calibration.measured.images)
    verdict = f"{counted(n, 'image')} used, {len(calibration.left_out)} not"
    return page(f"{calibration.adjusted.block.title or 'calibration'}: photographs", parts, (verdict, ""))


def calibration_summary(calibration: Calibration) -> dict:
    """The additional content of summary.json."""
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
    """Print the numbers of images and image points, and the findings."""
    n, points = len(calibration.measured.images), len(calibration.residuals_px)
    print_lines([f"{n} photographs used, {points} image points, RMS {calibration.rms_px:.3f} px"], console)
    print_lines((f"  - {sentence}" for sentence in findings(calibration)), console)
