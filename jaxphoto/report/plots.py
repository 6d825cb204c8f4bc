"""Pictures of an adjustment: residuals, check points, correlations. Matplotlib figures, and the panels of them."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError, camera_words, printable
from jaxphoto.report.findings import symbol
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 110


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    # Here, because importing matplotlib takes a third of a second that most uses of jaxphoto need not wait for.
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def axes_or_new(axes: Axes | None, *, in_3d: bool = False) -> Axes:
    """`axes`, or where there are none those of a new figure of pyplot's, which a notebook shows by itself.

    Raises InputError where a picture in space is to be drawn on flat axes.
    """
    if axes is None:
        # Here as above; and whoever gives axes has chosen a backend already.
        from matplotlib import pyplot

        if in_3d:
            return pyplot.figure(figsize=(7.0, 5.6)).add_axes((0.02, 0.02, 0.86, 0.92), projection="3d")
        return pyplot.figure(figsize=(6.4, 5.6), layout="constrained").add_subplot()
    if in_3d and axes.name != "3d":
        raise InputError('in_3d draws on axes in space: make them with subplot_kw={"projection": "3d"}')
    return axes


def log_ticks(axes: Axes) -> None:
    """A logarithmic axis of x with numbers at 1, 2 and 5 of each power of ten: more would lie over one another."""
    axes.set_xscale("log")
    # Of a logarithmic axis it is a LogLocator.
    axes.xaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))  # type: ignore[call-arg]
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")


def drawn(name: str) -> str:
    """A name of a file as matplotlib draws it: a dollar would begin a formula."""
    return printable(name).replace("$", r"\$")


def prepare_pictures() -> None:
    """Import and load what draws, which takes half a second: for a thread, while something else computes."""
    new_figure(1.0, 1.0).savefig(io.BytesIO())


def panels(
    width: float, height: float, down: int = 1, across: int = 1, *,
    left: float = 0.85, right: float = 0.15, bottom: float = 0.5, top: float = 0.4, between: float = 0.95,
):  # fmt: skip
    """A figure and its axes, with margins (inches) for labels as they are here: to find them takes half of drawing."""
    figure = new_figure(width, height)
    figure.set_layout_engine("none")
    wide = (width - left - right - between * (across - 1)) / across
    high = (height - top - bottom - between * (down - 1)) / down
    box = {"left": left / width, "right": 1 - right / width, "bottom": bottom / height, "top": 1 - top / height}
    spaces = {"wspace": between / wide, "hspace": between / high}
    return figure, figure.subplots(down, across, squeeze=False, gridspec_kw=box | spaces)


# More arrows than the first hide one another and take seconds to draw; among them are the largest ones.
_ARROWS, _LARGEST = 4000, 100


def residuals_figure(tables: Tables, camera: str) -> Figure:
    """Residual vectors of one camera's image points over its format, all images together; of many, a part."""
    figure, ((axes,),) = panels(6.4, 5.1, bottom=0.6)
    draw_residuals(axes, tables, camera)
    return figure


def draw_residuals(axes: Axes, tables: Tables, camera: str) -> None:
    """The same in a panel."""
    xy, v = of_camera(tables, camera)
    title = f"image residuals of {drawn(camera_words(camera))}"
    if (n := v.shape[1]) > _ARROWS:
        one_in = -(-n // _ARROWS)
        shown = np.union1d(np.arange(0, n, one_in), np.argsort(np.hypot(*v))[-_LARGEST:])
        xy, v, title = xy[:, shown], v[:, shown], f"{title}: 1 in {one_in}, and the largest {_LARGEST}"
    _over_format(axes, tables.adjusted.block.sensors[camera], xy, v, title)


# Cells of the mean residuals along the longer side of the format; fewer residuals than these have no mean worth a look.
_CELLS, _FEW = 12, 5


def mean_residuals_figure(tables: Tables, camera: str) -> Figure:
    """Means of one camera's residuals by cell of its format: what all its images have in common."""
    figure, ((axes,),) = panels(6.4, 5.1, bottom=0.6)
    draw_mean_residuals(axes, tables, camera)
    return figure


def draw_mean_residuals(axes: Axes, tables: Tables, camera: str) -> None:
    """The same in a panel."""
    xy, v = of_camera(tables, camera)
    sensor = tables.adjusted.block.sensors[camera]
    cell, centres = _cells(sensor, xy)
    n = np.bincount(cell, minlength=centres.shape[1])
    mean = np.stack([np.bincount(cell, one, centres.shape[1]) for one in v]) / np.maximum(n, 1)
    shown = n >= max(1, min(_FEW, n.max()))
    title = f"mean residuals by cell, {drawn(camera_words(camera))}"
    _over_format(axes, sensor, centres[:, shown], mean[:, shown], title)


def draw_density(axes: Axes, tables: Tables, camera: str) -> None:
    """How many image points of one camera lie in each cell of its format, all images together."""
    xy, _ = of_camera(tables, camera)
    sensor = tables.adjusted.block.sensors[camera]
    cell, centres = _cells(sensor, xy)
    across = len(np.unique(centres[0]))
    number = np.bincount(cell, minlength=centres.shape[1]).reshape(-1, across)
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    shown = axes.imshow(number, origin="lower", extent=(-w, w, -h, h), cmap="cividis", vmin=0)
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("image points by cell of the format, all images", loc="left", fontsize=9)


def _cells(sensor: Sensor, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of image points (2 x n, mm) the number of the cell of the format, and the centres of all cells (2 x cells, mm),
    row by row from below."""
    size = np.array([sensor.width_mm, sensor.height_mm])[:, None]
    across, down = np.maximum(1, np.round(_CELLS * size[:, 0] / size.max())).astype(int)
    column, row = np.clip((xy / size + 0.5) * [[across], [down]], 0, [[across - 1], [down - 1]]).astype(int)
    places = [np.tile(np.arange(across) + 0.5, down) / across, np.repeat(np.arange(down) + 0.5, across) / down]
    return row * across + column, (np.stack(places) - 0.5) * size


def of_camera(tables: Tables, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Image points of one camera and their residuals (2 x n, mm)."""
    a = tables.adjusted
    mine = np.array([c == camera for c in a.block.image_camera])[a.structure.image]
    return np.asarray(a.values.xy)[:, mine], (np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy))[:, mine]


def _over_format(axes: Axes, sensor: Sensor, xy: np.ndarray, v: np.ndarray, title: str) -> None:
    """Arrows (2 x n, mm) at places of the format."""
    # Thousands of thin arrows, or a hundred that are seen.
    key, width = _round_key(v), 0.0015 if v.shape[1] > _ARROWS / 10 else 0.003
    in_px = f" = {key / sensor.pixel_mm:.2g} px" if sensor.pixel_mm else ""
    _vectors(axes, xy, v, key, 0.06 * sensor.width_mm, f"{1000 * key:g} µm{in_px}", width=width, key_at=-0.11)
    w, h = sensor.width_mm / 2, sensor.height_mm / 2
    axes.plot([-w, w, w, -w, -w], [-h, -h, h, h, -h], color="0.4", lw=0.8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_aspect("equal")


def check_points_figure(adjustments: Mapping[str, Tables]) -> Figure:
    """Discrepancies at check points, surveyed minus computed: in plan on the left, in height (upwards) on the right.

    One line for each of `adjustments`, which are named; all arrows have one scale, so they can be compared.
    """
    key = _round_key(np.concatenate([_discrepancies(tables).ravel() for tables in adjustments.values()]))
    extent = np.max([np.ptp(of.adjusted.unknowns.exterior.position, axis=0) for of in adjustments.values()], axis=0)
    high = 4.2 * float(np.clip(extent[1] / max(extent[0], 1e-9), 0.2, 0.8))
    figure, rows = panels(9.6, 0.4 + (0.8 + high) * len(adjustments), len(adjustments), 2, top=0.55)
    for pair, (name, tables) in zip(rows, adjustments.items(), strict=True):
        for axes, upright in zip(pair, (False, True), strict=True):
            draw_check_points(axes, tables, upright, key, 1 + 0.12 / high, f"{drawn(name)}: " if name else "")
    figure.suptitle(
        "discrepancies at check points, surveyed minus computed", fontsize=11, y=1 - 0.1 / figure.get_figheight()
    )
    return figure


def draw_check_points(
    axes: Axes, tables: Tables, upright: bool, key: float | None = None, key_at: float = 1.04, of: str = ""
) -> None:
    """Discrepancies of one adjustment, in height where `upright`; arrows are scaled for a length of `key` metres."""
    a, d = tables.adjusted, _discrepancies(tables)
    key = _round_key(d) if key is None else key
    number = {point: k for k, point in enumerate(a.block.points)}
    at = np.asarray(a.unknowns.points)[[number[p] for p in tables.check_points["point"]], :2].T
    stations = np.asarray(a.unknowns.exterior.position)[:, :2].T
    length = 0.12 * float(np.ptp(np.hstack([stations, at]), axis=1).max())
    v = np.stack([np.zeros(d.shape[1]), d[2]]) if upright else d[:2]
    surveyed = np.isfinite(v).all(axis=0)
    axes.plot(*stations, "+", ms=6, color="0.75")
    axes.plot(*at[:, surveyed], ".", ms=4, color="tab:green")
    _vectors(axes, at[:, surveyed], v[:, surveyed], key, length, f"{key:g} m", width=0.003, key_at=key_at)
    axes.set(xlabel="X [m]", ylabel="Y [m]")
    axes.set_title(f"{of}{'dZ' if upright else 'dX, dY'}", loc="left", fontsize=10)
    axes.set_aspect("equal", adjustable="datalim")


def _discrepancies(tables: Tables) -> np.ndarray:
    """Surveyed minus computed coordinates of the check points (3 x n, m)."""
    return tables.check_points[["dX_m", "dY_m", "dZ_m"]].to_numpy(float).T


def correlation_figure(tables: Tables, camera: str) -> Figure:
    """Heat maps: IOP x IOP, and mean |rho| of EOP x IOP."""
    figure, ((left, right),) = panels(9.6, 4.4, 1, 2, left=0.6, right=1.1, bottom=0.55, top=0.3, between=0.65)
    draw_interior_correlation(left, tables, camera)
    draw_exterior_correlation(right, tables, camera)
    figure.colorbar(right.images[0], cax=figure.add_axes((0.91, 0.2, 0.015, 0.6)))
    return figure


def draw_interior_correlation(axes: Axes, tables: Tables, camera: str) -> None:
    """Correlation of the interior orientation of a camera with itself."""
    c = tables.correlations[camera]
    heat_map(axes, c.interior, c.parameters, c.parameters, "correlation of IOP")


def draw_exterior_correlation(axes: Axes, tables: Tables, camera: str) -> None:
    """Mean over the images of the correlation of exterior and interior orientation, without its sign."""
    c = tables.correlations[camera]
    heat_map(axes, c.mean_abs, c.eop_names, c.parameters, "mean |correlation| of EOP and IOP")


def heat_map(axes: Axes, values: np.ndarray, rows: Sequence[str], columns: Sequence[str], title: str) -> None:
    """Correlations `values` of `rows` with `columns`, in colours and numbers."""
    axes.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r", aspect="auto")
    axes.set_xticks(range(len(columns)), [drawn(symbol(name)) for name in columns], rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), [drawn(symbol(name)) for name in rows], fontsize=8)
    # No minus sign before zeros.
    shown = np.round(values, 2) + 0.0
    for i, j in np.ndindex(values.shape):
        colour = "white" if abs(values[i, j]) > 0.6 else "black"
        axes.text(j, i, f"{shown[i, j]:.2f}", ha="center", va="center", fontsize=7, color=colour)
    axes.set_title(title, fontsize=10)


def _round_key(v: np.ndarray) -> float:
    """A round number near three times the RMS of `v`, where it is known."""
    rms = float(np.sqrt(np.nanmean(v**2))) if np.isfinite(v).any() else 1.0
    return float(f"{3 * max(rms, 1e-12):.0e}")


def _vectors(
    axes: Axes, at: np.ndarray, v: np.ndarray, key: float, length: float, label: str, *, width: float, key_at: float
) -> None:
    """Arrows `v` at `at` (both 2 x n), and at the height `key_at` (of that of the axes) one of size `key` that is
    `length` long."""
    arrows = axes.quiver(*at, *v, angles="xy", scale_units="xy", scale=key / length, width=width, color="tab:blue")
    axes.quiverkey(arrows, 0.93, key_at, key, label, labelpos="W")
    axes.update_datalim((at + v * length / key).T)
    axes.autoscale_view()
