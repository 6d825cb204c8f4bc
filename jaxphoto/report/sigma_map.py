"""Pictures of the sigma map: how well a calibrated camera says where a point is seen, over its format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.camera import Sensor
from jaxphoto.errors import camera_words
from jaxphoto.report.plots import new_figure
from jaxphoto.report.tables import Tables
from jaxphoto.statistics.sigma_map import SigmaMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Lines are drawn at these times powers of ten: at the first of the rows that gives as many as this.
_LINES = 5
_ROUND = (
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0),
    (*np.arange(1.0, 2.0, 0.1), *np.arange(2.0, 5.0, 0.2), *np.arange(5.0, 10.0, 0.5)),
)


def sigma_map_figure(tables: Tables, camera: str) -> Figure:
    """The maps of one camera side by side, in the same colours."""
    sensor, maps = tables.adjusted.block.sensors[camera], tables.sigma_maps[camera]
    upright = sensor.height_px > sensor.width_px
    figure = new_figure(3.4 * len(maps) + 0.9 if upright else 4.7 * len(maps) + 0.8, 4.6 if upright else 3.4)
    panels = figure.subplots(1, len(maps), squeeze=False, sharey=True)[0]
    levels = _levels(sensor, *maps)
    for axes, one in zip(panels, maps, strict=True):
        _draw(axes, sensor, one, levels)
        axes.label_outer()
    _colour_bar(panels.tolist(), levels)
    return figure


def sigma_map_words(sensor: Sensor, maps: Sequence[SigmaMap]) -> str:
    """Middle and worst cell of each map in a sentence."""
    told = []
    for one in maps:
        worst = one.worst[np.isfinite(one.worst)] / sensor.pixel_mm
        spread = "not known anywhere"
        if len(worst):
            spread = f"{np.median(worst):.2g} px in the middle of all cells, {worst.max():.2g} px in the worst"
        told.append(f"{words_of_distance(one.distance_m)} {spread}")
    return f"{camera_words(maps[0].camera)}: sigma {'; '.join(told)}."


def draw_sigma_map(axes: Axes, sensor: Sensor, one: SigmaMap) -> Axes:
    """Standard deviation in its worst direction (px) as colours, with lines at round numbers."""
    levels = _levels(sensor, one)
    _draw(axes, sensor, one, levels)
    _colour_bar([axes], levels)
    return axes


def _draw(axes: Axes, sensor: Sensor, one: SigmaMap, levels: list[float]) -> None:
    x, y = (np.unique(v) for v in one.points.T)
    if len(x) * len(y) != len(one.points):
        raise ValueError("a map is drawn of cells in rows and columns")
    worst = np.ma.masked_invalid(one.worst.reshape(len(y), len(x)) / sensor.pixel_mm)
    if levels and worst.count():
        axes.contourf(x, y, worst, levels=levels, cmap="cividis", norm="log")
        lines = axes.contour(x, y, worst, levels=levels, colors="white", linewidths=0.7)
        axes.clabel(lines, fmt="%g", fontsize=8)
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.set_title(f"sigma {words_of_distance(one.distance_m)}", loc="left", fontsize=10)


def words_of_distance(distance_m: float) -> str:
    """Such as "of a point at 1050 m"."""
    if np.isinf(distance_m):
        return "of a ray (a point at infinity)"
    return f"of a point at {distance_m:.0f} m" if distance_m >= 100 else f"of a point at {distance_m:.3g} m"


def _colour_bar(axes: list[Axes], levels: list[float]) -> None:
    shown = [c for one in axes for c in one.collections if c.get_array() is not None]
    if shown:
        bar = axes[0].figure.colorbar(shown[0], ax=axes, shrink=0.9, ticks=levels, format="%g")
        bar.ax.minorticks_off()
        bar.set_label("worst direction [px]")


def _levels(sensor: Sensor, *maps: SigmaMap) -> list[float]:
    """Round numbers between the least and the largest of the maps (px), of equal ratio as nearly as may be."""
    worst = np.concatenate([one.worst for one in maps]) / sensor.pixel_mm
    worst = worst[np.isfinite(worst) & (worst > 0)]
    if not len(worst):
        return []
    low, high = worst.min(), worst.max()
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    rounds = (np.round(np.outer(powers, steps).ravel(), 12) for steps in _ROUND)
    inside = next((r for r in rounds if ((low < r) & (r < high)).sum() >= _LINES), np.array([low, high]))
    # From the last that is below to the first that is above, so that all of the map has a colour.
    first, last = np.searchsorted(inside, low, "right") - 1, np.searchsorted(inside, high, "left")
    return [float(k) for k in inside[max(first, 0) : last + 1]]
