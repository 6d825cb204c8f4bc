"""Sensitivity as tables and a picture: where a station bias ends, what estimates hang on, undetected errors."""

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
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.findings import parameter_words
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.plots import axes_or_new, drawn, new_figure
from jaxphoto.report.results import write_summary
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.report.study_page import StudyPart, WholePicture, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.report.units import label_unit
from jaxphoto.sensitivity.exact import Sensitivity, sensitivity
from jaxphoto.sensitivity.influence import DELTA0, Per, external_reliability, station_bias, variance_shares
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of the largest change, what a summary says.
_LARGEST = ("unit", "axis", "exact", "first_order", "over_sigma", "estimate_unit")
# Interior parameters in the figure.
_SHOWN = 6


class SensitivityTables:
    """What the sensitivity of an adjustment says of its shared unknowns and its check points.

    Numbers are in the estimate's own unit, which stands in `estimate_unit`. `bias_m` is the station bias and `per`
    whose stations have it: the block's, a strip's, an image's.
    """

    def __init__(self, adjusted: Adjustment, per: Per = "strip", bias_m: float = 0.10, delta0: float = DELTA0):
        self.adjusted, self.per, self.bias_m, self.delta0 = adjusted, per, bias_m, delta0
        self.check = tuple(adjusted.block.points[k] for k in dict.fromkeys(adjusted.block.check.who.tolist()))

    @cached_property
    def exact(self) -> Sensitivity:
        """The derivatives."""
        return sensitivity(self.adjusted, points=self.check)

    @cached_property
    def first_order(self) -> Sensitivity:
        """The classical first-order matrix."""
        return sensitivity(self.adjusted, curvature=False, points=self.check)

    @cached_property
    def _rows(self) -> slice:
        """Shared unknowns and check points: all estimates but the exterior orientations."""
        return slice(6 * len(self.adjusted.block.images), None)

    @cached_property
    def bias(self) -> pd.DataFrame:
        """unit, axis, bias_m, estimate, exact, first_order, difference, estimate_unit: what a bias of each unit's
        stations does."""
        of = [station_bias(self.adjusted, d, self.per, self.bias_m) for d in (self.exact, self.first_order)]
        exact, first = (b.change[self._rows].transpose(1, 2, 0) for b in of)
        labels = self.exact.labels[self._rows]
        index = pd.MultiIndex.from_product([of[0].units, AXES, labels], names=["unit", "axis", "estimate"])
        table = index.to_frame(index=False)
        table.insert(2, "bias_m", self.bias_m)
        table["exact"], table["first_order"] = exact.ravel(), first.ravel()
        table["difference"] = table["exact"] - table["first_order"]
        return table.assign(estimate_unit=table["estimate"].map(self._units))

    @cached_property
    def _units(self) -> dict[str, str]:
        """Units of the estimates."""
        return {label: label_unit(label, self.adjusted.unknowns.interior) for label in self.exact.labels[self._rows]}

    @cached_property
    def largest(self) -> pd.DataFrame:
        """Of each interior parameter the row of `bias` that changes it most, with the change over its sigma.

        estimate, exact, over_sigma (a priori), first_order, unit, axis, estimate_unit.
        """
        interior = self.bias[self.bias["estimate"].str.startswith("interior")]
        most = interior.loc[interior.groupby("estimate", sort=False)["exact"].apply(lambda v: v.abs().idxmax())]
        sigma = dict(zip(self.exact.labels, np.sqrt(variance_shares(self.adjusted, self.exact).variance), strict=True))
        over = most["exact"] / most["estimate"].map(sigma).where(lambda v: v > 0)
        columns = ["estimate", "exact", "over_sigma", "first_order", "unit", "axis", "estimate_unit"]
        return most.assign(over_sigma=over)[columns].reset_index(drop=True)

    @cached_property
    def variance_shares(self) -> pd.DataFrame:
        """estimate, group, share, and the observation (image, point, axis) that most of it is of, largest_share."""
        shares = variance_shares(self.adjusted, self.exact)
        found = []
        for group, share in shares.groups.items():
            if not share.size:
                continue
            share, rows = share[self._rows], self._observations[group]
            most = share.argmax(axis=1)
            table = rows.iloc[most][["image", "point", "axis"]].reset_index(drop=True)
            table.insert(0, "share", share.sum(axis=1))
            table.insert(0, "group", group)
            table.insert(0, "estimate", np.array(self.exact.labels[self._rows], object))
            table["largest_share"] = share.max(axis=1)
            found.append(table)
        return pd.concat(found, ignore_index=True).sort_values("estimate", kind="stable", ignore_index=True)

    @cached_property
    def external_reliability(self) -> pd.DataFrame:
        """Of each estimate and group the worst observation: what its minimal detectable error does, undetected.

        estimate, group, image, point, axis, redundancy_number, detectable, unit, effect, effect_over_sigma,
        estimate_unit: `unit` is that of the detectable error, `estimate_unit` that of the effect, sigma is the
        estimate's a priori. Observations that nothing checks are left out; the summary counts them.
        """
        found = external_reliability(self.adjusted, self.exact, self.delta0)
        sigma = np.sqrt(variance_shares(self.adjusted, self.exact).variance)[self._rows]
        tables = []
        for group, effect in found.effect.items():
            detectable = found.mdb[group]
            checked = np.isfinite(detectable)
            if not checked.any():
                continue
            effect, rows = effect[self._rows], self._observations[group]
            worst = np.where(checked, np.abs(effect), -1.0).argmax(axis=1)
            table = rows.iloc[worst].reset_index(drop=True).drop(columns=["group", "factor"])
            table.insert(0, "group", group)
            table.insert(0, "estimate", np.array(self.exact.labels[self._rows], object))
            table.insert(6, "detectable", rows["factor"].to_numpy()[worst] * detectable[worst])
            table["effect"] = effect[np.arange(len(effect)), worst]
            table["effect_over_sigma"] = table["effect"] / np.where(sigma > 0, sigma, np.nan)
            table["estimate_unit"] = table["estimate"].map(self._units)
            tables.append(table)
        return pd.concat(tables, ignore_index=True).sort_values("estimate", kind="stable", ignore_index=True)

    @cached_property
    def _observations(self) -> dict[str, pd.DataFrame]:
        """Whose each column of `Sensitivity.groups` is, with the factor to the unit of tables."""
        table = Tables(self.adjusted).residuals[["group", "image", "point", "axis", "redundancy_number", "unit"]]
        table = table.assign(factor=np.where(table["unit"] == "deg", 180 / np.pi, 1.0))
        return {str(group): rows for group, rows in table.groupby("group")}

    @cached_property
    def panels(self) -> dict[str, list[str]]:
        """What can be drawn, by title, and the estimates that it is of: interior orientation, check points by axis."""
        interior = [e for e in dict.fromkeys(self.bias["estimate"]) if e.startswith("interior")]
        panels = {e.split("].")[1] if len(self.adjusted.unknowns.interior) == 1 else e: [e] for e in interior}
        return panels | {
            f"check points, {a}, RMS [m]": [f"points[{p}].{a}" for p in self.check] for a in AXES if self.check
        }

    def figure(self) -> Figure:
        """Interior orientation and check points: the change by a bias of each unit and axis, exact and first-order."""
        interior = [title for title, (first, *_) in self.panels.items() if first.startswith("interior")]
        panels = [title for title in self.panels if title not in interior[_SHOWN:]]
        columns = 3
        down = max(1, -(-len(panels) // columns))
        figure = new_figure(9.6, 0.9 + 2.3 * down)
        # Names along an axis stand on end: room between them and the title of the panel below.
        figure.set_layout_engine("constrained", h_pad=0.12)
        for axes, title in zip(figure.subplots(down, columns, squeeze=False).flat, panels, strict=False):
            _draw_changes(axes, self, title)
        for axes in figure.axes[len(panels) :]:
            axes.remove()
        if panels:
            figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
        figure.suptitle(f"change by a station bias of {self.bias_m:g} m per {self.per}", fontsize=11)
        return figure


def plot_sensitivity(tables: SensitivityTables, title: str, ax: Axes | None = None) -> Axes:
    """What a station bias of each unit does to an estimate, or to the check points: exact, first-order, difference.

    `title` is one of `tables.panels`, such as `c_mm`. Raises InputError for another.
    """
    if title not in tables.panels:
        raise InputError(f"there is no {title!r} to be drawn; there are {'; '.join(tables.panels)}")
    ax = axes_or_new(ax)
    _draw_changes(ax, tables, title)
    ax.legend(fontsize=8)
    return ax


def _draw_changes(axes: Axes, tables: SensitivityTables, title: str) -> None:
    names = tables.panels[title]
    chosen = tables.bias[tables.bias["estimate"].isin(names)]
    by = chosen.groupby(["unit", "axis"], sort=False)[["exact", "first_order", "difference"]]
    values = by.sum() if len(names) == 1 else by.agg(_rms)
    at = np.arange(len(values))
    for k, (name, colour) in enumerate((("exact", "tab:blue"), ("first_order", "0.6"), ("difference", "tab:red"))):
        axes.bar(at + 0.27 * (k - 1), values[name], 0.27, color=colour, label=name.replace("_", " "))
    axes.set_xticks(at, [drawn(f"{unit} {axis}") for unit, axis in values.index], rotation=90, fontsize=7)
    axes.axhline(0, color="0.4", lw=0.6)
    axes.set_title(drawn(title), fontsize=10)
    axes.tick_params(axis="y", labelsize=8)


def _rms(values: pd.Series) -> float:
    return float(np.sqrt((values**2).mean()))


def write_sensitivity(tables: SensitivityTables, directory: Path, seconds: dict[str, float], made: Made) -> None:
    """Three tables, sensitivity.png, report.html and summary.json in `directory`.

    All of it is written before earlier results are replaced. Raises InputError where `directory` holds something that
    is not an earlier result.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        tables.bias.to_csv(work / "sensitivity.csv", index=False)
        tables.variance_shares.to_csv(work / "variance_shares.csv", index=False)
        tables.external_reliability.to_csv(work / "external_reliability.csv", index=False)
        picture = WholePicture.of(tables.figure(), "changes by a station bias: exact, first-order and their difference")
        (work / "sensitivity.png").write_bytes(picture.png)
        page = study_page("Sensitivity", *_page(tables, picture, made))
        (work / "report.html").write_text(page, encoding="utf-8")
        write_summary(_summary(tables, seconds | {"write": time.perf_counter() - began}), work)


def _page(tables: SensitivityTables, picture: WholePicture, made: Made) -> tuple[list[str], list[StudyPart]]:
    """Sentences and parts of the page: interior orientation and check points, and what most of each is of."""
    adjusted = tables.adjusted
    said = [
        f"What a bias of {tables.bias_m:g} m in the stations of a {tables.per} does to each estimate; what each hangs "
        "on; and what an error that no test finds would do.",
        f"{adjusted.block.title or 'Block'}: sigma naught {float(adjusted.sigma0):.4g}, redundancy "
        f"{adjusted.redundancy}, {len(tables.check)} check points.",
    ]
    shown = tables.bias["estimate"].str.startswith("interior")
    shares = tables.variance_shares[tables.variance_shares["estimate"].str.startswith("interior")]
    undetected = tables.external_reliability
    undetected = undetected[undetected["estimate"].str.startswith("interior")]
    if len(most := tables.largest.dropna()):
        worst = most.iloc[int(most["over_sigma"].abs().to_numpy().argmax())]
        said.append(
            f"Moved most, for its standard deviation, is {parameter_words(worst['estimate'])}: by "
            f"{abs(worst['over_sigma']):.2f} of it, where the stations of {worst['unit']} are off in {worst['axis']}."
        )
    # In a table of many units of measurement "unit" is read as one of them.
    largest, changes = (table.rename(columns={"unit": tables.per}) for table in (tables.largest, tables.bias[shown]))
    parts: list[StudyPart] = [
        *assumed_pixels(adjusted.block.sensors),
        Heading("Largest changes"),
        rows_of(largest),
        picture,
    ]
    parts += [Heading("Changes of the interior orientation")]
    parts += [rows_of(changes), Paragraph("Every estimate stands in sensitivity.csv.")]
    parts += [Heading("Which observations the variance is of"), rows_of(shares)]
    parts += [Heading("What an undetected error does"), rows_of(undetected), *made_section(made)]
    return said, parts


def _summary(tables: SensitivityTables, seconds: dict[str, float]) -> dict:
    adjusted, largest = tables.adjusted, tables.largest.set_index("estimate")
    shares = tables.variance_shares
    detectable = external_reliability(adjusted, tables.exact, tables.delta0).mdb
    interior = {}
    for name in (label for label in tables.exact.labels if label.startswith("interior")):
        worst = largest.loc[name]
        groups = shares[shares["estimate"] == name].set_index("group")["share"]
        interior[name] = {
            "largest_change": {key: worst[key] for key in _LARGEST},
            "variance_shares": {str(group): float(share) for group, share in groups.items()},
        }
    return {
        "title": adjusted.block.title,
        "bias_m": tables.bias_m,
        "per": tables.per,
        "delta0": tables.delta0,
        "sigma0": float(adjusted.sigma0),
        "redundancy": adjusted.redundancy,
        "check_points": len(tables.check),
        "unchecked_observations": {name: int((~np.isfinite(v)).sum()) for name, v in detectable.items()},
        "interior": interior,
        "seconds": {name: round(value, 6) for name, value in seconds.items()},
        "versions": versions(),
    }
