"""A flight against time: gaps, speed, and whether offsets and residuals change while it goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import few
from jaxphoto.procedures.rolling_shutter import GAP, NEIGHBOUR_M, Moment, usual_interval, velocities
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.flight.positions import AXES, less_mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_HEIGHT = 2.6


class TimeLine(NamedTuple):
    """Photographs in the order in which they were taken."""

    order: Int[np.ndarray, taken]
    """Indices of images; those of which no time is known are left out, unless none is."""
    at: Float[np.ndarray, taken]
    """Seconds from the first; numbers from 0 where no time is known."""
    timed: bool
    gap: Bool[np.ndarray, intervals]
    """Which intervals, from each photograph to the next, are longer than `GAP` usual ones."""
    speed: Float[np.ndarray, taken]
    """m/s; NaN where neighbours do not tell it, or nothing is in metres."""

    @property
    def usual(self) -> float:
        """The usual interval (s); infinite where no two times differ."""
        return usual_interval(self.at)


def time_line(report: PartReport, taken: Mapping[str, Moment]) -> TimeLine:
    """The photographs of a part by the times at which they were `taken`."""
    images, position = report.part.adjusted.block.images, np.asarray(report.part.adjusted.unknowns.exterior.position)
    moments = np.array([taken.get(name, (np.nan, 1.0)) for name in images]).reshape(-1, 2)
    known = np.isfinite(moments[:, 0])
    if known.sum() < 2:
        n = len(images)
        return TimeLine(
            np.arange(n), np.arange(n, dtype=float), False, np.zeros(max(n - 1, 0), bool), np.full(n, np.nan)
        )
    order = np.flatnonzero(known)[np.argsort(moments[known, 0], kind="stable")]
    at = moments[order, 0] - moments[order[0], 0]
    speed = np.full(len(images), np.nan)
    if report.coverage is not None:
        found = velocities(position, moments[:, 0], moments[:, 1], NEIGHBOUR_M)
        speed[found.known] = np.linalg.norm(found.velocity[found.known], axis=1)
    return TimeLine(order, at, True, np.diff(at) > GAP * usual_interval(at), speed[order])


def time_section(report: PartReport, taken: Mapping[str, Moment]) -> Iterator[Element]:
    """Gaps and speed in words, and panels against time, or against the order where no times are known."""
    yield Heading("Time line")
    line = time_line(report, taken)
    yield Paragraph(" ".join(_sentences(line, report.part.adjusted.block.images)))
    yield Pictures(
        tuple(
            DocumentPicture(partial(draw_in_time, line=line, shown=shown), shown.alt, _HEIGHT)
            for shown in shown_in_time(report, line).values()
        )
    )


class ShownInTime(NamedTuple):
    """Numbers in the order of a time line, with what they are called."""

    values: Mapping[str, Float[np.ndarray, taken]]
    what: str
    alt: str


def shown_in_time(report: PartReport, line: TimeLine) -> dict[str, ShownInTime]:
    """What there is of offsets (less their mean, of positions that are used), residuals, height and speed."""
    rms = report.images["rms_px"].to_numpy()[line.order]
    shown = {"residuals": ShownInTime({"rms": rms}, "residual [px]", "Residuals of photographs in their order")}
    if report.images["position"].eq("used").any():
        d, _, used = less_mean(report)
        by_axis = dict(zip(AXES, np.where(used[:, None], d, np.nan)[line.order].T, strict=True))
        alt = "Recorded minus adjusted positions less their mean by axis, in the order of the photographs"
        shown = {"offsets": ShownInTime(by_axis, "offset less mean [m]", alt)} | shown
    if report.coverage is not None and np.isfinite(report.coverage.height_m[line.order]).any():
        height = report.coverage.height_m[line.order]
        alt = f"Height over ground, {np.nanmin(height):.3g} to {np.nanmax(height):.3g} m"
        shown["height"] = ShownInTime({"height": height}, "height over ground [m]", alt)
    if np.isfinite(line.speed).any():
        alt = f"Speed, {np.nanmedian(line.speed):.3g} m/s in the median"
        shown["speed"] = ShownInTime({"speed": line.speed}, "speed [m/s]", alt)
    return shown


def _sentences(line: TimeLine, images: tuple[str, ...]) -> Iterator[str]:
    if not line.timed:
        yield "No times are known: photographs are in the order of the block, and no speeds or gaps are told."
        return
    without = len(images) - len(line.order)
    usual = f", usually {line.usual:.3g} s from one to the next" if np.isfinite(line.usual) else ""
    yield f"From the first to the last photograph {line.at[-1]:.0f} s passed{usual}."
    gaps = [
        f"{later:.3g} s from {images[line.order[k]]} to {images[line.order[k + 1]]}"
        for k, later in enumerate(np.diff(line.at))
        if line.gap[k]
    ]
    what = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    yield f"{what} of more than {GAP:g} times that (grey): {few(gaps, '; ')}." if gaps else "There are no gaps."
    if np.isfinite(line.speed).any():
        low, middle, high = np.nanpercentile(line.speed, [0, 50, 100])
        yield f"Speed {middle:.3g} m/s in the median, {low:.3g} to {high:.3g} m/s, from adjusted positions."
    if without:
        yield f"Of {without} photographs no time is known; they are not shown."


def draw_in_time(axes: Axes, line: TimeLine, shown: ShownInTime) -> None:
    """Lines of numbers in the order of `line`, interrupted by gaps, which are grey."""
    for k in np.flatnonzero(line.gap):
        axes.axvspan(line.at[k], line.at[k + 1], color="0.9", lw=0)
    breaks = np.flatnonzero(line.gap) + 1
    at = np.insert(line.at, breaks, np.nan)
    for (name, v), style in zip(shown.values.items(), ("o-", "s--", "^:"), strict=False):
        axes.plot(at, np.insert(np.asarray(v, float), breaks, np.nan), style, ms=2.5, lw=0.8, label=name)
    if len(shown.values) > 1:
        axes.legend(fontsize=7, ncols=len(shown.values))
    axes.set(xlabel="time since the first photograph [s]" if line.timed else "photograph", ylabel=shown.what)
