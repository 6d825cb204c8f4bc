"""Results of photographs: orientation, surveyed points, and calibration with targets."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.errors import counted, few
from jaxphoto.observations import AXES
from jaxphoto.procedures.calibration import Calibration, Detection, rms_px
from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.procedures.control.control_block import CRITICAL
from jaxphoto.procedures.orientation.orient_photographs import OrientationReport, Oriented
from jaxphoto.report.findings import Finding, Verdict
from jaxphoto.report.formatting import of_sigma
from jaxphoto.report.page import CommandRecord, Heading, Link, Part, PictureFile, page
from jaxphoto.report.plots import label, new_figure
from jaxphoto.report.results import write_results
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_lines
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CORRELATED = 1.2
"""Factor of standard deviations above which residuals are significantly correlated (from a few hundred rays)."""


# Orientation -----------------------------------------------------------------------------------------------------


def orientation_sentences(report: OrientationReport) -> list[str]:
    """Summarise oriented images, rejected matches by reason, residuals and estimated camera parameters in sentences."""
    rejected, skipped = report.gross_errors, report.unoriented
    sentences = [
        f"{len(report.order)} of {report.n_images} images oriented, from {report.n_pairs} pairs with a relative "
        "orientation",
        *([f"not oriented: {few([f'{name} ({why})' for name, why in skipped.items()])}"] if skipped else []),
        f"{report.n_points} points from {report.n_image_points} image points",
        f"rejected of {report.n_matches} matches: {rejected.off_epipolar} off the epipolar line, "
        f"{rejected.untriangulated} without a common point, {rejected.unoriented} of images that are not oriented",
        f"rejected image points: {rejected.beyond} with residuals over {report.limit_px:.2g} px, "
        f"{rejected.unsupported} of two rays at a depth that neighbouring points contradict, {rejected.too_few} of "
        "points or images with too few of them",
        f"residuals: {report.mean_px:.2f} px on average, sigma0 {report.sigma0:.2f}",
    ]
    if not report.settled:
        sentences.append(
            f"warning: the selection of image points did not converge in {report.rounds} iterations: check for "
            "false matches or an unsuitable distortion model (--model)"
        )
    elif not report.converged:
        sentences.append("warning: the last adjustment did not converge; adjust with more iterations (--max-steps)")
    sentences.append(f"estimated camera parameters: {', '.join(report.estimated) or 'none'}")
    factors = report.sigma_factors.values()
    if max(factors, default=1.0) > CORRELATED:
        sentences.append(
            f"residuals are spatially correlated: standard deviations of the camera are {min(factors):.2g} to "
            f"{max(factors):.2g} times those of independent residuals"
        )
    return sentences + list(report.observed)


def write_orientation(oriented: Oriented, folder: Path, **matching: float) -> None:
    """Write orientation.json, with statistics of the `matching`, into the folder of the block."""
    report = oriented.report
    summary = report._asdict() | {"gross_errors": report.gross_errors._asdict(), "matching": matching}
    (folder / "orientation.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


# Surveyed points -------------------------------------------------------------------------------------------------


def surveyed_points(control: ControlledBlock) -> pd.DataFrame:
    """Tabulate the surveyed points.

    Columns: point, role, state, n_marks, dX_m to dZ_m (surveyed minus adjusted), standard deviations of surveyed and
    adjusted coordinates, w_X to w_Z.
    """
    roles = np.where(control.check, "check", "control")
    columns: dict = {"point": control.ids, "role": roles, "state": control.state, "n_marks": control.n_marks}
    for pattern, values in (
        ("d{}_m", control.off_m), ("sigma_survey_{}_m", control.survey_sigma_m),
        ("sigma_adjusted_{}_m", control.sigma_m), ("w_{}", control.w),
    ):  # fmt: skip
        columns |= {pattern.format(axis): values[:, k] for k, axis in enumerate(AXES)}
    return pd.DataFrame(columns)


def control_marks(control: ControlledBlock) -> pd.DataFrame:
    """Tabulate the used image measurements of surveyed points.

    Columns: image, point, column_px, row_px, sigma_px, d_column_px, d_row_px (measured minus computed).
    """
    block, marks = control.adjusted.block, control.marks
    sensors = [block.sensors[block.image_camera[i]] for i in marks.image]
    places = [s.px_from_mm(xy[None])[0] for s, xy in zip(sensors, marks.xy_mm, strict=True)]
    names = {"image": [block.images[i] for i in marks.image], "point": [control.ids[p] for p in marks.point]}
    sigma = marks.sigma_mm / np.array([s.pixel_mm for s in sensors])
    values = np.column_stack([np.reshape(places, (-1, 2)), sigma, control.marks_px])
    numbers = pd.DataFrame(values, columns=["column_px", "row_px", "sigma_px", "d_column_px", "d_row_px"])
    return pd.concat([pd.DataFrame(names, dtype=object), numbers], axis=1)


def rmse(control: ControlledBlock, state: str) -> np.ndarray:
    """Return the RMS of surveyed minus adjusted X, Y, Z (m) of the points with a state; NaN if there are none."""
    discrepancy = control.off_m[np.array(control.state, object) == state]
    return pd.DataFrame(discrepancy**2, columns=list(AXES)).mean().pow(0.5).to_numpy()


def control_findings(control: ControlledBlock) -> list[Finding]:
    """Report rejected control points, RMSE and outliers of check points."""
    found, check = [], [k for k, state in enumerate(control.state) if state == "check"]
    rejected = [name for name, state in zip(control.ids, control.state, strict=True) if state == "left out"]
    if rejected:
        n = int((~control.check).sum())
        found.append(Finding("control_rejected", "warning", few(rejected), len(rejected), numbers={"n": n}))
    if check:
        sizes = ", ".join(of_sigma(v) or "-" for v in rmse(control, "check"))
        found.append(Finding("check_points", "note", sizes, len(check)))
        w = np.nan_to_num(control.w).max(axis=1)
        if beyond := [control.ids[k] for k in check if w[k] > CRITICAL]:
            found.append(Finding("check_points_far", "warning", few(beyond), len(beyond), CRITICAL))
    return found


def control_summary(control: ControlledBlock) -> dict:
    """Return states and residuals of the control points for summary.json."""
    rejected = [name for name, state in zip(control.ids, control.state, strict=True) if state == "left out"]
    states = {
        state: {
            "points": control.state.count(state),
            "rmse_m": [None if np.isnan(v) else float(v) for v in rmse(control, state)],
        }
        for state in ("control", "check")
    }
    return {**states, "left_out": rejected, "marks": len(control.marks.image), "sentences": list(control.sentences)}


def write_control(control: ControlledBlock, folder: Path) -> None:
    """Write surveyed_points.csv and control_marks.csv."""
    surveyed_points(control).to_csv(folder / "surveyed_points.csv", index=False)
    control_marks(control).to_csv(folder / "control_marks.csv", index=False)


# Calibration with targets ----------------------------------------------------------------------------------------

PICTURES = "photographs"
# Length of the arrow of an RMS residual as a fraction of the image width; width of a figure (inches).
_ARROW, _WIDTH = 0.03, 6.4
# Ratio of misfit to measurement sigma above which the misfit is reported.
_MISFIT = 2.0


def photographs_table(calibration: Calibration) -> pd.DataFrame:
    """Tabulate all images, skipped ones last: image, used, n_points, rms_px, max_px, reason."""
    rows, residuals = calibration.measured, calibration.residuals_px
    lines: list[tuple] = []
    for k, name in enumerate(rows.images):
        v = residuals[rows.image == k]
        lines.append((name, True, len(v), rms_px(v), float(np.linalg.norm(v, axis=1).max()), ""))
    lines += [(name, False, 0, np.nan, np.nan, reason) for name, reason in calibration.left_out.items()]
    return pd.DataFrame(lines, columns=["image", "used", "n_points", "rms_px", "max_px", "reason"])


def targets_figure(
    calibration: Calibration, image: str, picture: np.ndarray | None = None, found: Detection | None = None
) -> Figure:
    """Draw the targets of an image over its grey values, with enlarged residuals; of a skipped one those detected."""
    rows, sensor = calibration.measured, calibration.sensor
    figure = new_figure(_WIDTH, _WIDTH * sensor.height_px / sensor.width_px + 0.6)
    axes = figure.subplots()
    if picture is not None:
        step = max(1, sensor.width_px // 1000)
        extent = (0, sensor.width_px, sensor.height_px, 0)
        axes.imshow(picture[::step, ::step], cmap="gray", extent=extent, vmin=0, vmax=255)
    axes.set(xlim=(0, sensor.width_px), ylim=(sensor.height_px, 0), xlabel="column [px]", ylabel="row [px]")
    axes.set_aspect("equal")
    if image in calibration.left_out:
        axes.plot(*(np.zeros((0, 2)) if found is None else found.column_row).T, "x", ms=5, color="tab:orange")
        axes.set_title(label(f"{image}: not used, {calibration.left_out[image]}"), fontsize=10, wrap=True)
        return figure
    of_image = rows.image == rows.images.index(image)
    place, v = sensor.px_from_mm(rows.xy_mm[of_image]), calibration.residuals_px[of_image]
    scale = _ARROW * sensor.width_px / max(rms_px(calibration.residuals_px), 1e-12)
    axes.plot(*place.T, "+", ms=5, color="tab:cyan")
    axes.quiver(*place.T, *(scale * v).T, color="tab:red", angles="xy", scale_units="xy", scale=1, width=0.003)
    axes.set_title(label(f"{image}: RMS {rms_px(v):.3f} px, residuals {scale:.0f} times enlarged"), fontsize=10)
    return figure


def findings(calibration: Calibration) -> list[str]:
    """Return sentences on convergence, skipped images, rejected image points and misfit."""
    sentences = []
    if not calibration.settled:
        sentences.append(
            "blunder rejection did not converge, the results are those of the last iteration: remove the images with "
            "the largest residuals"
        )
    if skipped := [f"{name} ({reason})" for name, reason in calibration.left_out.items()]:
        sentences.append(f"{counted(len(skipped), 'image')} not used: {few(skipped)}")
    if removed := [f"{point} in {image}" for image, point in calibration.removed]:
        sentences.append(f"{counted(len(removed), 'image point')} rejected (over 5 sigma): {few(removed)}")
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

    summary.json also contains rms_px, n_images_used, n_image_points, added_sigma_px, settled, left_out, removed and
    `start`, a sentence on the initial camera. `pictures` maps images, including skipped ones, to functions that read
    their grey values. `detections`: targets detected in skipped images. `notes` become findings. `beside` writes
    additional files into the folder.
    """
    tables = Tables(calibration.adjusted)
    noted = [Finding("message", "note", text) for text in (*notes, *findings(calibration))]
    verdict, times = Verdict.of([*noted, *verdict_of(tables).findings]), calibration.adjusted.seconds
    entries = {
        "rms_px": calibration.rms_px,
        "n_images_used": len(calibration.measured.images),
        "n_image_points": len(calibration.residuals_px),
        "added_sigma_px": calibration.added_sigma_px,
        "settled": calibration.settled,
        "left_out": calibration.left_out,
        "removed": [f"{point} in {image}" for image, point in calibration.removed],
        "start": start,
    }
    photographs, detected = photographs_table(calibration), {d.image: d for d in detections}
    order = photographs.sort_values("rms_px", ascending=False, kind="stable")
    parts: list[Part] = [Link("all results", "report.html"), Heading("Residuals"), order]
    with whole_folder(directory) as work:
        spent = seconds | {k: times[k] for k in ("compile", "solve", "covariance")}
        write_results(tables, verdict, work, spent, entries, record)
        photographs.to_csv(work / "photographs.csv", index=False)
        (work / PICTURES).mkdir()
        for name in order["image"]:
            if name in calibration.measured.images or name in pictures:
                picture = pictures[name]() if name in pictures else None
                figure = targets_figure(calibration, name, picture, detected.get(name))
                figure.savefig(work / PICTURES / f"{name}.png")
                parts += [Heading(name), PictureFile(f"targets of {name} and residuals", f"{PICTURES}/{name}.png")]
        used = f"{counted(len(calibration.measured.images), 'image')} used, {len(calibration.left_out)} not"
        text = page(f"{calibration.adjusted.block.title or 'calibration'}: photographs", parts, (used, ""))
        (work / "photographs.html").write_text(text, encoding="utf-8")
        beside(work)
    return tables


def print_calibration(calibration: Calibration, console: Console) -> None:
    """Print the number of images and image points, and the findings."""
    n, points = len(calibration.measured.images), len(calibration.residuals_px)
    lines = [f"{n} photographs used, {points} image points, RMS {calibration.rms_px:.3f} px"]
    print_lines([*lines, *(f"  - {sentence}" for sentence in findings(calibration))], console)
