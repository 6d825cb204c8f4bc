"""Monte Carlo draws: a table with one row per draw, a summary that compares them with the prediction, plots."""

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
from jaxphoto.report.formatting import column_unit
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot, page, provenance
from jaxphoto.report.plots import axes_or_new, label, new_figure
from jaxphoto.report.results import assumed_pixels
from jaxphoto.sensitivity import Draws
from jaxphoto.statistics import Correlations, Covariance, correlation_matrix
from jaxphoto.writing import whole_file

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PICTURES = {
    "interior": (
        "Estimates over the draws",
        "Grey: histogram of the draws; red line: value without errors; blue line: predicted normal distribution.",
    ),
    "effects": (
        "Effect of each error on each estimate",
        "Effect of one sigma of each error (row) on each estimate (column), relative to its predicted sigma.",
    ),
}
LONG = ("exterior.", "point.", "check.", f"{TrajectoryKnot.kind}.")
"""Column prefixes of images, points and trajectory knots; these quantities are written to files only."""
EXTERIOR = ("X_m", "Y_m", "Z_m", "omega_rad", "phi_rad", "kappa_rad")
_QUANTILES = {"q025": 0.025, "q50": 0.5, "q975": 0.975}
# Maximum number of histograms in a figure; maximum width of the figure (inches).
_SHOWN, _WIDEST = 12, 10.5


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


def column_of(path: str) -> str:
    """Convert `interior[kodak].c_mm` to `kodak.c_mm`, `strips[E1].shift_X_m` to `strips.E1.shift_X_m`."""
    return in_degrees(_in_radians(path))


def _in_radians(path: str) -> str:
    if "[" not in path:
        return path
    kind, rest = path.split("[", 1)
    name, parameter = rest.rsplit("].", 1)
    return f"{name}.{parameter}" if kind == "interior" else f"{kind}.{name}.{parameter}"


class Moments(NamedTuple):
    """Mean, standard deviation and quantiles of one column of the draws."""

    mean: float
    sd: float
    quantiles: tuple[float, ...]


def moments(values: np.ndarray) -> Moments:
    """Compute the moments of one column of the draws; NaN for too few draws."""
    values = np.asarray(values, float)
    if not len(values):
        return Moments(np.nan, np.nan, (np.nan,) * len(_QUANTILES))
    sd = float(values.std(ddof=1)) if len(values) > 1 else np.nan
    return Moments(float(values.mean()), sd, tuple(np.quantile(values, list(_QUANTILES.values()))))


def summary_table(
    moments_of: Mapping[str, Moments],
    nominal: Mapping[str, float],
    predicted: Mapping[str, float],
    cameras: Mapping[str, InteriorOrientation],
) -> pd.DataFrame:
    """Tabulate the moments of the draws and their prediction.

    Columns: quantity, nominal, mean, sd, quantiles, predicted_sigma, ratio (sd over predicted), unit.
    """
    rows = [(name, nominal.get(name, np.nan), m.mean, m.sd, *m.quantiles) for name, m in moments_of.items()]
    table = pd.DataFrame(rows, columns=["quantity", "nominal", "mean", "sd", *_QUANTILES])
    table["predicted_sigma"] = [predicted.get(name, np.nan) for name in moments_of]
    table["ratio"] = table["sd"] / table["predicted_sigma"]
    return table.assign(unit=[column_unit(name, cameras) for name in moments_of])


def draws_figure(columns: Mapping[str, np.ndarray], summary: pd.DataFrame) -> Figure:
    """Draw histograms of some columns, with the nominal value and the predicted normal density."""
    chosen = list(columns)[:_SHOWN]
    across = min(3, len(chosen))
    down = -(-len(chosen) // across)
    figure = new_figure(3.3 * across, 2.5 * down)
    figure.set_layout_engine("constrained", h_pad=0.1)
    for axes, name in zip(figure.subplots(down, across, squeeze=False).flat, chosen, strict=False):
        _draw_histogram(axes, name, np.asarray(columns[name], float), summary)
    for axes in figure.axes[len(chosen) :]:
        axes.set_axis_off()
    return figure


def plot_draws(draws: pd.DataFrame, summary: pd.DataFrame, quantity: str, ax: Axes | None = None) -> Axes:
    """Draw the histogram of a quantity, with its error-free value and the predicted normal density.

    `draws` is the table of `draws_table` (draws.parquet), `summary` the table of `summary_table` (summary.csv). Raises
    InputError for a quantity that is missing in either.
    """
    quantities = summary["quantity"].tolist()
    if quantity not in quantities or quantity not in draws:
        names = ", ".join(name for name in quantities if name in draws and not name.startswith(LONG))
        raise InputError(f"unknown quantity {quantity!r} of the draws; use one of {names}, or one of images or points")
    ax = axes_or_new(ax)
    _draw_histogram(ax, quantity, draws[quantity].to_numpy(float), summary)
    return ax


def _draw_histogram(axes: Axes, name: str, values: np.ndarray, summary: pd.DataFrame) -> None:
    of = summary.set_index("quantity")
    nominal, sigma = (float(of[column].loc[name]) for column in ("nominal", "predicted_sigma"))
    # Skip the histogram if draws differ only by rounding.
    if len(values) and np.ptp(values) > 1e-12 * np.abs(values).max(initial=1e-300):
        axes.hist(values, bins=min(60, max(5, int(np.sqrt(len(values))))), density=True, color="0.75")
    axes.axvline(nominal, color="tab:red", lw=1)
    if sigma > 0:
        at = np.linspace(-4, 4, 200)
        density = np.exp(-0.5 * at**2) / sigma / np.sqrt(2 * np.pi)
        axes.plot(nominal + sigma * at, density, color="tab:blue", lw=1)
    axes.set_title(label(name), fontsize=9)
    axes.set_yticks([])
    axes.tick_params(labelsize=7)
    axes.locator_params(axis="x", nbins=4)


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
    ax.set_xticks(range(len(names)), list(map(label, names)), rotation=45, ha="right", fontsize=8)
    ax.set_yticks(range(len(effects)), list(map(label, effects["error"])), fontsize=7)
    ax.figure.colorbar(image, ax=ax, label="effect of one sigma / predicted sigma")
    return ax


def effects_figure(effects: pd.DataFrame, summary: pd.DataFrame, quantities: list[str]) -> Figure:
    """Draw `plot_effects` in a figure of suitable size."""
    figure = new_figure(min(1.8 + 0.8 * len(quantities), _WIDEST), max(3.2, 1.8 + 0.26 * len(effects)))
    plot_effects(effects, summary, quantities, figure.subplots())
    return figure


def write_draws_page(
    summary: Mapping[str, Any],
    table: pd.DataFrame,
    sensors: Mapping[str, Sensor],
    directory: Path,
    record: CommandRecord,
) -> None:
    """Write report.html of the draws into `directory`: summary, its table, and the plots in the folder."""
    few = ~table["quantity"].str.startswith(LONG)
    ratio = table.loc[few, "ratio"].dropna()
    ratios = "No estimate is predicted to change."
    if len(ratio):
        ratios = f"Standard deviations are {ratio.min():.3g} to {ratio.max():.3g} times the first-order prediction."
    verdict = f"{summary['draws']} draws, {summary['converged']} converged. {ratios}"
    parts: list[Part] = [*assumed_pixels(sensors)]
    for name, (heading, words) in _PICTURES.items():
        if (file := directory / f"{name}.png").is_file():
            parts += [Heading(heading), Paragraph(words), Plot(file, f"{heading}: {words}")]
    # List the errors last: their distribution is known.
    ordered = table[few].sort_values("quantity", key=lambda name: name.str.startswith("bias."), kind="stable")
    parts += [Heading("Means and standard deviations"), ordered]
    if not few.all():
        parts.append(Paragraph("Images, points and trajectory knots are in summary.csv."))
    text = page(f"Monte Carlo: {summary.get('title') or 'block'}", [*parts, *provenance(record)], (verdict, ""))
    with whole_file(directory / "report.html") as work:
        work.write_text(text, encoding="utf-8")


# xarray data sets for arrays of more than two dimensions: correlations by image, draws by image and point. Values are
# in radians, metres and millimetres, as stated in the coordinate names.


def correlation_cube(correlations: Correlations) -> xr.Dataset:
    """Return the correlations of a camera as an xarray data set.

    Variables: `interior` (parameter, with_parameter), `exterior` (image, element, parameter), `within_image` (image,
    element, with_element).
    """
    # Import locally: xarray takes a third of a second.
    import xarray as xr

    c = correlations
    return xr.Dataset(
        {
            "interior": (("parameter", "with_parameter"), c.interior),
            "exterior": (("image", "element", "parameter"), c.exterior),
            "within_image": (("image", "element", "with_element"), c.within_image),
        },
        coords={
            "parameter": list(c.parameters),
            "with_parameter": list(c.parameters),
            "image": list(c.images),
            "element": list(c.eop_names),
            "with_element": list(c.eop_names),
        },
        attrs={"camera": c.camera},
    )


def covariance_array(known: Covariance) -> xr.DataArray:
    """Return the correlations of all exterior orientations and shared unknowns as an xarray array.

    Dimensions: (unknown, with_unknown). The coordinate `sigma` (unknown) is a posteriori, in the units of the labels. A
    fixed unknown has zero sigma and no correlation.
    """
    import xarray as xr

    names = list(known.labels)
    sigma = np.concatenate([np.asarray(known.exterior_sigma).ravel(), np.asarray(known.shared_sigma)])
    coords = {"unknown": names, "with_unknown": names, "sigma": ("unknown", sigma)}
    return xr.DataArray(correlation_matrix(known), coords, ("unknown", "with_unknown"), name="correlation")


def draws_cube(draws: Draws, adjusted: Adjustment) -> xr.Dataset:
    """Return the draws of a Monte Carlo simulation as an xarray data set.

    Variables: `shared` (draw, parameter), `error` (draw, of_error), `converged`, `iterations` and `fallback` (draw). If
    stored, also `exterior` (draw, image, element) and `points` (draw, point, axis).
    """
    import xarray as xr

    variables: dict[str, tuple[tuple[str, ...], np.ndarray]] = {
        "shared": (("draw", "parameter"), draws.shared),
        "converged": (("draw",), draws.converged),
        "iterations": (("draw",), draws.steps),
        "fallback": (("draw",), draws.fallback),
    }
    coords: dict[str, object] = {"draw": np.arange(len(draws.steps)), "parameter": list(draws.labels)}
    if draws.recorded:
        variables["error"] = ("draw", "of_error"), np.stack(list(draws.recorded.values()), axis=1)
        coords["of_error"] = list(draws.recorded)
    if draws.exterior is not None:
        variables["exterior"] = ("draw", "image", "element"), draws.exterior
        coords |= {"image": list(adjusted.block.images), "element": list(EXTERIOR)}
    if draws.points is not None:
        variables["points"] = ("draw", "point", "axis"), draws.points
        coords |= {"point": list(adjusted.block.points), "axis": list(AXES)}
    return xr.Dataset(variables, coords)
