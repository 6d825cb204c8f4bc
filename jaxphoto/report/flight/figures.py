"""The pictures of the report of a flight, one by one, for notebooks: each takes and returns matplotlib axes.

Those of the whole block are of `Tables`, so of any adjusted block; those of recorded positions and times are of a
`PartReport`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from jaxphoto.errors import InputError
from jaxphoto.procedures.rolling_shutter import Moment
from jaxphoto.report.flight.coverage import draw_overlap, draw_rays
from jaxphoto.report.flight.links import draw_network, draw_strength, weakest
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.positions import draw_height, draw_plan
from jaxphoto.report.flight.residuals import draw_by_photograph
from jaxphoto.report.flight.time_line import draw_in_time, shown_in_time, time_line
from jaxphoto.report.plots import axes_or_new
from jaxphoto.report.tables import Tables
from jaxphoto.statistics.block_geometry import coverage, image_links

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_overlap(tables: Tables, ax: Axes | None = None) -> Axes:
    """How many photographs see each place of the ground; the coordinates are metres."""
    ax = axes_or_new(ax)
    draw_overlap(ax, coverage(tables.adjusted), tables.adjusted)
    return ax


def plot_rays(tables: Tables, ax: Axes | None = None) -> Axes:
    """How many object points have how many rays."""
    ax = axes_or_new(ax)
    draw_rays(ax, tables.adjusted)
    return ax


def plot_links(tables: Tables, ax: Axes | None = None) -> Axes:
    """The network of photographs in plan, by how many points they have in common; its weakest links in red."""
    ax, links = axes_or_new(ax), image_links(tables.adjusted)
    draw_network(ax, tables.adjusted, links, weakest(tables.adjusted, links))
    return ax


def plot_link_strength(tables: Tables, ax: Axes | None = None) -> Axes:
    """How many pairs of photographs have how many points in common."""
    ax = axes_or_new(ax)
    draw_strength(ax, image_links(tables.adjusted))
    return ax


def plot_position_offsets(report: PartReport, ax: Axes | None = None, *, upright: bool = False) -> Axes:
    """Recorded (GNSS) minus adjusted positions less their mean: arrows in plan, or bars in height where `upright`.

    Raises InputError where the part has no recorded positions.
    """
    if not report.part.placed:
        raise InputError(f"no recorded position of this part is used: {report.part.why_not or 'there are none'}")
    ax = axes_or_new(ax)
    (draw_height if upright else draw_plan)(ax, report)
    return ax


def plot_photograph_residuals(report: PartReport, ax: Axes | None = None) -> Axes:
    """Root mean square residual of each photograph (px); the largest are named."""
    ax = axes_or_new(ax)
    draw_by_photograph(ax, report)
    return ax


def plot_time_line(
    report: PartReport, what: str = "residuals", ax: Axes | None = None, *,
    taken: Mapping[str, Moment] = MappingProxyType({}),
) -> Axes:  # fmt: skip
    """`offsets` of positions, `residuals`, `height` or `speed` by the times at which photographs were `taken`.

    Where no times are known, in the order of the block. Raises InputError for what the part does not have.
    """
    line = time_line(report, taken)
    shown = shown_in_time(report, line)
    if what not in shown:
        raise InputError(f"of this part no {what!r} are known by time; there are {', '.join(shown)}")
    ax = axes_or_new(ax)
    draw_in_time(ax, line, shown[what])
    return ax


# All that is defined here, for the rooms that show it.
__all__ = [name for name in dir() if name.startswith("plot_")]
