"""The results of a boresight calibration: judgement, estimates of all steps, and each step's own result folder."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from jaxphoto.procedures import Step
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.plots import drawn, new_figure
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.study_page import PageLink, StudyPart, WholePicture, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Error bars are so many standard deviations.
_BARS = 2.0
_ANGLES = re.compile(r"mounts\[.*\]\.boresight_._deg")
_SHIFTS = re.compile(r"strips\[.*\]\.shift_._m")


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


def boresight_figure(steps: tuple[Step, ...]) -> Figure | None:
    """Misalignments of steps 3 and 4 and shifts of strips of step 2 with error bars; None without any."""
    table = steps_table(steps)
    panels = {
        "misalignment [deg], steps 3 and 4": table[table["parameter"].str.fullmatch(_ANGLES)],
        "shift of strips [m], step 2": table[(table["step"] == 2) & table["parameter"].str.fullmatch(_SHIFTS)],
    }
    panels = {title: rows for title, rows in panels.items() if len(rows)}
    if not panels:
        return None
    most = max(len(rows) for rows in panels.values())
    figure = new_figure(9.6, 1.2 + 0.24 * most)
    for axes, (title, rows) in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels.items(), strict=True):
        at, colours = np.arange(len(rows)), np.where(rows["step"] == 3, "0.5", "tab:blue")
        for k, value, sigma, colour in zip(at, rows["value"], rows["sigma"], colours, strict=True):
            axes.errorbar(value, k, xerr=_BARS * sigma, fmt="o", ms=4, capsize=3, color=colour)
        names = [
            _short(str(parameter)) + (f", step {step}" if step > 2 else "")
            for parameter, step in zip(rows["parameter"], rows["step"], strict=True)
        ]
        axes.set_yticks(at, [drawn(name) for name in names], fontsize=8)
        axes.invert_yaxis()
        axes.axvline(0, color="0.4", lw=0.6)
        axes.set_title(title, fontsize=10)
        axes.tick_params(axis="x", labelsize=8)
    return figure


def _short(path: str) -> str:
    """`E1 X` of strips[E1].shift_X_m, `default x` of mounts[default].boresight_x_deg."""
    name, parameter = path.split("[", 1)[1].rsplit("].", 1)
    return f"{name} {parameter.split('_')[1]}"


def boresight_page(steps: tuple[Step, ...], made: Made) -> str:
    """The report as HTML: judgement first, then what each step says and estimates."""
    parts: list[StudyPart] = []
    if figure := boresight_figure(steps):
        parts.append(WholePicture.of(figure, "misalignments and shifts of strips with error bars"))
        parts.append(Paragraph(f"Bars are {_BARS:g} standard deviations long to each side."))
    for step in steps:
        parts.append(Heading(f"Step {step.number}: {step.title}"))
        parts += [Paragraph(as_sentence(finding)) for finding in step.findings]
        if not step.go_on:
            parts[-1] = Paragraph(as_sentence(step.findings[-1]), "warning")
        table = pd.DataFrame(step.estimates, columns=["parameter", "value", "sigma", "unit"])
        parts += [rows_of(table), PageLink(f"all results of step {step.number}", f"step_{step.number}/report.html")]
    colour = "green" if all(step.go_on for step in steps) else "red"
    title = f"{steps[0].adjusted.block.title or 'block'}: boresight"
    return study_page(title, [boresight_verdict(steps)], [*parts, *made_section(made)], colour)


def write_boresight(steps: tuple[Step, ...], directory: Path, seconds: dict[str, float], made: Made) -> None:
    """steps.csv, summary.json, report.html and step_1 ... step_4, in `directory` only when all is written.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    began = time.perf_counter()
    with whole_folder(directory) as work:
        for step in steps:
            tables = Tables(step.adjusted)
            verdict, times = verdict_of(tables), step.adjusted.seconds
            order = ("compile", "solve", "covariance")
            folder, own = work / f"step_{step.number}", {name: times[name] for name in order}
            write_results(tables, verdict, folder, own, made=made)
        steps_table(steps).to_csv(work / "steps.csv", index=False)
        (work / "report.html").write_text(boresight_page(steps, made), encoding="utf-8")
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
