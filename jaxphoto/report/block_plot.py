"""A block on matplotlib axes, in plan or in space: as it starts, or as it was adjusted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.report.plots import axes_or_new, panels
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Frames of more images hide one another, and more points take seconds.
_FRAMES, _POINTS = 300, 20_000
# Length of the drawn pyramid of an image, as a part of the extent of the block.
_PYRAMID = 0.06
_CONTROL: dict[str, Any] = {"marker": "^", "ls": "", "ms": 6, "color": "tab:red"}
_CHECK: dict[str, Any] = {"marker": "s", "ls": "", "ms": 5, "mfc": "none", "color": "tab:green"}


def plot_block(source: Block | Adjustment, axes: Axes | None = None, *, in_3d: bool = False) -> Axes:
    """Camera stations with their strips, object points, control and check points; coordinates in metres.

    Of a block that is not adjusted, what is known to start with: given or observed positions, given points, control.
    `axes` are such as matplotlib makes, of the projection "3d" where `in_3d`; new ones where there are none.
    """
    axes = axes_or_new(axes, in_3d=in_3d)
    block = source if isinstance(source, Block) else source.block
    stations, points, image_known, point_known = _places(source)
    shown = 3 if in_3d else 2
    control = np.union1d(block.control.who, block.fixed.who).astype(int)
    check = np.unique(block.check.who).astype(int)
    tie = np.flatnonzero(point_known)
    tie = tie[:: max(1, -(-len(tie) // _POINTS))]
    if len(tie):
        axes.plot(*points[tie, :shown].T, ".", ms=2, color="0.65", label="object points")
    if image_known.any():
        axes.plot(*stations[image_known, :shown].T, "+", ms=8, color="tab:blue", label="camera stations")
    strips = np.array(block.image_strip)
    for strip in dict.fromkeys(strips[strips != ""]):
        mine = (strips == strip) & image_known
        axes.plot(*stations[mine, :shown].T, "-", lw=0.7, color="tab:blue", alpha=0.5)
    for name, who, style in (("control points", control, _CONTROL), ("check points", check, _CHECK)):
        known = who[point_known[who]]
        if len(known):
            axes.plot(*points[known, :shown].T, label=name, **style)
    axes.set(xlabel="X [m]", ylabel="Y [m]")
    if in_3d:
        _draw_pyramids(axes, block, stations, source, image_known)
        axes.set(zlabel="Z [m]", aspect="equal")
    else:
        axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"block layout{'' if isinstance(source, Adjustment) else ', before adjusting'}", fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    return axes


def layout_figure(tables: Tables) -> Figure:
    """Plan of an adjusted block."""
    figure, ((axes,),) = panels(6.4, 5.6)
    plot_block(tables.adjusted, axes)
    return figure


def _places(
    source: Block | Adjustment,
) -> tuple[
    Float[np.ndarray, "images 3"], Float[np.ndarray, "points 3"], Bool[np.ndarray, images], Bool[np.ndarray, points]
]:
    """Positions of images and points, and which of them are known."""
    if isinstance(source, Adjustment):
        stations, points = np.asarray(source.unknowns.exterior.position), np.asarray(source.unknowns.points)
        return stations, points, np.ones(len(stations), bool), np.ones(len(points), bool)
    start = source.start
    stations, points = (np.array(v, float) for v in (start.unknowns.exterior.position, start.unknowns.points))
    known: list[np.ndarray] = []
    for places, given, groups in (
        (stations, start.image_known, (source.stations,)),
        (points, start.point_known, (source.control, source.fixed, source.check)),
    ):
        has = np.repeat(np.asarray(given, bool)[:, None], 3, axis=1)
        for rows in groups:
            unknown = ~has[rows.who, rows.axis]
            places[rows.who[unknown], rows.axis[unknown]] = np.asarray(rows.value)[unknown]
            has[rows.who, rows.axis] = True
        # In plan X and Y are enough: a point that is held in height only has no place.
        known.append(np.asarray(has[:, :2].all(axis=1)))
    return stations, points, known[0], known[1]


def _draw_pyramids(
    axes: Any, block: Block, stations: Float[np.ndarray, "images 3"], source: Block | Adjustment, known: np.ndarray
) -> None:
    """The frame of each image before its projection centre, a part of the block's extent away."""
    start = source.start.unknowns if isinstance(source, Block) else source.unknowns
    turned = known if isinstance(source, Adjustment) else known & np.asarray(source.start.image_known, bool)
    images = np.flatnonzero(turned)
    images = images[:: max(1, -(-len(images) // _FRAMES))]
    if not len(images):
        return
    length = _PYRAMID * float(np.ptp(stations[known], axis=0).max() or 1.0)
    around = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
    for i in images:
        sensor, c = block.sensors[block.image_camera[i]], float(start.interior[block.image_camera[i]].c)
        corners = np.column_stack([around * [sensor.width_mm, sensor.height_mm], np.full(5, -c)]) * (length / c)
        frame = stations[i] + corners @ np.asarray(start.exterior.camera_from_object[i])
        lines = np.concatenate([frame, *([stations[i], corner] for corner in frame[:4])])
        axes.plot(*lines.T, lw=0.5, color="tab:blue", alpha=0.6)
