"""Pictures of a strip adjustment: gaps of strips, what scanner and camera have in common, errors of the trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.lidar.raster import Raster
from jaxphoto.procedures.lidar import StripAdjustment
from jaxphoto.report.plots import axes_or_new, drawn, heat_map, new_figure
from jaxphoto.report.strips import all_correlations, errors_along

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_GAP = "later strip above earlier (cm)"
# Curves are drawn at so many places from knot to knot.
_PLACES = 12
# Strips side by side in a row of panels.
_ABREAST = 4
_COMPONENTS = (("position (cm)", 100.0, ("X", "Y", "Z")), ("attitude (mdeg)", 1000.0, ("right", "forward", "up")))
# Okabe and Ito (2008): told apart by the colour-blind, too.
_COLOURS = ("#0072B2", "#E69F00", "#009E73")


def differences_figure(before: Raster, after: Raster) -> Figure:
    """Gaps of strips over the ground before and after, in the same colours, which reach 95 % of those before."""
    figure = new_figure(10.0, 4.6)
    both = figure.subplots(1, 2, sharex=True, sharey=True)
    limit = _limit(before)
    for axes, raster, name in zip(both, (before, after), ("before", "after"), strict=True):
        shown = _draw_differences(axes, raster, limit)
        axes.set_title(f"{name}: {axes.get_title(loc='left')}", loc="left")
    both[0].set_ylabel("Y (m)")
    figure.colorbar(shown, ax=list(both), label=_GAP, shrink=0.8)
    return figure


def plot_strip_differences(gaps: Raster, ax: Axes | None = None, *, limit_m: float | None = None) -> Axes:
    """Gaps of strips over the ground (`lidar.strip_differences`), in colours up to `limit_m`.

    Without a limit they reach 95 % of the gaps; give that of before to those after, and colours mean the same.
    """
    ax = axes_or_new(ax)
    shown = _draw_differences(ax, gaps, _limit(gaps) if limit_m is None else 100 * limit_m)
    ax.set_ylabel("Y (m)")
    ax.figure.colorbar(shown, ax=ax, label=_GAP, shrink=0.8)
    return ax


def _limit(gaps: Raster) -> float:
    return 100 * float(np.nanpercentile(np.abs(gaps.heights), 95)) or 1.0


def _draw_differences(axes: Axes, gaps: Raster, limit: float) -> AxesImage:
    """In centimetres, as is `limit`."""
    (west, south), (east, north) = gaps.extent
    shown = axes.imshow(100 * gaps.heights, extent=(west, east, south, north), cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.set_title(f"{100 * float(np.sqrt(np.nanmean(gaps.heights**2))):.2g} cm RMS", loc="left")
    axes.set(xlabel="X (m)", aspect="equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    return shown


def scanner_correlation_figure(result: StripAdjustment) -> Figure:
    """What is estimated of the scanner against cameras and mounts, and against itself: a heat map each."""
    rho, scanner, others = _scanner_and_others(result)
    sets = [("scanner with camera and mount", others), ("scanner with itself", scanner)]
    shown = [(title, names) for title, names in sets if names]
    wide = sum(len(names) for _, names in shown)
    figure = new_figure(3.4 + 0.52 * wide, 1.9 + 0.33 * len(scanner))
    many = figure.subplots(1, len(shown), sharey=True, squeeze=False, width_ratios=[len(n) for _, n in shown])[0]
    for axes, (title, names) in zip(many, shown, strict=True):
        heat_map(axes, rho.loc[scanner, names].to_numpy(), _short(scanner), _short(names), title)
    figure.colorbar(many[0].images[0], ax=list(many), shrink=0.9)
    return figure


def trajectory_errors_figure(result: StripAdjustment) -> Figure:
    """What the trajectory was off by along each strip, with bands of two standard deviations."""
    names = result.cloud.strips
    rows = 2 * -(-len(names) // _ABREAST)
    columns = min(len(names), _ABREAST)
    figure = new_figure(1.2 + 2.6 * columns, 0.6 + 1.9 * rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=False)
    for k, name in enumerate(names):
        for part, (unit, _, _) in enumerate(_COMPONENTS):
            panel = panels[2 * (k // _ABREAST) + part, k % _ABREAST]
            _draw_errors(panel, result, k, part)
            if part == 0:
                panel.set_title(f"strip {drawn(name)}", loc="left", fontsize=10)
            else:
                panel.set_xlabel("time (s)", fontsize=8)
            if k % _ABREAST == 0:
                panel.set_ylabel(unit, fontsize=8)
                panel.legend(fontsize=7, loc="best")
            panel.tick_params(labelsize=7)
    for panel in panels.flat:
        panel.set_visible(panel.has_data())
    return figure


def plot_trajectory_errors(
    result: StripAdjustment, strip: str, ax: Axes | None = None, *, attitude: bool = False
) -> Axes:
    """What the position (cm), or the `attitude` (mdeg), was off by along a strip, with bands of two sigmas.

    Raises InputError for a strip that there is not.
    """
    if strip not in result.cloud.strips:
        raise InputError(f"there is no strip {strip!r}; there are {', '.join(result.cloud.strips)}")
    ax = axes_or_new(ax)
    _draw_errors(ax, result, result.cloud.strips.index(strip), int(attitude))
    ax.set_title(f"strip {drawn(strip)}", loc="left", fontsize=10)
    ax.set(xlabel="time (s)", ylabel=_COMPONENTS[attitude][0])
    ax.legend(fontsize=7)
    return ax


def _draw_errors(axes: Axes, result: StripAdjustment, strip: int, part: int) -> None:
    """Of one strip one of `_COMPONENTS`."""
    spline, (_, factor, names) = result.errors.splines[strip], _COMPONENTS[part]
    time = np.linspace(spline.times[0], spline.times[-1], _PLACES * spline.size)
    value, sigma = errors_along(result, strip, time)
    for c, (axis, colour) in enumerate(zip(names, _COLOURS, strict=True)):
        v, s = factor * value[:, 3 * part + c], 2 * factor * sigma[:, 3 * part + c]
        axes.fill_between(time, v - s, v + s, color=colour, alpha=0.18, lw=0)
        axes.plot(time, v, color=colour, lw=1.3, label=axis)


def plot_scanner_correlation(result: StripAdjustment, ax: Axes | None = None, *, itself: bool = False) -> Axes:
    """Correlations of the scanner with cameras and mounts, or with `itself`, in colours and numbers.

    Raises InputError where nothing of these is estimated.
    """
    rho, scanner, others = _scanner_and_others(result)
    columns = scanner if itself else others
    if not scanner or not columns:
        raise InputError(f"nothing of {'the scanner' if not scanner else 'cameras and mounts'} is estimated here")
    ax = axes_or_new(ax)
    title = f"scanner with {'itself' if itself else 'camera and mount'}"
    heat_map(ax, rho.loc[scanner, columns].to_numpy(), _short(scanner), _short(columns), title)
    return ax


def _scanner_and_others(result: StripAdjustment) -> tuple[pd.DataFrame, list[str], list[str]]:
    """All correlations, and which unknowns are of the scanner, which of cameras and mounts."""
    rho = all_correlations(result)
    labels = [name for name in rho.index if not name.startswith(TrajectoryKnot.kind)]
    scanner = [name for name in labels if name.startswith("scanner")]
    return rho, scanner, [name for name in labels if name not in scanner]


def _short(labels: list[str]) -> list[str]:
    """Labels without their units, and without the names of their owners where one alone is so called."""
    short = [name.split(".")[-1].removesuffix("_rad") for name in labels]
    owners = [name.rsplit(".", 1)[0].partition("[")[2].removesuffix("]") for name in labels]
    return [f"{own} {name}" if short.count(name) > 1 and own else name for own, name in zip(owners, short, strict=True)]
