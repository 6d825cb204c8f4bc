"""Residuals against what may be behind them: the distance from the principal point, and time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.observations import AXES
from jaxphoto.report.plots import drawn, of_camera
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Rings of as many image points each: fewer than these have no mean worth a look.
_RINGS, _FEW = 12, 10
_BARS = 2.0
_COLOURS = ("tab:blue", "tab:orange", "tab:green")
_MARKS = ("o", "s", "^")


def draw_residuals_by_radius(axes: Axes, tables: Tables, camera: str) -> None:
    """Mean residuals along and across the radius from the principal point, with bars of two sigmas, by distance."""
    xy, v = of_camera(tables, camera)
    if not xy.size:
        axes.set_title("no residuals", loc="left", fontsize=9)
        return
    centre = np.asarray(tables.adjusted.unknowns.interior[camera].principal_point)[:, None]
    from_centre = xy - centre
    radius = np.hypot(*from_centre)
    along = from_centre / np.where(radius > 0, radius, 1.0)
    parts = {"radial": (along * v).sum(axis=0), "tangential": along[0] * v[1] - along[1] * v[0]}
    rings = np.array_split(np.argsort(radius), max(1, min(_RINGS, len(radius) // _FEW)))
    at = np.array([radius[ring].mean() for ring in rings])
    # Beside one another, that bars do not hide each other.
    aside = 0.008 * np.ptp(radius) * np.array([-1, 1])
    for (name, values), colour, mark, off in zip(parts.items(), _COLOURS, _MARKS, aside, strict=False):
        mean = 1e3 * np.array([values[ring].mean() for ring in rings])
        bars = 1e3 * _BARS * np.array([values[ring].std() / np.sqrt(len(ring)) for ring in rings])
        label = f"{name} (RMS {1e3 * np.sqrt((values**2).mean()):.2g} µm)"
        axes.errorbar(at + off, mean, yerr=bars, fmt=f"{mark}-", ms=4, lw=1, capsize=2, color=colour, label=label)
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel="distance from the principal point [mm]", ylabel="mean residual [µm]")
    axes.set_title("residuals by distance from the principal point", loc="left", fontsize=9)
    axes.legend(fontsize=7)


def draw_station_residuals(axes: Axes, tables: Tables) -> None:
    """Residuals of camera stations, observed minus computed, in the order of the flight; without times of the block."""
    a = tables.adjusted
    given = a.block.image_time if a.block.flight_time is None else a.block.flight_time
    time = np.asarray(given, float)
    # Times of strips, each from its own middle, are none of the flight: images of several have the same.
    timed = np.isfinite(time).all() and len(np.unique(time)) == len(time)
    number = np.argsort(np.argsort(time)) if timed else np.arange(len(time))
    observed = tables.residuals[tables.residuals["group"] == "stations"]
    place = observed["image"].map(dict(zip(a.block.images, number + 1, strict=True))).to_numpy(float)
    for axis, colour, mark in zip(AXES, _COLOURS, _MARKS, strict=True):
        mine = (observed["axis"] == axis).to_numpy()
        order = np.argsort(place[mine])
        values = observed["residual"].to_numpy(float)[mine][order]
        axes.plot(place[mine][order], values, f"{mark}-", ms=3, lw=0.6, color=colour, label=drawn(axis))
    sigma = float(np.median(a.block.stations.sigma))
    axes.axhline(0, color="0.6", lw=0.6)
    for side in (-_BARS, _BARS):
        axes.axhline(side * sigma, color="0.6", lw=0.6, ls=":")
    axes.set(xlabel=f"image, in the order of {'time' if timed else 'the block'}", ylabel="residual [m]")
    axes.set_title(f"residuals of stations; dotted: {_BARS:g} of their sigmas", loc="left", fontsize=9)
    axes.legend(fontsize=7)
