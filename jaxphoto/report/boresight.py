"""Results of a boresight calibration: verdict, estimates of all steps, and a result folder for each step."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from rich.console import Console
from rich.text import Text

from jaxphoto.errors import InputError
from jaxphoto.procedures import Step
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.page import CommandRecord, Heading, Link, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, label, new_figure
from jaxphoto.report.results import rounded, write_results, write_study
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Sigmas of error bars.
_BARS = 2.0
_ANGLES = re.compile(r"mounts\[.*\]\.boresight_._deg")
_SHIFTS = re.compile(r"strips\[.*\]\.shift_._m")


def boresight_verdict(steps: Sequence[Step]) -> str:
    """The result of the steps in one sentence."""
    failed = [step.number for step in steps if not step.go_on]
    last = steps[-1].number
    if not failed:
        return "the misalignment is usable: all four steps are passed"
    names = ", ".join(map(str, failed))
    if last < 4:
        return f"stopped at step {last}" + ("" if failed == [last] else f"; steps {names} are not passed")
    return f"do not use the misalignment: step {names} is not passed"


def steps_table(steps: Sequence[Step]) -> pd.DataFrame:
    """step, parameter, value, sigma, unit: sigma0 and every estimate; sigmas are a posteriori.

    That of sigma0 is sigma0 / sqrt(2 f) with the redundancy f.
    """
    rows: list[tuple] = []
    for step in steps:
        sigma0, redundancy = float(step.adjusted.sigma0), step.adjusted.redundancy
        rows.append((step.number, "sigma0", sigma0, sigma0 / math.sqrt(2 * redundancy) if redundancy > 0 else None, ""))
        rows += [(step.number, *estimate) for estimate in step.estimates]
    return pd.DataFrame(rows, columns=["step", "parameter", "value", "sigma", "unit"])


def boresight_figure(steps: Sequence[Step]) -> Figure | None:
    """Misalignments of steps 3 and 4 and shifts of strips of step 2 with error bars; None without any."""
    sets = [shifts for shifts in (False, True) if len(_rows(steps, shifts))]
    if not sets:
        return None
    figure = new_figure(4.8 * len(sets), 1.2 + 0.24 * max(len(_rows(steps, shifts)) for shifts in sets))
    for axes, shifts in zip(figure.subplots(1, len(sets), squeeze=False).flat, sets, strict=True):
        plot_boresight(steps, axes, shifts=shifts)
    return figure


def plot_boresight(steps: Sequence[Step], ax: Axes | None = None, *, shifts: bool = False) -> Axes:
    """Misalignments of steps 3 and 4 (deg), or `shifts` of strips of step 2 (m), with bars of two sigmas.

    Raises InputError if the steps estimated none.
    """
    rows = _rows(steps, shifts)
    if not len(rows):
        raise InputError(f"these steps estimated no {'shifts of strips' if shifts else 'misalignment'}")
    ax = axes_or_new(ax)
    names = [_short(str(parameter)) for parameter in rows["parameter"]]
    places = {name: k for k, name in enumerate(dict.fromkeys(names))}
    several = len(set(rows["step"])) > 1
    for k, (step, of_step) in enumerate(rows.assign(at=[places[name] for name in names]).groupby("step")):
        at = of_step["at"] + (0.3 * (k - 0.5) if several else 0.0)
        marker, colour = ("s", "0.5") if several and k == 0 else ("o", "tab:blue")
        bars: dict[str, Any] = {"xerr": _BARS * of_step["sigma"], "fmt": marker, "ms": 4, "capsize": 3}
        ax.errorbar(of_step["value"], at, color=colour, label=f"step {step}", **bars)
    ax.set_yticks(list(places.values()), [label(name) for name in places], fontsize=8)
    ax.set_ylim(len(places) - 0.5, -0.5)
    ax.axvline(0, color="0.4", lw=0.6)
    ax.set_title("shifts of strips, step 2" if shifts else "misalignment", fontsize=10)
    ax.set_xlabel("shift [m]" if shifts else "angle [deg]", fontsize=9)
    if several:
        ax.legend(fontsize=8)
    return ax


def _rows(steps: Sequence[Step], shifts: bool) -> pd.DataFrame:
    table = steps_table(steps)
    of = table["parameter"].str.fullmatch(_SHIFTS if shifts else _ANGLES)
    return table[of & (table["step"] == 2)] if shifts else table[of]


def _short(path: str) -> str:
    """`E1 X` of strips[E1].shift_X_m, `default x` of mounts[default].boresight_x_deg."""
    name, parameter = path.split("[", 1)[1].rsplit("].", 1)
    return f"{name} {parameter.split('_')[1]}"


def boresight_parts(steps: Sequence[Step]) -> list[Part]:
    """The page: misalignments, then findings and estimates of each step."""
    parts: list[Part] = []
    if figure := boresight_figure(steps):
        parts.append(Heading("Misalignment and shifts"))
        parts.append(Plot(figure, "misalignments and shifts of strips with error bars"))
        parts.append(Paragraph(f"Bars are {_BARS:g} standard deviations to each side."))
    for step in steps:
        parts.append(Heading(f"Step {step.number}: {step.title}"))
        parts += [Paragraph(as_sentence(finding)) for finding in step.findings]
        if not step.go_on:
            parts[-1] = Paragraph(as_sentence(step.findings[-1]), "warning")
        parts.append(pd.DataFrame(step.estimates, columns=["parameter", "value", "sigma", "unit"]))
        parts.append(Link(f"all results of step {step.number}", f"step_{step.number}/report.html"))
    return parts


def write_boresight(steps: Sequence[Step], directory: Path, seconds: dict[str, float], record: CommandRecord) -> None:
    """steps.csv, summary.json, report.html and step_1 ... step_4.

    Raises InputError if `directory` holds something else than an earlier result.
    """
    began, passed = time.perf_counter(), all(step.go_on for step in steps)
    block, verdict = steps[0].adjusted.block, boresight_verdict(steps)
    with whole_folder(directory) as work:
        for step in steps:
            tables, times = Tables(step.adjusted), step.adjusted.seconds
            spent = {name: times[name] for name in ("compile", "solve", "covariance")}
            write_results(tables, verdict_of(tables), work / f"step_{step.number}", spent, record=record)
        summary = {
            "title": block.title,
            "verdict": verdict,
            "passed": passed,
            "steps": [
                {
                    "step": step.number, "title": step.title, "go_on": step.go_on,
                    "converged": bool(step.adjusted.converged), "sigma0": float(step.adjusted.sigma0),
                    "redundancy": step.adjusted.redundancy, "findings": list(step.findings),
                    "estimates": [estimate._asdict() for estimate in step.estimates],
                }
                for step in steps
            ],
            "seconds": rounded(seconds | {"write": time.perf_counter() - began}),
        }  # fmt: skip
        write_study(
            work, f"{block.title or 'block'}: boresight", (verdict, "green" if passed else "red"),
            boresight_parts(steps), summary, record, {"steps": steps_table(steps)},
        )  # fmt: skip


def print_boresight(steps: Sequence[Step], console: Console) -> None:
    """Print the verdict and the findings of each step."""
    colour = "green" if all(step.go_on for step in steps) else "red"
    console.print(boresight_verdict(steps), style=colour, highlight=False, markup=False)
    for step in steps:
        console.print(Text.assemble((f"step {step.number}", "bold"), f": {step.title}"))
        for finding in step.findings:
            console.print(f"  - {finding}", highlight=False, markup=False)
