"""How photographs were oriented: counts in words, pictures of the network and of its residuals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from jaxphoto.procedures.orientation.orient_photographs import CAMERA, OrientationReport, Oriented
from jaxphoto.report.plots import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = 6
# What chance alone may do to the standard deviations of a few hundred rays.
ALIKE = 1.2


def orientation_sentences(report: OrientationReport) -> list[str]:
    """What came of an orientation: images, gross errors by reason, residuals and what is free of the camera."""
    left = report.gross_errors
    said = [
        f"{len(report.order)} of {report.n_images} images oriented, from {report.n_pairs} pairs with a relative "
        "orientation",
    ]
    said += [f"image {name} is not oriented: {why}" for name, why in list(report.unoriented.items())[:_SHOWN]]
    if len(report.unoriented) > _SHOWN:
        said.append(f"and {len(report.unoriented) - _SHOWN} more: {', '.join(list(report.unoriented)[_SHOWN:])}")
    said += [
        f"{report.n_points} points from {report.n_image_points} image points",
        f"rejected of {report.n_matches} matches: {left.off_epipolar} off the epipolar line, {left.untriangulated} "
        f"without a common point, {left.unoriented} of images that are not oriented",
        f"rejected image points: {left.beyond} with a residual of more than {report.limit_px:.2g} px, "
        f"{left.unsupported} of two rays at a depth that neighbouring points contradict, {left.too_few} of points or "
        "images with too few of them",
        f"residuals: {report.mean_px:.2f} px on average, sigma0 {report.sigma0:.2f}",
        *_doubts(report),
        f"free of the camera: {', '.join(report.estimated) or 'nothing'}",
    ]
    if report.alike > ALIKE:
        said.append(
            f"neighbouring rays of an image err alike: standard deviations of the camera are {report.alike:.2g} times "
            "what an adjustment says, which takes them for independent"
        )
    return said + list(report.observed)


def _doubts(report: OrientationReport) -> Iterator[str]:
    if not report.settled:
        yield (
            f"warning: after {report.rounds} iterations image points were still rejected: false matches or a "
            "distortion model that does not fit (--model) may be why"
        )
    elif not report.converged:
        yield "warning: the last adjustment did not converge; adjust the block with more iterations (--max-steps)"


def print_orientation(report: OrientationReport, console: Console) -> None:
    """Print `orientation_sentences`."""
    for sentence in orientation_sentences(report):
        console.print(sentence, highlight=False, markup=False, soft_wrap=True)


def network_figure(oriented: Oriented) -> Figure:
    """The network in plan and from the side: stations in the order of the images, and points, along its main axes.

    The axes are those of the stations and points together, because a free network has none of its own.
    """
    stations, points = (
        np.asarray(v, float)
        for v in (oriented.block.start.unknowns.exterior.position, oriented.block.start.unknowns.points)
    )
    # Far points would make everything else small.
    middle = np.median(points, axis=0)
    far = np.linalg.norm(points - middle, axis=1)
    near = points[far <= np.percentile(far, 95)]
    _, _, axes = np.linalg.svd(np.concatenate([near, stations]) - near.mean(axis=0), full_matrices=False)
    figure = new_figure(9.6, 4.6)
    for panel, (across, up) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        ends = axes[[across, up]].T
        panel.plot(*((near - middle) @ ends).T, ".", ms=1.5, color="0.6", label="points")
        panel.plot(*((stations - middle) @ ends).T, "-+", ms=7, lw=0.7, color="tab:blue", label="stations")
        panel.set_aspect("equal", adjustable="datalim")
        panel.set(xlabel=f"axis {across + 1}", ylabel=f"axis {up + 1}")
    panel.legend(fontsize=8)
    figure.suptitle("the network along its main axes, in a scale of its own", fontsize=11)
    return figure


def image_residuals_figure(oriented: Oriented) -> Figure:
    """Residuals of all image points: averaged over cells of the format, and how they scatter."""
    sensor, xy = oriented.block.sensors[CAMERA], np.asarray(oriented.block.image_points.xy).T
    v = oriented.residuals_mm.T / sensor.pixel_mm
    across = 12
    down = max(1, round(across * sensor.height_px / sensor.width_px))
    column = np.clip(((xy[0] / sensor.width_mm + 0.5) * across).astype(int), 0, across - 1)
    row = np.clip(((xy[1] / sensor.height_mm + 0.5) * down).astype(int), 0, down - 1)
    cell = row * across + column
    count = np.bincount(cell, minlength=across * down)
    mean = np.stack([np.bincount(cell, part, across * down) for part in v]) / np.maximum(count, 1)
    some = count >= 5
    figure = new_figure(9.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    places = np.stack(np.divmod(np.arange(across * down), across)[::-1]) + 0.5
    at = (places.T / [across, down] - 0.5) * [sensor.width_mm, sensor.height_mm]
    key = float(f"{max(np.abs(mean).max(), 1e-9):.0e}")
    arrows = left.quiver(
        *at[some].T,
        *mean[:, some],
        angles="xy",
        scale_units="xy",
        scale=key * across / sensor.width_mm,
        color="tab:blue",
    )
    left.quiverkey(arrows, 0.85, 1.04, key, f"{key:g} px", labelpos="E")
    left.set(xlabel="x [mm]", ylabel="y [mm]")
    left.set_title("mean residuals by place", loc="left", fontsize=10)
    left.set_aspect("equal")
    right.hist(v.ravel(), bins=61, range=(-4 * v.std(), 4 * v.std()), color="tab:blue")
    right.set(xlabel="residual [px]")
    right.set_title(f"residuals, RMS {v.std():.2f} px an axis", loc="left", fontsize=10)
    return figure


def write_orientation(oriented: Oriented, folder: Path, **matching: float) -> None:
    """orientation.json, orientation_network.png and orientation_residuals.png, beside the block in `folder`.

    `matching` are numbers of what came before (matches left out, how features scatter), under that name in the first.
    """
    report = oriented.report
    summary = report._asdict() | {"gross_errors": report.gross_errors._asdict(), "matching": matching}
    (folder / "orientation.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    network_figure(oriented).savefig(folder / "orientation_network.png")
    image_residuals_figure(oriented).savefig(folder / "orientation_residuals.png")
