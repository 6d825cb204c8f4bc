"""A Monte Carlo as tables and pictures: one row a draw, a summary beside the prediction, histograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.observations import AXES
from jaxphoto.report.document import Heading, Paragraph, rows_of
from jaxphoto.report.made import Made, made_section
from jaxphoto.report.plots import axes_or_new, drawn, new_figure
from jaxphoto.report.source_words import assumed_pixels
from jaxphoto.report.study_page import StudyPart, WholePicture, study_page
from jaxphoto.report.units import column_unit
from jaxphoto.sensitivity import Draws
from jaxphoto.writing import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PICTURES = {
    "interior": (
        "Estimates over the draws",
        "Grey: how many draws; red line: the value without errors; blue line: the normal distribution that the "
        "predicted sigma stands for.",
    ),
    "effects": (
        "Which error is behind which estimate",
        "What one sigma of each error (row) does to each estimate (column), as a part of its predicted sigma.",
    ),
}
LONG = ("exterior.", "point.", "check.", f"{TrajectoryKnot.kind}.")
"""How quantities begin that are of images, points and knots of a trajectory: files have them, no page and no screen."""
EXTERIOR = ("X_m", "Y_m", "Z_m", "omega_rad", "phi_rad", "kappa_rad")
_QUANTILES = {"q025": 0.025, "q50": 0.5, "q975": 0.975}
# Histograms of a picture.
_SHOWN = 12
# Inches: a wider picture is drawn smaller on a page, and its names are not read any more.
_WIDEST = 10.5


def draws_table(draws: Draws, adjusted: Adjustment, first: int = 0) -> pd.DataFrame:
    """One row a draw: draw (from `first`), converged, iterations, fallback, bias.*, then what was estimated.

    `<camera>.c_mm` and so on; `scanner.*`, `mounts.*`, `strips.*`; where they were kept `exterior.<image>.X_m ...
    kappa_deg` and `point.<id>.X_m`; and `check.<id>.dX_m`, surveyed minus computed, with the points. Angles are in
    degrees.
    """
    block = adjusted.block
    columns: dict[str, np.ndarray] = {
        "draw": first + np.arange(len(draws.steps)),
        "converged": draws.converged,
        "iterations": draws.steps,
        "fallback": draws.fallback,
    }
    columns |= {f"bias.{name}": v for name, v in draws.recorded.items()}
    columns |= dict(zip(map(_in_radians, draws.labels), draws.shared.T, strict=True))
    if draws.exterior is not None:
        names = [f"exterior.{image}.{name}" for image in block.images for name in EXTERIOR]
        columns |= dict(zip(names, draws.exterior.reshape(len(draws.steps), -1).T, strict=True))
    if draws.points is not None:
        names = [f"point.{point}.{axis}_m" for point in block.points for axis in AXES]
        columns |= dict(zip(names, draws.points.reshape(len(draws.steps), -1).T, strict=True))
        check = block.check
        for who, axis, value in zip(check.who, check.axis, np.asarray(check.value), strict=True):
            columns[f"check.{block.points[who]}.d{AXES[axis]}_m"] = value - draws.points[:, who, axis]
    return pd.DataFrame(
        {in_degrees(name): np.degrees(v) if name.endswith("_rad") else v for name, v in columns.items()}
    )


def in_degrees(name: str) -> str:
    """The name of a column whose numbers, if angles, are in degrees."""
    return name.removesuffix("_rad") + "_deg" if name.endswith("_rad") else name


def column_of(label: str) -> str:
    """`interior[kodak].c_mm` -> `kodak.c_mm`, `strips[E1].shift_X_m` -> `strips.E1.shift_X_m`.

    What belongs to nobody by name, such as `scanner.boresight_right_rad`, keeps its label.
    """
    return in_degrees(_in_radians(label))


def _in_radians(label: str) -> str:
    if "[" not in label:
        return label
    kind, rest = label.split("[", 1)
    name, parameter = rest.rsplit("].", 1)
    return f"{name}.{parameter}" if kind == "interior" else f"{kind}.{name}.{parameter}"


class Moments(NamedTuple):
    """Of one column: what its draws are like."""

    mean: float
    sd: float
    quantiles: tuple[float, ...]


def moments(values: np.ndarray) -> Moments:
    """Of the draws of one column; not a number where there are too few."""
    values = np.asarray(values, float)
    if not len(values):
        return Moments(np.nan, np.nan, (np.nan,) * len(_QUANTILES))
    sd = float(values.std(ddof=1)) if len(values) > 1 else np.nan
    return Moments(float(values.mean()), sd, tuple(np.quantile(values, list(_QUANTILES.values()))))


def summary_table(
    found: Mapping[str, Moments],
    nominal: Mapping[str, float],
    predicted: Mapping[str, float],
    cameras: Mapping[str, InteriorOrientation],
) -> pd.DataFrame:
    """quantity, nominal, mean, sd, quantiles, predicted_sigma, ratio (sd over predicted), unit."""
    rows = [(name, nominal.get(name, np.nan), m.mean, m.sd, *m.quantiles) for name, m in found.items()]
    table = pd.DataFrame(rows, columns=["quantity", "nominal", "mean", "sd", *_QUANTILES])
    table["predicted_sigma"] = [predicted.get(name, np.nan) for name in found]
    table["ratio"] = table["sd"] / table["predicted_sigma"]
    return table.assign(unit=[column_unit(name, cameras) for name in found])


def draws_figure(columns: Mapping[str, np.ndarray], summary: pd.DataFrame) -> Figure:
    """Histograms of some columns, with the nominal value and the predicted normal density."""
    chosen = list(columns)[:_SHOWN]
    across = min(3, len(chosen))
    down = -(-len(chosen) // across)
    figure = new_figure(3.3 * across, 2.5 * down)
    figure.set_layout_engine("constrained", h_pad=0.1)
    of = summary.set_index("quantity")
    for axes, name in zip(figure.subplots(down, across, squeeze=False).flat, chosen, strict=False):
        _draw_histogram(axes, name, np.asarray(columns[name], float), of)
    for axes in figure.axes[len(chosen) :]:
        axes.set_axis_off()
    return figure


def plot_draws(draws: pd.DataFrame, summary: pd.DataFrame, quantity: str, ax: Axes | None = None) -> Axes:
    """How often a quantity came out how large, with its value without errors and the normal density predicted.

    `draws` is that of `draws_table` (draws.parquet), `summary` that of `summary_table` (summary.csv). Raises InputError
    for a quantity that is not in both.
    """
    of = summary.set_index("quantity")
    if quantity not in of.index or quantity not in draws:
        known = ", ".join(name for name in of.index if name in draws and not name.startswith(LONG))
        raise InputError(f"the draws have no {quantity!r}; they have {known}, and those of images and points")
    ax = axes_or_new(ax)
    _draw_histogram(ax, quantity, draws[quantity].to_numpy(float), of)
    return ax


def _draw_histogram(axes: Axes, name: str, values: np.ndarray, summary: pd.DataFrame) -> None:
    """Of one quantity, by which the rows of the summary are named."""
    nominal, sigma = (float(summary[column].loc[name]) for column in ("nominal", "predicted_sigma"))
    # Where draws differ by rounding only, there is no width to divide into bins.
    apart = np.ptp(values) > 1e-12 * np.abs(values).max(initial=1e-300) if len(values) else False
    if apart:
        axes.hist(values, bins=min(60, max(5, int(np.sqrt(len(values))))), density=True, color="0.75")
    axes.axvline(nominal, color="tab:red", lw=1)
    if sigma > 0:
        at = np.linspace(-4, 4, 200)
        density = np.exp(-0.5 * at**2) / sigma / np.sqrt(2 * np.pi)
        axes.plot(nominal + sigma * at, density, color="tab:blue", lw=1)
    axes.set_title(drawn(name), fontsize=9)
    axes.set_yticks([])
    axes.tick_params(labelsize=7)
    axes.locator_params(axis="x", nbins=4)


def plot_effects(
    effects: pd.DataFrame, summary: pd.DataFrame, quantities: Sequence[str], ax: Axes | None = None
) -> Axes:
    """What one sigma of each error does to `quantities`, as parts of their predicted standard deviations.

    `effects` is effects.csv and `summary` summary.csv of a Monte Carlo. Raises InputError for what they do not have.
    """
    known = [name for name in summary["quantity"] if name in effects]
    if missing := [name for name in quantities if name not in known]:
        raise InputError(f"the effects have no {missing[0]!r}; they have {', '.join(known)}")
    ax = axes_or_new(ax)
    _draw_effects(ax, effects, summary, quantities)
    return ax


def effects_figure(effects: pd.DataFrame, summary: pd.DataFrame, quantities: list[str]) -> Figure:
    """What one sigma of each error does to some quantities, as parts of their predicted standard deviations."""
    figure = new_figure(min(1.8 + 0.8 * len(quantities), _WIDEST), max(3.2, 1.8 + 0.26 * len(effects)))
    _draw_effects(figure.subplots(), effects, summary, quantities)
    return figure


def _draw_effects(axes: Axes, effects: pd.DataFrame, summary: pd.DataFrame, quantities: Sequence[str]) -> None:
    names = list(quantities)
    predicted = summary.set_index("quantity")["predicted_sigma"][names].to_numpy()
    parts = effects[names].to_numpy() / np.where(predicted > 0, predicted, np.nan)
    image = axes.imshow(parts, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    axes.set_xticks(range(len(names)), list(map(drawn, names)), rotation=45, ha="right", fontsize=8)
    axes.set_yticks(range(len(effects)), list(map(drawn, effects["error"])), fontsize=7)
    axes.figure.colorbar(image, ax=axes, label="effect of one sigma / predicted sigma")


def write_draws_page(
    summary: Mapping[str, Any], table: pd.DataFrame, sensors: Mapping[str, Sensor], directory: Path, made: Made
) -> None:
    """report.html of the draws in `directory`, from the summary, its table and the pictures that are there."""
    few = ~table["quantity"].str.startswith(LONG)
    said = [
        f"{summary['draws']} draws, of which {summary['converged']} converged. {_ratios(table[few])}",
        "The predicted sigma is the effect of the errors to first order; the ratio says how far draws agree with it.",
    ]
    parts: list[StudyPart] = [*assumed_pixels(sensors)]
    for name, (heading, said_of) in _PICTURES.items():
        if (file := directory / f"{name}.png").is_file():
            parts += [Heading(heading), Paragraph(said_of), WholePicture.read(file, f"{heading}: {said_of}")]
    # What was drawn comes last: it is known beforehand.
    found = table[few].sort_values("quantity", key=lambda name: name.str.startswith("bias."), kind="stable")
    parts += [Heading("Means and standard deviations"), rows_of(found)]
    if not few.all():
        parts.append(Paragraph("Images, points and knots of trajectories stand in summary.csv."))
    page = study_page(f"Monte Carlo: {summary.get('title') or 'block'}", said, [*parts, *made_section(made)])
    with whole_file(directory / "report.html") as work:
        work.write_text(page, encoding="utf-8")


def _ratios(table: pd.DataFrame) -> str:
    ratio = table["ratio"].dropna()
    if ratio.empty:
        return "Nothing is predicted to change."
    return f"Standard deviations of the draws are {ratio.min():.3g} to {ratio.max():.3g} times those predicted."
