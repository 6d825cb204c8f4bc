"""Recorded positions against those of the network: arrows in plan, bars in height, and how they scatter by axis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.procedures.rolling_shutter import Moment
from jaxphoto.report.document import DocumentPicture, Element, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.flight.part import PartReport
from jaxphoto.report.plots import drawn

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AXES = ("X", "Y", "Z")
# Photographs that are named in the plan.
_NAMED = 3
# Of the largest offset that is used.
_ROOM = 1.25
# Standard deviations within which a normal error lies with these probabilities.
_WITHIN = ((1, 68.3), (2, 95.4), (3, 99.7))


def positions_section(report: PartReport, taken: Mapping[str, Moment]) -> Iterator[Element]:
    """Statistics, pictures, and how standard deviations are kept to; `taken` is when photographs were taken."""
    yield Heading("Recorded positions")
    part = report.part
    if not part.placed:
        yield Paragraph(f"No recorded position is used: {part.why_not or 'there are none'}.")
        return
    if part.why_not:
        yield Paragraph(f"They have brought the block to its place, but are not observed: {part.why_not}.")
    table = report.images
    used = table[table["position"] == "used"]
    n = table["position"].value_counts()
    yield Paragraph(
        f"Recorded minus adjusted, X east, Y north, Z up. Positions used: {len(used)}; left out because they "
        f"contradict the others: {n.get('left out', 0)}; photographs without one: {n.get('none', 0)}."
    )
    ordered, order = in_order(used, taken)
    yield offset_rows(offset_statistics(ordered))
    yield Paragraph(
        f"rms of steps is that of the differences from one photograph to the next ({order}) over the square root of 2: "
        "where it is much less than sd, offsets drift more than they jump. The pictures show offsets less their mean."
    )
    yield Pictures(
        (
            DocumentPicture(
                partial(draw_plan, report=report),
                f"Arrows of recorded minus adjusted positions less their mean; with it {_worst(used)}",
                4.2,
            ),
            DocumentPicture(
                partial(draw_height, report=report),
                "Bars of recorded minus adjusted heights less their mean, by photograph",
                4.2,
            ),
        )
    )
    yield from _kept(report)


def in_order(table: pd.DataFrame, taken: Mapping[str, Moment]) -> tuple[pd.DataFrame, str]:
    """Photographs as they were taken, where the time of all is known, else as they are; and which order that is."""
    if not all(name in taken for name in table["image"]):
        return table, "in the order of the block"
    at = np.array([taken[name][0] for name in table["image"]])
    return table.iloc[np.argsort(at, kind="stable")], "by their times"


def offset_statistics(table: pd.DataFrame) -> pd.DataFrame:
    """axis, n, mean, sd, rms, step_rms, largest, image: offsets (m) of photographs in their order, by axis."""
    rows = []
    for axis in AXES:
        known = table[table[f"d{axis}_m"].notna()]
        d = known[f"d{axis}_m"].to_numpy(float)
        if not len(d):
            continue
        sd = float(np.std(d, ddof=1)) if len(d) > 1 else np.nan
        step = float(np.sqrt(np.mean(np.diff(d) ** 2) / 2)) if len(d) > 1 else np.nan
        k = int(np.abs(d).argmax())
        rows.append((axis, len(d), d.mean(), sd, float(np.sqrt(np.mean(d**2))), step, d[k], known["image"].iloc[k]))
    return pd.DataFrame(rows, columns=["axis", "n", "mean", "sd", "rms", "step_rms", "largest", "image"])


def offset_rows(statistics: pd.DataFrame) -> Rows:
    """The same as a table of texts."""
    columns = ("axis", "n", "mean [m]", "sd [m]", "rms [m]", "rms of steps [m]", "largest [m]", "photograph")
    rows = [
        (
            s["axis"],
            str(s["n"]),
            f"{s['mean']:+.3f}",
            *(f"{s[name]:.3f}" for name in ("sd", "rms", "step_rms")),
            f"{s['largest']:+.3f}",
            s["image"],
        )
        for s in statistics.to_dict("records")
    ]
    return Rows(columns, tuple(rows))


def _worst(used: pd.DataFrame) -> str:
    plan = np.hypot(used["dX_m"], used["dY_m"])
    return f"{plan.max():.2g} m at most ({used['image'].iloc[int(plan.argmax())]})" if len(used) else "none used"


def _kept(report: PartReport) -> Iterator[Element]:
    """How residuals of what was recorded keep to its standard deviations."""
    residuals = report.tables.residuals
    rows = []
    for group in ("stations", "attitudes"):
        own = residuals[residuals["group"] == group]
        for axis, of in own.groupby("axis", sort=False):
            w = (of["residual"] / of["sigma"]).abs()
            inside = tuple(f"{100 * (w <= k).mean():.0f} %" for k, _ in _WITHIN)
            rms, unit = float(np.sqrt((of["residual"] ** 2).mean())), of["unit"].iloc[0]
            rows.append((group.replace("_", " "), str(axis), str(len(of)), f"{rms:.3g} {unit}",
                         f"{of['sigma'].median():.3g} {unit}", *inside))  # fmt: skip
    if rows:
        within = tuple(f"within {k} sigma ({p:g} %)" for k, p in _WITHIN)
        yield Rows(("residuals of", "axis", "n", "rms", "sigma (median)", *within), tuple(rows))
        yield Paragraph("In brackets the share of a normal error; sigma is that of the adjustment, by its weights.")


def less_mean(report: PartReport) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets (images x 3, m) less the mean of those used, which may be a shift of the receiver and would hide the
    rest; which photographs have one, and which are used."""
    d = report.images[["dX_m", "dY_m", "dZ_m"]].to_numpy(float)
    has = np.isfinite(d).all(axis=1)
    used = has & (report.images["position"] == "used").to_numpy()
    return d - (d[used].mean(axis=0) if used.any() else 0.0), has, used


def draw_plan(axes: Axes, report: PartReport) -> None:
    """Stations in plan with arrows, those left out in red; the largest are named."""
    table, station = report.images, np.asarray(report.part.adjusted.unknowns.exterior.position)
    d, has, used = less_mean(report)
    d = d[:, :2]
    axes.plot(station[:, 0], station[:, 1], "+", color="0.4", ms=5)
    if has.any():
        size = float(f"{max(np.median(np.hypot(*d[has].T)), 1e-3):.0e}")
        scale = 15 * size / max(np.ptp(station[:, :2], axis=0).max(), 1e-9)
        for rows, colour, label in ((has & ~used, "tab:red", "left out"), (used, "tab:blue", "used")):
            arrows = axes.quiver(
                *station[rows, :2].T, *d[rows].T, angles="xy", scale_units="xy", scale=scale,
                color=colour, width=0.005, label=label,
            )  # fmt: skip
        axes.quiverkey(arrows, 0.75, 1.04, size, f"{size:g} m", labelpos="E")
        if (has & ~used).any():
            axes.legend(fontsize=7)
        for k in np.argsort(-np.where(has, np.hypot(*np.nan_to_num(d).T), -1.0))[: min(_NAMED, has.sum())]:
            axes.annotate(drawn(table["image"].iloc[k]), (station[k, 0], station[k, 1]), fontsize=6, color="0.3")
        axes.update_datalim(station[used, :2] + d[used] / scale)
        axes.autoscale_view()
    axes.set(xlabel="X [m]", ylabel="Y [m]")
    axes.set_title("in plan, less the mean", loc="left", fontsize=9)
    axes.set_aspect("equal", adjustable="datalim")


def draw_height(axes: Axes, report: PartReport) -> None:
    """Bars in height, by photograph."""
    d, has, used = less_mean(report)
    number = np.flatnonzero(has)
    axes.bar(number, d[has, 2], color=np.where(used[has], "tab:blue", "tab:red"))
    axes.axhline(0, color="0.4", lw=0.6)
    if used.any() and (most := _ROOM * np.abs(d[used, 2]).max()) > 0:
        # Those left out may be tens of metres off: their bars are cut.
        axes.set_ylim(-most, most)
    axes.set(ylabel="dZ [m]")
    name_ends(axes, report.images["image"])
    axes.set_title("in height, less the mean", loc="left", fontsize=9)


def name_ends(axes: Axes, images: pd.Series) -> None:
    """The first and the last of bars by photograph, by their names."""
    last = len(images) - 1
    axes.set_xticks([0, last], [drawn(n) for n in images.iloc[[0, last]]], fontsize=7)
    first, end = axes.get_xticklabels()
    first.set_horizontalalignment("left")
    end.set_horizontalalignment("right")
