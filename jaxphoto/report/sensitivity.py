"""Sensitivity: effects of a station bias, variance contributions by observation group, external reliability."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.report.findings import in_symbols
from jaxphoto.report.formatting import label_unit, readable
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, label, new_figure
from jaxphoto.report.results import assumed_pixels, rounded, write_study
from jaxphoto.report.tables import Tables
from jaxphoto.sensitivity.exact import Sensitivity, sensitivity
from jaxphoto.sensitivity.influence import DELTA0, Per, external_reliability, station_bias, variance_shares
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Columns of the largest change in summary.json.
_LARGEST = ("unit", "axis", "exact", "first_order", "over_sigma", "estimate_unit")
# Interior parameters in the figure.
_SHOWN = 6


class SensitivityTables:
    """Sensitivity of the shared unknowns and check points of an adjustment.

    Numbers are in the estimate's own unit (`estimate_unit`). `bias_m` is the station bias, common to the stations of
    each unit of `per`: block, strip or image.
    """

    def __init__(self, adjusted: Adjustment, per: Per = "strip", bias_m: float = 0.10, delta0: float = DELTA0):
        self.adjusted, self.per, self.bias_m, self.delta0 = adjusted, per, bias_m, delta0
        self.check = tuple(adjusted.block.points[k] for k in dict.fromkeys(adjusted.block.check.who.tolist()))

    @cached_property
    def exact(self) -> Sensitivity:
        """The exact derivatives."""
        return sensitivity(self.adjusted, points=self.check)

    @cached_property
    def first_order(self) -> Sensitivity:
        """The classical first-order derivatives."""
        return sensitivity(self.adjusted, curvature=False, points=self.check)

    @property
    def _rows(self) -> slice:
        """All estimates except the exterior orientations."""
        return slice(6 * len(self.adjusted.block.images), None)

    @cached_property
    def _estimates(self) -> np.ndarray:
        return np.array(self.exact.labels[self._rows], object)

    @cached_property
    def _units(self) -> dict[str, str]:
        """Units of the estimates."""
        return {name: label_unit(name, self.adjusted.unknowns.interior) for name in self._estimates}

    @cached_property
    def _sigma(self) -> np.ndarray:
        """A priori sigmas of all estimates."""
        return np.sqrt(variance_shares(self.adjusted, self.exact).variance)

    @cached_property
    def bias(self) -> pd.DataFrame:
        """unit, axis, bias_m, estimate, exact, first_order, difference, estimate_unit: effects of the station bias."""
        of = [station_bias(self.adjusted, d, self.per, self.bias_m) for d in (self.exact, self.first_order)]
        exact, first = (b.change[self._rows].transpose(1, 2, 0) for b in of)
        index = pd.MultiIndex.from_product([of[0].units, AXES, self._estimates], names=["unit", "axis", "estimate"])
        table = index.to_frame(index=False)
        table.insert(2, "bias_m", self.bias_m)
        table["exact"], table["first_order"] = exact.ravel(), first.ravel()
        table["difference"] = table["exact"] - table["first_order"]
        return table.assign(estimate_unit=table["estimate"].map(self._units))

    @cached_property
    def largest(self) -> pd.DataFrame:
        """The largest effect on each interior parameter: estimate, exact, over_sigma (a priori), first_order, unit,
        axis, estimate_unit."""
        interior = self.bias[self.bias["estimate"].str.startswith("interior")]
        most = interior.loc[interior.groupby("estimate", sort=False)["exact"].apply(lambda v: v.abs().idxmax())]
        sigma = dict(zip(self.exact.labels, self._sigma, strict=True))
        over = most["exact"] / most["estimate"].map(sigma).where(lambda v: v > 0)
        columns = ["estimate", "exact", "over_sigma", "first_order", "unit", "axis", "estimate_unit"]
        return most.assign(over_sigma=over)[columns].reset_index(drop=True)

    @cached_property
    def variance_shares(self) -> pd.DataFrame:
        """estimate, group, share, and the observation (image, point, axis) with the largest_share."""
        tables = []
        for group, share in variance_shares(self.adjusted, self.exact).groups.items():
            if not share.size:
                continue
            share, rows = share[self._rows], self._observations[group]
            table = rows.iloc[share.argmax(axis=1)][["image", "point", "axis"]].reset_index(drop=True)
            table.insert(0, "share", share.sum(axis=1))
            table.insert(0, "group", group)
            table.insert(0, "estimate", self._estimates)
            tables.append(table.assign(largest_share=share.max(axis=1)))
        return pd.concat(tables, ignore_index=True).sort_values("estimate", kind="stable", ignore_index=True)

    @cached_property
    def external_reliability(self) -> pd.DataFrame:
        """For each estimate and group the observation whose bias of one MDB has the largest effect.

        estimate, group, image, point, axis, redundancy_number, detectable (MDB), unit, effect, effect_over_sigma (a
        priori), estimate_unit. Unchecked observations are skipped; the summary counts them.
        """
        reliability, sigma, tables = external_reliability(self.adjusted, self.exact, self.delta0), self._sigma, []
        for group, effect in reliability.effect.items():
            mdb = reliability.mdb[group]
            checked = np.isfinite(mdb)
            if not checked.any():
                continue
            effect, rows = effect[self._rows], self._observations[group]
            worst = np.where(checked, np.abs(effect), -1.0).argmax(axis=1)
            table = rows.iloc[worst].reset_index(drop=True).drop(columns=["group", "factor"])
            table.insert(0, "group", group)
            table.insert(0, "estimate", self._estimates)
            table.insert(6, "detectable", rows["factor"].to_numpy()[worst] * mdb[worst])
            table["effect"] = effect[np.arange(len(effect)), worst]
            own = sigma[self._rows]
            table["effect_over_sigma"] = table["effect"] / np.where(own > 0, own, np.nan)
            tables.append(table.assign(estimate_unit=table["estimate"].map(self._units)))
        return pd.concat(tables, ignore_index=True).sort_values("estimate", kind="stable", ignore_index=True)

    @cached_property
    def _observations(self) -> dict[str, pd.DataFrame]:
        """The observation of each column of `Sensitivity.groups`, with the factor to the unit of tables."""
        table = Tables(self.adjusted).residuals[["group", "image", "point", "axis", "redundancy_number", "unit"]]
        table = table.assign(factor=np.where(table["unit"] == "deg", 180 / np.pi, 1.0))
        return {str(group): rows for group, rows in table.groupby("group")}

    @cached_property
    def panels(self) -> dict[str, list[str]]:
        """Panels of the figure by title, with their estimates: interior orientation, check points by axis."""
        interior = [e for e in dict.fromkeys(self.bias["estimate"]) if e.startswith("interior")]
        panels = {e.split("].")[1] if len(self.adjusted.unknowns.interior) == 1 else e: [e] for e in interior}
        return panels | {
            f"check points, {a}, RMS [m]": [f"points[{p}].{a}" for p in self.check] for a in AXES if self.check
        }

    def figure(self) -> Figure:
        """Effects of the bias of each unit and axis on interior orientation and check points."""
        interior = [name for name, (first, *_) in self.panels.items() if first.startswith("interior")]
        panels = [name for name in self.panels if name not in interior[_SHOWN:]]
        down = max(1, -(-len(panels) // 3))
        figure = new_figure(9.6, 0.9 + 2.3 * down)
        figure.set_layout_engine("constrained", h_pad=0.12)
        for axes, name in zip(figure.subplots(down, 3, squeeze=False).flat, panels, strict=False):
            _draw_effects(axes, self, name)
        for axes in figure.axes[len(panels) :]:
            axes.remove()
        if panels:
            figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
        return figure


def plot_sensitivity(tables: SensitivityTables, title: str, ax: Axes | None = None) -> Axes:
    """Effects of a station bias of each unit on an estimate or the check points: exact, first-order, difference.

    `title` is one of `tables.panels`, such as `c_mm`. Raises InputError for another.
    """
    if title not in tables.panels:
        raise InputError(f"there is no {title!r} to be drawn; there are {'; '.join(tables.panels)}")
    ax = axes_or_new(ax)
    _draw_effects(ax, tables, title)
    ax.legend(fontsize=8)
    return ax


def _draw_effects(axes: Axes, tables: SensitivityTables, title: str) -> None:
    names = tables.panels[title]
    chosen = tables.bias[tables.bias["estimate"].isin(names)]
    by = chosen.groupby(["unit", "axis"], sort=False)[["exact", "first_order", "difference"]]
    values = by.sum() if len(names) == 1 else by.agg(_rms)
    at = np.arange(len(values))
    for k, (name, colour) in enumerate((("exact", "tab:blue"), ("first_order", "0.6"), ("difference", "tab:red"))):
        axes.bar(at + 0.27 * (k - 1), values[name], 0.27, color=colour, label=name.replace("_", " "))
    axes.set_xticks(at, [label(f"{unit} {axis}") for unit, axis in values.index], rotation=90, fontsize=7)
    axes.axhline(0, color="0.4", lw=0.6)
    axes.set_title(label(title), fontsize=10)
    axes.tick_params(axis="y", labelsize=8)


def _rms(values: pd.Series) -> float:
    return float(np.sqrt((values**2).mean()))


def write_sensitivity(
    tables: SensitivityTables, directory: Path, seconds: dict[str, float], record: CommandRecord
) -> None:
    """Three tables, sensitivity.png, report.html and summary.json in `directory`.

    Raises InputError if `directory` holds something else than an earlier result.
    """
    began, adjusted, figure = time.perf_counter(), tables.adjusted, tables.figure()
    files = {
        "sensitivity": tables.bias, "variance_shares": tables.variance_shares,
        "external_reliability": tables.external_reliability,
    }  # fmt: skip
    changes, shares, reliability = (t[t["estimate"].str.startswith("interior")] for t in files.values())
    verdict = f"Effects of a station bias of {tables.bias_m:g} m per {tables.per}"
    if len(most := tables.largest.dropna()):
        worst = most.iloc[int(most["over_sigma"].abs().to_numpy().argmax())]
        verdict += (
            f": at most {abs(worst['over_sigma']):.2f} sigma, {in_symbols(worst['estimate'])} by a bias of "
            f"{worst['unit']} in {worst['axis']}"
        )
    parts: list[Part] = [
        Paragraph(
            f"{adjusted.block.title or 'Block'}: sigma naught {float(adjusted.sigma0):.4g}, redundancy "
            f"{adjusted.redundancy}, {len(tables.check)} check points."
        ),
        *assumed_pixels(adjusted.block.sensors),
        Heading("Largest effects"),
        tables.largest.rename(columns={"unit": tables.per}),
        Plot(figure, "effects of a station bias: exact, first-order and their difference"),
        Heading("Effects on the interior orientation"),
        changes.rename(columns={"unit": tables.per}),
        Paragraph("All estimates are in sensitivity.csv."),
        Heading("Variance contributions by observation group"),
        readable(shares).rename(columns={"share": "fraction", "largest_share": "largest fraction"}),
        Heading("External reliability"),
        readable(reliability).rename(columns={"detectable": "MDB", "redundancy_number": "r"}),
    ]
    with whole_folder(directory) as work:
        summary = _summary(tables, seconds | {"write": time.perf_counter() - began})
        write_study(work, "Sensitivity", (verdict, ""), parts, summary, record, files, {"sensitivity": figure})


def _summary(tables: SensitivityTables, seconds: dict[str, float]) -> dict:
    adjusted, largest, shares = tables.adjusted, tables.largest.set_index("estimate"), tables.variance_shares
    mdb = external_reliability(adjusted, tables.exact, tables.delta0).mdb
    interior = {}
    for name in (path for path in tables.exact.labels if path.startswith("interior")):
        groups = shares[shares["estimate"] == name].set_index("group")["share"]
        interior[name] = {
            "largest_change": {key: largest.loc[name][key] for key in _LARGEST},
            "variance_shares": {str(group): float(share) for group, share in groups.items()},
        }
    return {
        "title": adjusted.block.title, "bias_m": tables.bias_m, "per": tables.per, "delta0": tables.delta0,
        "sigma0": float(adjusted.sigma0), "redundancy": adjusted.redundancy, "check_points": len(tables.check),
        "unchecked_observations": {name: int((~np.isfinite(v)).sum()) for name, v in mdb.items()}, "interior": interior,
        "seconds": rounded(seconds),
    }  # fmt: skip
