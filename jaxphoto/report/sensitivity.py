"""Sensitivity: effects of a station bias, variance contributions by observation group, external reliability."""

from __future__ import annotations

from functools import cached_property, partial
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
from jaxphoto.report.plots import axes_or_new, label
from jaxphoto.report.results import assumed_pixels, rounded, write_study
from jaxphoto.report.tables import Tables
from jaxphoto.sensitivity.exact import Sensitivity, sensitivity
from jaxphoto.sensitivity.influence import DELTA0, Per, external_reliability, station_bias, variance_shares
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Columns of the largest changes in summary.json.
_LARGEST = ("unit", "axis", "exact", "first_order", "over_sigma", "estimate_unit")
# Maximum number of interior parameters in the figure.
_SHOWN = 6


class SensitivityTables:
    """Sensitivity of the shared unknowns and check points of an adjustment.

    Values are in the unit of each estimate (`estimate_unit`). `bias_m` is the station bias, common to the stations of
    each unit of `per`: block, strip or image.
    """

    def __init__(self, adjusted: Adjustment, per: Per = "strip", bias_m: float = 0.10, delta0: float = DELTA0):
        self.adjusted, self.per, self.bias_m, self.delta0 = adjusted, per, bias_m, delta0
        self.check = tuple(adjusted.block.points[k] for k in dict.fromkeys(adjusted.block.check.who.tolist()))

    @cached_property
    def exact(self) -> Sensitivity:
        """Exact derivatives of the estimates."""
        return sensitivity(self.adjusted, points=self.check)

    @cached_property
    def first_order(self) -> Sensitivity:
        """First-order derivatives of the estimates."""
        return sensitivity(self.adjusted, curvature=False, points=self.check)

    @property
    def _rows(self) -> slice:
        """Index range of all estimates except the exterior orientations."""
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
        """Effects of the station bias.

        Columns: unit, axis, bias_m, estimate, exact, first_order, difference, estimate_unit.
        """
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
        """Largest effect on each interior parameter.

        Columns: estimate, exact, over_sigma (a priori), first_order, unit, axis, estimate_unit.
        """
        interior = self.bias[self.bias["estimate"].str.startswith("interior")]
        most = interior.loc[interior.groupby("estimate", sort=False)["exact"].apply(lambda v: v.abs().idxmax())]
        sigma = dict(zip(self.exact.labels, self._sigma, strict=True))
        over = most["exact"] / most["estimate"].map(sigma).where(lambda v: v > 0)
        columns = ["estimate", "exact", "over_sigma", "first_order", "unit", "axis", "estimate_unit"]
        return most.assign(over_sigma=over)[columns].reset_index(drop=True)

    @cached_property
    def variance_shares(self) -> pd.DataFrame:
        """Variance contributions by observation group.

        Columns: estimate, group, share, image, point and axis of the observation with the largest contribution, and
        largest_share.
        """
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
        """Observation whose bias of one MDB has the largest effect, by estimate and group.

        Columns: estimate, group, image, point, axis, redundancy_number, detectable (MDB), unit, effect,
        effect_over_sigma (a priori), estimate_unit. Unchecked observations are skipped; the summary contains their
        number.
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
        """Observations by group, one row per column of `Sensitivity.groups`, with the factor to the unit of tables."""
        table = Tables(self.adjusted).residuals[["group", "image", "point", "axis", "redundancy_number", "unit"]]
        table = table.assign(factor=np.where(table["unit"] == "deg", 180 / np.pi, 1.0))
        return {str(group): rows for group, rows in table.groupby("group")}

    @cached_property
    def panels(self) -> dict[str, list[str]]:
        """Panels of the figure by title, with their estimates: interior orientation, and check points by axis."""
        interior = [e for e in dict.fromkeys(self.bias["estimate"]) if e.startswith("interior")]
        panels = {e.split("].")[1] if len(self.adjusted.unknowns.interior) == 1 else e: [e] for e in interior}
        return panels | {
            f"check points, {a}, RMS [m]": [f"points[{p}].{a}" for p in self.check] for a in AXES if self.check
        }


def plot_sensitivity(tables: SensitivityTables, title: str, ax: Axes | None = None) -> Axes:
    """Draw effects of a station bias of each unit on an estimate or the check points: exact, first-order, difference.

    `title` is a key of `tables.panels`, such as `c_mm`. Raises InputError for an unknown title.
    """
    if title not in tables.panels:
        raise InputError(f"unknown estimate {title!r}; use one of {'; '.join(tables.panels)}")
    ax, names = axes_or_new(ax), tables.panels[title]
    chosen = tables.bias[tables.bias["estimate"].isin(names)]
    by = chosen.groupby(["unit", "axis"], sort=False)[["exact", "first_order", "difference"]]
    values = by.sum() if len(names) == 1 else by.agg(_rms)
    at = np.arange(len(values))
    for k, (name, colour) in enumerate((("exact", "tab:blue"), ("first_order", "0.6"), ("difference", "tab:red"))):
        ax.bar(at + 0.27 * (k - 1), values[name], 0.27, color=colour, label=name.replace("_", " "))
    ax.set_xticks(at, [label(f"{unit} {axis}") for unit, axis in values.index], rotation=90, fontsize=7)
    ax.axhline(0, color="0.4", lw=0.6)
    ax.set_title(label(title), fontsize=10)
    ax.tick_params(axis="y", labelsize=8)
    ax.legend(fontsize=7)
    return ax


def _rms(values: pd.Series) -> float:
    return float(np.sqrt((values**2).mean()))


def write_sensitivity(
    tables: SensitivityTables, directory: Path, seconds: dict[str, float], record: CommandRecord
) -> None:
    """Write three tables, report.html and summary.json into `directory`."""
    adjusted = tables.adjusted
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
        [
            Plot(partial(plot_sensitivity, tables, name), f"effects of a station bias on {name}: exact and first-order")
            for k, name in enumerate(tables.panels)
            if k < _SHOWN or name.startswith("check points")
        ],
        Heading("Effects on the interior orientation"),
        changes.rename(columns={"unit": tables.per}),
        Paragraph("All estimates are in sensitivity.csv."),
        Heading("Variance contributions by observation group"),
        readable(shares).rename(columns={"share": "fraction", "largest_share": "largest fraction"}),
        Heading("External reliability"),
        readable(reliability).rename(columns={"detectable": "MDB", "redundancy_number": "r"}),
    ]
    with whole_folder(directory) as work:
        write_study(work, "Sensitivity", (verdict, ""), parts, _summary(tables, seconds), record, files)


def _summary(tables: SensitivityTables, seconds: dict[str, float]) -> dict:
    adjusted, shares = tables.adjusted, tables.variance_shares.groupby("estimate")
    mdb = external_reliability(adjusted, tables.exact, tables.delta0).mdb
    interior = {
        row["estimate"]: {
            "largest_change": {key: row[key] for key in _LARGEST},
            "variance_shares": shares.get_group(row["estimate"]).set_index("group")["share"].to_dict(),
        }
        for row in tables.largest.to_dict("records")
    }
    return {
        "title": adjusted.block.title, "bias_m": tables.bias_m, "per": tables.per, "delta0": tables.delta0,
        "sigma0": float(adjusted.sigma0), "redundancy": adjusted.redundancy, "check_points": len(tables.check),
        "unchecked_observations": {name: int((~np.isfinite(v)).sum()) for name, v in mdb.items()}, "interior": interior,
        "seconds": rounded(seconds),
    }  # fmt: skip
