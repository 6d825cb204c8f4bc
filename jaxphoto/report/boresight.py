"""The results of a boresight calibration: judgement, estimates of all steps, and each step's own result folder."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from rich.console import Console
from rich.text import Text

from jaxphoto.errors import InputError
from jaxphoto.procedures import Step
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.plots import axes_or_new, drawn, new_figure
from jaxphoto.report.results import write_results, write_summary
from jaxphoto.report.study_page import PageLink, StudyPart, WholePicture, study_page
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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


def steps_table(steps: Sequence[Step]) -> pd.DataFrame:
    """step, parameter, value, sigma, unit: sigma0 and every estimate; sigmas are a posteriori.

    That of sigma0, with f the redundancy, is sigma0 / sqrt(2 f).
    """
    rows: list[tuple] = []
    for step in steps:
        sigma0, redundancy = float(step.adjusted.sigma0), step.adjusted.redundancy
        # Of normal errors, to first order.
        own = sigma0 / math.sqrt(2 * redundancy) if redundancy > 0 else None
        rows.append((step.number, "sigma0", sigma0, own, ""))
        rows += [(step.number, *estimate) for estimate in step.estimates]
    return pd.DataFrame(rows, columns=["step", "parameter", "value", "sigma", "unit"])


def boresight_figure(steps: tuple[Step, ...]) -> Figure | None:
    """Misalignments of steps 3 and 4 and shifts of strips of step 2 with error bars; None without any."""
    there = [shifts for shifts in (False, True) if len(_rows(steps, shifts))]
    if not there:
        return None
    most = max(len(_rows(steps, shifts)) for shifts in there)
    figure = new_figure(4.8 * len(there), 1.2 + 0.24 * most)
    for axes, shifts in zip(figure.subplots(1, len(there), squeeze=False).flat, there, strict=True):
        plot_boresight(steps, axes, shifts=shifts)
    return figure


def plot_boresight(steps: Sequence[Step], ax: Axes | None = None, *, shifts: bool = False) -> Axes:
    """Misalignments of steps 3 and 4 (deg), or `shifts` of strips of step 2 (m), with bars of two sigmas to each side.

    Raises InputError where the steps estimated none.
    """
    rows = _rows(steps, shifts)
    if not len(rows):
        raise InputError(f"these steps estimated no {'shifts of strips' if shifts else 'misalignment'}")
    ax = axes_or_new(ax)
    names = [_short(str(parameter)) for parameter in rows["parameter"]]
    places = {name: k for k, name in enumerate(dict.fromkeys(names))}
    several = len(set(rows["step"])) > 1
    for k, (step, own) in enumerate(rows.assign(at=[places[name] for name in names]).groupby("step")):
        # Of a parameter one step below the other; what the last one found is what is used.
        at = own["at"] + (0.3 * (k - 0.5) if several else 0.0)
        marker, colour = ("s", "0.5") if several and k == 0 else ("o", "tab:blue")
        ax.errorbar(
            own["value"], at, xerr=_BARS * own["sigma"], fmt=marker, ms=4, capsize=3, color=colour, label=f"step {step}"
        )
    ax.set_yticks(list(places.values()), [drawn(name) for name in places], fontsize=8)
    ax.set_ylim(len(places) - 0.5, -0.5)
    ax.axvline(0, color="0.4", lw=0.6)
    ax.set_title("shifts of strips, step 2" if shifts else "misalignment", fontsize=10)
    ax.set_xlabel("shift [m]" if shifts else "angle [deg]", fontsize=9)
    ax.tick_params(axis="x", labelsize=8)
    if several:
        ax.legend(fontsize=8)
    return ax


def _rows(steps: Sequence[Step], shifts: bool) -> pd.DataFrame:
    """Of `steps_table` what is drawn."""
    table = steps_table(steps)
    of = table["parameter"].str.fullmatch(_SHIFTS if shifts else _ANGLES)
    return table[of & (table["step"] == 2)] if shifts else table[of]


def _short(path: str) -> str:
    """`E1 X` of strips[E1].shift_X_m, `default x` of mounts[default].boresight_x_deg."""
    name, parameter = path.split("[", 1)[1].rsplit("].", 1)
    return f"{name} {parameter.split('_')[1]}"


def boresight_page(steps: tuple[Step, ...], made: Made) -> str:
    """The report as HTML: judgement first, then what each step says and estimates."""
    parts: list[StudyPart] = []
    if figure := boresight_figure(steps):
        parts.append(Heading("Misalignment and shifts"))
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
