"""Any picture that matplotlib draws here as a figure of plotly, which zooms and answers: its twin.

Nothing is drawn twice: what the axes hold is taken from them, in the coordinates of the data.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.report.plotly_axes import (
    PX,
    Trace,
    axis_of,
    colour_scale,
    css,
    data_of,
    in_data,
    kinds_of,
    raster,
    say,
    shown,
    texts_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawn
    from plotly.graph_objects import Figure

_DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
_STEPPED = {"steps": "vh", "steps-pre": "vh", "steps-mid": "hvh", "steps-post": "hv"}
_MARKERS = {
    "o": "circle", ".": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down",
    "<": "triangle-left", ">": "triangle-right", "*": "star", "x": "x-thin", "+": "cross-thin",
    "|": "line-ns", "_": "line-ew",
}  # fmt: skip
# Thin ones have no face: their line is what shows.
_THIN = ("x-thin", "cross-thin", "line-ns", "line-ew")
# What upright and lying bars tell.
_LENGTH = ("%{x}: %{customdata:.6~g}<extra></extra>", "%{y}: %{customdata:.6~g}<extra></extra>")
_NONE = ("", " ", "None", "none", None)
_INCHES_PX = 96
# Size of a sign in space, over that of the same on paper.
_BOLD = 0.6
# Above what is drawn, for the key of its arrows, as a part of its height.
_HEADROOM = 0.12


def to_plotly(ax: Axes) -> Figure:
    """The twin of matplotlib axes, flat or in space: lines, markers, arrows, areas, rasters, texts, axes and legend.

    Every `plot_...` returns such axes, and axes of a user's own will do. Values show where the pointer is; colour
    bars come along. Warns of what the axes hold that has no twin. Raises InputError for axes of another kind (polar).
    """
    if ax.name not in ("rectilinear", "3d"):
        raise InputError(f"axes are {ax.name}; twins in plotly are of flat ones and of those in space")
    # Arrows and labels find their place when they are drawn.
    ax.figure.canvas.figure.draw_without_rendering()
    return _twin(ax)


def twins_of(figure: Drawn) -> list[Figure]:
    """The twins of all flat panels of a figure of matplotlib that show something; colour bars come along."""
    figure.draw_without_rendering()
    artists = (artist for ax in figure.axes for artist in (*ax.images, *ax.collections))
    bars = {artist.colorbar.ax for artist in artists if artist.colorbar is not None}
    return [_twin(ax) for ax in figure.axes if ax not in bars and ax.get_visible() and ax.has_data()]


def _twin(ax: Axes) -> Figure:
    # Here, because importing plotly takes half a second that most uses of jaxphoto need not wait for.
    from plotly.graph_objects import Figure

    width, height = _size_px(ax)
    layout: dict[str, Any] = {
        "title": {"text": shown(" ".join(filter(None, (ax.get_title(loc) for loc in ("left", "center", "right")))))},
        "width": round(width),
        "height": round(height),
        "showlegend": ax.get_legend() is not None or bool(ax.figure.legends),
        "barmode": "overlay",
        "template": "simple_white",
    }
    if hasattr(ax, "get_zlim"):
        scene = {f"{a}axis": {"title": {"text": getattr(ax, f"get_{a}label")()}} for a in "xyz"}
        for artist in ax.collections:
            say(artist)
        traces = [trace for line in ax.lines if line.get_visible() for trace in _in_space(line)]
        return Figure(data=traces, layout=layout | {"scene": {"aspectmode": "data", **scene}})
    layout |= {"xaxis": axis_of(ax, "x"), "yaxis": axis_of(ax, "y"), "annotations": list(texts_of(ax))}
    if ax.get_aspect() != "auto":
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": float(ax.get_aspect()), "constrain": "domain"}
        layout["xaxis"] |= {"constrain": "domain"}
    traces = list(_flat(ax))
    if any("QuiverKey" in kinds_of(artist) for artist in ax.artists):
        low, high = layout["yaxis"]["range"]
        layout["yaxis"]["range"] = [low, high + _HEADROOM * (high - low)]
    return Figure(data=traces, layout=layout)


def _size_px(axes: Axes) -> tuple[float, float]:
    """Of the figure that the axes would be alone in."""
    width, height = (_INCHES_PX / axes.figure.dpi * v for v in axes.figure.bbox.size)
    if (spec := axes.get_subplotspec()) is not None:
        top = spec.get_topmost_subplotspec()
        down, across = top.get_gridspec().get_geometry()
        width, height = width * len(top.colspan) / across, height * len(top.rowspan) / down
    return width, height


def _flat(axes: Axes) -> Iterator[Trace]:
    """What the axes hold, the lowest first."""
    bars = {one[0]: one for one in axes.containers if "BarContainer" in kinds_of(one) and one}
    together = {patch for container in bars.values() for patch in container}
    others = {axes.patch, axes.get_legend(), *axes.spines.values(), *(getattr(axes, f"{a}axis") for a in "xy")}
    artist: Any
    for artist in sorted(axes.get_children(), key=lambda a: a.get_zorder()):
        kinds = kinds_of(artist)
        if artist in others or not artist.get_visible() or "Text" in kinds:
            continue
        if "Line2D" in kinds:
            yield from _line(artist, axes)
        elif artist in together:
            if artist in bars:
                yield _bars(bars[artist])
        elif "AxesImage" in kinds and np.ndim(artist.get_array()) == 2:
            yield raster(artist)
        elif "QuiverKey" in kinds:
            yield _key(artist, axes)
        elif "Collection" in kinds:
            yield from _collection(artist, axes)
        elif "Patch" in kinds:
            path = artist.get_path().transformed(artist.get_transform())
            area = _area([path], artist.get_facecolor(), artist.get_edgecolor(), axes, artist.get_linewidth())
            yield area | _named(artist)
        else:
            say(artist)


def _named(artist: Any) -> Trace:
    """Name and place in the legend; those whose label begins with "_" have none."""
    # Of bars together and of points with bars the first member stands for all.
    whole = next((c for c in artist.axes.containers if c and c[0] is artist), artist)
    label = str(whole.get_label())
    return (
        {"name": shown(label), "showlegend": True} if label and label[0] != "_" else {"showlegend": False, "name": ""}
    )


# Lines and markers ---------------------------------------------------------------------------------------------


def _look(line: Any) -> Trace:
    """Mode, line and marker of a line of matplotlib's."""
    marker, drawn = line.get_marker(), line.get_linestyle() not in _NONE and line.get_linewidth() > 0
    look: Trace = {"mode": "+".join(["lines"] * drawn + ["markers"] * (marker not in _NONE)) or "none"}
    if drawn:
        width = line.get_linewidth() * PX
        look["line"] = {
            "color": css(line.get_color(), line.get_alpha()),
            "width": width,
            "dash": _DASHES.get(line.get_linestyle(), "dash"),
        }
    if marker not in _NONE:
        symbol = _MARKERS.get(marker, "circle")
        edge, face = line.get_markeredgecolor(), line.get_markerfacecolor()
        hollow = isinstance(face, str) and face.lower() == "none"
        size = line.get_markersize() * PX * (0.5 if marker == "." else 1.0)
        look["marker"] = {
            "symbol": f"{symbol}-open" if hollow and symbol not in _THIN else symbol,
            "size": size,
            "color": css(edge if hollow or symbol in _THIN else face),
            "line": {"color": css(edge), "width": line.get_markeredgewidth() * PX},
        }
    return look


def _line(line: Any, axes: Axes) -> Iterator[Trace]:
    xy = in_data(np.asarray(line.get_xydata(), float), line.get_transform(), axes)
    if len(xy):
        look = _look(line)
        if "line" in look:
            look["line"]["shape"] = _STEPPED.get(line.get_drawstyle(), "linear")
        yield {"type": "scatter", "x": xy[:, 0], "y": xy[:, 1], **look, **_named(line)}


def _in_space(line: Any) -> Iterator[Trace]:
    x, y, z = (np.asarray(v, float) for v in line.get_data_3d())
    look = _look(line)
    # In space plotly has neither thin signs nor triangles, and draws its signs bold.
    if "marker" in look:
        look["marker"]["size"] *= _BOLD
        known = ("circle", "square", "diamond", "circle-open", "square-open", "diamond-open")
        symbol = look["marker"]["symbol"]
        look["marker"]["symbol"] = {"x-thin": "x", "cross-thin": "cross"}.get(
            symbol, symbol if symbol in known else "diamond"
        )
    yield {"type": "scatter3d", "x": x, "y": y, "z": z, **look, **_named(line)}


def _bars(container: Any) -> Trace:
    """Bars of one kind, upright or lying, which tell how long they are."""
    box: Float[np.ndarray, "n 4"] = np.array([(*p.get_xy(), p.get_width(), p.get_height()) for p in container], float)
    lying = container.orientation == "horizontal"
    x, y, width, height = box.T
    at, base, wide, long = (y, x, height, width) if lying else (x, y, width, height)
    values = (long, at + wide / 2) if lying else (at + wide / 2, long)
    colours, edges = zip(*((css(p.get_facecolor()), css(p.get_edgecolor())) for p in container), strict=True)
    return {
        "type": "bar", "orientation": "h" if lying else "v", "x": values[0], "y": values[1], "width": np.abs(wide),
        "marker": {"color": colours, "line": {"color": edges, "width": container[0].get_linewidth() * PX}},
        **_named(container[0]),
        # From elsewhere than zero plotly would tell where a bar ends.
        **({"base": base, "customdata": long, "hovertemplate": _LENGTH[lying]} if base.any() else {}),
    }  # fmt: skip


# Areas and arrows ----------------------------------------------------------------------------------------------


def _area(paths: list, face: Any, edge: Any, axes: Axes, width: float = 0.75) -> Trace:
    """Paths in pixels of one colour, as lines that are filled where it has a face."""
    rings = [ring for path in paths for ring in path.to_polygons(closed_only=False) if len(ring)]
    gap = np.full((1, 2), np.nan)
    xy = np.concatenate([part for ring in rings for part in (data_of(np.asarray(ring), axes), gap)] or [gap])
    filled = len(face) > 3 and face[3] > 0
    line = {"color": css(edge), "width": width * PX if len(edge) > 3 and edge[3] > 0 else 0.0}
    fill = {"fill": "toself", "fillcolor": css(face)} if filled else {}
    return {
        "type": "scatter", "mode": "lines", "x": xy[:-1, 0], "y": xy[:-1, 1], "line": line,
        "hoverinfo": "skip", "showlegend": False, **fill,
    }  # fmt: skip


def _collection(artist: Any, axes: Axes) -> Iterator[Trace]:
    """Scattered markers as such; all else as areas and lines, those of a colour together, with what they tell."""
    kinds = kinds_of(artist)
    at = in_data(np.ma.filled(np.ma.asarray(artist.get_offsets(), float), np.nan), artist.get_offset_transform(), axes)
    faces, edges = artist.get_facecolor(), artist.get_edgecolor()
    values = artist.get_array()
    if "PathCollection" in kinds:
        # Of markers without a face the edge is what shows.
        seen, sizes = faces if len(faces) else edges, np.sqrt(artist.get_sizes()) * PX
        colour: Any = [css(c) for c in seen] if len(seen) > 1 else css(seen[0] if len(seen) else (0, 0, 0, 0))
        marker: Trace = {"color": colour, "size": float(sizes[0]) if len(sizes) == 1 else np.resize(sizes, len(at))}
        marker["symbol"] = "circle" if len(faces) else "circle-open"
        told: Trace = {}
        if values is not None:
            marker |= {"color": np.ma.filled(values, np.nan), **colour_scale(artist, "c")}
            told = {"hovertemplate": "x %{x}, y %{y}<br>%{marker.color:.3g}<extra></extra>"}
            # What is pale has an edge.
            marker |= {"line": {"color": css(edges[0]), "width": 1}} if len(edges) == 1 else {}
        dots = {"type": "scatter", "mode": "markers", "x": at[:, 0], "y": at[:, 1], "marker": marker}
        yield dots | _named(artist) | told
        return
    width = float(np.max(artist.get_linewidth(), initial=0.0))
    together: dict[tuple, list] = defaultdict(list)
    filled = "ContourSet" in kinds and artist.filled
    bands = [f"{a:.3g} to {b:.3g}" for a, b in pairwise(artist.levels)] if filled else []
    words: dict[tuple, str] = {}
    for k, path in enumerate(_paths(artist)):
        face, edge = (tuple(c[k % len(c)]) if len(c) else (0.0, 0.0, 0.0, 0.0) for c in (faces, edges))
        together[face, edge].append(path)
        words |= {(face, edge): bands[k]} if k < len(bands) else {}
    name = _named(artist)
    for (face, edge), paths in together.items():
        band = {"hoverinfo": "text", "hoveron": "fills", "text": words[face, edge]} if words else {}
        yield _area(paths, face, edge, axes, width) | name | band
        name = {"showlegend": False}
    if "Quiver" in kinds:
        arrows = np.stack([np.ma.filled(v, np.nan) for v in (artist.U, artist.V)], axis=1)
        trace = _told(
            at, arrows, "x %{x:.5g}, y %{y:.5g}<br>(%{customdata[0]:.3g}, %{customdata[1]:.3g})<extra></extra>"
        )
        if values is not None:
            trace["marker"] |= {
                "color": np.ma.filled(np.ma.asarray(values, float), np.nan),
                **colour_scale(artist, "c"),
            }
        yield trace
    elif values is not None and np.ndim(values) == 1 and len(values) == len(at) and "ContourSet" not in kinds:
        known: np.ndarray = np.ma.filled(np.ma.asarray(values, float), np.nan)
        trace = _told(at, known[:, None], "x %{x:.5g}, y %{y:.5g}<br>%{customdata[0]:.3g}<extra></extra>")
        yield trace | {"marker": {"color": known, "opacity": 0.0, **colour_scale(artist, "c")}}
    elif artist.colorbar is not None:
        yield _told(np.full((1, 2), np.nan), np.zeros((1, 1)), "") | {
            "marker": {"color": [0.0], **colour_scale(artist, "c")}
        }


def _paths(artist: Any) -> Iterator[Any]:
    """Of each member its path in pixels."""
    paths, own, place = artist.get_paths(), artist.get_transforms(), artist.get_transform()
    offsets = artist.get_offset_transform().transform(np.ma.filled(np.ma.asarray(artist.get_offsets(), float), np.nan))
    for k in range(max(len(paths), len(offsets), len(own)) if len(paths) else 0):
        path, moved = paths[k % len(paths)], offsets[k % len(offsets)] if len(offsets) else np.zeros(2)
        turned = own[k % len(own)] if len(own) else np.eye(3)
        if np.isfinite(moved).all():
            yield _moved(_moved(path, turned[:2, :2], turned[:2, 2]).transformed(place), np.eye(2), moved)


def _moved(path: Any, turn: Float[np.ndarray, "2 2"], by: Float[np.ndarray, 2]) -> Any:
    """A path of matplotlib's, turned and shifted."""
    return type(path)(path.vertices @ turn.T + by, path.codes)


def _told(at: np.ndarray, told: np.ndarray, words: str) -> Trace:
    """What shows where the pointer is, of marks that do not."""
    return {
        "type": "scatter", "mode": "markers", "x": at[:, 0], "y": at[:, 1], "customdata": told, "hovertemplate": words,
        "marker": {"opacity": 0.0}, "showlegend": False,
    }  # fmt: skip


def _key(key: Any, axes: Axes) -> Trace:
    """The arrow that tells the scale, above the picture on the left, with its text."""
    arrow = next(_paths(key.vector))
    tail = np.zeros(2) if not len(arrow.vertices) else arrow.vertices[:-1].min(axis=0)
    corner = axes.transAxes.transform((0.03, 1.0 + _HEADROOM / 2))
    colour = key.vector.get_facecolor()[0]
    area = _area([_moved(arrow, np.eye(2), corner - tail)], tuple(colour), tuple(colour), axes)
    end = float(np.nanmax(area["x"]))
    words = shown(key.text.get_text())
    return area | {
        "mode": "lines+text",
        "x": np.append(area["x"], [np.nan, end]),
        "y": np.append(area["y"], [np.nan, area["y"][0]]),
        "text": [""] * (len(area["x"]) + 1) + [f"  {words}"],
        "textposition": "middle right",
        "textfont": {"color": css(colour)},
    }
