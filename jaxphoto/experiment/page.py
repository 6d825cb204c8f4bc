"""The page of an experiment: what agrees, then each table as printed, ours in the same cells."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from jaxphoto.experiment.comparison import MEAN_DIFFERENCE
from jaxphoto.experiment.plots import draw_agreement
from jaxphoto.experiment.runner import Run
from jaxphoto.experiment.wording import heading, own_decimals, power_of, printed_decimals, table_title
from jaxphoto.report import check_points_figure, plot_block
from jaxphoto.report.block_plot import block_words
from jaxphoto.report.page import Heading, Link, Made, Paragraph, Part, Plot, page, provenance

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


def experiment_page(run: Run, comparison: pd.DataFrame, made: Made | None = None) -> str:
    """The page as HTML: agreement, the block of the first layout, each table as printed, check points."""
    tables = [table_texts(str(name), cells) for name, cells in comparison.groupby("table", sort=False)]
    judged, good = (sum(table[name] for table in tables) for name in ("judged", "good"))
    verdict = f"{good} of {judged} printed values with a tolerance are within it"
    n = int(comparison["published"].notna().sum())
    verdict += f"; {n - judged} of {n} printed values have no tolerance" if n > judged else ""
    if not judged:
        verdict = "no printed value has a tolerance"
    colour = "" if not judged else "green" if good == judged else "amber"
    parts = [*_parts(run, comparison, tables), *(provenance(made) if made else ())]
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
    """What a printed table says, each cell as text: title, columns, rows, notes, and how many cells are within."""
    overall = cells["column"] == MEAN_DIFFERENCE
    shown = cells[~overall]
    # A note of a whole column stands at its heading, others at their cells; they are numbered as they come.
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
        "name": name,
        "title": table_title(name),
        "judged": int((cells["within"] != "").sum()),
        "good": int((cells["within"] == "yes").sum()),
        "columns": columns,
        "rows": rows,
        "printed": bool(shown["published"].notna().any()),
        "notes": list(numbers),
        "difference": _difference(cells[overall].iloc[0]) if overall.any() else None,
    }


def _column(of: pd.DataFrame, power: int, marks: dict[str, int]) -> list[tuple[pd.Series, dict]]:
    """Every cell of one column with its texts; the digits are those of the column."""
    scale = 10.0**-power
    printed = printed_decimals(of["published"].dropna(), power)
    size = scale * float(of["ours"].abs().max())
    found = []
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
        found.append((cell, text))
    return found


def _difference(cell: pd.Series) -> dict[str, str]:
    promised = f" (at most {cell['tolerance']:g} promised)" if pd.notna(cell["tolerance"]) else ""
    return {"words": f"{cell['ours']:.3g}{promised}", "within": cell["within"]}
