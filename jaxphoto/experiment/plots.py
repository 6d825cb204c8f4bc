"""Pictures of an experiment: ours against what is printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from jaxphoto.experiment.comparison import MEAN_DIFFERENCE
from jaxphoto.experiment.wording import heading, power_of, table_title
from jaxphoto.report import new_figure
from jaxphoto.report.plots import axes_or_new

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ACROSS = 5


def plot_comparison(comparison: pd.DataFrame, table: str, column: str, ax: Axes | None = None) -> Axes:
    """One printed column of `table`, a line for each row: what is printed and ours.

    `comparison` is that of `compare`. Bars are the tolerance of the printed value and the standard deviation of ours
    from layout to layout. Raises ValueError where nothing of the column is both printed and ours.
    """
    cells = _both(comparison, table)
    of = cells[cells["column"] == column]
    if of.empty:
        known = ", ".join(dict.fromkeys(cells["column"]))
        raise ValueError(f"no column {column!r} of {table!r} is both printed and ours; those that are: {known}")
    ax = axes_or_new(ax)
    rows = list(dict.fromkeys(of["row"]))
    _draw_column(ax, of, rows)
    _name_rows(ax, rows)
    ax.legend(fontsize=8)
    return ax


def comparison_figure(comparison: pd.DataFrame, table: str) -> Figure:
    """One panel for each printed column of `table`, as `plot_comparison` has it.

    Raises ValueError where nothing of the table is both printed and ours.
    """
    cells = _both(comparison, table)
    rows = list(dict.fromkeys(cells["row"]))
    groups = list(cells.groupby("column", sort=False))
    down = -(-len(groups) // _ACROSS)
    figure = new_figure(1.6 + 1.8 * min(len(groups), _ACROSS), down * (1.2 + 0.24 * len(rows)))
    panels = figure.subplots(down, min(len(groups), _ACROSS), squeeze=False, sharey=True).ravel()
    for axes, (_, of) in zip(panels, groups, strict=False):
        _draw_column(axes, of, rows)
    for axes in panels[len(groups) :]:
        axes.set_axis_off()
    _name_rows(panels[0], rows)
    figure.suptitle(table_title(table), fontsize=11)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _both(comparison: pd.DataFrame, table: str) -> pd.DataFrame:
    """The cells of a table that are both printed and ours."""
    cells = comparison[(comparison["table"] == table) & (comparison["column"] != MEAN_DIFFERENCE)]
    cells = cells[cells["published"].notna() & cells["ours"].notna()]
    if cells.empty:
        raise ValueError(f"nothing of {table!r} is both printed and ours")
    return cells


def _draw_column(axes: Axes, of: pd.DataFrame, rows: list[str]) -> None:
    power = power_of(np.concatenate([of["published"], of["ours"]]))
    values = of[["published", "tolerance", "ours", "spread"]].astype(float) * 10.0**-power
    at = np.array([rows.index(row) for row in of["row"]])
    bars: dict[str, Any] = {"capsize": 2, "lw": 1, "ls": "none"}
    axes.errorbar(
        values["published"], at - 0.15, xerr=values["tolerance"], marker="s", ms=5, mfc="none",
        color="0.45", label="printed ± tolerance", **bars,
    )  # fmt: skip
    axes.errorbar(
        values["ours"], at + 0.15, xerr=values["spread"], marker="o", ms=4, color="tab:blue",
        label="ours ± spread", **bars,
    )  # fmt: skip
    unit = next((u for u in of["unit"] if isinstance(u, str)), "")
    axes.set_title(heading(str(of["column"].iloc[0]), unit, power), fontsize=9)
    axes.tick_params(labelsize=7)
    axes.grid(axis="y", lw=0.3)
    axes.locator_params(axis="x", nbins=4)


def _name_rows(axes: Axes, rows: list[str]) -> None:
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)


def plot_agreement(comparison: pd.DataFrame, ax: Axes | None = None) -> Axes:
    """Of every value with a tolerance ours minus printed over it, by table; `comparison` is that of `compare`.

    Raises ValueError where no value that is ours has one.
    """
    if not comparison["within"].ne("").any():
        raise ValueError("no value that is printed and ours has a tolerance")
    ax = axes_or_new(ax)
    draw_agreement(ax, comparison)
    return ax


def draw_agreement(axes: Axes, comparison: pd.DataFrame) -> None:
    """The same in a panel."""
    cells = comparison[comparison["within"] != ""]
    off = ((cells["ours"] - cells["published"]) / cells["tolerance"]).to_numpy(float)
    tables = list(dict.fromkeys(cells["table"]))
    place, number = pd.factorize(cells["table"])[0], cells.groupby("table").cumcount().to_numpy()
    # Values of a table one below the other, in the order of the print.
    at = place + 0.7 * (number / np.maximum(cells.groupby("table")["table"].transform("size") - 1, 1) - 0.5)
    within = (cells["within"] == "yes").to_numpy()
    axes.axvspan(-1, 1, color="0.93", lw=0)
    for rows, marker, colour, label in ((within, "o", "tab:blue", "within"), (~within, "x", "tab:red", "not within")):
        if rows.any():
            axes.plot(off[rows], at[rows], marker, ms=5, mew=1.5, color=colour, label=label, ls="none")
    axes.set_yticks(range(len(tables)), list(map(table_title, tables)), fontsize=8)
    axes.set_ylim(len(tables) - 0.5, -0.5)
    axes.set_xlabel("(ours - printed) / tolerance")
    axes.set_title("all values with a tolerance", loc="left", fontsize=9)
    axes.legend(fontsize=7)
