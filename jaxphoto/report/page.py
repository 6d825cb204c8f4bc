"""The HTML report: one file that opens offline, judgement first, then tables and pictures."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.report.block_plot import layout_figure
from jaxphoto.report.findings import Verdict
from jaxphoto.report.plots import (
    check_points_figure,
    correlation_figure,
    mean_residuals_figure,
    residuals_figure,
)
from jaxphoto.report.positional_accuracy import accuracy_sentences
from jaxphoto.report.recovery import recovery_spread
from jaxphoto.report.sigma_map import sigma_map_figure, sigma_map_words
from jaxphoto.report.style import STYLE
from jaxphoto.report.table_files import head_of, readable
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import LEAST_CHECKED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>{{ style }}</style></head><body>
<h1>{{ title }}</h1>
<p class="verdict {{ verdict.colour }}"><b>{{ verdict.headline }}</b></p>
{% for f in verdict.findings %}<p class="{{ f.level.name.lower() }}">{{ f.text }}</p>{% endfor %}
<p>{{ outcome }} ({{ steps }} iterations)</p>
<p>&sigma;<sub>0</sub> = <b>{{ sigma0 }}</b>, redundancy {{ redundancy }}: {{ counts }}.
Standard deviations are a posteriori (times &sigma;<sub>0</sub>). Correlations refer to the rotations {{ rotations }}.</p>
<h2>Interior orientation</h2>{{ interior }}
{% for figure in correlation %}<div class="wide"><img alt="correlations of the interior orientation with itself and with the exterior one" src="{{ figure }}"></div>{% endfor %}
{% if sigma_maps %}<h2>How sure the camera is, over its format</h2>
<p>Standard deviation of where the calibrated camera says that a point is seen, interior and exterior orientation taken together, in the direction in which it is largest
(<code>sigma_map.csv</code>). Of a direction the whole error of the principal distance counts; of a point as far away as those that were seen, only what its distance does not make good.</p>
{% for s in sigma_maps %}<p>{{ s.words }}</p><div class="wide"><img alt="{{ s.words }}" src="{{ s.picture }}"></div>{% endfor %}{% endif %}
{% if recovery %}<h2>Beside the truth of the simulation</h2>
<p>Estimate minus truth in standard deviations (<code>recovery.csv</code>): about 1 in the root mean square, and 5 % beyond 2, where the model of the adjustment is that of the simulation.</p>
{{ recovery }}{{ recovery_interior }}{% endif %}
{% if georeferencing %}<h2>Mounts and strips</h2>{{ georeferencing }}{% endif %}
<h2>Block</h2><img alt="block layout" src="{{ layout }}">
<h2>Residuals</h2>{{ spread }}
{% for figure in residuals %}<img alt="image residuals" src="{{ figure }}">{% endfor %}
{% if trends %}<h3>Patterns: what the images have in common, and time and strips</h3>{{ trends }}{% endif %}
<h3>Largest normalised residuals</h3>{{ largest }}
{% if check %}<h2>Check points: surveyed minus computed</h2>{{ check_spread }}
{% for s in accuracy_said %}<p>{{ s }}</p>{% endfor %}{{ accuracy }}
<img alt="discrepancies at check points" src="{{ check_picture }}">{{ check }}{% endif %}
<h2>Exterior orientation</h2>{{ exterior }}
<h2>Correlation of exterior and interior orientation over the images</h2>{{ summary }}
{% if ground %}<h2>Correlation of the interior orientation and the ground as a whole</h2>{{ ground }}{% endif %}
</body></html>
"""
_LARGEST = 20


def report_page(tables: Tables, verdict: Verdict) -> str:
    """The whole report as HTML, pictures inside."""
    a = tables.adjusted
    counts = [f"{n} observations of {group.replace('_', ' ')}" for group, n in a.n_observations.items() if n]
    counts += [f"{a.n_constraints} constraints of the datum"] if a.n_constraints else []
    used = [c for c, corr in tables.correlations.items() if corr.parameters and corr.images]
    checked = tables.residuals[tables.residuals["redundancy_number"] > LEAST_CHECKED]
    largest = checked.assign(size=checked["w"].abs()).nlargest(_LARGEST, "size")
    interior = tables.interior
    interior = interior[interior["sigma"].notna() | (interior["value"] != 0)]
    check = tables.check_points
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            style=STYLE,
            title=a.block.title or "jaxphoto adjustment",
            outcome=a.outcome.value,
            steps=int(a.steps),
            sigma0=f"{float(a.sigma0):.6g}",
            redundancy=a.redundancy,
            counts=", ".join(counts) + f"; {sum(a.n_unknowns.values())} unknowns",
            rotations=tables.rotations.replace("_", ", "),
            verdict=verdict,
            interior=_html(interior),
            correlation=[_picture(correlation_figure(tables, c)) for c in used],
            sigma_maps=[
                {"words": sigma_map_words(a.block.sensors[c], maps), "picture": _picture(sigma_map_figure(tables, c))}
                for c, maps in tables.sigma_maps.items()
            ],
            recovery=_html(recovery_spread(tables.recovery)) if tables.truth else "",
            recovery_interior=_html(tables.recovery[tables.recovery["parameter"].str.startswith("interior[")]),
            georeferencing=_html(tables.georeferencing) if len(tables.georeferencing) else "",
            layout=_picture(layout_figure(tables)),
            spread=_html(tables.residual_spread),
            residuals=[
                _picture(figure(tables, c))
                for c in a.unknowns.interior
                for figure in (residuals_figure, mean_residuals_figure)
            ],
            trends=_html(tables.trends) if len(tables.trends) else "",
            largest=_html(largest.drop(columns="size")),
            check_picture=_picture(check_points_figure({"": tables})) if len(check) else "",
            check=_html(check) if len(check) else "",
            accuracy=_html(tables.positional_accuracy) if len(check) else "",
            accuracy_said=accuracy_sentences(tables.tested_accuracy),
            check_spread=_html(_check_spread(check)) if len(check) else "",
            exterior=_html(tables.exterior),
            summary=_html(tables.correlation_summary),
            ground=_html(tables.correlation_ground) if len(tables.correlation_ground) else "",
        )
    )


def _check_spread(check: pd.DataFrame) -> pd.DataFrame:
    values = check.drop(columns="point")
    rows = {"mean": values.mean(), "rmse": np.sqrt((values**2).mean()), "max_abs": values.abs().max()}
    return pd.DataFrame(rows).T.reset_index(names="check points")


def _html(table: pd.DataFrame) -> Markup:
    """A table as it is to be read: units in the heads, digits that follow sigmas."""
    shown = readable(table)
    shown.columns = [head_of(str(name)) for name in table.columns]
    return Markup(f'<div class="wide">{shown.to_html(index=False, border=0)}</div>')


def _picture(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
