"""A block on matplotlib axes, in plan or in space: as it starts, or as it was adjusted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import counted
from jaxphoto.report.block_places import BlockPlaces, places_of, pyramids
from jaxphoto.report.plots import axes_or_new, panels
from jaxphoto.report.tables import Tables
from jaxphoto.tracing import outside_transformations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Frames of more images hide one another, and more points take seconds.
_FRAMES, _POINTS = 300, 20_000
_CONTROL: dict[str, Any] = {"marker": "^", "ls": "", "ms": 6, "color": "tab:red"}
_CHECK: dict[str, Any] = {"marker": "s", "ls": "", "ms": 5, "mfc": "none", "color": "tab:green"}


@outside_transformations
def plot_block(source: Block | Adjustment, ax: Axes | None = None, *, in_3d: bool = False) -> Axes:
    """Camera stations with their strips, object points, control and check points; coordinates in metres.

    Of a block that is not adjusted, what is known to start with: given or observed positions, given points, control.
    `ax` are axes such as matplotlib makes, of the projection "3d" where `in_3d`; new ones where there are none.
    """
    ax = axes_or_new(ax, in_3d=in_3d)
    places = places_of(source)
    shown = 3 if in_3d else 2
    tie = places.ties(_POINTS)
    if len(tie):
        ax.plot(*places.points[tie, :shown].T, ".", ms=2, color="0.65", label="object points")
    if places.image_known.any():
        known = places.stations[places.image_known, :shown]
        ax.plot(*known.T, "+", ms=8, color="tab:blue", label="camera stations")
    for mine in places.strips:
        ax.plot(*places.stations[mine, :shown].T, "-", lw=0.7, color="tab:blue", alpha=0.5)
    for name, who, style in (("control points", places.control, _CONTROL), ("check points", places.check, _CHECK)):
        if len(who):
            ax.plot(*places.points[who, :shown].T, label=name, **style)
    ax.set(xlabel="X [m]", ylabel="Y [m]")
    if in_3d:
        _draw_pyramids(ax, source, places)
        ax.set(zlabel="Z [m]", aspect="equal")
    else:
        ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"block layout{'' if isinstance(source, Adjustment) else ', before adjusting'}", fontsize=10)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=8)
    return ax


def layout_figure(tables: Tables) -> Figure:
    """Plan of an adjusted block."""
    figure, ((axes,),) = panels(6.4, 5.6)
    plot_block(tables.adjusted, axes)
    return figure


def block_words(block: Block) -> str:
    """What a picture of a block shows, for those who do not see it."""
    control, check = (len(np.unique(rows.who)) for rows in (block.control, block.check))
    return (
        f"The block: {counted(len(block.images), 'camera station')}, {counted(len(block.points), 'object point')}, "
        f"{counted(control, 'control point')}, {counted(check, 'check point')}"
    )


def _draw_pyramids(axes: Any, source: Block | Adjustment, places: BlockPlaces) -> None:
    for pyramid in pyramids(source, places, _FRAMES):
        axes.plot(*pyramid.T, lw=0.5, color="tab:blue", alpha=0.6)
