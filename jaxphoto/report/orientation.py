"""Orientation of images: counts in sentences, plots of the network and of its residuals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from jaxphoto.procedures.orientation.orient_photographs import CAMERA, OrientationReport, Oriented
from jaxphoto.report.plots import draw_arrows, new_figure, round_key, title
from jaxphoto.report.terminal import print_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 6
CORRELATED = 1.2
"""Factor of spatially correlated residuals that is significant with a few hundred rays."""


def orientation_sentences(report: OrientationReport) -> list[str]:
    """Oriented images, rejected matches by reason, residuals and estimated camera parameters."""
    rejected, skipped = report.gross_errors, list(report.unoriented.items())
    more = skipped[_SHOWN:]
    sentences = [
        f"{len(report.order)} of {report.n_images} images oriented, from {report.n_pairs} pairs with a relative "
        "orientation",
        *(f"image {name} is not oriented: {why}" for name, why in skipped[:_SHOWN]),
        *([f"and {len(more)} more: {', '.join(name for name, _ in more)}"] if more else []),
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
            f"warning: the selection of image points did not converge in {report.rounds} iterations: false matches or "
            "an unsuitable distortion model (--model)"
        )
    elif not report.converged:
        sentences.append("warning: the last adjustment did not converge; adjust with more iterations (--max-steps)")
    sentences.append(f"estimated camera parameters: {', '.join(report.estimated) or 'none'}")
    if report.alike > CORRELATED:
        sentences.append(
            f"residuals are spatially correlated: standard deviations of the camera are {report.alike:.2g} times those "
            "of an adjustment of independent rays"
        )
    return sentences + list(report.observed)


def print_orientation(report: OrientationReport, console: Console) -> None:
    """Print `orientation_sentences`."""
    print_lines(orientation_sentences(report), console)


def network_figure(oriented: Oriented) -> Figure:
    """Stations and points along their principal axes, in plan and from the side: a free network has no axes."""
    start = oriented.block.start.unknowns
    stations, points = np.asarray(start.exterior.position, float), np.asarray(start.points, float)
    # The farthest 5 % would make everything else small.
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    near = points[distance <= np.percentile(distance, 95)]
    _, _, axes = np.linalg.svd(np.concatenate([near, stations]) - near.mean(axis=0), full_matrices=False)
    figure = new_figure(9.6, 4.6)
    for panel, (across, up) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        ends = axes[[across, up]].T
        panel.plot(*((near - middle) @ ends).T, ".", ms=1.5, color="0.6", label="points", rasterized=True)
        panel.plot(*((stations - middle) @ ends).T, "-+", ms=7, lw=0.7, color="tab:blue", label="stations")
        panel.set_aspect("equal", adjustable="datalim")
        panel.set(xlabel=f"axis {across + 1}", ylabel=f"axis {up + 1}")
    panel.legend(fontsize=8)
    figure.suptitle("network along its principal axes, arbitrary scale", fontsize=11)
    return figure


def image_residuals_figure(oriented: Oriented) -> Figure:
    """Mean residuals by cell of the image format, and the histogram of all residuals."""
    sensor, xy = oriented.block.sensors[CAMERA], np.asarray(oriented.block.image_points.xy).T
    v, across = oriented.residuals_mm.T / sensor.pixel_mm, 12
    size = np.array([[sensor.width_mm], [sensor.height_mm]])
    cells = np.array([[across], [max(1, round(across * sensor.height_px / sensor.width_px))]])
    column, row = np.clip(((xy / size + 0.5) * cells).astype(int), 0, cells - 1)
    cell, n = row * across + column, int(cells.prod())
    count = np.bincount(cell, minlength=n)
    mean, enough = np.stack([np.bincount(cell, part, n) for part in v]) / np.maximum(count, 1), count >= 5
    at = ((np.stack(np.divmod(np.arange(n), across)[::-1]) + 0.5) / cells - 0.5) * size
    figure = new_figure(9.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    key = round_key(mean[:, enough])
    draw_arrows(left, at[:, enough], mean[:, enough], key, 0.06 * sensor.width_mm, f"{key:g} px")
    left.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    title(left, "mean residuals by cell")
    right.hist(v.ravel(), bins=61, range=(-4 * v.std(), 4 * v.std()), color="tab:blue")
    right.set(xlabel="residual [px]")
    title(right, f"residuals, RMS {v.std():.2f} px per axis")
    return figure


def write_orientation(oriented: Oriented, folder: Path, **matching: float) -> None:
    """Write orientation.json, orientation_network.png and orientation_residuals.png into the folder of the block.

    `matching` are numbers of the matching, under that name in the first.
    """
    report = oriented.report
    summary = report._asdict() | {"gross_errors": report.gross_errors._asdict(), "matching": matching}
    (folder / "orientation.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    network_figure(oriented).savefig(folder / "orientation_network.png")
    image_residuals_figure(oriented).savefig(folder / "orientation_residuals.png")
