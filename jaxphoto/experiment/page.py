"""The page of an experiment: each table as printed, ours in the same cells."""

import base64
import io

import pandas as pd
from jinja2 import Environment
from matplotlib.figure import Figure

from jaxphoto.experiment.runner import Run
from jaxphoto.report import STYLE, layout_figure

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{{ title }}</title><style>{{ style }}
td.no { background: #fbe3e0 } td.yes { background: #e4f3e6 } .ours { font-weight: 600 } .paper { color: #777 }
</style></head><body>
<h1>{{ title }}</h1>
<p>Of {{ judged }} printed cells with a tolerance, <b>{{ good }}</b> are within it. In each cell: <span class="ours">ours</span>,
the mean over {{ layouts }} simulated layouts, &plusmn; the standard deviation from layout to layout;
<span class="paper">below, what the paper prints</span>. Green and red: within the tolerance or not; no colour: nothing promised.</p>
{% for failure in failures %}<p class="warning">left out: {{ failure }}</p>{% endfor %}
<h2>Block of the first layout</h2><img alt="block layout" src="{{ layout }}">
{% for table in tables %}<h2>{{ table.name }}</h2><div class="wide"><table>
<tr><th></th>{% for c in table.columns %}<th>{{ c }}</th>{% endfor %}</tr>
{% for row in table.rows %}<tr><td>{{ row.name }}</td>{% for cell in row.cells %}<td class="{{ cell.within }}" title="{{ cell.note }}">
<span class="ours">{{ cell.ours }}</span><br><span class="paper">{{ cell.published }}</span></td>{% endfor %}</tr>
{% endfor %}</table></div>
{% for note in table.notes %}<p class="warning">{{ note }}</p>{% endfor %}
{% endfor %}</body></html>
"""


def experiment_page(run: Run, comparison: pd.DataFrame) -> str:
    """The whole page as HTML, pictures inside."""
    judged = comparison["within"] != ""
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            title=run.experiment.title,
            style=STYLE,
            judged=int(judged.sum()),
            good=int((comparison["within"] == "yes").sum()),
            layouts=run.cells["layout"].nunique(),
            failures=run.failures,
            layout=_picture(layout_figure(next(iter(run.first.values())))),
            tables=[_table(str(name), cells) for name, cells in comparison.groupby("table", sort=False)],
        )
    )


def _table(name: str, cells: pd.DataFrame) -> dict:
    columns = list(dict.fromkeys(cells["column"]))
    place = {(r.row, r.column): r for r in cells.itertuples()}
    rows = [
        {"name": row, "cells": [_cell(place.get((row, column))) for column in columns]}
        for row in dict.fromkeys(cells["row"])
    ]
    notes = [f"{_listed(c)}: {note}" for note, c in cells[cells["note"] != ""].groupby("note", sort=False)]
    return {"name": name, "columns": columns, "rows": rows, "notes": notes}


def _listed(cells: pd.DataFrame) -> str:
    """The columns that a note is about, with their rows where not all of the table have it."""
    return "; ".join(f"{column} ({', '.join(of['row'])})" for column, of in cells.groupby("column", sort=False))


def _cell(cell) -> dict[str, str]:
    if cell is None:
        return {"ours": "", "published": "", "within": "", "note": ""}
    spread = f" ± {cell.spread:.2g}" if pd.notna(cell.spread) else ""
    tolerance = f" (± {cell.tolerance:.2g})" if pd.notna(cell.tolerance) else ""
    return {
        "ours": f"{cell.ours:.5g}{spread}" if pd.notna(cell.ours) else "",
        "published": f"{cell.published:.5g}{tolerance}" if pd.notna(cell.published) else "",
        "within": cell.within,
        "note": cell.note,
    }


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
