"""Plots of a flight: recorded positions, residuals by image, and quantities by time."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.procedures.flight import FlightPart
from jaxphoto.procedures.rolling_shutter import GAP, NEIGHBOUR_M, Moment, usual_interval, velocities
from jaxphoto.report.findings import Verdict
from jaxphoto.report.orientation import CORRELATED
from jaxphoto.report.plots import axes_or_new, label, title
from jaxphoto.report.tables import Tables
from jaxphoto.statistics.block_geometry import Coverage

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Images that are named in plots.
_NAMED = 3
# Range of the height axis over the largest used offset.
_ROOM = 1.25


class PartReport(NamedTuple):
    """A part of a flight (connected images) with its tables and verdict."""

    part: FlightPart
    tables: Tables
    verdict: Verdict
    images: pd.DataFrame
    """image, n_image_points, rms_px, dX_m to dZ_m (recorded minus adjusted position), position (used, left out,
    none)."""
    coverage: Coverage | None
    """Coverage of the ground; None if the block has no metric scale."""

    @property
    def unit(self) -> str:
        """Unit of coordinates: metres, or arbitrary units."""
        return "units" if self.coverage is None else "m"

    @property
    def sigma_factor(self) -> float:
        """Factor of camera sigmas for spatially correlated residuals; 1 if not significant."""
        factor = self.part.oriented.report.alike
        return factor if factor > CORRELATED else 1.0


def offsets_less_mean(report: PartReport) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position offsets (images x 3, m) minus the mean of used ones, which may be a receiver shift; masks of images with
    a position, and with a used one."""
    d = report.images[["dX_m", "dY_m", "dZ_m"]].to_numpy(float)
    has = np.isfinite(d).all(axis=1)
    used = has & (report.images["position"] == "used").to_numpy()
    return d - (d[used].mean(axis=0) if used.any() else 0.0), has, used


def plot_position_offsets(report: PartReport, ax: Axes | None = None, *, upright: bool = False) -> Axes:
    """Recorded (GNSS) minus adjusted positions without their mean: arrows in plan, or bars in height if `upright`.

    Raises InputError if the part has no recorded positions.
    """
    if not report.part.placed:
        raise InputError(f"no recorded position of this part is used: {report.part.why_not or 'there are none'}")
    ax, (d, has, used) = axes_or_new(ax), offsets_less_mean(report)
    if upright:
        ax.bar(np.flatnonzero(has), d[has, 2], color=np.where(used[has], "tab:blue", "tab:red"))
        ax.axhline(0, color="0.4", lw=0.6)
        if used.any() and (most := _ROOM * np.abs(d[used, 2]).max()) > 0:
            # Rejected positions may be tens of metres off: their bars are cut.
            ax.set_ylim(-most, most)
        ax.set(ylabel="dZ [m]")
        _name_ends(ax, report.images["image"])
        title(ax, "height offsets, without their mean")
        return ax
    station = np.asarray(report.part.adjusted.unknowns.exterior.position)[:, :2]
    ax.plot(*station.T, "+", color="0.4", ms=5)
    d = d[:, :2]
    if has.any():
        size = float(f"{max(np.median(np.hypot(*d[has].T)), 1e-3):.0e}")
        scale = 15 * size / max(np.ptp(station, axis=0).max(), 1e-9)
        for rows, colour, name in ((has & ~used, "tab:red", "left out"), (used, "tab:blue", "used")):
            style = {"angles": "xy", "scale_units": "xy", "scale": scale, "color": colour, "width": 0.005}
            arrows = ax.quiver(*station[rows].T, *d[rows].T, label=name, **style)
        ax.quiverkey(arrows, 0.75, 1.04, size, f"{size:g} m", labelpos="E")
        if (has & ~used).any():
            ax.legend(fontsize=7)
        largest = np.argsort(-np.where(has, np.hypot(*np.nan_to_num(d).T), -1.0))
        for k in largest[: min(_NAMED, has.sum())]:
            ax.annotate(label(report.images["image"].iloc[k]), tuple(station[k]), fontsize=6, color="0.3")
        ax.update_datalim(station[used] + d[used] / scale)
        ax.autoscale_view()
    ax.set(xlabel="X [m]", ylabel="Y [m]")
    title(ax, "plan offsets, without their mean")
    ax.set_aspect("equal", adjustable="datalim")
    return ax


def plot_photograph_residuals(report: PartReport, ax: Axes | None = None) -> Axes:
    """RMS residual of each image (px); the largest are named."""
    ax, rms = axes_or_new(ax), report.images["rms_px"].to_numpy(float)
    ax.bar(np.arange(len(rms)), rms, color="0.5")
    for k in np.argsort(-rms)[:_NAMED]:
        ax.annotate(label(report.images["image"].iloc[k]), (k, rms[k]), fontsize=6, ha="center", va="bottom")
    ax.set(ylabel="RMS residual [px]")
    _name_ends(ax, report.images["image"])
    title(ax, "residuals by image")
    return ax


def _name_ends(axes: Axes, images: pd.Series) -> None:
    """Label the first and the last of bars by image."""
    last = len(images) - 1
    axes.set_xticks([0, last], [label(n) for n in images.iloc[[0, last]]], fontsize=7)
    first, end = axes.get_xticklabels()
    first.set_horizontalalignment("left")
    end.set_horizontalalignment("right")


class TimeLine(NamedTuple):
    """Images in order of exposure."""

    order: Int[np.ndarray, taken]
    """Indices of images; those without a time are skipped, unless none has one."""
    since: Float[np.ndarray, taken]
    """Seconds since the first; consecutive numbers if no times are known."""
    timed: bool
    gap: Bool[np.ndarray, intervals]
    """Intervals longer than `GAP` usual ones."""
    speed: Float[np.ndarray, taken]
    """m/s; NaN if unknown."""

    @property
    def usual(self) -> float:
        """The usual interval (s); infinite if no two times differ."""
        return usual_interval(self.since)


def time_line(report: PartReport, taken: Mapping[str, Moment]) -> TimeLine:
    """The images of a part in the order in which they were `taken`."""
    images, position = report.part.adjusted.block.images, np.asarray(report.part.adjusted.unknowns.exterior.position)
    moments = np.array([taken.get(name, (np.nan, 1.0)) for name in images]).reshape(-1, 2)
    timed_images, n = np.isfinite(moments[:, 0]), len(images)
    if timed_images.sum() < 2:
        number = np.arange(n)
        return TimeLine(number, number.astype(float), False, np.zeros(max(n - 1, 0), bool), np.full(n, np.nan))
    order = np.flatnonzero(timed_images)[np.argsort(moments[timed_images, 0], kind="stable")]
    at, speed = moments[order, 0] - moments[order[0], 0], np.full(n, np.nan)
    if report.coverage is not None:
        moving = velocities(position, moments[:, 0], moments[:, 1], NEIGHBOUR_M)
        speed[moving.known] = np.linalg.norm(moving.velocity[moving.known], axis=1)
    return TimeLine(order, at, True, np.diff(at) > GAP * usual_interval(at), speed[order])


def quantities_in_time(report: PartReport, line: TimeLine) -> dict[str, tuple[str, dict[str, np.ndarray]]]:
    """Available quantities by time: axis label, and values by name. Offsets are without their mean."""
    shown: dict[str, tuple[str, dict[str, np.ndarray]]] = {}
    if report.images["position"].eq("used").any():
        d, _, used = offsets_less_mean(report)
        values = np.where(used[:, None], d, np.nan)[line.order].T
        shown["offsets"] = "offset without mean [m]", dict(zip(AXES, values, strict=True))
    shown["residuals"] = "residual [px]", {"rms": report.images["rms_px"].to_numpy()[line.order]}
    if report.coverage is not None and np.isfinite(height := report.coverage.height_m[line.order]).any():
        shown["height"] = "height over ground [m]", {"height": height}
    if np.isfinite(line.speed).any():
        shown["speed"] = "speed [m/s]", {"speed": line.speed}
    return shown


def plot_time_line(
    report: PartReport, what: str = "residuals", ax: Axes | None = None, *,
    taken: Mapping[str, Moment] = MappingProxyType({}),
) -> Axes:  # fmt: skip
    """`offsets` of positions, `residuals`, `height` or `speed` by the times at which images were `taken`.

    Without times in the order of the block. Raises InputError for an unavailable quantity.
    """
    line = time_line(report, taken)
    shown = quantities_in_time(report, line)
    if what not in shown:
        raise InputError(f"of this part no {what!r} are known by time; there are {', '.join(shown)}")
    ax, (name, values) = axes_or_new(ax), shown[what]
    for k in np.flatnonzero(line.gap):
        ax.axvspan(line.since[k], line.since[k + 1], color="0.9", lw=0)
    breaks = np.flatnonzero(line.gap) + 1
    at = np.insert(line.since, breaks, np.nan)
    for (key, v), style in zip(values.items(), ("o-", "s--", "^:"), strict=False):
        ax.plot(at, np.insert(np.asarray(v, float), breaks, np.nan), style, ms=2.5, lw=0.8, label=key)
    if len(values) > 1:
        ax.legend(fontsize=7, ncols=len(values))
    ax.set(xlabel="time since the first image [s]" if line.timed else "image", ylabel=name)
    return ax
