"""Plots of an adjustment. Each function draws on matplotlib axes `ax` (default: a new figure) and returns them.

`camera` may be omitted if the block has one camera.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxphoto.block_edits import one_camera
from jaxphoto.camera import Sensor, parameter_names
from jaxphoto.errors import InputError, printable
from jaxphoto.observations import AXES
from jaxphoto.report.formatting import symbol
from jaxphoto.report.tables import Tables
from jaxphoto.stability import NORMAL_95, DistortionCurve, distortion_curve
from jaxphoto.statistics.block_geometry import coverage, image_links
from jaxphoto.statistics.sigma_map import SigmaMap, sigma_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from matplotlib.quiver import Quiver

_COLOURS = ("tab:blue", "tab:orange", "tab:green")
# Maximum number of points of a Q-Q plot.
_QUANTILES = 400
_MARKS = ("o", "s", "^")
_BARS = 2.0
"""Length of error bars in standard deviations."""


# Axes and figures ------------------------------------------------------------------------------------------------


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches."""
    # Import locally: matplotlib takes a third of a second.
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def axes_or_new(axes: Axes | None, *, in_3d: bool = False) -> Axes:
    """Return `axes`, or new pyplot axes, which a notebook displays.

    Raises InputError for a 3-D plot on 2-D axes.
    """
    if axes is None:
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=(6.4, 5.6), layout="constrained")
        return figure.add_subplot(projection="3d" if in_3d else None)
    if in_3d and axes.name != "3d":
        raise InputError('in_3d needs 3D axes; create them with subplot_kw={"projection": "3d"}')
    return axes


def label(name: str) -> str:
    """Escape a name for matplotlib, which would read a dollar sign as the start of a formula."""
    return printable(name).replace("$", r"\$")


def prepare_pictures() -> None:
    """Import and initialise matplotlib (half a second). Run it in a thread during other computations."""
    new_figure(1.0, 1.0).savefig(io.BytesIO())


def title(axes: Axes, text: str) -> None:
    """Set the title of a panel."""
    axes.set_title(text, loc="left", fontsize=8.5)


def log_ticks(axes: Axes) -> None:
    """Make the x axis logarithmic with ticks at 1, 2 and 5 times powers of ten."""
    axes.set_xscale("log")
    axes.xaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))  # type: ignore[call-arg]
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")


def colour_bar(axes: Axes, drawn: ScalarMappable, name: str = "") -> None:
    """Draw the colour bar of `drawn` to the right of a panel, as tall as the panel also with equal aspect."""
    axes.figure.colorbar(drawn, cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)), label=name)


def arrow_key(axes: Axes, arrows: Quiver, size: float, text: str) -> None:
    """Draw an arrow of `size` with its label above the right end of a panel."""
    axes.quiverkey(arrows, 0.94, 1.05, size, text, labelpos="W", labelsep=0.05, fontproperties={"size": 7.5})


def draw_format(axes: Axes, sensor: Sensor) -> None:
    """Draw the outline of the image format; axes in millimetres from its centre."""
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")


def draw_format_map(
    axes: Axes, sensor: Sensor, cells_mm: Float[np.ndarray, "cells 2"], name: str, values: Float[np.ndarray, cells]
) -> None:
    """Draw a colour map over the image format with the title `name`."""
    if np.ptp(values) > 1e-9 * max(np.abs(values).max(), 1e-300):
        filled = axes.tricontourf(cells_mm[:, 0], cells_mm[:, 1], values, levels=12, cmap="cividis")
        colour_bar(axes, filled)
    else:
        axes.text(0, 0, f"{values.mean():.3g} everywhere", ha="center", fontsize=8)
    draw_format(axes, sensor)
    title(axes, name)


def draw_matrix(axes: Axes, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], name: str) -> None:
    """Draw correlations `values` of `rows` with `columns` as colours and text."""
    axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
    axes.set_xticks(range(len(columns)), [label(symbol(name)) for name in columns], rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), [label(symbol(name)) for name in rows], fontsize=8)
    # Avoid a minus sign before zeros.
    shown = np.round(values, 2) + 0.0
    for i, j in np.ndindex(values.shape):
        colour = "white" if abs(values[i, j]) > 0.6 else "black"
        axes.text(j, i, f"{shown[i, j]:.2f}", ha="center", va="center", fontsize=7, color=colour)
    title(axes, name)


def draw_arrows(axes: Axes, at: np.ndarray, v: np.ndarray, key: float, length: float, text: str) -> None:
    """Draw arrows `v` at `at` (2 x n). The key is an arrow of size `key`, drawn length `length` and label `text`."""
    arrows = axes.quiver(*at, *v, angles="xy", scale_units="xy", scale=key / length, width=0.004, color="tab:blue")
    arrow_key(axes, arrows, key, text)
    axes.update_datalim((at + v * length / key).T)
    axes.autoscale_view()


def round_key(v: np.ndarray) -> float:
    """Round three times the RMS of `v` to one significant digit."""
    rms = float(np.sqrt(np.nanmean(v**2))) if np.isfinite(v).any() else 1.0
    return float(f"{3 * max(rms, 1e-12):.0e}")


# Residuals -------------------------------------------------------------------------------------------------------

# Maximum number of arrows; number of the largest arrows that are always drawn.
_ARROWS, _LARGEST = 300, 50
# Number of cells along the longer side of the format; minimum number of residuals per cell mean.
_CELLS, _FEW = 12, 5
# Number of rings with equal numbers of image points; minimum number of residuals per ring.
_RINGS, _OF_RING = 12, 10


def residuals_of(tables: Tables, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the image points of a camera and their residuals (2 x n, mm)."""
    a = tables.adjusted
    of_camera = np.array([c == camera for c in a.block.image_camera])[a.structure.image]
    return np.asarray(a.values.xy)[:, of_camera], (np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy))[
        :, of_camera
    ]


def plot_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the image residuals of all images over the format of a camera."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    name = _of_camera("residuals", tables, camera)
    if (n := v.shape[1]) > _ARROWS:
        one_in = -(-n // _ARROWS)
        shown = np.union1d(np.arange(0, n, one_in), np.argsort(np.hypot(*v))[-_LARGEST:])
        xy, v, name = xy[:, shown], v[:, shown], f"{name}, 1 in {one_in}"
    return _over_format(ax, tables, camera, xy, v, name)


def plot_mean_residuals(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw mean residuals by cell of the format, which show systematic residuals of all images."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    cell, centres = _cells(tables.adjusted.block.sensors[camera], xy)
    n = np.bincount(cell, minlength=centres.shape[1])
    mean = np.stack([np.bincount(cell, one, centres.shape[1]) for one in v]) / np.maximum(n, 1)
    shown = n >= max(1, min(_FEW, n.max()))
    name = _of_camera("mean residuals", tables, camera)
    return _over_format(ax, tables, camera, centres[:, shown], mean[:, shown], name)


def _of_camera(name: str, tables: Tables, camera: str) -> str:
    """Add the camera if there are several."""
    return f"{name}, {label(camera)}" if len(tables.adjusted.unknowns.interior) > 1 else name


def _over_format(ax: Axes, tables: Tables, camera: str, xy: np.ndarray, v: np.ndarray, name: str) -> Axes:
    sensor, key = tables.adjusted.block.sensors[camera], round_key(v)
    in_px = f" = {key / sensor.pixel_mm:.2g} px" if sensor.pixel_mm else ""
    draw_arrows(ax, xy, v, key, 0.06 * sensor.width_mm, f"{1000 * key:g} µm{in_px}")
    draw_format(ax, sensor)
    title(ax, name)
    return ax


def _cells(sensor: Sensor, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell index of image points (2 x n, mm), and the centres of all cells (2 x cells, mm).

    Cells are in rows, bottom row first.
    """
    size = np.array([sensor.width_mm, sensor.height_mm])[:, None]
    across, down = np.maximum(1, np.round(_CELLS * size[:, 0] / size.max())).astype(int)
    column, row = np.clip((xy / size + 0.5) * [[across], [down]], 0, [[across - 1], [down - 1]]).astype(int)
    places = [np.tile(np.arange(across) + 0.5, down) / across, np.repeat(np.arange(down) + 0.5, across) / down]
    return row * across + column, (np.stack(places) - 0.5) * size


def plot_residuals_by_radius(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw mean radial and tangential residuals by distance from the principal point, with bars of two sigmas."""
    ax, camera = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    xy, v = residuals_of(tables, camera)
    title(ax, "mean residuals by distance" if xy.size else "no residuals")
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
        # Offset the two series horizontally so that their bars do not overlap.
        shift = 0.008 * np.ptp(radius) * (2 * k - 1)
        style: dict[str, Any] = {"ms": 4, "lw": 1, "capsize": 2, "color": _COLOURS[k], "label": text}
        ax.errorbar(at + shift, mean, yerr=bars, fmt=f"{_MARKS[k]}-", **style)
    ax.axhline(0, color="0.6", lw=0.6)
    ax.set(xlabel="distance from the principal point [mm]", ylabel="mean residual [µm]")
    ax.legend(fontsize=7)
    return ax


def plot_w(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw the histogram of the normalised residuals w and the standard normal density."""
    ax, w = axes_or_new(ax), tables.checked_w.to_numpy()
    grid = np.linspace(-4.0, 4.0, 161)
    beyond = (np.abs(w) > grid[-1]).sum()
    ax.hist(np.clip(w, grid[0], grid[-1]), bins=40, range=(grid[0], grid[-1]), density=True, color="0.75")
    ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color="tab:blue", label="standard normal")
    ax.set(xlabel="w", ylabel="density")
    ax.legend(fontsize=7)
    title(ax, f"normalised residuals: {len(w)}, {beyond} beyond 4")
    return ax


def plot_w_quantiles(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw the normalised residuals w against the quantiles of the standard normal distribution."""
    ax, w = axes_or_new(ax), np.sort(tables.checked_w.to_numpy())
    n, normal = len(w), NormalDist()
    # Rows at equal distances along the axis: all of the tails, of the middle as many as a curve needs.
    limit = -normal.inv_cdf(0.5 / max(n, 1))
    ranks = [n * normal.cdf(z) for z in np.linspace(-limit, limit, _QUANTILES)]
    shown = np.unique(np.clip(np.array(ranks, int), 0, n - 1)) if n else np.zeros(0, int)
    expected = np.array([normal.inv_cdf((k + 0.5) / n) for k in shown])
    ax.plot(expected, w[shown], ".", ms=3)
    ax.plot([-limit, limit], [-limit, limit], color="0.6", lw=0.8)
    ax.set(xlabel="standard normal quantile", ylabel="w")
    title(ax, "Q-Q plot of normalised residuals")
    return ax


def plot_station_residuals(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw residuals of camera stations in the order of the flight. Raises InputError without observed stations."""
    a = tables.adjusted
    if not len(a.block.stations.who):
        raise InputError("the block has no observed stations to draw")
    ax = axes_or_new(ax)
    time = np.asarray(a.block.image_time if a.block.flight_time is None else a.block.flight_time, float)
    # Use times only if they are unique; times relative to the middle of each strip are not.
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
    ax.locator_params(axis="x", integer=True)
    title(ax, f"residuals of stations; dotted: {_BARS:g} sigma")
    ax.legend(fontsize=7)
    return ax


def plot_check_points(
    tables: Tables, ax: Axes | None = None, *, upright: bool = False, key: float | None = None
) -> Axes:
    """Draw discrepancies at check points (surveyed minus computed) in plan, or in height if `upright`.

    Arrows are scaled for a length of `key` metres. Raises InputError without check points.
    """
    if not len(tables.check_points):
        raise InputError("the block has no check points to draw")
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
    """Return surveyed minus computed coordinates of the check points (3 x n, m)."""
    return tables.check_points[["dX_m", "dY_m", "dZ_m"]].to_numpy(float).T


def check_points_figure(adjustments: Mapping[str, Tables]) -> Figure:
    """Draw discrepancies at check points in plan and in height; one row per adjustment, all at one scale."""
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
    """Draw the correlations within the interior orientation."""
    ax, c = axes_or_new(ax), tables.correlations[one_camera(tables.adjusted.block, camera)]
    draw_matrix(ax, c.interior, c.parameters, c.parameters, "correlation of IOP")
    return ax


def plot_exterior_correlation(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw the mean absolute correlation of exterior and interior orientation over the images."""
    ax, c = axes_or_new(ax), tables.correlations[one_camera(tables.adjusted.block, camera)]
    draw_matrix(ax, c.mean_abs, c.eop_names, c.parameters, "mean |correlation| of EOP and IOP")
    return ax


def correlation_figure(tables: Tables, camera: str | None = None) -> Figure:
    """Draw both correlation matrices of a camera side by side."""
    figure = new_figure(9.6, 4.0)
    for axes, plot in zip(figure.subplots(1, 2), (plot_interior_correlation, plot_exterior_correlation), strict=True):
        plot(tables, camera, axes)
    return figure


def plot_sigma_map(
    tables: Tables, camera: str | None = None, ax: Axes | None = None, *, distance_m: float = float("inf")
) -> Axes:
    """Draw the projection uncertainty over the image format for points at a distance (`jaxphoto.sigma_map`)."""
    ax, name = axes_or_new(ax), one_camera(tables.adjusted.block, camera)
    draw_sigma_map(ax, tables.adjusted.block.sensors[name], sigma_map(tables.adjusted, name, distance_m=distance_m))
    return ax


def draw_sigma_map(axes: Axes, sensor: Sensor, one: SigmaMap) -> None:
    """Draw the standard deviation in the worst direction (px)."""
    worst = np.asarray(one.worst)
    known = np.isfinite(worst)
    name = f"sigma {distance_words(one.distance_m).removeprefix('of a point ')} [px]"
    draw_format_map(axes, sensor, np.asarray(one.points)[known], name, worst[known] / sensor.pixel_mm)


def distance_words(distance_m: float) -> str:
    """Describe the distance of a point, such as "of a point at 1050 m"."""
    if np.isinf(distance_m):
        return "of a point at infinity"
    return f"of a point at {distance_m:.0f} m" if distance_m >= 100 else f"of a point at {distance_m:.3g} m"


def distortion_of(tables: Tables, camera: str | None = None) -> DistortionCurve:
    """Return the distortion curve of a camera by radial distance, with a posteriori standard deviations."""
    name, a = one_camera(tables.adjusted.block, camera), tables.adjusted
    interior = a.unknowns.interior[name]
    covariance = tables.covariance.of_interior(name, parameter_names(interior))
    return distortion_curve(interior, a.block.sensors[name], covariance)


def plot_distortion(tables: Tables, camera: str | None = None, ax: Axes | None = None) -> Axes:
    """Draw radial and non-radial distortion by distance from the principal point, and the 95 % half-width of radial."""
    ax = axes_or_new(ax)
    draw_distortion(ax, distortion_of(tables, camera))
    return ax


def draw_distortion(axes: Axes, curve: DistortionCurve) -> None:
    """Draw radial and other distortion (um); its 95 % half-width, thinner than a line, on the right."""
    lines = [
        *axes.plot(curve.r, 1e3 * curve.radial, "-", color="#08519c", label="radial"),
        *axes.plot(curve.r, 1e3 * curve.other, "--", color="#d95f02", label="decentring, affinity"),
    ]
    if curve.sigma is not None:
        half_width = axes.twinx()
        half = 1e3 * NORMAL_95 * curve.sigma
        lines += half_width.plot(curve.r, half, ":", color="tab:green", label="95 % of radial (right)")
        half_width.set(ylabel="95 % within +- [µm]", ylim=(0, None))
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel="distance from the principal point [mm]", ylabel="measured - ideal [µm]")
    title(axes, "distortion")
    axes.legend(handles=lines, fontsize=7)


# Block -----------------------------------------------------------------------------------------------------------

# Length of the major axis of the median error ellipse, as a fraction of the extent of the block.
_ELLIPSE = 0.03
# Maximum number of ellipses.
_ELLIPSES = 400


def ellipse_axes(
    covariance: Float[np.ndarray, "n 2 2"],
) -> tuple[Float[np.ndarray, n], Float[np.ndarray, n], Float[np.ndarray, n]]:
    """Return the semi-axes a >= b of error ellipses, and the direction of a from X towards Y (rad)."""
    variance, axes = np.linalg.eigh(covariance)
    # Clip at zero: rounding may make the zero variance of a fixed coordinate negative.
    b, a = np.sqrt(np.maximum(variance, 0.0)).T
    return a, b, np.arctan2(axes[:, 1, 1], axes[:, 0, 1])


def plot_error_ellipses(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw enlarged standard ellipses (39 % probability) of the object points in plan; colour: sigma of Z.

    Points that no image determines are skipped; of many points, every n-th is drawn.
    """
    from matplotlib.collections import EllipseCollection

    covariance = np.asarray(tables.covariance.points) * float(tables.covariance.variance_factor)
    ax, unit, a = axes_or_new(ax), tables.unit, tables.adjusted
    at, station = np.asarray(a.unknowns.points), np.asarray(a.unknowns.exterior.position)
    ax.plot(*station[:, :2].T, "+", ms=5, color="0.75")
    name = "error ellipses of object points"
    measured = np.bincount(a.structure.point, minlength=len(at)) > 0
    known = np.flatnonzero(measured & np.isfinite(covariance).all(axis=(1, 2)))
    known = known[:: -(-len(known) // _ELLIPSES) or 1]
    major, minor, direction = ellipse_axes(covariance[known][:, :2, :2])
    if (major > 0).any():
        extent = max(float(np.ptp(at[:, :2], axis=0).max()), float(np.median(major[major > 0])))
        factor = max(1.0, float(f"{_ELLIPSE * extent / np.median(major[major > 0]):.0e}"))
        ellipses = EllipseCollection(
            2 * factor * major, 2 * factor * minor, np.degrees(direction), units="xy", offsets=at[known, :2],
            offset_transform=ax.transData, array=np.sqrt(np.maximum(covariance[known, 2, 2], 0.0)),
            cmap="cividis", alpha=0.7,
        )  # fmt: skip
        ax.add_collection(ellipses)
        reach = factor * major[:, None] * np.ones(2)
        ax.update_datalim(np.concatenate([at[known, :2] - reach, at[known, :2] + reach]))
        ax.autoscale_view()
        colour_bar(ax, ellipses, f"sigma of Z [{unit}]")
        name = f"error ellipses x {factor:,.0f}, largest {major.max():.2g} {unit}"
    ax.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    title(ax, name)
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def plot_intersection_angles(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw the histogram of the largest intersection angle of each object point."""
    ax = axes_or_new(ax)
    ax.hist(tables.object_points["angle_deg"].dropna().to_numpy(), bins=45, color="tab:blue")
    ax.set(xlabel="largest angle between rays [deg]", ylabel="points")
    title(ax, "intersection angles")
    return ax


def plot_overlap(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw the number of images that cover each cell of the ground; coordinates in metres."""
    ax, cover = axes_or_new(ax), tables.coverage or coverage(tables.adjusted)
    counts = np.ma.masked_less(cover.seen_by, 1)
    (x0, x1), (y0, y1) = ((v[0] - cover.step_m / 2, v[-1] + cover.step_m / 2) for v in (cover.x, cover.y))
    shown = ax.imshow(counts, cmap="viridis", origin="lower", extent=(x0, x1, y0, y1))
    colour_bar(ax, shown, "images")
    station = np.asarray(tables.adjusted.unknowns.exterior.position)
    ax.plot(station[:, 0], station[:, 1], "w+", ms=5, mew=0.8)
    ax.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
    title(ax, "overlap")
    return ax


def plot_links(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw the image network in plan: pairs of images with common points, strong links on top."""
    from matplotlib.collections import LineCollection

    ax, links, unit = axes_or_new(ax), image_links(tables.adjusted), tables.unit
    station, order = np.asarray(tables.adjusted.unknowns.exterior.position)[:, :2], np.argsort(links.common)
    ends = np.stack([station[links.first], station[links.second]], axis=1)[order]
    drawn = LineCollection(list(ends), array=links.common[order], cmap="cividis_r", lw=0.8, rasterized=len(ends) > 2000)
    ax.add_collection(drawn)
    colour_bar(ax, drawn, "common points")
    ax.plot(*station.T, "o", ms=3, color="tab:blue")
    ax.set(xlabel=f"X [{unit}]", ylabel=f"Y [{unit}]")
    title(ax, f"{len(ends)} pairs of images with common points")
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def plot_convergence(tables: Tables, ax: Axes | None = None) -> Axes:
    """Draw sigma naught by iteration. Raises InputError if unknown."""
    if tables.adjusted.history is None:
        raise InputError("this adjustment has no iteration history; adjust the block to draw its convergence")
    ax, sigma0 = axes_or_new(ax), tables.convergence["sigma0"].to_numpy(float)
    ax.plot(np.arange(len(sigma0)), sigma0, "o-", ms=4, color="tab:blue")
    ax.locator_params(axis="x", integer=True)
    low, high = np.nanmin(sigma0), np.nanmax(sigma0)
    if high > 3.0 * low:
        ax.set_yscale("log")
    else:
        ax.set_ylim(min(low, 0.98 * high), max(high, 1.02 * low))
    ax.set(xlabel="steps taken", ylabel="sigma naught")
    title(ax, "sigma naught")
    return ax
