"""The page of an experiment: agreement, then each table as printed, ours in the same cells; its figures and files."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from jaxphoto.experiment.experiment import MEAN_DIFFERENCE, Run, compare
from jaxphoto.report import check_points_figure, new_figure, plot_block
from jaxphoto.report.block_plot import block_words
from jaxphoto.report.page import CommandRecord, Heading, Link, Paragraph, Part, Plot, page, provenance
from jaxphoto.report.plots import axes_or_new
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AGREEMENT = (
    "Ours minus printed over the tolerance promised, by table: within it between the lines at -1 and 1, crosses beyond"
)
_STYLE = """\
:root { --width: 72rem } .as-printed :is(td, th) { white-space: nowrap; line-height: 1.3; padding: .2rem .35rem }
.as-printed th:not([aria-sort]) button::after { content: "" }
.as-printed th { font-weight: 600 }
.no { background: var(--red) } .yes { background: var(--green) } .chip { padding: 0 .5em; border-radius: 3px }
.yes, .no { print-color-adjust: exact } .no::before { content: "\\2717\\a0"; color: var(--bad) }
.ours { font-weight: 600 } .spread, .paper { color: var(--grey) } .spread { font-size: 90% }
ol.notes { margin: 0 0 1.5rem; font-size: 13px; color: var(--grey) } sup { color: var(--grey); font-size: 75% }
@media print { ol.notes { break-before: avoid; font-size: 9px } .as-printed :is(td + td, th) { white-space: normal } }
"""
_LEGEND = Markup(
    '<p>In each cell, above: <span class="ours">ours</span>, the mean over {}{}. Below: <span class="paper">what is '
    'printed (± the tolerance promised)</span>. <span class="chip yes">green</span> within the tolerance, <span '
    'class="chip no">red</span> and a cross not, no colour: nothing promised. Small numbers at cells and headings refer '
    "to the notes below the table. Tables sort by what is ours.</p>"
)
_SPREAD = Markup(', <span class="spread">± the standard deviation from layout to layout</span>')
_TABLE = Environment(loader=PackageLoader("jaxphoto.experiment"), autoescape=True).get_template("printed_table.html")


def index_page(experiments: Mapping[str, tuple[str, pd.DataFrame]]) -> str:
    """A page with links to those of several experiments: name -> title and comparison."""
    parts: list[Part] = []
    for name, (title, t) in experiments.items():
        good, judged = int((t["within"] == "yes").sum()), int((t["within"] != "").sum())
        parts.append(Link(f"{title}: {good} of {judged} printed values with a tolerance are within it", f"{name}.html"))
    return page("Experiments", parts)


def experiment_page(run: Run, comparison: pd.DataFrame, record: CommandRecord | None = None) -> str:
    """The page as HTML: agreement, the block of the first layout, each table as printed, check points."""
    tables = [table_texts(str(name), cells) for name, cells in comparison.groupby("table", sort=False)]
    judged, good = (sum(table[name] for table in tables) for name in ("judged", "good"))
    verdict = f"{good} of {judged} printed values with a tolerance are within it"
    n = int(comparison["published"].notna().sum())
    verdict += f"; {n - judged} of {n} printed values have no tolerance" if n > judged else ""
    if not judged:
        verdict = "no printed value has a tolerance"
    colour = "" if not judged else "green" if good == judged else "amber"
    parts = [*_parts(run, comparison, tables), *(provenance(record) if record else ())]
    return page(run.experiment.title, parts, (verdict, colour), _STYLE)


def _parts(run: Run, comparison: pd.DataFrame, tables: list[dict]) -> Iterator[Part]:
    yield from (Paragraph(f"skipped: {failure}", "warning") for failure in run.failures)
    yield Heading("Within the tolerances")
    counts = [(t["title"], t["good"], t["judged"]) for t in tables]
    yield pd.DataFrame(counts, columns=["table", "within", "values with a tolerance"])
    if any(table["judged"] for table in tables):
        yield [Plot(partial(draw_agreement, comparison=comparison), _AGREEMENT, 3.6)]
    first = next(iter(run.first.values()))
    yield Heading("Block of the first layout")
    yield [Plot(lambda ax: plot_block(first.adjusted, ax), block_words(first.adjusted.block), 4.2)]
    layouts = run.cells["layout"].nunique()
    many = layouts > 1
    yield Heading("Tables")
    yield _LEGEND.format(f"{layouts} simulated layout{'s' * many}", _SPREAD if many else "")
    for table in tables:
        yield Heading(table["title"])
        yield Markup(_TABLE.render(table))
    if check := {name: of for name, of in run.first.items() if len(of.check_points)}:
        yield Heading("Check points of the first layout")
        yield Plot(check_points_figure(check), "discrepancies at check points, in plan and in height")


def table_texts(name: str, cells: pd.DataFrame) -> dict:
    """The texts of a printed table: title, columns, rows, notes, and the number of cells within their tolerance."""
    overall = cells["column"] == MEAN_DIFFERENCE
    shown = cells[~overall]
    # A note of a whole column is put at its heading, others at their cells; they are numbered in order.
    numbers: dict[str, int] = {}
    columns: list[dict] = []
    texts: dict[tuple, dict] = {}
    for column, of in shown.groupby("column", sort=False):
        notes = [note for note in of["note"].unique() if note]
        whole = [note for note in notes if (of["note"] == note).all()]
        for note in notes:
            numbers.setdefault(note, len(numbers) + 1)
        power = power_of(np.concatenate([of["ours"].dropna(), of["published"].dropna()]))
        unit = next((u for u in of["unit"] if isinstance(u, str)), "")
        columns.append({"heading": heading(str(column), unit, power), "notes": [numbers[note] for note in whole]})
        marks = {note: numbers[note] for note in notes if note not in whole}
        texts |= {(cell["row"], column): text for cell, text in _column(of, power, marks)}
    empty = {"ours": "", "spread": "", "published": "", "within": "", "note": ""}
    names = list(dict.fromkeys(shown["column"]))
    rows = [{"name": r, "cells": [texts.get((r, c), empty) for c in names]} for r in dict.fromkeys(shown["row"])]
    return {
        "name": name, "title": table_title(name), "judged": int((cells["within"] != "").sum()),
        "good": int((cells["within"] == "yes").sum()), "columns": columns, "rows": rows,
        "printed": bool(shown["published"].notna().any()), "notes": list(numbers),
        "difference": _difference(cells[overall].iloc[0]) if overall.any() else None,
    }  # fmt: skip


def _column(of: pd.DataFrame, power: int, marks: dict[str, int]) -> list[tuple[pd.Series, dict]]:
    """Every cell of one column with its texts, in the digits of the column."""
    scale = 10.0**-power
    printed = printed_decimals(of["published"].dropna(), power)
    size = scale * float(of["ours"].abs().max())
    column = []
    for _, cell in of.iterrows():
        spread = scale * float(cell["spread"]) if pd.notna(cell["spread"]) else 0.0
        ours, paper = scale * float(cell["ours"]), scale * float(cell["published"])
        digits = own_decimals(ours, spread, printed, size) if pd.notna(ours) else 0
        tolerance = f" (± {scale * cell['tolerance']:.2g})" if pd.notna(cell["tolerance"]) else ""
        text = {
            "ours": f"{ours:z.{digits}f}" if pd.notna(ours) else "",
            "spread": f" ± {spread:.{digits}f}" if round(spread, digits) else "",
            "published": f"{paper:.{printed or 0}f}{tolerance}" if pd.notna(paper) else "",
            "within": cell["within"],
            "note": marks.get(cell["note"], ""),
        }
        column.append((cell, text))
    return column


def _difference(cell: pd.Series) -> dict[str, str]:
    promised = f" (at most {cell['tolerance']:g} promised)" if pd.notna(cell["tolerance"]) else ""
    return {"words": f"{cell['ours']:.3g}{promised}", "within": cell["within"]}


def write_runs(
    runs: Mapping[Path, Run], out: Path, record: Mapping[Path, CommandRecord] = MappingProxyType({})
) -> None:
    """Write tables.csv, cells.csv (every layout) and report.html of the `runs` of experiment folders into `out`.

    Several experiments have a page each and report.html as index; `record` is the provenance of each run. Raises what
    `whole_folder` raises.
    """
    tables = {folder: compare(run, folder) for folder, run in runs.items()}
    only = len(runs) == 1
    pages = {
        "report.html" if only else f"{folder.name}.html": experiment_page(run, tables[folder], record.get(folder))
        for folder, run in runs.items()
    }
    if not only:
        pages["report.html"] = index_page({f.name: (run.experiment.title, tables[f]) for f, run in runs.items()})
    cells = [run.cells.assign(experiment=folder.name) for folder, run in runs.items()]
    with whole_folder(out) as work:
        pd.concat(tables.values(), ignore_index=True).to_csv(work / "tables.csv", index=False)
        pd.concat(cells, ignore_index=True).to_csv(work / "cells.csv", index=False)
        for name, content in pages.items():
            (work / name).write_text(content, encoding="utf-8")


# Labels ----------------------------------------------------------------------------------------------------

_WORDS = {
    "iops": "IOPs", "gcp": "GCP", "abs": "absolute", "rmse": "RMSE", "n": "number of", "sigma": "σ",
    "omega": "ω", "phi": "φ", "kappa": "κ", "domega": "dω", "dphi": "dφ", "dkappa": "dκ",
}  # fmt: skip
_UNITS = {"mm", "m", "px", "um", "deg", "arcsec", "mm-1", "mm-2", "mm-4", "mm-6"}
_SMALL = 1e-3
"""Columns of smaller numbers are given in a power of ten."""


def table_title(name: str) -> str:
    """`table2_iops` -> `Table 2: IOPs`; `agreement` -> `Agreement`."""
    numbered = re.fullmatch(r"table(\d+)_(.+)", name)
    if numbered:
        return f"Table {numbered[1]}: {_words(numbered[2])}"
    return _words(name)[:1].upper() + _words(name)[1:]


def heading(column: str, unit: str, power: int) -> str:
    """The label of a column, with the unit of its name, else `unit`; its numbers are times 10**`power`."""
    stem, _, last = column.rpartition("_")
    named = last in _UNITS and bool(stem)
    of = (last if named else unit).replace("um", "µm")
    of = re.sub(r"\^?-(\d)", lambda m: _raised(-int(m[1])), of)
    scale = f"10{_raised(power)}" if power else ""
    inside = " ".join(word for word in (scale, of) if word)
    return _words(stem if named else column) + (f" [{inside}]" if inside else "")


def power_of(values: Iterable[float]) -> int:
    """The power of ten of a column of small numbers, 0 for others."""
    largest = max((abs(v) for v in values), default=0.0)
    return math.floor(math.log10(largest)) if 0 < largest < _SMALL else 0


def printed_decimals(values: Iterable[float], power: int) -> int | None:
    """Decimals that give all `values` (in 10**`power`) exactly; None if all are zero."""
    places = [-int(Decimal(repr(float(v))).normalize().as_tuple().exponent) + power for v in values if v]
    return max([0, *places]) if places else None


def own_decimals(value: float, spread: float, printed: int | None, size: float) -> int:
    """Decimals of a value of ours: two digits of its spread, but at least `printed` and at most one more.

    Without printed value and spread: three digits of `size`. Counts have none.
    """
    if value == round(value) and not spread > 0:
        return 0
    of_spread = 1 - math.floor(math.log10(spread)) if spread > 0 else None
    if printed is not None:
        return min(max(printed, of_spread if of_spread is not None else printed + 1), printed + 1)
    of_size = 2 - math.floor(math.log10(abs(size))) if size else 0
    return max(0, of_spread if of_spread is not None else of_size)


def _words(name: str) -> str:
    return " ".join(_WORDS.get(word, word) for word in name.split("_"))


def _raised(power: int) -> str:
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


# Figures ---------------------------------------------------------------------------------------------------

_ACROSS = 5


def plot_comparison(comparison: pd.DataFrame, table: str, column: str, ax: Axes | None = None) -> Axes:
    """Plot one printed column of `table`, a line for each row: printed and ours.

    `comparison` is from `compare`. Bars are the tolerance of the printed value and the standard deviation of ours
    from layout to layout. Raises ValueError if no cell of the column is both printed and ours.
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
    """One panel for each printed column of `table`, as in `plot_comparison`.

    Raises ValueError if no cell of the table is both printed and ours.
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
    """Plot ours minus printed over the tolerance, by table; `comparison` is from `compare`.

    Raises ValueError if no value of ours has a tolerance.
    """
    if not comparison["within"].ne("").any():
        raise ValueError("no value that is printed and ours has a tolerance")
    ax = axes_or_new(ax)
    draw_agreement(ax, comparison)
    return ax


def draw_agreement(axes: Axes, comparison: pd.DataFrame) -> None:
    """`plot_agreement` in a panel."""
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
