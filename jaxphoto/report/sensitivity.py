"""Sensitivity: effects of a station bias, variance contributions by observation group, external reliability."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.report.findings import in_symbols
from jaxphoto.report.formatting import in_figures, label_unit, of_sigma, path_words, to_rich, with_sigma
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, label
from jaxphoto.report.results import assumed_pixels, rounded, write_study
from jaxphoto.report.tables import Tables, about_sigma, estimates_table
from jaxphoto.report.terminal import plain, print_sigma0
from jaxphoto.sensitivity.exact import Sensitivity, sensitivity
from jaxphoto.sensitivity.influence import DELTA0, Per, external_reliability, station_bias, variance_shares
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Times of the adjustment in summary.json.
_TIMES = ("compile", "solve", "covariance", "sensitivity")
# Columns of the largest changes in summary.json.
_LARGEST = ("unit", "axis", "exact", "first_order", "over_sigma", "estimate_unit")


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
    def tables(self) -> Tables:
        """Tables of the adjustment."""
        return Tables(self.adjusted)

    @cached_property
    def sigma(self) -> pd.Series:
        """Standard deviations of the estimates (a posteriori), as in `Tables`; NaN for fixed ones."""
        c, points = self.tables.covariance, self.adjusted.block.points
        sigma = dict(zip(self.adjusted.structure.labels, np.asarray(c.shared_sigma), strict=True))
        at = np.asarray(c.point_sigma)
        sigma |= {f"points[{p}].{a}": at[points.index(p), k] for p in self.check for k, a in enumerate(AXES)}
        return pd.Series([sigma.get(name, np.nan) for name in self._estimates], self._estimates).where(lambda v: v > 0)

    def in_order(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the rows of the interior parameters in the order of the estimates."""
        place = {name: k for k, name in enumerate(self._estimates)}
        rows = table[table["estimate"].str.startswith("interior")]
        return rows.sort_values("estimate", key=lambda names: names.map(place), kind="stable")

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

        Columns: estimate, exact, over_sigma (a posteriori), first_order, unit, axis, estimate_unit.
        """
        interior = self.bias[self.bias["estimate"].str.startswith("interior")]
        most = interior.loc[interior.groupby("estimate", sort=False)["exact"].apply(lambda v: v.abs().idxmax())]
        over = most["exact"] / most["estimate"].map(self.sigma)
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
        effect_over_sigma, estimate_unit. MDB, effect and the standard deviation of the last ratio are a priori, as in
        `Tables.residuals`: the ratio does not depend on sigma naught. Unchecked observations are skipped; the summary
        contains their number.
        """
        reliability = external_reliability(self.adjusted, self.exact, self.delta0)
        sigma, tables = self.sigma.to_numpy() / np.sqrt(float(self.tables.covariance.variance_factor)), []
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
            table["effect_over_sigma"] = table["effect"] / sigma
            tables.append(table.assign(estimate_unit=table["estimate"].map(self._units)))
        return pd.concat(tables, ignore_index=True).sort_values("estimate", kind="stable", ignore_index=True)

    @cached_property
    def _observations(self) -> dict[str, pd.DataFrame]:
        """Observations by group, one row per column of `Sensitivity.groups`, with the factor to the unit of tables."""
        table = self.tables.residuals[["group", "image", "point", "axis", "redundancy_number", "unit"]]
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


def sensitivity_verdict(tables: SensitivityTables) -> str:
    """State the largest effect of the station bias on an interior parameter."""
    verdict = f"Effects of a station bias of {tables.bias_m:g} m per {tables.per}"
    if not len(most := tables.largest.dropna()):
        return verdict
    worst = most.iloc[int(most["over_sigma"].abs().to_numpy().argmax())]
    return (
        f"{verdict}: at most {abs(worst['over_sigma']):.2f} sigma, {in_symbols(worst['estimate'])} by a bias of "
        f"{worst['unit']} in {worst['axis']}"
    )


def largest_effects(tables: SensitivityTables) -> pd.DataFrame:
    """Tabulate the interior parameters with the largest effect of the station bias on each, as text.

    Columns: parameter, value, sigma, unit, largest effect, in sigma, by.
    """
    largest, sizes = tables.largest.set_index("estimate"), estimates_table(tables.tables).set_index("parameter")
    rows = []
    for path, effect in zip(largest.index.astype(str), largest.to_dict("records"), strict=True):
        value, sigma = (float(sizes[name].get(path, np.nan)) for name in ("value", "sigma"))
        rows.append({
            "parameter": path_words(str(path)).partition(" [")[0], "value": with_sigma(value, sigma),
            "sigma": of_sigma(sigma), "largest effect": with_sigma(effect["exact"], 0.1 * sigma),
            "unit": effect["estimate_unit"], "in sigma": f"{effect['over_sigma']:.2f}",
            f"by {tables.per}": f"{effect['unit']} in {effect['axis']}",
        })  # fmt: skip
    return pd.DataFrame(rows)


def effects_by_unit(tables: SensitivityTables) -> pd.DataFrame:
    """Tabulate the effects of the station bias as text, one row per unit and axis.

    Columns: unit, axis, one per interior parameter (in sigma), and RMS effects on the check points.
    """
    bias, columns = tables.bias, {}
    for title, names in tables.panels.items():
        chosen = bias[bias["estimate"].isin(names)].groupby(["unit", "axis"], sort=False)["exact"]
        if len(names) == 1 and names[0].startswith("interior"):
            head = f"{path_words(title).partition(' [')[0]} [sigma]"
            # Avoid a minus sign before zeros.
            columns[head] = ((chosen.sum() / tables.sigma[names[0]]).round(2) + 0.0).map("{:.2f}".format)
        else:
            columns[title] = chosen.agg(_rms).map("{:.4f}".format)
    return pd.DataFrame(columns).reset_index(names=[tables.per, "axis"])


def contributions(tables: SensitivityTables) -> pd.DataFrame:
    """Tabulate the variance fractions of the interior parameters as text, one column per group of observations."""
    rows = []
    for path, of in tables.in_order(tables.variance_shares).groupby("estimate", sort=False):
        worst = of.iloc[int(of["largest_share"].to_numpy().argmax())]
        rows.append({
            "parameter": path_words(str(path)).partition(" [")[0],
            **{str(g).replace("_", " "): f"{100 * v:.1f} %" for g, v in zip(of["group"], of["share"], strict=True)},
            "largest contribution": f"{100 * worst['largest_share']:.1f} %", "by": _observation(worst),
        })  # fmt: skip
    return pd.DataFrame(rows).fillna("")


def reliability(tables: SensitivityTables) -> pd.DataFrame:
    """Tabulate the external reliability of the interior parameters as text.

    Columns: parameter, observation, r, MDB, effect [sigma].
    """
    return pd.DataFrame([
        {
            "parameter": path_words(row["estimate"]).partition(" [")[0], "observation": _observation(row),
            "r": f"{row['redundancy_number']:.3f}", "MDB": f"{in_figures(row['detectable'], 3)} {row['unit']}",
            "effect [sigma]": f"{row['effect_over_sigma']:.2f}",
        }
        for row in tables.in_order(tables.external_reliability).to_dict("records")
    ])  # fmt: skip


def _observation(row: Mapping[Any, Any] | pd.Series) -> str:
    words = [str(row["group"]).replace("_", " ").removesuffix("s")]
    words += [f"{name} {row[name]}" for name in ("point", "image") if row[name]]
    return f"{', '.join(words)}, {row['axis']}"


def write_sensitivity(
    tables: SensitivityTables, directory: Path, seconds: dict[str, float], record: CommandRecord
) -> None:
    """Write three tables, report.html and summary.json into `directory`."""
    adjusted = tables.adjusted
    files = {
        "sensitivity": tables.bias, "variance_shares": tables.variance_shares,
        "external_reliability": tables.external_reliability,
    }  # fmt: skip
    verdict = sensitivity_verdict(tables)
    interior = tables.bias["estimate"].str.startswith("interior")
    over = (tables.bias["difference"].abs() / tables.bias["estimate"].map(tables.sigma))[interior]
    parts: list[Part] = [
        largest_effects(tables),
        Paragraph(
            f"{about_sigma(adjusted)} They are those of jaxphoto adjust. {adjusted.block.title or 'Block'}: "
            f"{len(tables.check)} check points. Exact and first-order effects on the interior orientation differ by at "
            f"most {over.max():.2g} sigma."
        ),
        *assumed_pixels(adjusted.block.sensors),
        Heading("Effects of the station bias"),
        Paragraph(
            f"Exact effect of {tables.bias_m:g} m on each interior parameter (in its sigma), and RMS effect on the "
            "check points. sensitivity.csv has all estimates with their units and the first-order effects."
        ),
        effects_by_unit(tables),
        [
            Plot(partial(plot_sensitivity, tables, name), f"effects of a station bias on {name}: exact and first-order")
            for k, name in enumerate(tables.panels)
            if k == 0 or name.startswith("check points, Z")
        ],
        Heading("Variance contributions by observation group"),
        Paragraph("Fraction of the variance of each parameter, and the observation that contributes most."),
        contributions(tables),
        Heading("External reliability"),
        Paragraph(
            "Observation of each group whose bias of one MDB (minimal detectable bias) changes the parameter most. r "
            "is the redundancy number. The effect in sigma does not depend on sigma naught: it is that of the page of "
            "jaxphoto adjust."
        ),
        reliability(tables),
    ]
    with whole_folder(directory) as work:
        write_study(work, "Sensitivity", (verdict, ""), parts, _summary(tables, seconds), record, files)


def print_sensitivity(tables: SensitivityTables, console: Console) -> None:
    """Print the verdict, sigma naught, and the largest effect on each interior parameter."""
    console.print(plain(tables.adjusted.block.title or "block"), style="bold")
    console.print(plain(sensitivity_verdict(tables)), soft_wrap=True)
    print_sigma0(tables.adjusted, console)
    name = f"largest effects of a station bias of {tables.bias_m:g} m per {tables.per} (sigma a posteriori)"
    console.print(to_rich(largest_effects(tables), name))


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
        "seconds": rounded(seconds | {name: adjusted.seconds[name] for name in _TIMES}),
    }  # fmt: skip
