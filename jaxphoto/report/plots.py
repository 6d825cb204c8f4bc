"""Plots of an adjustment, each a function that takes and returns matplotlib axes (`ax`; by default a new figure).

`camera` may be omitted if the block has one camera.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import TOLERANCE, Adjustment
from jaxphoto.block_edits import one_camera
from jaxphoto.camera import Sensor, parameter_names
from jaxphoto.errors import InputError, camera_words, printable
from jaxphoto.observations import AXES
from jaxphoto.report.findings import symbol
from jaxphoto.report.tables import Tables
from jaxphoto.stability import NORMAL_95, DistortionCurve, distortion_curve
from jaxphoto.statistics.block_geometry import Coverage, ImageLinks, WeakLink, coverage, image_links, weak_links
from jaxphoto.statistics.sigma_map import SigmaMap, sigma_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("tab:blue", "tab:orange", "tab:green")
_MARKS = ("o", "s", "^")
_BARS = 2.0
"""Standard deviations of error bars."""


# Axes and figures ------------------------------------------------------------------------------------------------


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    # Imported here because matplotlib takes a third of a second.
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def axes_or_new(axes: Axes | None, *, in_3d: bool = False) -> Axes:
    """`axes`, or those of a new pyplot figure, which a notebook shows.

    Raises InputError if a 3-D plot is to be drawn on flat axes.
    """
    if axes is None:
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=(6.4, 5.6), layout="constrained")
        return figure.add_subplot(projection="3d" if in_3d else None)
    if in_3d and axes.name != "3d":
        raise InputError('in_3d draws on axes in space: make them with subplot_kw={"projection": "3d"}')
    return axes


def label(name: str) -> str:
    """A name as matplotlib text: a dollar would begin a formula."""
    return printable(name).replace("$", r"\$")


def prepare_pictures() -> None:
    """Import and load matplotlib, which takes half a second: for a thread while something else is computed."""
    new_figure(1.0, 1.0).savefig(io.BytesIO())


def title(axes: Axes, text: str) -> None:
    """Set the title of a panel."""
    axes.set_title(text, loc="left", fontsize=9)


def log_ticks(axes: Axes) -> None:
    """Make the x axis logarithmic with ticks at 1, 2 and 5 times powers of ten."""
    axes.set_xscale("log")
    axes.xaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))  # type: ignore[call-arg]
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")


def draw_format(axes: Axes, sensor: Sensor) -> None:
    """The outline of the image format on axes of millimetres from its centre."""
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")


def draw_format_map(
    axes: Axes, sensor: Sensor, cells_mm: Float[np.ndarray, "cells 2"], name: str, values: Float[np.ndarray, cells]
) -> None:
    """A colour map over the image format; `name` is its title."""
    if np.ptp(values) > 1e-9 * max(np.abs(values).max(), 1e-300):
        filled = axes.tricontourf(cells_mm[:, 0], cells_mm[:, 1], values, levels=12, cmap="cividis")
        axes.figure.colorbar(filled, ax=axes, shrink=0.85)
    else:
        axes.text(0, 0, f"{values.mean():.3g} everywhere", ha="center", fontsize=8)
    draw_format(axes, sensor)
    title(axes, name)


def draw_matrix(axes: Axes, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], name: str) -> None:
    """Correlations `values` of `rows` with `columns`, in colours and numbers."""
    axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
    axes.set_xticks(range(len(columns)), [label(symbol(name)) for name in columns], rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), [label(symbol(name)) for name in rows], fontsize=8)
    # No minus sign in front of zeros.
    shown = np.round(values, 2) + 0.0
    for i, j in np.ndindex(values.shape):
        colour = "white" if abs(values[i, j]) > 0.6 else "black"
        axes.text(j, i, f"{shown[i, j]:.2f}", ha="center", va="center", fontsize=7, color=colour)
    title(axes, name)


def draw_arrows(axes: Axes, at: np.ndarray, v: np.ndarray, key: float, length: float, text: str) -> None:
    """Arrows `v` at `at` (2 x n); one of size `key` has a drawn `length` and is the key, labelled `text`."""
    arrows = axes.quiver(*at, *v, angles="xy", scale_units="xy", scale=key / length, width=0.003, color="tab:blue")
    axes.quiverkey(arrows, 0.93, 1.04, key, text, labelpos="W")
    axes.update_datalim((at + v * length / key).T)
    axes.autoscale_view()


def round_key(v: np.ndarray) -> float:
    """A round number near three times the RMS of `v`."""
    rms = float(np.sqrt(np.nanmean(v**2))) if np.isfinite(v).any() else 1.0
    return float(f"{3 * max(rms, 1e-12):.0e}")


# Residuals -------------------------------------------------------------------------------------------------------

# More arrows hide each other; the largest are always drawn.
_ARROWS, _LARGEST = 4000, 100
# Cells along the longer side of the format, and residuals that a mean needs.
_CELLS, _FEW = 12, 5
# Rings of equally many image points, and residuals that a ring needs.
_RINGS, _OF_RING = 12, 10


def residuals_of(tables: Tables, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Image points of a camera and their residuals (2 x n, mm)."""
    a = tables.adjusted
    of_camera = np.array([c == camera for c in a.block.image_camera])[a.structure.image]
    return np.asarray(a.values.xy)[:, of_camera], (np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy))[
        :, of_camera
    ]


def plot_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Image residuals over the format of a camera, all images together."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    name = f"image residuals of {label(camera_words(camera))}"
    if (n := v.shape[1]) > _ARROWS:
        one_in = -(-n // _ARROWS)
        shown = np.union1d(np.arange(0, n, one_in), np.argsort(np.hypot(*v))[-_LARGEST:])
        xy, v, name = xy[:, shown], v[:, shown], f"{name}: 1 in {one_in}, and the largest {_LARGEST}"
    return _over_format(ax, tables, camera, xy, v, name)


def plot_mean_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Mean residuals by cell of the format: systematic residuals of all images."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    cell, centres = _cells(tables.adjusted.block.sensors[camera], xy)
    n = np.bincount(cell, minlength=centres.shape[1])
    mean = np.stack([np.bincount(cell, one, centres.shape[1]) for one in v]) / np.maximum(n, 1)
    shown = n >= max(1, min(_FEW, n.max()))
    name = f"mean residuals by cell, {label(camera_words(camera))}"
    return _over_format(ax, tables, camera, centres[:, shown], mean[:, shown], name)


def _over_format(ax: Axes, tables: Tables, camera: str, xy: np.ndarray, v: np.ndarray, name: str) -> Axes:
    sensor, key = tables.adjusted.block.sensors[camera], round_key(v)
    in_px = f" = {key / sensor.pixel_mm:.2g} px" if sensor.pixel_mm else ""
    draw_arrows(ax, xy, v, key, 0.06 * sensor.width_mm, f"{1000 * key:g} µm{in_px}")
    draw_format(ax, sensor)
    title(ax, name)
    return ax


def plot_density(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Number of image points in each cell of the format."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    sensor = tables.adjusted.block.sensors[camera]
    cell, centres = _cells(sensor, residuals_of(tables, camera)[0])
    number = np.bincount(cell, minlength=centres.shape[1]).reshape(-1, len(np.unique(centres[0])))
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    shown = ax.imshow(number, origin="lower", extent=(-w, w, -h, h), cmap="cividis", vmin=0)
    ax.figure.colorbar(shown, ax=ax, shrink=0.8)
    ax.set(xlabel="x [mm]", ylabel="y [mm]")
    title(ax, "image points by cell of the format, all images")
    return ax


def _cells(sensor: Sensor, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cell number of image points (2 x n, mm), and the centres of all cells (2 x cells, mm), row by row from below."""
    size = np.array([sensor.width_mm, sensor.height_mm])[:, None]
    across, down = np.maximum(1, np.round(_CELLS * size[:, 0] / size.max())).astype(int)
    column, row = np.clip((xy / size + 0.5) * [[across], [down]], 0, [[across - 1], [down - 1]]).astype(int)
    places = [np.tile(np.arange(across) + 0.5, down) / across, np.repeat(np.arange(down) + 0.5, across) / down]
    return row * across + column, (np.stack(places) - 0.5) * size


def plot_residuals_by_radius(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Mean radial and tangential residuals by distance from the principal point, with bars of two sigmas."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    title(ax, "residuals by distance from the principal point" if xy.size else "no residuals")
    if not xy.size:
        return ax
    offset = xy - np.asarray(tables.adjusted.unknowns.interior[camera].principal_point)[:, None]
    radius = np.hypot(*offset)
    along = offset / np.where(radius > 0, radius, 1.0)
    parts = {"radial": (along * v).sum(axis=0), "tangential": along[0] * v[1] - along[1] * v[0]}
    rings = np.array_split(np.argsort(radius), max(1, min(_RINGS, len(radius) // _OF_RING)))
    at = np.array([radius[ring].mean() for ring in rings])
    for k, (name, values) in enumerate(parts.items()):
        mean = 1e3 * np.array([values[ring].mean() for ring in rings])
        bars = 1e3 * _BARS * np.array([values[ring].std() / np.sqrt(len(ring)) for ring in rings])
        text = f"{name} (RMS {1e3 * np.sqrt((values**2).mean()):.2g} µm)"
        # Side by side, so that bars do not hide each other.
        shift = 0.008 * np.ptp(radius) * (2 * k - 1)
        style: dict[str, Any] = {"ms": 4, "lw": 1, "capsize": 2, "color": _COLOURS[k], "label": text}
        ax.errorbar(at + shift, mean, yerr=bars, fmt=f"{_MARKS[k]}-", **style)
    ax.axhline(0, color="0.6", lw=0.6)
    ax.set(xlabel="distance from the principal point [mm]", ylabel="mean residual [µm]")
    ax.legend(fontsize=7)
    return ax


def plot_station_residuals(tables: Tables, ax: Axes | None = None) -> Axes:
    """Residuals of camera stations in the order of the flight. Raises InputError without observed stations."""
    a = tables.adjusted
    if not len(a.block.stations.who):
        raise InputError("the block has no observed stations to be drawn")
    ax = axes_or_new(ax)
    time = np.asarray(a.block.image_time if a.block.flight_time is None else a.block.flight_time, float)
    # Times relative to the middle of each strip are not unique.
    timed = np.isfinite(time).all() and len(np.unique(time)) == len(time)
    number = np.argsort(np.argsort(time)) if timed else np.arange(len(time))
    observed = tables.residuals[tables.residuals["group"] == "stations"]
    place = observed["image"].map(dict(zip(a.block.images, number + 1, strict=True))).to_numpy(float)
    for axis, colour, mark in zip(AXES, _COLOURS, _MARKS, strict=True):
        of_axis = (observed["axis"] == axis).to_numpy()
        order = np.argsort(place[of_axis])
        values = observed["residual"].to_numpy(float)[of_axis][order]
        ax.plot(place[of_axis][order], values, f"{mark}-", ms=3, lw=0.6, color=colour, label=axis)
    sigma = float(np.median(a.block.stations.sigma))
    for level, style in ((0.0, "-"), (-_BARS * sigma, ":"), (_BARS * sigma, ":")):
        ax.axhline(level, color="0.6", lw=0.6, ls=style)
    ax.set(xlabel=f"image, in the order of {'time' if timed else 'the block'}", ylabel="residual [m]")
    title(ax, f"residuals of stations; dotted: {_BARS:g} sigma")
    ax.legend(fontsize=7)
    return ax


def plot_check_points(
    tables: Tables, ax: Axes | None = None, *, upright: bool = False, key: float | None = None
) -> Axes:
    """Discrepancies at check points (surveyed minus computed) in plan, or in height if `upright`.

    Arrows are scaled for a length of `key` metres. Raises InputError without check points.
    """
    if not len(tables.check_points):
        raise InputError("the block has no check points to be drawn")
    ax, a, d = axes_or_new(ax), tables.adjusted, discrepancies(tables)
    key = round_key(d) if key is None else key
    number = {point: k for k, point in enumerate(a.block.points)}
    at = np.asarray(a.unknowns.points)[[number[p] for p in tables.check_points["point"]], :2].T
    stations = np.asarray(a.unknowns.exterior.position)[:, :2].T
    length = 0.12 * float(np.ptp(np.hstack([stations, at]), axis=1).max())
    v = np.stack([np.zeros(d.shape[1]), d[2]]) if upright else d[:2]
    surveyed = np.isfinite(v).all(axis=0)
    ax.plot(*stations, "+", ms=6, color="0.75")
    ax.plot(*at[:, surveyed], ".", ms=4, color="tab:green")
    draw_arrows(ax, at[:, surveyed], v[:, surveyed], key, length, f"{key:g} m")
    ax.set(xlabel="X [m]", ylabel="Y [m]")
    title(ax, f"check points, {'dZ' if upright else 'dX, dY'}")
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def discrepancies(tables: Tables) -> np.ndarray:
    """Surveyed minus computed coordinates of the check points (3 x n, m)."""
    return tables.check_points[["dX_m", "dY_m", "dZ_m"]].to_numpy(float).T


def check_points_figure(adjustments: Mapping[str, Tables]) -> Figure:
    """Discrepancies at check points in plan and in height; one row per adjustment, all with one scale."""
    key = round_key(np.concatenate([discrepancies(tables).ravel() for tables in adjustments.values()]))
    figure = new_figure(9.6, 4.2 * len(adjustments))
    rows = figure.subplots(len(adjustments), 2, squeeze=False)
    for pair, (name, tables) in zip(rows, adjustments.items(), strict=True):
        for axes, upright in zip(pair, (False, True), strict=True):
            plot_check_points(tables, axes, upright=upright, key=key)
            title(axes, f"{label(name)}: {axes.get_title(loc='left')}" if name else axes.get_title(loc="left"))
    return figure


# Camera ----------------------------------------------------------------------------------------------------------


def plot_interior_correlation(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Correlations within the interior orientation."""
    ax, c = axes_or_new(ax), tables.correlations[one_camera(tables.adjusted.block, camera)]
    draw_matrix(ax, c.interior, c.parameters, c.parameters, "correlation of IOP")
    return ax


def plot_exterior_correlation(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Mean absolute correlation of exterior and interior orientation over the images."""
    ax, c = axes_or_new(ax), tables.correlations[one_camera(tables.adjusted.block, camera)]
    draw_matrix(ax, c.mean_abs, c.eop_names, c.parameters, "mean |correlation| of EOP and IOP")
    return ax


def correlation_figure(tables: Tables, camera: str | None = None) -> Figure:
    """Both correlation matrices of a camera side by side."""
    figure = new_figure(9.6, 4.0)
    for axes, plot in zip(figure.subplots(1, 2), (plot_interior_correlation, plot_exterior_correlation), strict=True):
        plot(tables, camera, axes)
    return figure


def distortion_of(tables: Tables, camera: str | None = None) -> DistortionCurve:
    """Distortion of a camera by distance, with a posteriori sigmas."""
    name, a = one_camera(tables.adjusted.block, camera), tables.adjusted
    interior = a.unknowns.interior[name]
    covariance = tables.covariance.of_interior(name, parameter_names(interior))
    return distortion_curve(interior, a.block.sensors[name], covariance)


def plot_distortion(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Radial distortion by distance from the principal point with its 95 % band, and the remaining distortion."""
    ax = axes_or_new(ax)
    draw_distortion(ax, distortion_of(tables, camera))
    return ax


def draw_distortion(axes: Axes, curve: DistortionCurve, factor: float = 1.0) -> None:
    """Radial distortion (um) with its 95 % band times `factor`, and the remaining distortion."""
    um = 1e3
    if curve.sigma is not None:
        half = um * NORMAL_95 * factor * curve.sigma
        band = um * curve.radial - half, um * curve.radial + half
        axes.fill_between(curve.r, *band, color="#9ecae1", label="95 % band", lw=0)
    axes.plot(curve.r, um * curve.radial, "-", color="#08519c", label="radial")
    axes.plot(curve.r, um * curve.other, "--", color="#d95f02", label="decentring, affinity (RMS)")
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel="distance from the principal point [mm]", ylabel="measured - ideal [µm]")
    title(axes, "distortion")
    axes.legend(fontsize=7)


def plot_distortion_band(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Half width of the 95 % band of the radial distortion, which is often thinner than the line of the curve."""
    ax, curve = axes_or_new(ax), distortion_of(tables, camera)
    if curve.sigma is not None:
        ax.plot(curve.r, 1e3 * NORMAL_95 * curve.sigma, "-", color="#08519c")
    ax.set(xlabel="distance from the principal point [mm]", ylabel="95 % within +- [µm]", ylim=(0, None))
    title(ax, "uncertainty of the radial distortion")
    return ax


# Contours are drawn at these times powers of ten: the first set that gives `_LINES` of them.
_LINES = 5
_ROUND = (
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0),
    (*np.arange(1.0, 2.0, 0.1), *np.arange(2.0, 5.0, 0.2), *np.arange(5.0, 10.0, 0.5)),
)


def plot_sigma_map(
    tables: Tables, camera: str | None = None, ax: Axes | None = None, *, distance_m: float = float("inf")
) -> Axes:
    """Projection uncertainty over the image format for points at a distance (`jaxphoto.sigma_map`)."""
    ax, name = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    draw_sigma_map(ax, tables.adjusted.block.sensors[name], sigma_map(tables.adjusted, name, distance_m=distance_m))
    return ax


def draw_sigma_map(axes: Axes, sensor: Sensor, one: SigmaMap) -> None:
    """Sigma in its worst direction (px), with contours at round numbers."""
    x, y = (np.unique(v) for v in one.points.T)
    if len(x) * len(y) != len(one.points):
        raise ValueError("a map is drawn of cells in rows and columns")
    worst = np.ma.masked_invalid(one.worst.reshape(len(y), len(x)) / sensor.pixel_mm)
    levels = _levels(worst.compressed())
    if levels:
        filled = axes.contourf(x, y, worst, levels=levels, cmap="cividis", norm="log")
        lines = axes.contour(x, y, worst, levels=levels, colors="white", linewidths=0.7)
        axes.clabel(lines, fmt="%g", fontsize=8)
        bar = axes.figure.colorbar(filled, ax=axes, shrink=0.9, ticks=levels, format="%g")
        bar.ax.minorticks_off()
        bar.set_label("worst direction [px]")
    draw_format(axes, sensor)
    title(axes, f"sigma {distance_words(one.distance_m)}")


def distance_words(distance_m: float) -> str:
    """Such as "of a point at 1050 m"."""
    if np.isinf(distance_m):
        return "of a point at infinity"
    return f"of a point at {distance_m:.0f} m" if distance_m >= 100 else f"of a point at {distance_m:.3g} m"


def _levels(values: np.ndarray) -> list[float]:
    """Round contour levels that enclose all values, of nearly equal ratio."""
    values = values[values > 0]
    if not len(values):
        return []
    low, high = values.min(), values.max()
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    rounds = (np.round(np.outer(powers, steps).ravel(), 12) for steps in _ROUND)
    inside = next((r for r in rounds if ((low < r) & (r < high)).sum() >= _LINES), np.array([low, high]))
    first, last = np.searchsorted(inside, low, "right") - 1, np.searchsorted(inside, high, "left")
    return [float(k) for k in inside[max(first, 0) : last + 1]]


# Block -----------------------------------------------------------------------------------------------------------

# Length of the major axis of the median error ellipse, as a fraction of the extent of the block.
_ELLIPSE = 0.03


def ellipse_axes(
    covariance: Float[np.ndarray, "n 2 2"],
) -> tuple[Float[np.ndarray, n], Float[np.ndarray, n], Float[np.ndarray, n]]:
    """Semi-axes a >= b of error ellipses, and the direction of a from X towards Y (rad)."""
    variance, axes = np.linalg.eigh(covariance)
    # A fixed coordinate has a variance of zero or, by rounding, below.
    b, a = np.sqrt(np.maximum(variance, 0.0)).T
    return a, b, np.arctan2(axes[:, 1, 1], axes[:, 0, 1])


def plot_error_ellipses(tables: Tables, ax: Axes | None = None, *, unit: str = "m") -> Axes:
    """Standard error ellipses of the projection centres in plan (39 % lie within), enlarged; colour: sigma of Z."""
    from matplotlib.collections import EllipseCollection

    ax, covariance = axes_or_new(ax), tables.covariance.positions * float(tables.covariance.variance_factor)
    at = np.asarray(tables.adjusted.unknowns.exterior.position)
    ax.plot(*at[:, :2].T, "+", ms=4, color="0.4")
    name = "error ellipses of projection centres"
    known = np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    a, b, direction = ellipse_axes(covariance[known][:, :2, :2])
    if (a > 0).any():
        extent = max(float(np.ptp(at[:, :2], axis=0).max()), float(np.median(a[a > 0])))
        factor = max(1.0, float(f"{_ELLIPSE * extent / np.median(a[a > 0]):.0e}"))
        ellipses = EllipseCollection(
            2 * factor * a, 2 * factor * b, np.degrees(direction), units="xy", offsets=at[known, :2],
            offset_transform=ax.transData, array=np.sqrt(np.maximum(covariance[known, 2, 2], 0.0)),
            cmap="cividis", alpha=0.7,
        )  # fmt: skip
        ax.add_collection(ellipses)
        reach = factor * a[:, None] * np.ones(2)
        ax.update_datalim(np.concatenate([at[known, :2] - reach, at[known, :2] + reach]))
        ax.autoscale_view()
        ax.figure.colorbar(ellipses, ax=ax, shrink=0.8, label=f"sigma of Z [{unit}]")
        name += f", {factor:,.0f} times; largest {a.max():.2g} {unit}"
    ax.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    title(ax, name)
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def plot_intersection_angles(tables: Tables, ax: Axes | None = None) -> Axes:
    """Histogram of the largest intersection angle of each object point."""
    ax = axes_or_new(ax)
    ax.hist(tables.object_points["angle_deg"].dropna().to_numpy(), bins=45, color="tab:blue")
    ax.set(xlabel="largest angle between rays [deg]", ylabel="points")
    title(ax, "intersection angles")
    return ax


def plot_point_sigmas(tables: Tables, ax: Axes | None = None, *, unit: str = "m") -> Axes:
    """Histograms of the standard deviations of object points by axis, up to the 99th percentile."""
    ax, points = axes_or_new(ax), tables.object_points
    sigma = points.loc[points["n_images"] > 0, [f"sigma_{a}_m" for a in AXES]].to_numpy()
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    if len(known):
        low, high = np.percentile(known, [0.5, 99])
        for k, (axis, line) in enumerate(zip(AXES, ("-", "--", ":"), strict=True)):
            ax.hist(sigma[:, k], bins=np.geomspace(low, high, 40).tolist(), histtype="step", ls=line, label=axis)
        log_ticks(ax)
        ax.legend(fontsize=7)
    ax.set(xlabel=f"sigma [{unit}]", ylabel="points")
    title(ax, "standard deviations of points")
    return ax


def plot_rays(tables: Tables, ax: Axes | None = None) -> Axes:
    """Number of object points by number of rays."""
    ax, most = axes_or_new(ax), 15
    rays = np.minimum(np.bincount(tables.adjusted.structure.point), most)
    ax.bar(np.arange(2, most + 1), np.bincount(rays, minlength=most + 1)[2:], color="tab:blue")
    ax.set(xlabel=f"rays of a point ({most}: or more)", ylabel="points", yscale="log")
    title(ax, "points by number of rays")
    return ax


def plot_overlap(tables: Tables, ax: Axes | None = None) -> Axes:
    """Number of images that cover each cell of the ground; coordinates are metres."""
    ax = axes_or_new(ax)
    draw_overlap(ax, coverage(tables.adjusted), tables.adjusted)
    return ax


def draw_overlap(ax: Axes, cover: Coverage, adjusted: Adjustment) -> None:
    """Number of images per cell, and the stations."""
    counts = np.ma.masked_less(cover.seen_by, 1)
    x, y = (np.append(v - cover.step_m / 2, v[-1] + cover.step_m / 2) for v in (cover.x, cover.y))
    shown = ax.pcolormesh(x, y, counts, cmap="viridis", rasterized=True)
    ax.figure.colorbar(shown, ax=ax, label="images", shrink=0.8)
    station = np.asarray(adjusted.unknowns.exterior.position)
    ax.plot(station[:, 0], station[:, 1], "w+", ms=5, mew=0.8)
    ax.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    title(ax, "overlap: images per cell of the ground")


# Links of a class that are drawn, classes, and weakest links that are named.
_LINKS, _CLASSES, WEAKEST = 2000, 5, 5
# Fraction of the plot that lines may cover, and its width in points: where most images are linked, lines are thinner.
_INK, _ACROSS, _THINNEST = 0.5, 200.0, 0.05


def plot_links(tables: Tables, ax: Axes | None = None, *, unit: str = "m") -> Axes:
    """The network of images in plan by common points, dark lines for strong links; the weakest in red.

    Of a class of many links an even sample is drawn, as title and legend say.
    """
    ax, links = axes_or_new(ax), image_links(tables.adjusted)
    draw_network(ax, np.asarray(tables.adjusted.unknowns.exterior.position)[:, :2], links,
                 weak_links(tables.adjusted, links, WEAKEST))  # fmt: skip
    ax.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    return ax


def draw_network(axes: Axes, station: Float[np.ndarray, "n 2"], links: ImageLinks, weak: Sequence[WeakLink]) -> None:
    """Links between stations by class of strength."""
    limits = strength_classes(links.common)
    lines = []
    for k, low in enumerate(limits):
        high = limits[k + 1] if k + 1 < len(limits) else np.inf
        members = np.flatnonzero((links.common >= low) & (links.common < high))
        one_in = max(1, -(-len(members) // _LINKS))
        name = f"{low} or more" if np.isinf(high) else f"{low} to {high - 1}"
        strength = k / max(len(limits) - 1, 1)
        lines.append((members[::one_in], strength, name if one_in == 1 else f"{name}: 1 in {one_in}"))
    way = np.linalg.norm(station[links.second] - station[links.first], axis=1)
    size = max(float(np.ptp(station, axis=0).max()), 1e-9)
    ink = sum(float(way[members].sum()) * (0.3 + 2 * strength) for members, strength, _ in lines) / (size * _ACROSS)
    thinner = min(1.0, _INK / ink) if ink > 0 else 1.0
    for members, strength, name in lines:
        ends = np.stack(
            [station[links.first[members]], station[links.second[members]], np.full((len(members), 2), np.nan)], axis=1
        )
        width = max(_THINNEST, thinner * (0.3 + 2 * strength))
        axes.plot(*ends.reshape(-1, 2).T, "-", color=str(0.85 - 0.75 * strength), lw=width, label=name)
    for k, w in enumerate(weak):
        text = "weakest" if k == 0 else None
        axes.plot(*station[[w.first, w.second]].T, "--", color="tab:red", lw=1.2, label=text)
    axes.plot(*station.T, "o", ms=3, color="tab:blue")
    axes.legend(fontsize=6, title="common points", title_fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    shown, n = sum(len(members) for members, _, _ in lines), len(links.common)
    title(axes, f"images and their common points{f': {shown} of {n} links' if shown < n else ''}")
    axes.set_aspect("equal", adjustable="datalim")


def strength_classes(common: np.ndarray) -> list[int]:
    """Lower limits of the classes of links by common points, in steps of about the same factor."""
    return sorted({int(v) for v in np.geomspace(1, max(common.max() / 2, 1), _CLASSES).round()})


def plot_link_strength(tables: Tables, ax: Axes | None = None) -> Axes:
    """Histogram of the common points of pairs of images."""
    ax, common = axes_or_new(ax), image_links(tables.adjusted).common
    edges = np.unique(np.geomspace(1, max(common.max(), 2) + 1, 16).round())
    number, _ = np.histogram(common, edges)
    ax.bar(edges[:-1], number, width=np.diff(edges), align="edge", color="tab:blue", edgecolor="white", lw=0.5)
    ax.set(xscale="log", xlabel="common points of two images", ylabel="pairs")
    title(ax, "strength of links")
    return ax


def plot_convergence(tables: Tables, ax: Axes | None = None, *, steps: bool = False) -> Axes:
    """Sigma naught by iteration, or the length of each of the `steps` in sigmas. Raises InputError if unknown."""
    if tables.adjusted.history is None:
        raise InputError("of this adjustment no iteration is known: adjust the block to draw its convergence")
    ax, table = axes_or_new(ax), tables.convergence
    ax.locator_params(axis="x", integer=True)
    if steps:
        table = table.dropna(subset="length")
        length, taken = table["length"].to_numpy(float), (table["taken"] == "yes").to_numpy()
        k = np.arange(1, len(length) + 1)
        ax.semilogy(k, length, "-", lw=1, color="tab:blue")
        ax.semilogy(k[taken], length[taken], "o", ms=4, color="tab:blue", label="accepted")
        if not taken.all():
            ax.semilogy(k[~taken], length[~taken], "o", ms=5, mfc="none", color="tab:orange", label="rejected")
        ax.axhline(TOLERANCE, ls="--", color="0.4", label="tolerance")
        ax.set(xlabel="step", ylabel="largest move [sigma]")
        title(ax, "step length")
        ax.legend(fontsize=7)
        return ax
    sigma0 = table["sigma0"].to_numpy(float)
    ax.plot(np.arange(len(sigma0)), sigma0, "o-", ms=4, color="tab:blue")
    low, high = np.nanmin(sigma0), np.nanmax(sigma0)
    if high > 3.0 * low:
        ax.set_yscale("log")
    else:
        ax.set_ylim(min(low, 0.98 * high), max(high, 1.02 * low))
    ax.set(xlabel="steps taken", ylabel="sigma naught")
    title(ax, "sigma naught")
    return ax
