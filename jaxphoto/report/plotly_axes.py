"""What a twin in plotly takes from matplotlib axes beside what is drawn: colours, places, axes, texts, colour bars."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Transform

Trace = dict[str, Any]

# A point of matplotlib's, 1/72 inch, in pixels of a browser, 1/96.
PX = 96 / 72
# Steps of a colour scale: finer than an eye tells apart.
_STEPS = 64
# Width of a colour bar in pixels.
_BAR = 14
# Below, numbers at an axis have an exponent.
_SMALL = 1e-3
_DIGITS, _MOST_DIGITS = 3, 15


def say(artist: Any) -> None:
    """Warn that it has no twin."""
    warnings.warn(f"{type(artist).__name__} has no twin in plotly: it is not shown", stacklevel=5)


def kinds_of(artist: Any) -> set[str]:
    """The names of its classes in matplotlib, which is not imported for that: whoever has axes has done so."""
    return {kind.__name__ for kind in type(artist).__mro__ if kind.__module__.startswith("matplotlib.")}


def data_of(pixels: Float[np.ndarray, "n 2"], axes: Axes) -> Float[np.ndarray, "n 2"]:
    """Pixels of the drawn picture in the coordinates of the data."""
    return axes.transData.inverted().transform(pixels)


def in_data(xy: Float[np.ndarray, "n 2"], transform: Transform, axes: Axes) -> Float[np.ndarray, "n 2"]:
    """What is placed by a transform of matplotlib's in the coordinates of the data."""
    return xy if transform == axes.transData else data_of(transform.transform(xy), axes)


def css(colour: Any, alpha: float | None = None) -> str:
    """Any colour of matplotlib's as a browser writes it."""
    from matplotlib.colors import to_rgba

    red, green, blue, opacity = to_rgba(colour, alpha)
    return f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{opacity:.3g})"


def shown(text: str) -> str:
    """Of matplotlib's text what a browser shows: no formula but a bare sign of dollar."""
    return text.replace(r"\$", "$").replace("\n", "<br>")


def colour_scale(artist: Any, kind: str) -> Trace:
    """Colours of values, and the bar that explains them where the picture has one."""
    # Of no values there are none.
    low, high = (limit if v is None else float(v) for limit, v in zip((0.0, 1.0), artist.get_clim(), strict=True))
    # By value: norms that are not linear have their colours where they have them.
    at = np.linspace(0.0, 1.0, _STEPS)
    scale: Trace = {"colorscale": [[float(a), css(artist.to_rgba(low + a * (high - low)))] for a in at]}
    scale |= {f"{kind}min": low, f"{kind}max": high, "showscale": artist.colorbar is not None}
    if artist.colorbar is not None:
        bar = artist.colorbar.ax
        scale["colorbar"] = {
            "title": {"text": shown(bar.get_ylabel() or bar.get_xlabel()), "side": "right"},
            "thickness": _BAR,
            "outlinewidth": 0,
        }
    return scale


def raster(image: Any) -> Trace:
    """An image of values as a heat map, its rows where matplotlib has them."""
    z: Float[np.ndarray, "down across"] = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    left, right, bottom, top = image.get_extent()
    first, last = (top, bottom) if image.origin == "upper" else (bottom, top)

    def middles(a: float, b: float, n: int) -> np.ndarray:
        return a + (b - a) * (np.arange(n) + 0.5) / n

    x, y = middles(left, right, z.shape[1]), middles(first, last, z.shape[0])
    return {"type": "heatmap", "x": x, "y": y, "z": z, "hoverongaps": False, **colour_scale(image, "z")}


def axis_of(axes: Axes, which: str) -> Trace:
    """Title, range, kind and, where they are words, the ticks of an axis."""
    limits = np.asarray(getattr(axes, f"get_{which}lim")(), float)
    own = getattr(axes, f"{which}axis")
    logarithmic = own.get_scale() == "log"
    if own.get_scale() not in ("linear", "log"):
        warnings.warn(f"an axis of kind {own.get_scale()} is shown as a linear one", stacklevel=4)
    found: Trace = {
        "title": {"text": shown(own.get_label_text())},
        "range": (np.log10(limits) if logarithmic else limits).tolist(),
        "type": "log" if logarithmic else "linear",
        "visible": bool(axes.axison and own.get_visible()),
        # Coordinates with all of their digits: not 5.4M.
        "exponentformat": "none" if np.abs(limits).max() > _SMALL else "power",
    }
    # Of what the axis spans, four digits where the pointer is.
    if not logarithmic and 0 < (span := float(abs(limits[1] - limits[0]))) < np.inf:
        found["hoverformat"] = f".{int(np.clip(_DIGITS - np.floor(np.log10(span)), 0, _MOST_DIGITS))}f"
    # What plotly writes by itself is as good; words, dates and percentages are matplotlib's.
    if not kinds_of(own.get_major_formatter()) & {"ScalarFormatter", "LogFormatter", "NullFormatter"}:
        places = own.get_ticklocs()
        # Of panels that share an axis those without words have them, too.
        words = own.get_major_formatter().format_ticks(places)
        found |= {"tickvals": list(map(float, places)), "ticktext": list(map(shown, words))}
    return found


def texts_of(axes: Axes) -> Iterator[Trace]:
    """Texts in the picture; those that are placed by its frame stay there."""
    ends = {"left": "left", "right": "right", "center": "center"}
    levels = {"top": "top", "bottom": "bottom", "center": "middle", "center_baseline": "middle", "baseline": "bottom"}
    for text in axes.texts:
        if not text.get_visible() or not text.get_text():
            continue
        by_frame = text.get_transform() == axes.transAxes
        x, y = text.get_position()
        if not by_frame:
            ((x, y),) = in_data(np.array([[x, y]], float), text.get_transform(), axes)
            # Of logarithmic axes plotly wants the logarithms here, though nowhere else.
            x, y = (np.log10(v) if s == "log" else v for v, s in ((x, axes.get_xscale()), (y, axes.get_yscale())))
        if (arrow := getattr(text, "arrow_patch", None)) is not None:
            say(arrow)
        yield {
            "x": float(x), "y": float(y), "text": shown(text.get_text()), "showarrow": False,
            "xref": "x domain" if by_frame else "x", "yref": "y domain" if by_frame else "y",
            "xanchor": ends[text.get_horizontalalignment()], "yanchor": levels[text.get_verticalalignment()],
            "textangle": -float(text.get_rotation()),
            "font": {"size": float(text.get_fontsize()) * PX, "color": css(text.get_color())},
        }  # fmt: skip
