"""Plots of a block before or after adjustment, in plan or 3-D."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import counted
from jaxphoto.report.plots import axes_or_new, title
from jaxphoto.tracing import outside_transformations

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Maximum number of points and of image frames in the plot; of more, every n-th is drawn.
_POINTS, _FRAMES = 20_000, 300
# Length of a drawn image pyramid as a fraction of the extent.
_PYRAMID = 0.06
# Indices of image corners along the outline of an image pyramid, drawn as one line; None: projection centre.
_OUTLINE = (0, 1, 2, 3, 0, None, 0, None, 1, None, 2, None, 3)
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2


class BlockPlaces(NamedTuple):
    """Coordinates of stations and points in the block's frame (m), and masks of the known ones."""

    stations: Float[np.ndarray, "images 3"]
    points: Float[np.ndarray, "points 3"]
    image_known: Bool[np.ndarray, images]
    point_known: Bool[np.ndarray, points]
    control: Int[np.ndarray, control]
    """Indices of control points (weighted or fixed) with a position."""
    check: Int[np.ndarray, check]
    strips: tuple[Int[np.ndarray, of_strip], ...]
    """Indices of the images of each strip, in the order of the block."""

    @property
    def extent(self) -> float:
        """Extent of all known images along the longest axis (m)."""
        known = self.stations[self.image_known]
        return float(np.ptp(known, axis=0).max()) or 1.0 if len(known) else 1.0

    def ties(self, most: int) -> Int[np.ndarray, drawn]:
        """Return the indices of known points; of more than `most`, every n-th."""
        known = np.flatnonzero(self.point_known)
        return known[:: max(1, -(-len(known) // most))]


def places_of(source: Block | Adjustment) -> BlockPlaces:
    """Return the estimates of an adjusted block, or the approximate values of a block without adjustment.

    Unknown approximate values are replaced by observed coordinates.
    """
    block = source if isinstance(source, Block) else source.block
    unknowns = source.start.unknowns if isinstance(source, Block) else source.unknowns
    stations, points = (np.array(v, float) for v in (unknowns.exterior.position, unknowns.points))
    image_known, point_known = np.ones(len(stations), bool), np.ones(len(points), bool)
    if isinstance(source, Block):
        image_known = _completed(stations, block.start.image_known, (block.stations,))
        point_known = _completed(points, block.start.point_known, (block.control, block.fixed, block.check))
    control = np.union1d(block.control.who, block.fixed.who).astype(int)
    check = np.unique(block.check.who).astype(int)
    strip = np.array(block.image_strip)
    strips = tuple(np.flatnonzero((strip == s) & image_known) for s in dict.fromkeys(strip[strip != ""]))
    control, check = control[point_known[control]], check[point_known[check]]
    return BlockPlaces(stations, points, image_known, point_known, control, check, strips)


def _completed(places: np.ndarray, given: Any, groups: tuple[Any, ...]) -> np.ndarray:
    """Fill unknown coordinates with observed ones in place. Return a mask of the rows with X and Y."""
    has = np.repeat(np.asarray(given, bool)[:, None], 3, axis=1)
    for rows in groups:
        unknown = ~has[rows.who, rows.axis]
        places[rows.who[unknown], rows.axis[unknown]] = np.asarray(rows.value)[unknown]
        has[rows.who, rows.axis] = True
    return np.asarray(has[:, :2].all(axis=1))


def pyramids(source: Block | Adjustment, places: BlockPlaces, most: int) -> Float[np.ndarray, "images corners 3"]:
    """Return a line along the edges of each image's pyramid; of more than `most` images, of every n-th."""
    block, start = (source, source.start.unknowns) if isinstance(source, Block) else (source.block, source.unknowns)
    images = np.flatnonzero(places.image_known & (np.asarray(block.start.image_known, bool) | (source is not block)))
    images = images[:: max(1, -(-len(images) // most))]
    length, rotation = _PYRAMID * places.extent, np.asarray(start.exterior.camera_from_object)
    lines = np.zeros((len(images), len(_OUTLINE), 3))
    for line, i in zip(lines, images, strict=True):
        sensor, c = block.sensors[block.image_camera[i]], float(start.interior[block.image_camera[i]].c)
        corners = np.column_stack([_CORNERS * [sensor.width_mm, sensor.height_mm], np.full(4, -c)]) * (length / c)
        frame = places.stations[i] + corners @ rotation[i]
        line[:] = [places.stations[i] if k is None else frame[k] for k in _OUTLINE]
    return lines


@outside_transformations
def plot_block(source: Block | Adjustment, ax: Axes | None = None, *, in_3d: bool = False) -> Axes:
    """Draw camera stations with their strips, object points, control and check points; coordinates in metres.

    For a block without adjustment, the approximate values or the observed positions are drawn. With `in_3d`, `ax` must
    have the projection "3d".
    """
    ax = axes_or_new(ax, in_3d=in_3d)
    places, n = places_of(source), 3 if in_3d else 2
    tie = places.ties(_POINTS)
    if len(tie):
        ax.plot(*places.points[tie, :n].T, ".", ms=2, color="0.65", label="object points", rasterized=len(tie) > 2000)
    if places.image_known.any():
        ax.plot(*places.stations[places.image_known, :n].T, "+", ms=8, color="tab:blue", label="camera stations")
    for strip in places.strips:
        ax.plot(*places.stations[strip, :n].T, "-", lw=0.7, color="tab:blue", alpha=0.5)
    control: dict[str, Any] = {"marker": "^", "ls": "", "ms": 6, "color": "tab:red", "label": "control points"}
    check: dict[str, Any] = {"marker": "s", "ls": "", "ms": 5, "mfc": "none", "color": "tab:green"}
    for index, style in ((places.control, control), (places.check, check | {"label": "check points"})):
        if len(index):
            ax.plot(*places.points[index, :n].T, **style)
    ax.set(xlabel="X [m]", ylabel="Y [m]")
    if in_3d:
        axes: Any = ax
        for pyramid in pyramids(source, places, _FRAMES):
            axes.plot(*pyramid.T, lw=0.5, color="tab:blue", alpha=0.6)
        axes.set(zlabel="Z [m]", aspect="equal")
    else:
        ax.set_aspect("equal", adjustable="datalim")
    title(ax, f"block layout{'' if isinstance(source, Adjustment) else ', before adjustment'}")
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7)
    return ax


def block_words(block: Block) -> str:
    """Return the description of a block plot."""
    control, check = (len(np.unique(rows.who)) for rows in (block.control, block.check))
    return (
        f"The block: {counted(len(block.images), 'camera station')}, {counted(len(block.points), 'object point')}, "
        f"{counted(control, 'control point')}, {counted(check, 'check point')}"
    )


# 3-D view --------------------------------------------------------------------------------------------------------
