"""The choice of a distortion model as tables, a picture, a page and words in the terminal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.procedures.model_choice import ModelChoice
from jaxphoto.report.digits import of_p
from jaxphoto.report.document import Heading, rows_of
from jaxphoto.report.made import Made, made_section, versions
from jaxphoto.report.plots import axes_or_new, drawn, new_figure
from jaxphoto.report.results import write_summary
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.report.study_page import WholePicture, study_page
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The page shows these of `choice_table`, so written; the terminal a few of them.
_SHOWN: dict[str, Callable[[Any], str]] = {
    "model": str, "parameters": str, "sigma0": "{:.3f}".format, "rms_px": "{:.4f}".format,
    "cv_rms_px": "{:.4f}".format, "cv_excess_se": "{:.1f}".format, "delta_aicc": "{:.1f}".format,
    "delta_bic": "{:.1f}".format, "smaller": str, "f": "{:.2f}".format, "f_p": of_p, "weakest": str,
    "weakest_ratio": "{:.1f}".format,
}  # fmt: skip

_IN_TERMINAL = ("model", "parameters", "rms_px", "cv_rms_px", "cv_excess_se", "delta_bic", "f_p")
# Differences of BIC below this say nothing (Kass and Raftery 1995).
_ALIKE = 2.0
# On the axis of these, which is logarithmic; from `_FAR` on, tenths say nothing.
_MARKS = (0, 2, 10, 100, 1000, 10_000, 100_000, 1_000_000)
_FAR = 100.0


def choice_table(choice: ModelChoice) -> pd.DataFrame:
    """One row a candidate; `delta_` are differences from the smallest, empty cells what there is not.

    model, distortion, coefficients, parameters, observations, redundancy, v'Pv, sigma0, rms_px, cv_rms_px,
    cv_excess_se, aic, aicc, bic, delta_aic, delta_aicc, delta_bic, smaller, f, f_p, weakest, weakest_ratio, weakest_p,
    problem: as `jaxphoto.procedures.model_choice` says.
    """
    rows = []
    for j in choice.judged:
        weakest = j.weakest
        rows.append(
            {
                "model": j.candidate.name,
                "distortion": j.candidate.distortion.__name__,
                "coefficients": " ".join(j.candidate.free),
                "parameters": j.n_parameters,
                "observations": j.n_effective,
                "redundancy": j.redundancy,
                "square_sum": j.square_sum,
                "sigma0": j.sigma0,
                "rms_px": j.rms_px,
                "cv_rms_px": j.cv_rms_px,
                "cv_excess_se": j.cv_excess,
                "aic": j.aic,
                "aicc": j.aicc,
                "bic": j.bic,
                "smaller": j.smaller,
                "f": j.f,
                "f_p": j.f_p,
                "weakest": weakest.parameter if weakest else "",
                "weakest_ratio": weakest.ratio if weakest else np.nan,
                "weakest_p": weakest.p_value if weakest else np.nan,
                "problem": j.problem,
            }
        )
    table = pd.DataFrame(rows)
    place = table.columns.tolist().index("bic") + 1
    for k, name in enumerate(("aic", "aicc", "bic")):
        table.insert(place + k, f"delta_{name}", table[name] - table[name].min())
    return table


def parameter_table(choice: ModelChoice) -> pd.DataFrame:
    """model, camera, parameter, value, sigma (a posteriori), unit, ratio, p_value of every estimated interior
    parameter."""
    rows = [
        (j.candidate.name, s.camera, s.parameter, s.value, s.sigma, s.unit, s.ratio, s.p_value)
        for j in choice.judged
        for s in j.parameters
    ]
    return pd.DataFrame(rows, columns=["model", "camera", "parameter", "value", "sigma", "unit", "ratio", "p_value"])


def choice_verdict(choice: ModelChoice) -> list[str]:
    """The choice in sentences."""
    if not choice.by_bic:
        return ["no model could be adjusted; see the column problem"]
    best = min(j.bic for j in choice.judged if math.isfinite(j.bic))
    alike = [j.candidate.name for j in choice.judged if j.bic <= best + _ALIKE and j.candidate.name != choice.by_bic]
    said = [f"BIC prefers {choice.by_bic}" + f", and hardly less {', '.join(alike)}" * bool(alike)]
    if choice.by_prediction:
        said.append(
            f"of {choice.n_left_out} image points left out, {choice.by_prediction} is the smallest model that predicts "
            "within one standard error of the best"
        )
    said += [f"{j.candidate.name} could not be judged: {j.problem}" for j in choice.judged if j.problem]
    return said


def choice_figure(choice: ModelChoice) -> Figure:
    """Both pictures of `plot_models`, one beside the other; empty where no model could be adjusted."""
    known = [j for j in choice.judged if math.isfinite(j.bic)]
    figure = new_figure(9.6, 1.2 + 0.36 * max(len(known), 3))
    if known:
        for axes, rms in zip(figure.subplots(1, 2, sharey=True), (False, True), strict=True):
            plot_models(choice, axes, rms=rms)
    return figure


def plot_models(choice: ModelChoice, ax: Axes | None = None, *, rms: bool = False) -> Axes:
    """BIC above the smallest, model by model, or the `rms` of adjusted and of left-out image points (px).

    Behind each name stands how many interior parameters are estimated. Raises InputError where no model could be
    adjusted.
    """
    judged = [j for j in choice.judged if math.isfinite(j.bic)]
    if not judged:
        raise InputError("no model could be adjusted: there is nothing to be drawn")
    ax, at = axes_or_new(ax), np.arange(len(judged))
    if rms:
        ax.plot([j.rms_px for j in judged], at, "o", color="0.5", label="adjusted")
        if choice.n_left_out:
            ax.plot([j.cv_rms_px for j in judged], at, "D", color="tab:blue", label="left out")
        ax.set_xlabel("RMS of image points [px]", fontsize=9)
        ax.legend(fontsize=8)
        ax.grid(axis="x", lw=0.3)
        ax.set_title("how well image points fit, and are predicted", loc="left", fontsize=10)
    else:
        above = np.array([j.bic for j in judged])
        above -= above.min()
        # From one on: the smallest is at zero, which a logarithmic axis does not have.
        ax.barh(at, above, left=1.0, color="tab:blue")
        for k, one in enumerate(above):
            ax.text(1 + one, k, f" {one:.1f}" if one < _FAR else f" {one:,.0f}", va="center", fontsize=8)
        ax.set_xscale("log")
        ax.set_xlim(1.0, 4 * (1 + max(above.max(), _MARKS[1])))
        marks = [mark for mark in _MARKS if mark <= max(above.max(), _MARKS[1])]
        ax.set_xticks([1.0 + mark for mark in marks], [f"{mark:g}" for mark in marks], minor=False)
        ax.minorticks_off()
        ax.set_xlabel("BIC above the smallest", fontsize=9)
        ax.set_title(f"what BIC prefers: {drawn(choice.by_bic)}", loc="left", fontsize=10)
    ax.set_yticks(at, [drawn(f"{j.candidate.name} ({j.n_parameters})") for j in judged], fontsize=8)
    ax.set_ylim(len(judged) - 0.5, -0.5)
    return ax


def write_model_choice(
    choice: ModelChoice, block: Block, directory: Path, seconds: dict[str, float], made: Made
) -> None:
    """models.csv, parameters.csv, models.png, report.html and summary.json, in `directory` only when all is written.

    Raises InputError where `directory` holds something that is not an earlier result.
    """
    began = time.perf_counter()
    table, parameters, verdict = choice_table(choice), parameter_table(choice), choice_verdict(choice)
    alt = "BIC above the smallest, and RMS of image points adjusted and left out, model by model"
    picture = WholePicture.of(choice_figure(choice), alt)
    title = block.title
    parts = (
        *assumed_pixels(block.sensors),
        Heading("Models"),
        rows_of(_shown(table)),
        picture,
        Heading("Estimated parameters of every model"),
        rows_of(parameters),
        *made_section(made),
    )
    with whole_folder(directory) as work:
        table.to_csv(work / "models.csv", index=False)
        parameters.to_csv(work / "parameters.csv", index=False)
        (work / "models.png").write_bytes(picture.png)
        page = study_page(f"{title or 'block'}: models", verdict, parts)
        (work / "report.html").write_text(page, encoding="utf-8")
        summary = {
            "title": title,
            "verdict": verdict,
            "by_bic": choice.by_bic,
            "by_prediction": choice.by_prediction,
            "n_left_out": choice.n_left_out,
            "models": table["model"].tolist(),
            "seconds": {k: round(v, 6) for k, v in (seconds | {"write": time.perf_counter() - began}).items()},
            "versions": versions(),
        }
        write_summary(summary, work)


def print_model_choice(choice: ModelChoice, console: Console) -> None:
    """Print the choice, then the table."""
    for sentence in choice_verdict(choice):
        console.print(sentence, highlight=False, markup=False)
    shown = _shown(choice_table(choice))
    shown = shown[[name for name in _IN_TERMINAL if name in shown]]
    table = Table(*map(str, shown.columns))
    for row in shown.itertuples(index=False):
        table.add_row(*row)
    console.print(table)


def _shown(table: pd.DataFrame) -> pd.DataFrame:
    """The columns for people, as text; those of which no model has a number are left out."""
    columns = {}
    for name, form in _SHOWN.items():
        cells = ["" if pd.isna(v) else form(v) for v in table[name]]
        if any(cells):
            columns[name] = cells
    return pd.DataFrame(columns)
