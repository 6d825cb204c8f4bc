"""Pictures of a strip adjustment: gaps of strips, what scanner and camera have in common, errors of the trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.lidar.raster import Raster
from jaxphoto.procedures.lidar import StripAdjustment
from jaxphoto.report.plots import drawn, heat_map, new_figure
from jaxphoto.report.strips import all_correlations, errors_along

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    limit = 100 * float(np.nanpercentile(np.abs(before.heights), 95)) or 1.0
    for axes, raster, name in zip(both, (before, after), ("before", "after"), strict=True):
        (west, south), (east, north) = raster.extent
        shown = axes.imshow(
            100 * raster.heights, extent=(west, east, south, north), cmap="RdBu_r", vmin=-limit, vmax=limit
        )
        rms = float(np.sqrt(np.nanmean(raster.heights**2)))
        axes.set_title(f"{name}: {100 * rms:.2g} cm RMS", loc="left")
        axes.set(xlabel="X (m)", aspect="equal")
        axes.ticklabel_format(useOffset=False, style="plain")
    both[0].set_ylabel("Y (m)")
    figure.colorbar(shown, ax=list(both), label="later strip above earlier (cm)", shrink=0.8)
    return figure


def scanner_correlation_figure(result: StripAdjustment) -> Figure:
    """What is estimated of the scanner against cameras and mounts, and against itself: a heat map each."""
    rho = all_correlations(result)
    labels = [name for name in rho.index if not name.startswith(TrajectoryKnot.kind)]
    scanner = [name for name in labels if name.startswith("scanner")]
    others = [name for name in labels if name not in scanner]
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
    names, splines = result.cloud.strips, result.errors.splines
    rows = 2 * -(-len(names) // _ABREAST)
    columns = min(len(names), _ABREAST)
    figure = new_figure(1.2 + 2.6 * columns, 0.6 + 1.9 * rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharey=False)
    for k, (name, spline) in enumerate(zip(names, splines, strict=True)):
        time = np.linspace(spline.times[0], spline.times[-1], _PLACES * spline.size)
        value, sigma = errors_along(result, k, time)
        for part, (unit, factor, axes_names) in enumerate(_COMPONENTS):
            panel = panels[2 * (k // _ABREAST) + part, k % _ABREAST]
            for c, (axis, colour) in enumerate(zip(axes_names, _COLOURS, strict=True)):
                v, s = factor * value[:, 3 * part + c], 2 * factor * sigma[:, 3 * part + c]
                panel.fill_between(time, v - s, v + s, color=colour, alpha=0.18, lw=0)
                panel.plot(time, v, color=colour, lw=1.3, label=axis)
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


def _short(labels: list[str]) -> list[str]:
    """Labels without their units, and without the names of their owners where one alone is so called."""
    short = [name.split(".")[-1].removesuffix("_rad") for name in labels]
    owners = [name.rsplit(".", 1)[0].partition("[")[2].removesuffix("]") for name in labels]
    return [f"{own} {name}" if short.count(name) > 1 and own else name for own, name in zip(owners, short, strict=True)]
