"""A block in 3-D that can be turned: the twin of `plot_block(in_3d=True)`, for pages and notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.observations import AXES
from jaxphoto.report.block_places import BlockPlaces, places_of, pyramids
from jaxphoto.report.error_ellipsoids import ellipsoid_mesh
from jaxphoto.statistics import Covariance, physical_residuals

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

# Points that a browser turns smoothly, and pyramids.
_POINTS, _PYRAMIDS = 5_000, 500
# Of more images pyramids and offsets hide the rest: they are shown when the legend is asked for them.
_CROWDED = 150
# Ellipsoids of stations and tie points, each; control and check points have theirs besides.
_ELLIPSOIDS = 80
# Ellipsoids so many times longer than the median one would hide the block, and stand far out of it.
_LONGEST = 10.0
# Drawn lengths, as parts of the extent of the block: of the median ellipsoid's longest axis, and of an rms offset.
_AXIS, _OFFSET = 0.015, 0.05
# Coordinates beyond this are shown less a round number: WebGL has seven digits.
_FAR, _ROUND = 1e4, 1e3
_MOST = 1e30
# What fits into the picture, seen from the usual place, in sides of plotly's box.
_WIDE, _HIGH = 2.1, 1.3
# Colours that those who see no red or green tell apart, on light and dark paper (Okabe and Ito 2008).
_GREY, _BLUE, _RED, _GREEN, _PURPLE, _SKY = "#8a8f96", "#2f8fd0", "#d55e00", "#009e73", "#cc79a7", "#56b4e9"


def block_in_space(source: Block | Adjustment, covariance: Covariance | None = None) -> Figure:
    """Stations with the pyramids of their images, strips, object points, control and check points, in metres.

    Of an adjustment also by how much observed positions (GNSS) differ from it, as lines from the stations; with its
    `covariance` the error ellipsoids of stations and points (one sigma, a posteriori). Both are drawn larger than they
    are; by how much says the legend. Many points are thinned. What stands for an image or a point carries its name as
    `text`, and its trace says of what as `meta`.
    """
    # Here, because importing plotly takes half a second that most uses of jaxphoto need not wait for.
    from plotly.graph_objects import Figure

    block, places = (source, places_of(source)) if isinstance(source, Block) else (source.block, places_of(source))
    origin = origin_of(places)
    traces = [*_point_traces(block, places, origin), *_image_traces(source, places, origin)]
    if not isinstance(source, Block):
        traces += _offset_traces(source, places, origin)
        if covariance is not None:
            traces += _ellipsoid_traces(covariance, places, origin)
    axes = zip(AXES, origin, strict=True)
    # Each text on an axis takes as long to draw as a thousand points.
    common = {"showbackground": False, "nticks": 6}
    shown = {f"{a.lower()}axis": {"title": {"text": _axis_title(a, v)}, **common} for a, v in axes}
    far = _far(traces)
    eye = {"x": 0.4 * far, "y": -1.7 * far, "z": 1.1 * far}
    camera = {"eye": eye, "center": {"x": 0, "y": 0, "z": -0.15}}
    layout = {
        "scene": {"aspectmode": "data", "camera": camera, **shown},
        "legend": {"orientation": "h", "yanchor": "top", "y": 0, "itemsizing": "constant"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
    }
    return Figure(data=traces, layout=layout, skip_invalid=False)


def origin_of(places: BlockPlaces) -> Float[np.ndarray, 3]:
    """What the drawn coordinates are less of (m): round, and zero where coordinates are small."""
    known = places.points[places.point_known] if places.point_known.any() else places.stations[places.image_known]
    known = known[np.isfinite(known).all(axis=1)]
    middle = np.median(known, axis=0) if len(known) else np.zeros(3)
    return np.where(np.abs(middle) > _FAR, np.round(middle / _ROUND) * _ROUND, 0.0)


def _far(traces: list[dict[str, Any]]) -> float:
    """How much farther off than usual the eye has to be, so that all of what is high or long is in the picture."""
    shown = [np.stack([t[a] for a in "xyz"], axis=1) for t in traces if t.get("visible", True) is True]
    at = np.concatenate([np.zeros((0, 3)), *shown])
    at = at[np.isfinite(at).all(axis=1)]
    if not len(at):
        return 1.0
    size = np.maximum(np.ptp(at, axis=0), 1e-6)
    # plotly draws a box of these sides, whose volume is one; the eye looks down by 32 degrees.
    x, y, z = size / np.cbrt(size.prod())
    return float(max(1.0, x / _WIDE, (0.85 * z + 0.53 * y) / _HIGH))


def drawable(at: np.ndarray) -> np.ndarray:
    """Coordinates as WebGL has them; those of an adjustment that diverged may be larger than any such number."""
    return np.clip(at, -_MOST, _MOST).astype(np.float32)


def _axis_title(axis: str, origin: float) -> str:
    return f"{axis} [m]" if not origin else f"{axis} {'-' if origin > 0 else '+'} {abs(origin):.0f} [m]"


def _point_traces(block: Block, places: BlockPlaces, origin: np.ndarray) -> list[dict[str, Any]]:
    tie = np.setdiff1d(places.ties(_POINTS), np.concatenate([places.control, places.check]))
    shown = places.point_known.sum()
    thinned = f" (1 in {-(-shown // _POINTS)})" if shown > _POINTS else ""
    kinds = (
        (f"object points{thinned}", tie, {"size": 2, "color": _GREY}),
        ("control points", places.control, {"size": 6, "color": _RED, "symbol": "diamond"}),
        ("check points", places.check, {"size": 6, "color": _GREEN, "symbol": "square-open"}),
    )
    names = np.array(block.points, object)
    return [_marks(name, "point", places.points[who] - origin, names[who], m) for name, who, m in kinds if len(who)]


def _image_traces(source: Block | Adjustment, places: BlockPlaces, origin: np.ndarray) -> list[dict[str, Any]]:
    block = source if isinstance(source, Block) else source.block
    known = np.flatnonzero(places.image_known)
    if not len(known):
        return []
    mark = {"size": 4, "color": _BLUE, "symbol": "circle"}
    names = np.array(block.images, object)[known]
    traces = [_marks("camera stations", "image", places.stations[known] - origin, names, mark)]
    lines = pyramids(source, places, _PYRAMIDS)
    if len(lines):
        traces.append(_lines("images", lines - origin, _BLUE, 1.5) | _hidden_among(len(known)))
    if places.strips:
        flown = [places.stations[strip] - origin for strip in places.strips]
        traces.append(_lines("strips", flown, _BLUE, 1, dash="dot"))
    return traces


def _offset_traces(adjusted: Adjustment, places: BlockPlaces, origin: np.ndarray) -> list[dict[str, Any]]:
    """Lines that begin at stations; what was not observed of a position has no part in them."""
    rows = adjusted.block.stations
    residuals = physical_residuals(adjusted)
    if rows.group not in residuals:
        return []
    offset = np.zeros_like(places.stations)
    offset[rows.who, rows.axis] = residuals[rows.group]
    images = np.unique(rows.who).astype(int)
    # Root mean square of the lengths.
    size = float(np.sqrt((offset[images] ** 2).sum(axis=1).mean())) if len(images) else 0.0
    if not 0 < size < np.inf:
        return []
    factor = _round_factor(_OFFSET * places.extent / size)
    start = places.stations[images] - origin
    tip = start + factor * offset[images]
    name = f"observed minus adjusted positions, {factor:,.0f} times"
    lines = _lines(name, np.stack([start, tip], axis=1), _PURPLE, 3)
    return [lines | _hidden_among(len(images))]


def _ellipsoid_traces(covariance: Covariance, places: BlockPlaces, origin: np.ndarray) -> list[dict[str, Any]]:
    n, factor2 = covariance.n_images, float(covariance.variance_factor)
    images = np.arange(n)[:: max(1, -(-n // _ELLIPSOIDS))]
    who = np.union1d(places.ties(_ELLIPSOIDS), np.concatenate([places.control, places.check]))
    centre = np.concatenate([places.stations[images], places.points[who]]) - origin
    matrix = np.concatenate([covariance.positions[images], np.asarray(covariance.points)[who]]) * factor2
    longest = np.sqrt(np.maximum(np.linalg.eigvalsh(matrix)[:, -1], 0.0)) if np.isfinite(matrix).all() else np.zeros(0)
    if not (longest > 0).any():
        return []
    median = float(np.median(longest[longest > 0]))
    factor = _round_factor(_AXIS * places.extent / median)
    drawn = (longest > 0) & (longest <= _LONGEST * median)
    larger = int((longest > _LONGEST * median).sum())
    at, triangles = ellipsoid_mesh(centre[drawn], matrix[drawn] * factor**2)
    i, j, k = triangles.T
    without = f" ({larger} without end or too large to show)" if larger else ""
    mesh = {
        "type": "mesh3d", "i": i, "j": j, "k": k, "color": _SKY, "opacity": 0.45, "hoverinfo": "skip",
        "name": f"error ellipsoids, {factor:,.0f} times{without}", "showlegend": True, "flatshading": False,
    }  # fmt: skip
    return [mesh | _xyz(at)]


def _hidden_among(images: int) -> dict[str, Any]:
    """What a trace of so many images is given beside its lines."""
    return {"visible": "legendonly" if images > _CROWDED else True}


def _round_factor(factor: float) -> float:
    """To one digit, and no less than 1."""
    return max(1.0, float(f"{factor:.0e}"))


def _marks(name: str, of: str, at: np.ndarray, names: np.ndarray, marker: dict[str, Any]) -> dict[str, Any]:
    own = {"type": "scatter3d", "mode": "markers", "name": name, "meta": of, "text": names.tolist(), "marker": marker}
    return own | _xyz(at) | {"hovertemplate": f"{of} %{{text}}<br>%{{x:.3f}}, %{{y:.3f}}, %{{z:.3f}}<extra></extra>"}


def _lines(name: str, lines: Any, colour: str, width: float, dash: str = "solid") -> dict[str, Any]:
    """Several lines as one trace, with gaps between."""
    gap = np.full((1, 3), np.nan)
    at = np.concatenate([part for line in lines for part in (line, gap)])
    own = {"type": "scatter3d", "mode": "lines", "name": name, "hoverinfo": "skip"}
    return own | {"line": {"color": colour, "width": width, "dash": dash}} | _xyz(at)


def _xyz(at: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", drawable(at).T, strict=True))
