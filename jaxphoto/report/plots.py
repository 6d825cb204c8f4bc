"""Pictures of an adjustment: block layout, residuals over the image, correlations. Matplotlib figures."""

import numpy as np
from matplotlib.figure import Figure

from jaxphoto.report.tables import Tables

_DPI = 110


def layout_figure(tables: Tables) -> Figure:
    """Plan of the block: camera stations, object points, control and check points."""
    a = tables.adjusted
    figure = Figure(figsize=(6.4, 5.6), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    points, stations = np.asarray(a.unknowns.points), np.asarray(a.unknowns.exterior.position)
    control = np.union1d(a.block.control.who, a.block.fixed.who).astype(int)
    check = np.unique(a.block.check.who)
    axes.plot(points[:, 0], points[:, 1], ".", ms=2, color="0.65", label="object points")
    axes.plot(stations[:, 0], stations[:, 1], "+", ms=8, color="tab:blue", label="camera stations")
    strips = np.array(a.block.image_strip)
    for strip in dict.fromkeys(strips[strips != ""]):
        axes.plot(*stations[strips == strip, :2].T, "-", lw=0.7, color="tab:blue", alpha=0.5)
    if len(control):
        axes.plot(*points[control, :2].T, "^", ms=6, color="tab:red", label="control points")
    if len(check):
        axes.plot(*points[check, :2].T, "s", ms=5, mfc="none", color="tab:green", label="check points")
    axes.set(xlabel="X [m]", ylabel="Y [m]", title="block layout")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8)
    return figure


def residuals_figure(tables: Tables, camera: str) -> Figure:
    """Residual vectors of one camera's image points over its format, all images together."""
    a = tables.adjusted
    mine = np.array([c == camera for c in a.block.image_camera])[a.structure.image]
    xy, v = np.asarray(a.values.xy)[:, mine], (np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy))[:, mine]
    sensor = a.block.sensors[camera]
    figure = Figure(figsize=(6.4, 5.0), dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    # The key is a round number near three times the RMS, and six per cent of the format long.
    rms = max(float(np.sqrt((v**2).mean())), 1e-12) if v.size else 1.0
    key = float(f"{3 * rms:.0e}")
    scale = 0.06 * sensor.width_mm / key
    arrows = axes.quiver(*xy, *v, angles="xy", scale_units="xy", scale=1 / scale, width=0.0015, color="tab:blue")
    axes.quiverkey(arrows, 0.85, 1.03, key, f"{1000 * key:g} µm", labelpos="E")
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", title=f"image residuals of camera {camera}")
    axes.set_aspect("equal")
    return figure


def correlation_figure(tables: Tables, camera: str) -> Figure:
    """Heat maps: IOP x IOP, and mean |rho| of EOP x IOP."""
    c = tables.correlations[camera]
    figure = Figure(figsize=(9.6, 4.4), dpi=_DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, values, rows, title in (
        (left, c.interior, c.parameters, "correlation of IOP"),
        (right, c.mean_abs, c.eop_names, "mean |correlation| of EOP and IOP"),
    ):
        image = axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
        axes.set_xticks(range(len(c.parameters)), c.parameters, rotation=45, ha="right", fontsize=8)
        axes.set_yticks(range(len(rows)), rows, fontsize=8)
        for i, j in np.ndindex(values.shape):
            colour = "white" if abs(values[i, j]) > 0.6 else "black"
            axes.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize=7, color=colour)
        axes.set_title(title, fontsize=10)
    figure.colorbar(image, ax=[left, right], shrink=0.8)
    return figure
