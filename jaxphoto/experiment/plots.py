"""Pictures of an experiment: ours against what is printed. Matplotlib figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.experiment.comparison import MEAN_DIFFERENCE
from jaxphoto.experiment.wording import heading, power_of, table_title
from jaxphoto.report import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ACROSS = 5


def comparison_figure(comparison: pd.DataFrame, table: str) -> Figure:
    """One panel for each printed column of `table`, one line for each row: what is printed and ours.

    `comparison` is that of `compare`. Bars are the tolerance of the printed value and the standard deviation of ours
    from layout to layout. Raises ValueError where nothing of the table is both printed and ours.
    """
    cells = comparison[(comparison["table"] == table) & (comparison["column"] != MEAN_DIFFERENCE)]
    cells = cells[cells["published"].notna() & cells["ours"].notna()]
    if cells.empty:
        raise ValueError(f"nothing of {table!r} is both printed and ours")
    rows = list(dict.fromkeys(cells["row"]))
    groups = list(cells.groupby("column", sort=False))
    down = -(-len(groups) // _ACROSS)
    figure = new_figure(1.6 + 1.8 * min(len(groups), _ACROSS), down * (1.2 + 0.24 * len(rows)))
    panels = figure.subplots(down, min(len(groups), _ACROSS), squeeze=False, sharey=True).ravel()
    for axes, (column, of) in zip(panels, groups, strict=False):
        power = power_of(np.concatenate([of["published"], of["ours"]]))
        values = of[["published", "tolerance", "ours", "spread"]].astype(float) * 10.0**-power
        at = np.array([rows.index(row) for row in of["row"]])
        bars = {"capsize": 2, "lw": 1, "ls": "none"}
        axes.errorbar(
            values["published"], at - 0.15, xerr=values["tolerance"], marker="s", ms=5, mfc="none",
            color="0.45", label="printed ± tolerance", **bars,
        )  # fmt: skip
        axes.errorbar(
            values["ours"], at + 0.15, xerr=values["spread"], marker="o", ms=4, color="tab:blue",
            label="ours ± spread", **bars,
        )  # fmt: skip
        unit = next((u for u in of["unit"] if isinstance(u, str)), "")
        axes.set_title(heading(str(column), unit, power), fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(axis="y", lw=0.3)
        axes.locator_params(axis="x", nbins=4)
    for axes in panels[len(groups) :]:
        axes.set_axis_off()
    panels[0].set_yticks(range(len(rows)), rows, fontsize=8)
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    figure.suptitle(table_title(table), fontsize=11)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure
