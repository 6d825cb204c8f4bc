"""HTML page of an experiment: agreement, each table with published and computed values, figures and files."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from jaxphoto.experiment.experiment import Run, compare
from jaxphoto.report.block_plot import block_words, plot_block
from jaxphoto.report.formatting import head_of, plus_minus, without_empty, without_unit
from jaxphoto.report.page import CommandRecord, Heading, Link, Paragraph, Part, Plot, page, provenance
from jaxphoto.report.plots import axes_or_new, check_points_figure, new_figure, title
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LEGEND = (
    "In each cell, above: ours, the mean over {layouts} simulated layouts +- the standard deviation from layout to "
    "layout. Below: the printed value (+- its tolerance). Green: within the tolerance; red and a cross: not. "
    "Yellow: no tolerance, ours over printed beyond 2 or below 1/2. No colour: no tolerance."
)
_WITHOUT_TOLERANCE, _NOT_COMPUTED = "no tolerance is published", "not computed"
# Beginning of columns with the value that the standard deviations of ours predict.
_EXPECTED = "expected_"
# Ratio of a computed and a published value without tolerance beyond which the page marks it; signed columns have none.
_FAR, _SIGNED = 2.0, r"mean_(?!abs)"
_STYLE = ".far { background: var(--amber); padding: 0 .3em }"
_CELL = Markup('<span class="{}">{}{}</span><br>{}')
_ACROSS = 5


def index_page(experiments: Mapping[str, tuple[str, pd.DataFrame]]) -> str:
    """Return a page with links to the pages of several experiments. Input: title and comparison by name."""
    return page("Experiments", [Link(f"{name}: {agreement(t)}", f"{k}.html") for k, (name, t) in experiments.items()])


def agreement(comparison: pd.DataFrame) -> str:
    """Summarise the number of judged values within their tolerance, and of published values that are not judged."""
    good, judged = (int((comparison["within"].isin(words)).sum()) for words in (["yes"], ["yes", "no"]))
    text = f"{good} of {judged} judged values within tolerance" if judged else "no value is judged"
    reasons = not_judged(comparison)
    few = {_WITHOUT_TOLERANCE: 0, "reason in the notes": 0, _NOT_COMPUTED: 0}
    for reason, n in zip(reasons["reason"], reasons["values"], strict=True):
        few[str(reason) if reason in few else "reason in the notes"] += int(n)
    words = "; ".join(f"{name}: {n}" for name, n in few.items() if n)
    return f"{text}; {reasons['values'].sum()} not judged ({words})" if len(reasons) else text


def not_judged(comparison: pd.DataFrame) -> pd.DataFrame:
    """Count the published values that are not judged: reason (the note of the cell, if any), values, tables."""
    cells = comparison[(comparison["within"] == "") & comparison["published"].notna()]
    reason = cells["note"].where(cells["note"] != "", _WITHOUT_TOLERANCE).where(cells["ours"].notna(), _NOT_COMPUTED)
    groups = cells["table"].groupby(reason.rename("reason"), sort=False)
    table = groups.agg(values="size", tables=lambda names: ", ".join(map(table_title, dict.fromkeys(names))))
    return table.reset_index().sort_values("values", ascending=False, kind="stable", ignore_index=True)


def far_apart(comparison: pd.DataFrame) -> pd.DataFrame:
    """Tabulate values without tolerance that differ from the published ones by more than a factor of 2.

    Columns: table, row, column, ours, published, ratio, expected (by the standard deviations of ours, if computed),
    unit, note. Signed columns (means) have no ratio.
    """
    key = ["table", "row", "column"]
    expected = comparison[comparison["column"].str.startswith(_EXPECTED)].set_index(key)["ours"]
    positive = (comparison[["ours", "published"]] > 0).all(axis=1) & ~comparison["column"].str.match(_SIGNED)
    ratio = (comparison["ours"] / comparison["published"]).where(positive & (comparison["within"] == ""))
    far = comparison.assign(ratio=ratio)[(ratio > _FAR) | (ratio < 1 / _FAR)]
    names = far.assign(column=_EXPECTED + far["column"].astype(str))[key].itertuples(index=False, name=None)
    far = far.assign(expected=[expected.get(name, np.nan) for name in names])
    return far[[*key, "ours", "published", "ratio", "expected", "unit", "note"]]


def experiment_page(run: Run, comparison: pd.DataFrame, record: CommandRecord | None = None) -> str:
    """Return the HTML page: agreement, the block of the first layout, each table, check points."""
    judged, first = comparison[comparison["within"] != ""], next(iter(run.first.values()))
    colour = "" if judged.empty else "amber" if (judged["within"] == "no").any() else "green"
    parts: list[Part] = [Paragraph(f"skipped: {failure}", "warning") for failure in run.failures]
    if len(reasons := not_judged(comparison)):
        parts += [Heading("Values that are not judged"), reasons]
    if len(far := far_apart(comparison)):
        words = "Values without tolerance, more than twice or less than half of the printed ones (yellow below)."
        if far["expected"].notna().any():
            words += (
                " Expected: by the standard deviations of our adjustment. Where ours agrees with it, the adjustment is "
                "consistent, and the difference is one of the simulated block from that of the paper."
            )
        shown = far.assign(table=far["table"].map(table_title), column=far["column"].map(head_of))
        for field in ("ours", "published", "ratio", "expected"):
            shown[field] = ["" if np.isnan(v) else f"{v:.3g}" for v in shown[field]]
        parts += [Paragraph(words), without_empty(shown.fillna(""))]
    if len(judged):
        words = "Ours minus printed over the tolerance, by table: within it between the lines, crosses beyond"
        parts += [Heading("Within the tolerances"), [Plot(partial(plot_agreement, comparison), words, 3.6)]]
    parts += [Heading("Block of the first layout")]
    parts += [[Plot(partial(plot_block, first.adjusted), block_words(first.adjusted.block), 4.2)]]
    parts += [Heading("Tables"), Paragraph(_LEGEND.format(layouts=run.cells["layout"].nunique()))]
    for name, cells in comparison.groupby("table", sort=False):
        parts += [Heading(table_title(str(name))), printed_table(cells)]
        notes = cells[cells["note"] != ""].groupby("note", sort=False)["column"].unique()
        parts += [Paragraph(f"{', '.join(map(head_of, columns))}: {note}") for note, columns in notes.items()]
    if check := {name: of for name, of in run.first.items() if len(of.check_points)}:
        parts += [Heading("Check points of the first layout")]
        parts += [Plot(check_points_figure(check), "discrepancies at check points, in plan and in height")]
    parts += provenance(record) if record else []
    return page(run.experiment.title, parts, (agreement(comparison), colour), _STYLE)


def printed_table(cells: pd.DataFrame) -> pd.DataFrame:
    """Return one table in the layout of the paper, as text: ours above the published value of each cell."""
    far, names = far_apart(cells)["ratio"], list(dict.fromkeys(cells["row"].astype(str)))
    heads = [heading(str(column), unit) for column, unit in zip(cells["column"], cells["unit"], strict=True)]
    # Cells are markup: columns of objects, because those of text would convert it.
    table = pd.DataFrame("", index=pd.Index(names, name="row"), columns=list(dict.fromkeys(heads)), dtype=object)
    for k, head, cell in zip(cells.index, heads, cells.to_dict("records"), strict=True):
        ours, printed = cell_words(cell)
        mark = " ✗" if cell["within"] == "no" else f" (x {far[k]:.2g})" if k in far else ""
        kind = "far" if k in far else cell["within"]
        table.loc[str(cell["row"]), head] = _CELL.format(kind, ours, mark, printed)
    return table.reset_index()


def cell_words(cell: Mapping[Any, Any]) -> tuple[str, str]:
    """Format the computed and the published value of a cell; "" if missing."""
    ours, spread, published, tolerance = (float(cell[k]) for k in ("ours", "spread", "published", "tolerance"))
    computed = plus_minus(ours, spread) if spread > 0 else f"{ours:.6g}"
    promised = f" (+- {tolerance:.2g})" if np.isfinite(tolerance) else ""
    return computed if np.isfinite(ours) else "", f"{published:g}{promised}" if np.isfinite(published) else ""


def heading(column: str, unit: Any) -> str:
    """Return the label of a column with its unit."""
    return head_of(column) if without_unit(column)[1] or not isinstance(unit, str) else f"{head_of(column)} [{unit}]"


def table_title(name: str) -> str:
    """`table2_iops` -> `Table 2: iops`; `agreement` -> `Agreement`."""
    number, _, words = name.partition("_")
    if number[:5] == "table" and number[5:].isdigit():
        return f"Table {number[5:]}: {words.replace('_', ' ')}"
    return name[:1].upper() + name[1:].replace("_", " ")


def write_runs(
    runs: Mapping[Path, Run], out: Path, record: Mapping[Path, CommandRecord] = MappingProxyType({})
) -> None:
    """Write tables.csv, cells.csv (every layout) and report.html of the `runs` of experiment folders into `out`.

    Several experiments get one page each, with report.html as index. `record` is the provenance of each run.
    """
    tables = {folder: compare(run, folder) for folder, run in runs.items()}
    pages = {f"{f.name}.html": experiment_page(run, tables[f], record.get(f)) for f, run in runs.items()}
    index = index_page({folder.name: (run.experiment.title, tables[folder]) for folder, run in runs.items()})
    pages = pages | {"report.html": index} if len(runs) > 1 else {"report.html": next(iter(pages.values()))}
    cells = [run.cells.assign(experiment=folder.name) for folder, run in runs.items()]
    with whole_folder(out) as work:
        pd.concat(tables.values(), ignore_index=True).to_csv(work / "tables.csv", index=False)
        pd.concat(cells, ignore_index=True).to_csv(work / "cells.csv", index=False)
        for name, content in pages.items():
            (work / name).write_text(content, encoding="utf-8")


# Figures ---------------------------------------------------------------------------------------------------------


def plot_comparison(comparison: pd.DataFrame, table: str, column: str, ax: Axes | None = None) -> Axes:
    """Plot one published column of `table` with the computed values, one line per row.

    `comparison` is the result of `compare`. Bars show the tolerance of the published value and the standard deviation
    of the computed value over the layouts. Raises ValueError if no cell of the column is both published and computed.
    """
    cells = _both(comparison, table)
    of, rows = cells[cells["column"] == column], list(dict.fromkeys(cells["row"]))
    if of.empty:
        known = ", ".join(dict.fromkeys(cells["column"]))
        raise ValueError(
            f"{table!r}: column {column!r} has no cell that is both printed and computed; choose among {known}"
        )
    ax, at = axes_or_new(ax), np.array([rows.index(row) for row in of["row"]])
    bars: dict[str, Any] = {"capsize": 2, "lw": 1, "ls": "none"}
    printed: dict[str, Any] = {"marker": "s", "ms": 5, "mfc": "none", "color": "0.45"}
    ours: dict[str, Any] = {"marker": "o", "ms": 4}
    ax.errorbar(of["published"], at - 0.15, xerr=of["tolerance"], label="printed ± tolerance", **printed, **bars)
    ax.errorbar(of["ours"], at + 0.15, xerr=of["spread"], label="ours ± spread", **ours, **bars)
    ax.set_title(heading(column, of["unit"].iloc[0]), fontsize=9)
    ax.tick_params(labelsize=7)
    ax.grid(axis="y", lw=0.3)
    ax.locator_params(axis="x", nbins=4)
    ax.set_yticks(range(len(rows)), rows, fontsize=8)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    return ax


def comparison_figure(comparison: pd.DataFrame, table: str) -> Figure:
    """Plot each published column of `table` in one panel, as in `plot_comparison`."""
    cells = _both(comparison, table)
    names = list(dict.fromkeys(cells["column"]))
    down, across = -(-len(names) // _ACROSS), min(len(names), _ACROSS)
    figure = new_figure(1.6 + 1.8 * across, down * (1.2 + 0.24 * cells["row"].nunique()))
    for k, name in enumerate(names):
        panel = plot_comparison(comparison, table, name, figure.add_subplot(down, across, k + 1))
        panel.tick_params(labelleft=k % across == 0)
    figure.suptitle(table_title(table), fontsize=11)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _both(comparison: pd.DataFrame, table: str) -> pd.DataFrame:
    """Return the cells of a table that are both published and computed."""
    cells = comparison[(comparison["table"] == table) & comparison["published"].notna() & comparison["ours"].notna()]
    if cells.empty:
        raise ValueError(f"{table!r}: no cell is both printed and computed")
    return cells


def plot_agreement(comparison: pd.DataFrame, ax: Axes | None = None) -> Axes:
    """Plot (computed - published) / tolerance by table; `comparison` is the result of `compare`.

    Raises ValueError if no computed value has a tolerance.
    """
    cells = comparison[comparison["within"] != ""]
    if cells.empty:
        raise ValueError("no cell that is both printed and computed has a tolerance")
    ax = axes_or_new(ax)
    off = ((cells["ours"] - cells["published"]) / cells["tolerance"]).to_numpy(float)
    place, tables = pd.factorize(cells["table"])
    number = cells.groupby("table").cumcount().to_numpy()
    of = cells.groupby("table")["table"].transform("size").to_numpy()
    # Arrange the values of a table from top to bottom, in the order of the paper.
    at = place + 0.7 * (number / np.maximum(of - 1, 1) - 0.5)
    within = (cells["within"] == "yes").to_numpy()
    ax.axvspan(-1, 1, color="0.93", lw=0)
    for rows, marker, colour, label in ((within, "o", "tab:blue", "within"), (~within, "x", "tab:red", "not within")):
        if rows.any():
            ax.plot(off[rows], at[rows], marker, ms=5, mew=1.5, color=colour, label=label, ls="none")
    ax.set_yticks(range(len(tables)), list(map(table_title, tables)), fontsize=8)
    ax.set_ylim(len(tables) - 0.5, -0.5)
    ax.set_xlabel("(ours - printed) / tolerance")
    title(ax, "all values with a tolerance")
    ax.legend(fontsize=7)
    return ax
