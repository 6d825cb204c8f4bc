"""Any picture that matplotlib draws here as a figure of plotly, which zooms and answers: its twin.

Nothing is drawn twice: what the axes hold is taken from them, in the coordinates of the data.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Transform
    from plotly.graph_objects import Figure

Trace = dict[str, Any]

_DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
_MARKERS = {
    "o": "circle", ".": "circle", "s": "square", "D": "diamond", "^": "triangle-up", "v": "triangle-down",
    "<": "triangle-left", ">": "triangle-right", "*": "star", "x": "x-thin", "+": "cross-thin",
}  # fmt: skip
# Thin ones have no face: their line is what shows.
_THIN = ("x-thin", "cross-thin")
_NONE = ("", " ", "None", "none", None)
# A point of matplotlib's, 1/72 inch, in pixels of a browser, 1/96.
_PX = 96 / 72
# Steps of a colour scale: finer than an eye tells apart.
_STEPS = 64
_INCHES_PX = 96
# Size of a sign in space, over that of the same on paper.
_BOLD = 0.6


def to_plotly(axes: Axes) -> Figure:
    """The twin of matplotlib axes, flat or in space: lines, markers, arrows, areas, rasters, texts, axes and legend.

    Every `plot_...` returns such axes, and axes of a user's own will do. Values show where the pointer is; colour
    bars come along. Warns of what the axes hold that has no twin.
    """
    # Here, because importing plotly takes half a second that most uses of jaxphoto need not wait for.
    from plotly.graph_objects import Figure

    # Arrows and labels find their place when they are drawn.
    axes.figure.canvas.draw()
    width, height = (_INCHES_PX / axes.figure.dpi * v for v in axes.figure.bbox.size)
    layout: dict[str, Any] = {
        "title": {"text": _shown(" ".join(filter(None, (axes.get_title(loc) for loc in ("left", "center", "right")))))},
        "width": round(width),
        "height": round(height),
        "showlegend": axes.get_legend() is not None,
        "template": "simple_white",
    }
    if hasattr(axes, "get_zlim"):
        scene = {f"{a}axis": {"title": {"text": getattr(axes, f"get_{a}label")()}} for a in "xyz"}
        traces = [trace for line in axes.lines for trace in _in_space(line)]
        return Figure(data=traces, layout=layout | {"scene": {"aspectmode": "data", **scene}})
    layout |= {"xaxis": _axis(axes, "x"), "yaxis": _axis(axes, "y"), "annotations": list(_texts(axes))}
    if axes.get_aspect() != "auto":
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": float(axes.get_aspect())}
    return Figure(data=list(_flat(axes)), layout=layout)


def _flat(axes: Axes) -> Iterator[Trace]:
    """What the axes hold, the lowest first."""
    others = {axes.patch, axes.get_legend(), *axes.spines.values(), *(getattr(axes, f"{a}axis") for a in "xy")}
    artist: Any
    for artist in sorted(axes.get_children(), key=lambda a: a.get_zorder()):
        kinds = _kinds(artist)
        if artist in others or not artist.get_visible() or "Text" in kinds:
            continue
        if "Line2D" in kinds:
            yield from _line(artist, axes)
        elif "AxesImage" in kinds:
            yield _raster(artist)
        elif "QuiverKey" in kinds:
            yield _key(artist, axes)
        elif "Collection" in kinds:
            yield from _collection(artist, axes)
        elif "Patch" in kinds:
            path = artist.get_path().transformed(artist.get_transform())
            yield _area([path], artist.get_facecolor(), artist.get_edgecolor(), axes)
        else:
            warnings.warn(f"{type(artist).__name__} has no twin in plotly: it is not shown", stacklevel=3)


def _kinds(artist: Any) -> set[str]:
    """The names of its classes in matplotlib, which is not imported for that: whoever has axes has done so."""
    return {kind.__name__ for kind in type(artist).__mro__ if kind.__module__.startswith("matplotlib.")}


def _data(pixels: Float[np.ndarray, "n 2"], axes: Axes) -> Float[np.ndarray, "n 2"]:
    """Pixels of the drawn picture in the coordinates of the data."""
    return axes.transData.inverted().transform(pixels)


def _in_data(xy: Float[np.ndarray, "n 2"], transform: Transform, axes: Axes) -> Float[np.ndarray, "n 2"]:
    return xy if transform == axes.transData else _data(transform.transform(xy), axes)


def _css(colour: Any, alpha: float | None = None) -> str:
    from matplotlib.colors import to_rgba

    red, green, blue, opacity = to_rgba(colour, alpha)
    return f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{opacity:.3g})"


def _shown(text: str) -> str:
    """Of matplotlib's text what a browser shows: no formula but a bare sign of dollar."""
    return text.replace(r"\$", "$").replace("\n", "<br>")


def _named(artist: Any) -> Trace:
    """Name and place in the legend; those whose label begins with "_" have none."""
    label = str(artist.get_label())
    return {"name": _shown(label), "showlegend": True} if label and label[0] != "_" else {"showlegend": False}


# Lines and markers ---------------------------------------------------------------------------------------------


def _look(line: Any) -> Trace:
    """Mode, line and marker of a line of matplotlib's."""
    marker, drawn = line.get_marker(), line.get_linestyle() not in _NONE and line.get_linewidth() > 0
    look: Trace = {"mode": "+".join(["lines"] * drawn + ["markers"] * (marker not in _NONE)) or "none"}
    if drawn:
        width = line.get_linewidth() * _PX
        look["line"] = {
            "color": _css(line.get_color(), line.get_alpha()),
            "width": width,
            "dash": _DASHES.get(line.get_linestyle(), "dash"),
        }
    if marker not in _NONE:
        symbol = _MARKERS.get(marker, "circle")
        edge, face = line.get_markeredgecolor(), line.get_markerfacecolor()
        hollow = isinstance(face, str) and face.lower() == "none"
        size = line.get_markersize() * _PX * (0.5 if marker == "." else 1.0)
        look["marker"] = {
            "symbol": f"{symbol}-open" if hollow and symbol not in _THIN else symbol,
            "size": size,
            "color": _css(edge if hollow or symbol in _THIN else face),
            "line": {"color": _css(edge), "width": line.get_markeredgewidth() * _PX},
        }
    return look


def _line(line: Any, axes: Axes) -> Iterator[Trace]:
    xy = _in_data(np.asarray(line.get_xydata(), float), line.get_transform(), axes)
    if len(xy):
        shape = "hv" if line.get_drawstyle() == "steps-post" else "linear"
        look = _look(line)
        if "line" in look:
            look["line"]["shape"] = shape
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


# Areas and arrows ----------------------------------------------------------------------------------------------


def _area(paths: list, face: Any, edge: Any, axes: Axes) -> Trace:
    """Paths in pixels of one colour, as lines that are filled where it has a face."""
    rings = [ring for path in paths for ring in path.to_polygons(closed_only=False) if len(ring)]
    gap = np.full((1, 2), np.nan)
    xy = np.concatenate([part for ring in rings for part in (_data(np.asarray(ring), axes), gap)] or [gap])
    filled = len(face) > 3 and face[3] > 0
    line = {"color": _css(edge), "width": 1.0 if len(edge) > 3 and edge[3] > 0 else 0.0}
    fill = {"fill": "toself", "fillcolor": _css(face)} if filled else {}
    return {
        "type": "scatter", "mode": "lines", "x": xy[:-1, 0], "y": xy[:-1, 1], "line": line,
        "hoverinfo": "skip", "showlegend": False, **fill,
    }  # fmt: skip


def _collection(artist: Any, axes: Axes) -> Iterator[Trace]:
    """Scattered markers as such; all else as areas and lines, those of a colour together, with what they tell."""
    kinds = _kinds(artist)
    at = _in_data(np.ma.filled(np.ma.asarray(artist.get_offsets(), float), np.nan), artist.get_offset_transform(), axes)
    faces, edges = artist.get_facecolor(), artist.get_edgecolor()
    values = artist.get_array()
    if "PathCollection" in kinds:
        colour: Any = [_css(c) for c in faces] if len(faces) > 1 else _css(faces[0] if len(faces) else edges[0])
        marker: Trace = {"color": colour, "size": np.sqrt(artist.get_sizes()) * _PX}
        if values is not None:
            marker |= {"color": np.ma.filled(values, np.nan), **_scale(artist, "c")}
        yield {"type": "scatter", "mode": "markers", "x": at[:, 0], "y": at[:, 1], "marker": marker, **_named(artist)}
        return
    together: dict[tuple, list] = defaultdict(list)
    for k, path in enumerate(_paths(artist)):
        face, edge = (tuple(c[k % len(c)]) if len(c) else (0.0, 0.0, 0.0, 0.0) for c in (faces, edges))
        together[face, edge].append(path)
    name = _named(artist)
    for (face, edge), paths in together.items():
        yield _area(paths, face, edge, axes) | name
        name = {"showlegend": False}
    if "Quiver" in kinds:
        told = np.stack([np.ma.filled(v, np.nan) for v in (artist.U, artist.V)], axis=1)
        yield _told(at, told, "x %{x:.5g}, y %{y:.5g}<br>(%{customdata[0]:.3g}, %{customdata[1]:.3g})<extra></extra>")
    elif values is not None and len(values) == len(at):
        told = np.ma.filled(np.ma.asarray(values, float), np.nan)
        trace = _told(at, told[:, None], "x %{x:.5g}, y %{y:.5g}<br>%{customdata[0]:.3g}<extra></extra>")
        yield trace | {"marker": {"color": told, "opacity": 0.0, **_scale(artist, "c")}}
    elif artist.colorbar is not None:
        yield _told(np.full((1, 2), np.nan), np.zeros((1, 1)), "") | {"marker": {"color": [0.0], **_scale(artist, "c")}}


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
    """The arrow that tells the scale, at the top left of the picture, with its text."""
    arrow = next(_paths(key.vector))
    tail = np.zeros(2) if not len(arrow.vertices) else arrow.vertices[:-1].min(axis=0)
    corner = axes.transAxes.transform((0.03, 0.95))
    colour = key.vector.get_facecolor()[0]
    area = _area([_moved(arrow, np.eye(2), corner - tail)], tuple(colour), tuple(colour), axes)
    place = np.array([[area["x"][0], area["y"][0]]])
    end = float(np.nanmax(area["x"]))
    words = _shown(key.text.get_text())
    return area | {
        "mode": "lines+text",
        "x": np.append(area["x"], [np.nan, end]),
        "y": np.append(area["y"], [np.nan, place[0, 1]]),
        "text": [""] * (len(area["x"]) + 1) + [f"  {words}"],
        "textposition": "middle right",
    }


# Rasters, axes, texts --------------------------------------------------------------------------------------------


def _scale(artist: Any, kind: str) -> Trace:
    """Colours of values, and the bar that explains them where the picture has one."""
    low, high = artist.get_clim()
    # By value: norms that are not linear have their colours where they have them.
    at = np.linspace(0.0, 1.0, _STEPS)
    scale: Trace = {"colorscale": [[float(a), _css(artist.to_rgba(low + a * (high - low)))] for a in at]}
    scale |= {f"{kind}min": low, f"{kind}max": high, "showscale": artist.colorbar is not None}
    if artist.colorbar is not None:
        bar = artist.colorbar.ax
        scale["colorbar"] = {"title": {"text": _shown(bar.get_ylabel() or bar.get_xlabel()), "side": "right"}}
    return scale


def _raster(image: Any) -> Trace:
    z: Float[np.ndarray, "down across"] = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    left, right, bottom, top = image.get_extent()
    first, last = (top, bottom) if image.origin == "upper" else (bottom, top)

    def middles(a: float, b: float, n: int) -> np.ndarray:
        return a + (b - a) * (np.arange(n) + 0.5) / n

    x, y = middles(left, right, z.shape[1]), middles(first, last, z.shape[0])
    return {"type": "heatmap", "x": x, "y": y, "z": z, "hoverongaps": False, **_scale(image, "z")}


def _axis(axes: Axes, which: str) -> Trace:
    """Title, range, kind and, where they are words, the ticks of an axis."""
    limits = np.asarray(getattr(axes, f"get_{which}lim")(), float)
    own = getattr(axes, f"{which}axis")
    logarithmic = own.get_scale() == "log"
    found: Trace = {
        "title": {"text": _shown(own.get_label_text())},
        "range": (np.log10(limits) if logarithmic else limits).tolist(),
        "type": "log" if logarithmic else "linear",
        "visible": bool(axes.axison and own.get_visible()),
    }
    if _kinds(own.get_major_formatter()) & {"FixedFormatter", "FuncFormatter"}:
        ticks = [
            (float(v), _shown(t.get_text())) for v, t in zip(own.get_ticklocs(), own.get_ticklabels(), strict=False)
        ]
        found |= {"tickvals": [v for v, _ in ticks], "ticktext": [t for _, t in ticks]}
    return found


def _texts(axes: Axes) -> Iterator[Trace]:
    """Texts in the picture; those that are placed by its frame stay there."""
    ends = {"left": "left", "right": "right", "center": "center"}
    levels = {"top": "top", "bottom": "bottom", "center": "middle", "center_baseline": "middle", "baseline": "bottom"}
    for text in axes.texts:
        if not text.get_visible() or not text.get_text():
            continue
        by_frame = text.get_transform() == axes.transAxes
        x, y = text.get_position()
        if not by_frame:
            ((x, y),) = _in_data(np.array([[x, y]], float), text.get_transform(), axes)
        yield {
            "x": float(x), "y": float(y), "text": _shown(text.get_text()), "showarrow": False,
            "xref": "x domain" if by_frame else "x", "yref": "y domain" if by_frame else "y",
            "xanchor": ends[text.get_horizontalalignment()], "yanchor": levels[text.get_verticalalignment()],
            "textangle": -float(text.get_rotation()),
            "font": {"size": float(text.get_fontsize()) * _PX, "color": _css(text.get_color())},
        }  # fmt: skip
