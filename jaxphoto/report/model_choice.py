"""Choice of a distortion model: tables, plot, page and terminal output."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.procedures.model_choice import ModelChoice
from jaxphoto.report.formatting import to_rich, without_empty
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot
from jaxphoto.report.plots import axes_or_new, label, title
from jaxphoto.report.results import assumed_pixels, rounded, write_study
from jaxphoto.report.terminal import print_lines
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Columns of `choice_table` in the terminal, and further ones on the page.
_IN_TERMINAL = ["model", "parameters", "sigma0", "redundancy", "rms_px", "cv_rms_px", "cv_excess_se", "delta_bic"]
_ON_PAGE = [*_IN_TERMINAL, "delta_aicc", "smaller", "f", "f_p", "weakest", "weakest_ratio"]
_HEADS = {
    "cv_rms_px": "held-out_rms_px", "cv_excess_se": "above the best [standard errors]",
    "delta_bic": "BIC above the best", "delta_aicc": "AICc above the best", "smaller": "smaller model", "f": "F",
    "f_p": "p_value", "weakest": "least significant", "weakest_ratio": "its ratio",
}  # fmt: skip
# Difference of BIC below which two models are equally good (Kass and Raftery 1995).
_EQUAL = 2.0


def choice_table(choice: ModelChoice) -> pd.DataFrame:
    """Tabulate the candidates; `delta_` are differences from the smallest value, NaN if undefined.

    Columns: model, distortion, coefficients, parameters, observations, redundancy, square_sum (v'Pv), sigma0, rms_px,
    cv_rms_px, cv_excess_se, aic, aicc, bic, delta_aic, delta_aicc, delta_bic, smaller, f, f_p, weakest, weakest_ratio,
    weakest_p, problem. See `jaxphoto.procedures.model_choice`.
    """
    rows = []
    for j in choice.judged:
        weakest = j.weakest
        rows.append({
            "model": j.candidate.name, "distortion": j.candidate.distortion.__name__,
            "coefficients": " ".join(j.candidate.free), "parameters": j.n_parameters, "observations": j.n_effective,
            "redundancy": j.redundancy, "square_sum": j.sum_of_squares, "sigma0": j.sigma0, "rms_px": j.rms_px,
            "cv_rms_px": j.cv_rms_px, "cv_excess_se": j.cv_excess, "aic": j.aic, "aicc": j.aicc, "bic": j.bic,
            "smaller": j.smaller, "f": j.f, "f_p": j.f_p, "weakest": weakest.parameter if weakest else "",
            "weakest_ratio": weakest.ratio if weakest else np.nan,
            "weakest_p": weakest.p_value if weakest else np.nan, "problem": j.problem,
        })  # fmt: skip
    table = pd.DataFrame(rows)
    place = table.columns.tolist().index("bic") + 1
    for k, name in enumerate(("aic", "aicc", "bic")):
        table.insert(place + k, f"delta_{name}", table[name] - table[name].min())
    return table


def parameter_table(choice: ModelChoice) -> pd.DataFrame:
    """Tabulate the interior parameters of all models.

    Columns: model, camera, parameter, value, sigma (a posteriori), unit, ratio, p_value.
    """
    rows = [
        (j.candidate.name, s.camera, s.parameter, s.value, s.sigma, s.unit, s.ratio, s.p_value)
        for j in choice.judged
        for s in j.parameters
    ]
    return pd.DataFrame(rows, columns=["model", "camera", "parameter", "value", "sigma", "unit", "ratio", "p_value"])


def choice_verdict(choice: ModelChoice) -> list[str]:
    """Return the model choice as text, one sentence per item."""
    if not choice.by_bic:
        return ["no model could be adjusted; see the column problem"]
    best = min(j.bic for j in choice.judged if math.isfinite(j.bic))
    equal = [j.candidate.name for j in choice.judged if j.bic <= best + _EQUAL and j.candidate.name != choice.by_bic]
    also = f"; not significantly worse: {', '.join(equal)}" if equal else ""
    sentences = [f"BIC prefers {choice.by_bic}{also}"]
    if choice.by_prediction:
        sentences.append(
            f"{choice.by_prediction} is the smallest model that predicts {choice.n_left_out} held-out image points "
            "within one standard error of the best"
        )
    if choice.weights:
        sentences.append(choice.weights.words)
    return sentences + [f"{j.candidate.name} could not be adjusted: {j.problem}" for j in choice.judged if j.problem]


def plot_models(choice: ModelChoice, ax: Axes | None = None, *, rms: bool = False) -> Axes:
    """Draw BIC minus the smallest BIC by model, or the `rms` of adjusted and held-out image points (px).

    Each label contains the number of interior parameters. Raises InputError if no model could be adjusted.
    """
    judged = [j for j in choice.judged if math.isfinite(j.bic)]
    if not judged:
        raise InputError("no model could be adjusted; see the problems in choice.judged")
    ax, at = axes_or_new(ax), np.arange(len(judged))
    if rms:
        ax.plot([j.rms_px for j in judged], at, "o", color="0.5", label="adjusted")
        if choice.n_left_out:
            ax.plot([j.cv_rms_px for j in judged], at, "D", color="tab:blue", label="held out")
        ax.set_xlabel("RMS of image points [px]", fontsize=9)
        ax.legend(fontsize=8)
        ax.grid(axis="x", lw=0.3)
        title(ax, "fit and prediction of image points")
    else:
        above = np.array([j.bic for j in judged])
        above -= above.min()
        ax.barh(at, above, color="tab:blue")
        for k, one in enumerate(above):
            ax.text(one, k, f" {one:,.1f}", va="center", fontsize=8)
        ax.set_xscale("symlog", linthresh=_EQUAL)
        ax.set_xlim(0.0, 4 * (1 + above.max()))
        ax.set_xlabel("BIC above the smallest", fontsize=9)
        title(ax, f"BIC prefers {label(choice.by_bic)}")
    ax.set_yticks(at, [label(f"{j.candidate.name} ({j.n_parameters})") for j in judged], fontsize=8)
    ax.set_ylim(len(judged) - 0.5, -0.5)
    return ax


def write_model_choice(
    choice: ModelChoice, block: Block, directory: Path, seconds: dict[str, float], record: CommandRecord
) -> None:
    """Write models.csv, parameters.csv, report.html and summary.json."""
    verdict, table, parameters = choice_verdict(choice), choice_table(choice), parameter_table(choice)
    names = {False: "BIC above the smallest, by model", True: "RMS of image points adjusted and held out, by model"}
    plots: list[Plot] = [Plot(partial(plot_models, choice, rms=rms), name) for rms, name in names.items()]
    chosen: list[Part] = [_chosen(choice), Paragraph(f"Estimates of {choice.by_bic}, a posteriori.")]
    parts: list[Part] = [
        *(chosen if choice.by_bic else []),
        *assumed_pixels(block.sensors),
        Heading("Models"),
        without_empty(table[_ON_PAGE]).rename(columns=_HEADS),
        plots if choice.by_bic else [],
        Heading("Estimated parameters of every model"),
        parameters,
    ]
    summary = {
        "title": block.title, "verdict": verdict, "by_bic": choice.by_bic, "by_prediction": choice.by_prediction,
        "n_left_out": choice.n_left_out, "models": table["model"].tolist(), "seconds": rounded(seconds),
    }  # fmt: skip
    tables = {"models": table, "parameters": parameters}
    with whole_folder(directory) as work:
        name = f"{block.title or 'block'}: models"
        write_study(work, name, (". ".join(verdict), ""), parts, summary, record, tables)


def print_model_choice(choice: ModelChoice, console: Console) -> None:
    """Print the choice, its table, and the estimates of the chosen model."""
    print_lines(choice_verdict(choice), console)
    console.print(to_rich(without_empty(choice_table(choice)[_IN_TERMINAL]).rename(columns=_HEADS), "models"))
    if choice.by_bic:
        console.print(to_rich(_chosen(choice), f"estimates of {choice.by_bic} (a posteriori)"))


def _chosen(choice: ModelChoice) -> pd.DataFrame:
    """Return the estimates of the model with the smallest BIC: camera (if several), parameter, value, sigma, unit."""
    table = parameter_table(choice)
    table = table[table["model"] == choice.by_bic][["camera", "parameter", "value", "sigma", "unit"]]
    return table if len(set(table["camera"])) > 1 else table.drop(columns="camera")
