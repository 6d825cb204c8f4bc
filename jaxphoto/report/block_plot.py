"""A block in plan or in space, before or after adjustment: matplotlib plot and interactive 3-D view (plotly)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from markupsafe import Markup

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import counted
from jaxphoto.observations import AXES
from jaxphoto.report.plots import axes_or_new
from jaxphoto.statistics import Covariance, physical_residuals
from jaxphoto.tracing import outside_transformations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from plotly.graph_objects import Figure

# Points and image frames of the plot; of more, every n-th.
_POINTS, _FRAMES = 20_000, 300
# The same of the 3-D view, and its error ellipsoids of stations and of tie points.
_POINTS_3D, _FRAMES_3D, _ELLIPSOIDS = 5_000, 500, 80
# Ellipsoids this many times longer than the median are skipped: they would hide the block.
_LONGEST = 10.0
# Drawn lengths as fractions of the extent: image pyramids, median ellipsoid, RMS position residual.
_PYRAMID, _ELLIPSOID, _OFFSET = 0.06, 0.015, 0.05
# Coordinates beyond this are shown relative to a round origin: WebGL has seven digits.
_FAR, _ROUND = 1e4, 1e3
# The outline of an image and lines to its projection centre (None), drawn as one line.
_OUTLINE = (0, 1, 2, 3, 0, None, 0, None, 1, None, 2, None, 3)
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_GREY, _BLUE, _RED, _GREEN, _PURPLE, _SKY = "#8a8f96", "#2f8fd0", "#d55e00", "#009e73", "#cc79a7", "#56b4e9"


class BlockPlaces(NamedTuple):
    """Positions in the block's frame (m), and which are known."""

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
        """Indices of known points; of more than `most` every n-th."""
        known = np.flatnonzero(self.point_known)
        return known[:: max(1, -(-len(known) // most))]


def places_of(source: Block | Adjustment) -> BlockPlaces:
    """Estimates of an adjusted block; otherwise approximate values, completed by observed coordinates."""
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
    """Fill unknown coordinates by observed ones, and return which rows have X and Y."""
    has = np.repeat(np.asarray(given, bool)[:, None], 3, axis=1)
    for rows in groups:
        unknown = ~has[rows.who, rows.axis]
        places[rows.who[unknown], rows.axis[unknown]] = np.asarray(rows.value)[unknown]
        has[rows.who, rows.axis] = True
    return np.asarray(has[:, :2].all(axis=1))


def pyramids(source: Block | Adjustment, places: BlockPlaces, most: int) -> Float[np.ndarray, "images corners 3"]:
    """A line along the edges of each image's pyramid; of more than `most` images for every n-th."""
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
    """Camera stations with their strips, object points, control and check points; coordinates in metres.

    Of a block that is not adjusted, approximate values are drawn: given or observed positions and points. `ax` has the
    projection "3d" if `in_3d`.
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
    ax.set_title(f"block layout{'' if isinstance(source, Adjustment) else ', before adjustment'}", fontsize=10)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=8)
    return ax


def block_words(block: Block) -> str:
    """Description of a plot of a block."""
    control, check = (len(np.unique(rows.who)) for rows in (block.control, block.check))
    return (
        f"The block: {counted(len(block.images), 'camera station')}, {counted(len(block.points), 'object point')}, "
        f"{counted(control, 'control point')}, {counted(check, 'check point')}"
    )


# 3-D view --------------------------------------------------------------------------------------------------------


def block_view(adjusted: Adjustment, covariance: Covariance | None) -> Markup | None:
    """The 3-D view as part of a page, with plotly.js inside; None if plotly is not installed (extra `report`)."""
    try:
        figure = block_in_space(adjusted, covariance)
    except ImportError:
        return None
    config = {"displaylogo": False, "responsive": True}
    view = figure.to_html(config=config, full_html=False, include_plotlyjs=True, default_height="100%")
    return Markup('<figure class="block">{}</figure>').format(Markup(view))


def block_in_space(source: Block | Adjustment, covariance: Covariance | None = None) -> Figure:
    """Stations with image pyramids, strips, object, control and check points as a plotly figure, in metres.

    Of an adjustment also position residuals (GNSS) as lines from the stations and, with its `covariance`, error
    ellipsoids of stations and points (one sigma, a posteriori); the legend has their magnification.
    """
    from plotly.graph_objects import Figure

    block, places = (source, places_of(source)) if isinstance(source, Block) else (source.block, places_of(source))
    origin = _origin(places)
    traces = [*_points(block, places), *_images(source, places)]
    if not isinstance(source, Block):
        traces += _position_residuals(source, places)
        traces += _ellipsoids(covariance, places) if covariance is not None else []
    for trace in traces:
        # Coordinates of an adjustment that diverged may exceed the range of WebGL.
        at = np.clip(trace.pop("at") - origin, -1e30, 1e30).astype(np.float32)
        trace |= dict(zip("xyz", at.T, strict=True))
    names = (
        f"{a} {'-' if o > 0 else '+'} {abs(o):.0f} [m]" if o else f"{a} [m]" for a, o in zip(AXES, origin, strict=True)
    )
    scene = {
        f"{a}axis": {"title": {"text": name}, "showbackground": False} for a, name in zip("xyz", names, strict=True)
    }
    layout = {
        "scene": {"aspectmode": "data", "camera": {"eye": {"x": 0.4, "y": -1.7, "z": 1.1}}, **scene},
        "legend": {"orientation": "h", "yanchor": "top", "y": 0, "itemsizing": "constant"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "white",
    }
    return Figure(data=traces, layout=layout)


def _origin(places: BlockPlaces) -> Float[np.ndarray, 3]:
    """A round origin of the drawn coordinates (m); zero where coordinates are small."""
    known = places.points[places.point_known] if places.point_known.any() else places.stations[places.image_known]
    known = known[np.isfinite(known).all(axis=1)]
    middle = np.median(known, axis=0) if len(known) else np.zeros(3)
    return np.where(np.abs(middle) > _FAR, np.round(middle / _ROUND) * _ROUND, 0.0)


def _points(block: Block, places: BlockPlaces) -> list[dict[str, Any]]:
    tie = np.setdiff1d(places.ties(_POINTS_3D), np.concatenate([places.control, places.check]))
    n = places.point_known.sum()
    thinned = f" (1 in {-(-n // _POINTS_3D)})" if n > _POINTS_3D else ""
    kinds = (
        (f"object points{thinned}", tie, {"size": 2, "color": _GREY}),
        ("control points", places.control, {"size": 6, "color": _RED, "symbol": "diamond"}),
        ("check points", places.check, {"size": 6, "color": _GREEN, "symbol": "square-open"}),
    )
    names = np.array(block.points, object)
    return [_markers(name, places.points[index], names[index], marker) for name, index, marker in kinds if len(index)]


def _images(source: Block | Adjustment, places: BlockPlaces) -> list[dict[str, Any]]:
    block, known = source if isinstance(source, Block) else source.block, np.flatnonzero(places.image_known)
    if not len(known):
        return []
    names = np.array(block.images, object)[known]
    traces = [_markers("camera stations", places.stations[known], names, {"size": 4, "color": _BLUE})]
    lines = pyramids(source, places, _FRAMES_3D)
    if len(lines):
        traces.append(_lines("images", lines, _BLUE, 1.5))
    if places.strips:
        traces.append(_lines("strips", [places.stations[strip] for strip in places.strips], _BLUE, 1))
    return traces


def _position_residuals(adjusted: Adjustment, places: BlockPlaces) -> list[dict[str, Any]]:
    """Lines from stations to their observed positions, enlarged; unobserved coordinates are zero."""
    rows, residuals = adjusted.block.stations, physical_residuals(adjusted)
    if rows.group not in residuals or not len(rows.who):
        return []
    offset = np.zeros_like(places.stations)
    offset[rows.who, rows.axis] = residuals[rows.group]
    images = np.unique(rows.who).astype(int)
    rms = float(np.sqrt((offset[images] ** 2).sum(axis=1).mean()))
    if not 0 < rms < np.inf:
        return []
    factor = max(1.0, float(f"{_OFFSET * places.extent / rms:.0e}"))
    start = places.stations[images]
    ends = np.stack([start, start + factor * offset[images]], axis=1)
    return [_lines(f"observed minus adjusted positions, {factor:,.0f} times", ends, _PURPLE, 3)]


def _ellipsoids(covariance: Covariance, places: BlockPlaces) -> list[dict[str, Any]]:
    n = covariance.n_images
    images = np.arange(n)[:: max(1, -(-n // _ELLIPSOIDS))]
    points = np.union1d(places.ties(_ELLIPSOIDS), np.concatenate([places.control, places.check]))
    centre = np.concatenate([places.stations[images], places.points[points]])
    matrix = np.concatenate([covariance.positions[images], np.asarray(covariance.points)[points]])
    matrix = matrix * float(covariance.variance_factor)
    longest = np.sqrt(np.maximum(np.linalg.eigvalsh(matrix)[:, -1], 0.0)) if np.isfinite(matrix).all() else np.zeros(0)
    if not (longest > 0).any():
        return []
    median = float(np.median(longest[longest > 0]))
    factor = max(1.0, float(f"{_ELLIPSOID * places.extent / median:.0e}"))
    shown, skipped = (longest > 0) & (longest <= _LONGEST * median), int((longest > _LONGEST * median).sum())
    at, triangles = ellipsoid_mesh(centre[shown], matrix[shown] * factor**2)
    i, j, k = triangles.T
    name = f"error ellipsoids, {factor:,.0f} times" + (f" ({skipped} too large to show)" if skipped else "")
    style = {"color": _SKY, "opacity": 0.45, "hoverinfo": "skip", "showlegend": True}
    return [{"type": "mesh3d", "name": name, "at": at, "i": i, "j": j, "k": k, **style}]


def ellipsoid_mesh(
    centre: Float[np.ndarray, "n 3"], covariance: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, "corners 3"], Int[np.ndarray, "triangles 3"]]:
    """Corners, and corner indices of triangles, of the surfaces d' covariance^-1 d = 1 around the centres.

    A singular covariance gives a flat ellipsoid.
    """
    around, rings = 10, 5
    polar = np.linspace(0, np.pi, rings + 2)[1:-1, None]
    azimuth = np.linspace(0, 2 * np.pi, around, endpoint=False)
    xyz = np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar))
    sphere = np.concatenate([[[0, 0, 1]], np.stack(xyz, axis=2).reshape(-1, 3), [[0, 0, -1]]])
    here, right, last = np.arange(around), (np.arange(around) + 1) % around, len(sphere) - 1
    triangles = [np.stack([0 * here, 1 + here, 1 + right], axis=1)]
    for above in 1 + around * np.arange(rings - 1):
        below = above + around
        triangles.append(np.stack([above + here, below + here, below + right], axis=1))
        triangles.append(np.stack([above + here, below + right, above + right], axis=1))
    triangles.append(np.stack([0 * here + last, last - around + right, last - around + here], axis=1))
    variance, axes = np.linalg.eigh(covariance)
    # A fixed coordinate has a variance of zero or, by rounding, below.
    semi_axes = axes * np.sqrt(np.maximum(variance, 0.0))[:, None, :]
    corners = centre[:, None, :] + np.einsum("nij,cj->nci", semi_axes, sphere)
    shifted = np.concatenate(triangles) + len(sphere) * np.arange(len(centre))[:, None, None]
    return corners.reshape(-1, 3), shifted.reshape(-1, 3)


def _markers(name: str, at: np.ndarray, names: np.ndarray, marker: dict[str, Any]) -> dict[str, Any]:
    hover = "%{text}<br>%{x:.3f}, %{y:.3f}, %{z:.3f}<extra></extra>"
    style = {"type": "scatter3d", "mode": "markers", "marker": marker, "hovertemplate": hover}
    return style | {"name": name, "at": at, "text": names.tolist()}


def _lines(name: str, lines: Any, colour: str, width: float) -> dict[str, Any]:
    """Several lines as one trace, with gaps."""
    gap = np.full((1, 3), np.nan)
    at = np.concatenate([part for line in lines for part in (line, gap)])
    style = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "line": {"color": colour, "width": width}}
    return style | {"name": name, "at": at}
