"""Monte Carlo draws: a table with one row per draw, a summary that compares them with the prediction, plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.observations import AXES
from jaxphoto.report.formatting import column_unit, path_words, to_rich
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot, page, provenance
from jaxphoto.report.plots import axes_or_new, colour_bar, label
from jaxphoto.report.results import assumed_pixels
from jaxphoto.report.terminal import plain
from jaxphoto.sensitivity import Draws
from jaxphoto.writing import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LONG = ("exterior.", "point.", "check.", f"{TrajectoryKnot.kind}.")
"""Column prefixes of images, points and trajectory knots; these quantities are written to files only."""
EXTERIOR = ("X_m", "Y_m", "Z_m", "omega_rad", "phi_rad", "kappa_rad")
_QUANTILES = {"q025": 0.025, "q50": 0.5, "q975": 0.975}
# Maximum number of histograms, and of errors in the figure of effects.
_SHOWN, _ERRORS = 12, 60


def draws_table(draws: Draws, adjusted: Adjustment, first: int = 0) -> pd.DataFrame:
    """Tabulate the draws: draw (from `first`), converged, iterations, fallback, bias.*, then the estimates.

    Estimates are `<camera>.c_mm` etc., `scanner.*`, `mounts.*`, `strips.*`. If stored, also `exterior.<image>.X_m ...
    kappa_deg` and `point.<id>.X_m`; with points, also `check.<id>.dX_m` (surveyed minus computed). Angles in degrees.
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
        for index, axis, value in zip(check.who, check.axis, np.asarray(check.value), strict=True):
            columns[f"check.{block.points[index]}.d{AXES[axis]}_m"] = value - draws.points[:, index, axis]
    return pd.DataFrame(
        {in_degrees(name): np.degrees(v) if name.endswith("_rad") else v for name, v in columns.items()}
    )


def in_degrees(name: str) -> str:
    """Replace the suffix _rad of a column name by _deg."""
    return name.removesuffix("_rad") + "_deg" if name.endswith("_rad") else name


def _in_radians(path: str) -> str:
    """Convert `interior[kodak].c_mm` to `kodak.c_mm`, `strips[E1].shift_X_m` to `strips.E1.shift_X_m`."""
    if "[" not in path:
        return path
    kind, rest = path.split("[", 1)
    name, parameter = rest.rsplit("].", 1)
    return f"{name}.{parameter}" if kind == "interior" else f"{kind}.{name}.{parameter}"


def summary_table(
    columns: pd.DataFrame,
    nominal: Mapping[str, float],
    predicted: Mapping[str, float],
    cameras: Mapping[str, InteriorOrientation],
) -> pd.DataFrame:
    """Tabulate the moments of the columns of draws and their prediction.

    Columns: quantity, nominal, mean, sd, quantiles, predicted_sigma, ratio (sd over predicted), unit.
    """
    quantiles = columns.quantile(list(_QUANTILES.values())).set_axis(list(_QUANTILES)).T
    table = pd.DataFrame({"mean": columns.mean(), "sd": columns.std()}).join(quantiles).reset_index(names="quantity")
    table.insert(1, "nominal", table["quantity"].map(lambda name: nominal.get(name, np.nan)))
    table["predicted_sigma"] = table["quantity"].map(lambda name: predicted.get(name, np.nan))
    table["ratio"] = table["sd"] / table["predicted_sigma"]
    return table.assign(unit=[column_unit(name, cameras) for name in table["quantity"]])


def plot_draws(draws: pd.DataFrame, summary: pd.DataFrame, quantity: str, ax: Axes | None = None) -> Axes:
    """Draw the histogram of a quantity, with its error-free value and the predicted normal density.

    `draws` is the table of `draws_table` (draws.parquet), `summary` the table of `summary_table` (summary.csv). Raises
    InputError for a quantity that is missing in either.
    """
    quantities = summary["quantity"].tolist()
    if quantity not in quantities or quantity not in draws:
        names = ", ".join(name for name in quantities if name in draws and not name.startswith(LONG))
        raise InputError(f"unknown quantity {quantity!r} of the draws; use one of {names}, or one of images or points")
    ax, of = axes_or_new(ax), summary[summary["quantity"] == quantity]
    nominal, sigma = of[["nominal", "predicted_sigma"]].to_numpy(float)[0]
    values = draws[quantity].to_numpy(float)
    # Skip the histogram if draws differ only by rounding.
    if len(values) and np.ptp(values) > 1e-12 * np.abs(values).max(initial=1e-300):
        ax.hist(values, bins=min(60, max(5, int(np.sqrt(len(values))))), density=True, color="0.75")
    ax.axvline(nominal, color="tab:red", lw=1)
    if sigma > 0:
        at = np.linspace(-4, 4, 200)
        ax.plot(nominal + sigma * at, np.exp(-0.5 * at**2) / sigma / np.sqrt(2 * np.pi), color="tab:blue", lw=1)
    ax.set_title(label(path_words(quantity)), fontsize=9)
    ax.set_yticks([])
    ax.tick_params(labelsize=7)
    ax.locator_params(axis="x", nbins=4)
    return ax


def plot_effects(
    effects: pd.DataFrame, summary: pd.DataFrame, quantities: Sequence[str], ax: Axes | None = None
) -> Axes:
    """Draw the effect of one sigma of each error on `quantities`, relative to their predicted sigmas.

    `effects` is effects.csv and `summary` is summary.csv of a Monte Carlo simulation. Raises InputError for unknown
    quantities.
    """
    names = list(quantities)
    available = [name for name in summary["quantity"] if name in effects]
    if missing := [name for name in names if name not in available]:
        raise InputError(f"unknown quantity {missing[0]!r} of the effects; use one of {', '.join(available)}")
    ax, predicted = axes_or_new(ax), summary.set_index("quantity")["predicted_sigma"][names].to_numpy()
    fractions = effects[names].to_numpy() / np.where(predicted > 0, predicted, np.nan)
    image = ax.imshow(fractions, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    columns, rows = (
        [label(path_words(path).partition(" [")[0]) for path in paths] for paths in (names, effects["error"])
    )
    ax.set_xticks(range(len(names)), columns, rotation=45, ha="right", fontsize=8)
    ax.set_yticks(range(len(effects)), rows, fontsize=7)
    colour_bar(ax, image, "effect of one sigma / predicted sigma")
    return ax


def write_draws_page(
    summary: Mapping[str, Any],
    table: pd.DataFrame,
    sensors: Mapping[str, Sensor],
    directory: Path,
    record: CommandRecord,
) -> None:
    """Write report.html of the draws in `directory`: summary, its table, histograms and effects."""
    few, ordered = ~table["quantity"].str.startswith(LONG), _ordered(table)
    shared = [name for name in ordered["quantity"] if not name.startswith("bias.")]
    draws = pd.read_parquet(directory / "draws.parquet", columns=["converged", *shared[:_SHOWN]])
    plots: list[Plot] = [
        Plot(partial(plot_draws, draws[draws["converged"]], table, name), f"histogram of {name}", 2.6)
        for name in shared[:_SHOWN]
    ]
    words = "Grey: histogram of the draws; red line: value without errors; blue line: predicted normal distribution."
    parts: list[Part] = [_shown(ordered), *assumed_pixels(sensors), Heading("Estimates over the draws")]
    parts += [Paragraph(words), plots]
    if (file := directory / "effects.csv").is_file() and len(effects := pd.read_csv(file)) <= _ERRORS:
        words = "Effect of one sigma of each error (row) on each estimate (column), relative to its predicted sigma."
        draw = partial(plot_effects, effects, table, [name for name in shared if name in effects])
        parts += [Heading("Effect of each error on each estimate"), Plot(draw, words, max(3.2, 1 + 0.2 * len(effects)))]
    if not few.all():
        parts.append(Paragraph("Images, points and trajectory knots are in summary.csv."))
    title, verdict = f"Monte Carlo: {summary.get('title') or 'block'}", (_verdict(summary, table), "")
    text = page(title, [*parts, *provenance(record)], verdict)
    with whole_file(directory / "report.html") as work:
        work.write_text(text, encoding="utf-8")


def _verdict(summary: Mapping[str, Any], table: pd.DataFrame) -> str:
    ratio = table.loc[~table["quantity"].str.startswith(LONG), "ratio"].dropna()
    ratios = "No estimate is predicted to change."
    if len(ratio):
        ratios = f"Standard deviations are {ratio.min():.3g} to {ratio.max():.3g} times the first-order prediction."
    return f"{summary['draws']} draws, {summary['converged']} converged. {ratios}"


def _ordered(table: pd.DataFrame) -> pd.DataFrame:
    """Return the quantities that are not of images or points, errors last: their distribution is known."""
    few = table[~table["quantity"].str.startswith(LONG)]
    return few.sort_values("quantity", key=lambda name: name.str.startswith("bias."), kind="stable")


def _shown(ordered: pd.DataFrame) -> pd.DataFrame:
    """Return the table of the page: parameters in words."""
    return ordered.assign(quantity=[path_words(name).partition(" [")[0] for name in ordered["quantity"]])


def print_draws(summary: Mapping[str, Any], table: pd.DataFrame, console: Console) -> None:
    """Print the number of draws, and mean and standard deviation of every estimate."""
    console.print(plain(str(summary.get("title") or "block")), style="bold")
    console.print(plain(_verdict(summary, table)), soft_wrap=True)
    speed = f"{summary['draws_per_second']:.0f} draws per second"
    console.print(f"{summary['fallbacks']} by a full adjustment; {speed}", soft_wrap=True)
    rows = _ordered(table[~table["quantity"].str.startswith("bias.")])
    columns = ["quantity", "nominal", "mean", "sd", "predicted_sigma", "ratio", "unit"]
    console.print(to_rich(_shown(rows)[columns], "estimates over the draws"))
