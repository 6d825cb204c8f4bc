"""Results of a boresight calibration: verdict, estimates of all steps, and one result folder per step."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.errors import InputError
from jaxphoto.procedures.boresight import HIGH, BoresightEstimate, Step
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.formatting import label_unit, to_rich
from jaxphoto.report.page import CommandRecord, Heading, Link, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, label
from jaxphoto.report.results import rounded, write_results, write_study
from jaxphoto.report.tables import Tables, about_sigma, initial_values
from jaxphoto.report.terminal import headline, plain, print_lines
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import chi_square_p
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Beginning of the parameters of step 4 that are differences.
_DIFFERENCE = "step 4 - step 3: "
# Length of error bars in standard deviations.
_BARS = 2.0
_ANGLES = re.compile(r"mounts\[.*\]\.boresight_._deg")
_SHIFTS = re.compile(r"strips\[.*\]\.shift_._m")


def boresight_verdict(steps: Sequence[Step]) -> str:
    """Summarise the result of the steps in one sentence."""
    failed = [step.number for step in steps if not step.go_on]
    last = steps[-1].number
    if not failed and abs(rho := steps[-1].correlation) > HIGH:
        return (
            f"all four steps passed, but the principal point is correlated with the misalignment ({rho:+.3f}): fix it"
        )
    if not failed:
        return "the misalignment is usable: all four steps passed"
    names = ", ".join(map(str, failed))
    if last < 4:
        return f"stopped at step {last}" + ("" if failed == [last] else f"; failed steps: {names}")
    return f"do not use the misalignment; failed steps: {names}"


def _colour(steps: Sequence[Step]) -> str:
    if not all(step.go_on for step in steps):
        return "red"
    return "amber" if abs(steps[-1].correlation) > HIGH else "green"


def steps_table(steps: Sequence[Step]) -> pd.DataFrame:
    """Tabulate sigma0 and all estimates of each step.

    Columns: step, parameter, value, sigma (a posteriori), unit. The sigma of sigma0 is sigma0 / sqrt(2 f) with the
    redundancy f.
    """
    rows: list[tuple] = []
    for step in steps:
        sigma0, redundancy = float(step.adjusted.sigma0), step.adjusted.redundancy
        rows.append((step.number, "sigma0", sigma0, sigma0 / math.sqrt(2 * redundancy) if redundancy > 0 else None, ""))
        rows += [(step.number, *estimate) for estimate in step.estimates]
    return pd.DataFrame(rows, columns=["step", "parameter", "value", "sigma", "unit"])


def estimates(steps: Sequence[Step]) -> pd.DataFrame:
    """Tabulate the result, the estimates of step 3 or of the last step: parameter, initial, value, sigma, unit."""
    step, start = _result(steps), steps[0].adjusted.block.start.unknowns
    rows = [one for one in step.estimates if not one.parameter.startswith(_DIFFERENCE)]
    table, initial = pd.DataFrame(rows, columns=BoresightEstimate._fields), initial_values(start)
    table.insert(1, "initial", [initial.get(path, np.nan) for path in table["parameter"]])
    return table.assign(unit=[unit or label_unit(path, start.interior) for path, *_, unit in rows])


def differences(steps: Sequence[Step]) -> pd.DataFrame:
    """Tabulate step 4 minus step 3: parameter, difference, sigma, unit; empty without step 4."""
    rows = [one for one in steps[-1].estimates if one.parameter.startswith(_DIFFERENCE)]
    rows = [one._replace(parameter=one.parameter.removeprefix(_DIFFERENCE)) for one in rows]
    return pd.DataFrame(rows, columns=["parameter", "difference", "sigma", "unit"])


def tests_table(steps: Sequence[Step]) -> pd.DataFrame:
    """Tabulate the test of each step: step, observations, sigma0, redundancy, p_value, passed."""
    rows = []
    for step in steps:
        a = step.adjusted
        p = chi_square_p(float(a.sum_of_squares), a.redundancy) if bool(a.converged) else np.nan
        rows.append((step.number, step.title.partition(":")[0], f"{float(a.sigma0):.4f}", a.redundancy, p, step.go_on))
    return pd.DataFrame(rows, columns=["step", "observations", "sigma0", "redundancy", "p_value", "passed"])


def _result(steps: Sequence[Step]) -> Step:
    return next((step for step in steps if step.number == 3), steps[-1])


def plot_boresight(steps: Sequence[Step], ax: Axes | None = None, *, shifts: bool = False) -> Axes:
    """Draw misalignments of steps 3 and 4 (deg), or strip `shifts` of step 2 (m), with error bars of two sigmas.

    Raises InputError if the steps have no such estimates.
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
    ax.locator_params(axis="x", nbins=6)
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
    """Shorten a label: strips[E1].shift_X_m to `E1 X`, mounts[default].boresight_x_deg to `default x`."""
    name, parameter = path.split("[", 1)[1].rsplit("].", 1)
    return f"{name} {parameter.split('_')[1]}"


def boresight_parts(steps: Sequence[Step]) -> list[Part]:
    """Return the parts of the page: result, test of each step, plots, then findings and estimates of each step."""
    words = f"Estimates of step {_result(steps).number}. {about_sigma(_result(steps).adjusted)}"
    parts: list[Part] = [estimates(steps), Paragraph(words)]
    if len(table := differences(steps)):
        parts += [Paragraph("Step 4 minus step 3, the effect of the control:"), table]
    parts += [Paragraph("Steps, each with the chi-square test of sigma naught:"), tests_table(steps)]
    names = {False: "misalignments", True: "shifts of strips"}
    plots = [
        Plot(partial(plot_boresight, steps, shifts=shifts), f"{name} with bars of {_BARS:g} standard deviations")
        for shifts, name in names.items()
        if len(_rows(steps, shifts))
    ]
    parts += [Heading("Misalignment and shifts"), plots] if plots else []
    for step in steps:
        parts.append(Heading(f"Step {step.number}: {step.title}"))
        parts += [Paragraph(as_sentence(finding)) for finding in step.findings]
        if not step.go_on:
            parts[-1] = Paragraph(as_sentence(step.findings[-1]), "warning")
        parts.append(pd.DataFrame(step.estimates, columns=["parameter", "value", "sigma", "unit"]))
        parts.append(Link(f"all results of step {step.number}", f"step_{step.number}/report.html"))
    return parts


def write_boresight(steps: Sequence[Step], directory: Path, seconds: dict[str, float], record: CommandRecord) -> None:
    """Write steps.csv, summary.json, report.html and the result folders step_1 to step_4."""
    block, verdict, passed = steps[0].adjusted.block, boresight_verdict(steps), all(step.go_on for step in steps)
    summary = {
        "title": block.title, "verdict": verdict, "passed": passed,
        "steps": [
            {
                "step": step.number, "title": step.title, "go_on": step.go_on,
                "converged": bool(step.adjusted.converged), "sigma0": float(step.adjusted.sigma0),
                "redundancy": step.adjusted.redundancy, "findings": list(step.findings),
                "estimates": [estimate._asdict() for estimate in step.estimates],
            }
            for step in steps
        ],
        "seconds": rounded(seconds),
    }  # fmt: skip
    with whole_folder(directory) as work:
        for step in steps:
            tables, times = Tables(step.adjusted), step.adjusted.seconds
            spent = {name: times[name] for name in ("compile", "solve", "covariance")}
            write_results(tables, verdict_of(tables), work / f"step_{step.number}", spent, record=record)
        write_study(
            work, f"{block.title or 'block'}: boresight", (f"{_colour(steps)}: {verdict}", _colour(steps)),
            boresight_parts(steps), summary, record, {"steps": steps_table(steps)},
        )  # fmt: skip


def print_boresight(steps: Sequence[Step], console: Console) -> None:
    """Print the verdict, sigma naught and test of each step, the estimates, and the findings of each step."""
    console.print(plain(steps[0].adjusted.block.title or "block"), style="bold")
    colour = _colour(steps)
    console.print(headline(f"{colour}: {boresight_verdict(steps)}", colour), soft_wrap=True)
    console.print(to_rich(tests_table(steps), "steps"))
    console.print(to_rich(estimates(steps), f"estimates of step {_result(steps).number} (a posteriori)"))
    if len(table := differences(steps)):
        console.print(to_rich(table, "step 4 minus step 3"))
    for step in steps:
        print_lines((f"step {step.number}: {finding}" for finding in step.findings), console)
