"""The page of an experiment: what agrees, then each table as printed, ours in the same cells."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from jinja2 import Environment

from jaxphoto.experiment.comparison import MEAN_DIFFERENCE
from jaxphoto.experiment.runner import Run
from jaxphoto.experiment.wording import heading, own_decimals, power_of, printed_decimals, table_title
from jaxphoto.report import check_points_figure, layout_figure, page_head
from jaxphoto.report.document_html import html_of
from jaxphoto.report.made import Made, made_section

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """\
:root { --width: 86rem } td, th { white-space: nowrap } th { font-weight: 600 } .tables td, .tables th { line-height: 1.3; padding: .2rem .4rem }
.no { background: var(--red) } .yes { background: var(--green) } .chip { padding: 0 .5em; border-radius: 3px }
.yes, .no { print-color-adjust: exact } .no::before { content: "\\2717\\a0"; color: var(--bad) }
.ours { font-weight: 600 } .spread, .paper { color: var(--grey) } .spread { font-size: 90% }
ol.notes { margin: 0 0 1.5rem; font-size: 13px; color: var(--grey) } sup { color: var(--grey); font-size: 75% }
@media print { ol.notes { break-before: avoid; font-size: 9px } td + td, th { white-space: normal } }
"""
_PAGE = """{{ head }}<body>
<h1>{{ title }}</h1>
<p>{% if judged %}<b>{{ good }} of {{ judged }}</b> printed values for which a tolerance is promised are within it.
{% else %}Nothing is promised here: no printed value has a tolerance.{% endif %}</p>
<p>In each cell, above: <span class="ours">ours</span>, the mean over {{ layouts }} simulated
{{ "layout" if layouts == 1 else "layouts" }}{% if layouts > 1 %}, <span class="spread">± the standard deviation from layout
to layout</span>{% endif %}. Below: <span class="paper">what is printed (± the tolerance promised)</span>.
<span class="chip yes">green</span> within the tolerance, <span class="chip no">red</span> and a cross not, no colour: nothing promised.
Small numbers at cells and headings refer to the notes below the table.</p>
{% for failure in failures %}<p class="warning">left out: {{ failure }}</p>{% endfor %}
<div class="wide"><table><tr><th>table</th><th>within</th><th>of</th></tr>
{% for table in tables %}<tr><td><a href="#{{ table.name }}">{{ table.title }}</a></td>
<td>{{ table.good if table.judged else "" }}</td><td>{{ table.judged or "nothing promised" }}</td></tr>
{% endfor %}</table></div>
<h2>Block of the first layout</h2><img alt="block layout" src="{{ layout }}">
<div class="tables">
{% for table in tables %}<h2 id="{{ table.name }}">{{ table.title }}</h2>
{% if table.columns %}<div class="wide"><table class="as-printed">
<thead><tr><th></th>{% for c in table.columns %}<th>{{ c.heading }}{% for n in c.notes %}<sup>{{ n }}</sup>{% endfor %}</th>{% endfor %}</tr></thead>
{% for row in table.rows %}<tr><td>{{ row.name }}</td>{% for cell in row.cells %}<td class="{{ cell.within }}">
{%- if cell.ours %}<span class="ours">{{ cell.ours }}</span><span class="spread">{{ cell.spread }}</span>{% endif %}
{%- if cell.published or table.printed %}<br><span class="paper">{{ cell.published|replace("± ", "±\u00a0") or "&nbsp;"|safe }}</span>{% endif %}
{%- if cell.note %}<sup>{{ cell.note }}</sup>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</table></div>{% endif %}
{% if table.notes %}<ol class="notes">{% for note in table.notes %}<li>{{ note }}</li>{% endfor %}</ol>{% endif %}
{% if table.difference %}<p>Mean of |ours - printed| over the table:
<span class="chip {{ table.difference.within }}">{{ table.difference.words }}</span></p>{% endif %}
{% endfor %}</div>
{% if check %}<h2>Check points of the first layout</h2>
<div class="wide"><img alt="discrepancies at check points" src="{{ check }}"></div>{% endif %}
{% for element in made %}{{ element }}
{% endfor %}</body></html>
"""


_INDEX = """{{ head("Experiments") }}<body>
<h1>Experiments</h1>
<div class="wide"><table><tr><th>experiment</th><th>within</th><th>of the values promised</th></tr>
{% for row in rows %}<tr><td><a href="{{ row.name }}.html">{{ row.title }}</a></td><td>{{ row.good }}</td><td>{{ row.judged }}</td></tr>
{% endfor %}</table></div></body></html>
"""


def index_page(experiments: Mapping[str, tuple[str, pd.DataFrame]]) -> str:
    """A page that leads to those of several experiments: name -> title and comparison."""
    rows = [
        {
            "name": name,
            "title": title,
            "good": int((t["within"] == "yes").sum()),
            "judged": int((t["within"] != "").sum()),
        }
        for name, (title, t) in experiments.items()
    ]
    return Environment(autoescape=True).from_string(_INDEX).render(head=page_head, rows=rows)


def experiment_page(run: Run, comparison: pd.DataFrame, made: Made | None = None) -> str:
    """The whole page as HTML, pictures inside."""
    tables = [table_texts(str(name), cells) for name, cells in comparison.groupby("table", sort=False)]
    check = {name: of for name, of in run.first.items() if len(of.check_points)}
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            title=run.experiment.title,
            head=page_head(run.experiment.title, _STYLE),
            judged=sum(table["judged"] for table in tables),
            good=sum(table["good"] for table in tables),
            layouts=run.cells["layout"].nunique(),
            failures=run.failures,
            layout=_picture(layout_figure(next(iter(run.first.values())))),
            tables=tables,
            check=_picture(check_points_figure(check)) if check else "",
            made=[html_of(element) for element in made_section(made)] if made else [],
        )
    )


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


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
