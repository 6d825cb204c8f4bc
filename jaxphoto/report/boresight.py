"""The results of a boresight calibration: judgement, estimates of all steps, and each step's own result folder."""

import time
from pathlib import Path

import pandas as pd
from jinja2 import Environment
from markupsafe import Markup
from rich.console import Console
from rich.text import Text

from jaxphoto.procedures import Step
from jaxphoto.report.made import versions
from jaxphoto.report.page_head import page_head
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

_PAGE = """{{ head(title) }}<body>
<h1>{{ title }}</h1>
<p class="{{ 'good' if good else 'bad' }}"><b>{{ verdict }}</b></p>
{% for step in steps %}
<h2>Step {{ step.number }}: {{ step.title }}</h2>
{% for finding in step.findings %}<p{% if not step.go_on and loop.last %} class="warning"{% endif %}>{{ finding }}</p>
{% endfor %}{{ tables[loop.index0] }}
<p><a href="step_{{ step.number }}/report.html">all results of step {{ step.number }}</a></p>
{% endfor %}
</body></html>
"""


def boresight_verdict(steps: tuple[Step, ...]) -> str:
    """What came of the steps, in one sentence."""
    objecting = [step.number for step in steps if not step.go_on]
    last = steps[-1].number
    if not objecting:
        return "the misalignment can be used: all four steps are passed"
    if last < 4:
        return (
            f"stopped at step {last}: it makes no sense to continue"
            if objecting == [last]
            else (f"stopped at step {last}; steps {', '.join(map(str, objecting))} are not passed")
        )
    return f"the misalignment must not be used: step {', '.join(map(str, objecting))} not passed"


def steps_table(steps: tuple[Step, ...]) -> pd.DataFrame:
    """step, parameter, value, sigma, unit: sigma0 and every estimate; sigmas are a posteriori."""
    rows: list[tuple] = []
    for step in steps:
        rows.append((step.number, "sigma0", float(step.adjusted.sigma0), None, ""))
        rows += [(step.number, *estimate) for estimate in step.estimates]
    return pd.DataFrame(rows, columns=["step", "parameter", "value", "sigma", "unit"])


def boresight_page(steps: tuple[Step, ...]) -> str:
    """The report as HTML: judgement first, then what each step says and estimates."""
    table = steps_table(steps)
    shown = [
        table[table["step"] == step.number]
        .drop(columns="step")
        .to_html(index=False, border=0, na_rep="", formatters={"value": "{:.7g}".format, "sigma": "{:.3g}".format})
        for step in steps
    ]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            head=page_head,
            title=f"{steps[0].adjusted.block.title or 'block'}: boresight",
            verdict=boresight_verdict(steps),
            good=all(step.go_on for step in steps),
            steps=steps,
            tables=[Markup(html) for html in shown],
        )
    )


def write_boresight(steps: tuple[Step, ...], directory: Path, seconds: dict[str, float]) -> None:
    """steps.csv, summary.json, report.html and step_1 ... step_4, in `directory` only when all is written.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        for step in steps:
            tables = Tables(step.adjusted)
            verdict, times = verdict_of(tables), step.adjusted.seconds
            order = ("compile", "solve", "covariance")
            write_results(tables, verdict, work / f"step_{step.number}", {name: times[name] for name in order})
        steps_table(steps).to_csv(work / "steps.csv", index=False)
        (work / "report.html").write_text(boresight_page(steps), encoding="utf-8")
        write_summary(
            {
                "title": steps[0].adjusted.block.title,
                "verdict": boresight_verdict(steps),
                "passed": all(step.go_on for step in steps),
                "steps": [
                    {
                        "step": step.number,
                        "title": step.title,
                        "go_on": step.go_on,
                        "converged": bool(step.adjusted.converged),
                        "sigma0": float(step.adjusted.sigma0),
                        "redundancy": step.adjusted.redundancy,
                        "findings": list(step.findings),
                        "estimates": [estimate._asdict() for estimate in step.estimates],
                    }
                    for step in steps
                ],
                "seconds": {k: round(v, 6) for k, v in (seconds | {"write": time.perf_counter() - began}).items()},
                "versions": versions(),
            },
            work,
        )


def print_boresight(steps: tuple[Step, ...], console: Console) -> None:
    """Print the judgement, then what each step found."""
    colour = "green" if all(step.go_on for step in steps) else "red"
    console.print(boresight_verdict(steps), style=colour, highlight=False, markup=False)
    for step in steps:
        console.print(Text.assemble((f"step {step.number}", "bold"), f": {step.title}"))
        for finding in step.findings:
            console.print(f"  - {finding}", highlight=False, markup=False)
