"""Many simulated flights of one recipe, adjusted: do the standard deviations cover the errors?"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.io.draws_folder import DRAWS, DrawsFolder
from jaxphoto.io.recipe.truth import truth_tables
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.weights import estimate_weights
from jaxphoto.report import Tables
from jaxphoto.report.formatting import path_words
from jaxphoto.report.page import CommandRecord, Heading, Paragraph, Part, Plot, page, provenance, versions
from jaxphoto.report.plots import axes_or_new, label
from jaxphoto.simulation import Recipe, simulate
from jaxphoto.workers import in_parts
from jaxphoto.writing import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Number of flights per part: an interrupted study loses these.
_PART = 4
# Tables of true values of cameras, mounts, scanner and strips.
_SHARED = ("interior", "georeferencing")
# Maximum number of histograms.
_SHOWN = 12


class SimulatedFlights(NamedTuple):
    """Simulation and adjustment of the flights of a recipe; a study of `in_parts`."""

    recipe: Recipe

    def compute(self, part: range) -> pd.DataFrame:
        """Return the estimates of the flights with the seeds `part`, a row per flight and parameter.

        Columns: flight (its seed), problem (why there are no estimates), sigma0, parameter, estimate, truth, error,
        sigma, ratio, unit. Parameters are those of cameras, mounts, scanner and strips.
        """
        return pd.concat([self._flight(seed) for seed in part], ignore_index=True)

    def _flight(self, seed: int) -> pd.DataFrame:
        numbers = {name: [np.nan] for name in ("estimate", "truth", "error", "sigma", "ratio")}
        problem, sigma0, rows = "", np.nan, pd.DataFrame({"parameter": [""], **numbers, "unit": [""]})
        try:
            simulation = simulate(self.recipe, seed)
            adjusted = adjust(simulation.block)
            if bool(adjusted.converged):
                weights = estimate_weights(adjusted)
                adjusted = weights.adjusted if weights else adjusted
                known = {name: t for name, t in truth_tables(simulation).items() if name in _SHARED}
                sigma0, rows = float(adjusted.sigma0), Tables(adjusted, truth=known).recovery
            else:
                problem = adjusted.outcome.value
        except (JaxphotoError, ValueError) as error:
            problem = str(error)
        names = rows.columns
        return rows.assign(flight=seed, problem=problem, sigma0=sigma0)[["flight", "problem", "sigma0", *names]]


def simulate_flights(
    recipe: Recipe,
    flights: int,
    seed: int,
    directory: Path,
    progress: Callable[[int], object] = lambda done: None,
    client: Any = None,
) -> tuple[dict[str, Any], pd.DataFrame]:
    """Simulate and adjust `flights` flights with the seeds `seed`, `seed` + 1, ...; return summary and table.

    Writes draws.parquet (`SimulatedFlights.compute`), summary.csv and summary.json into `directory`. An interrupted
    study continues. Standard deviations are those that `jaxphoto adjust` prints, with estimated weights. `client`: a
    `dask.distributed.Client`, whose workers compute the flights (docs/cluster.md).

    Columns of the table: parameter, flights, mean_error, rms_error, rms_sigma, rms_ratio (error / sigma),
    inside_percent (errors within the interval of 95 %), sigma_inside_percent, unit.

    Raises InputError if no flight can be adjusted, and for a folder of another study.
    """
    settings = {"recipe": hashlib.sha256(repr(recipe).encode()).hexdigest(), "seed": seed, "versions": versions()}
    folder = DrawsFolder(directory, settings, flights, _PART)
    study = SimulatedFlights(recipe)

    def parts(missing: list[int]) -> Generator[tuple[int, pd.DataFrame], None, None]:
        first = {k: seed + k * _PART for k in missing}
        yield from in_parts(study, ((k, range(first[k], first[k] + folder.size(k))) for k in missing), client)

    folder.fill(parts, progress)
    found = pd.read_parquet(directory / DRAWS)
    table = coverage_table(found)
    problems = found.loc[found["problem"] != "", "problem"]
    if not len(table):
        raise InputError(f"no flight could be adjusted; the first: {problems.iloc[0]}")
    summary = {
        "title": recipe.title, "flights": flights, "adjusted": flights - len(problems),
        "first_problem": problems.iloc[0] if len(problems) else "", "versions": versions(),
    }  # fmt: skip
    with whole_file(directory / "summary.csv") as work:
        table.to_csv(work, index=False)
    with whole_file(directory / "summary.json") as work:
        work.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary, table


def coverage_table(found: pd.DataFrame) -> pd.DataFrame:
    """Summarise errors and standard deviations by parameter (columns: `simulate_flights`)."""
    groups = found[found["problem"] == ""].groupby("parameter", sort=False)
    rms = lambda v: np.sqrt(np.mean(v**2))  # noqa: E731
    table = groups.agg(
        flights=("error", "size"), mean_error=("error", "mean"), rms_error=("error", rms), rms_sigma=("sigma", rms),
        rms_ratio=("ratio", rms), inside=("ratio", lambda v: np.mean(np.abs(v) < stats.norm.isf(0.025))),
        unit=("unit", "first"),
    ).reset_index()  # fmt: skip
    inside, n = table.pop("inside"), table["flights"]
    # With Wilson's centre, the standard deviation of 100 % is not zero.
    centre = (inside * n + 2) / (n + 4)
    table.insert(6, "inside_percent", 100 * inside)
    table.insert(7, "sigma_inside_percent", 100 * np.sqrt(centre * (1 - centre) / n))
    return table


def plot_ratio(found: pd.DataFrame, parameter: str, ax: Axes | None = None) -> Axes:
    """Draw the histogram of error / sigma of a parameter, with the standard normal density."""
    ax, at = axes_or_new(ax), np.linspace(-4, 4, 200)
    values = found.loc[found["parameter"] == parameter, "ratio"].to_numpy(float)
    ax.hist(values, bins=min(40, max(5, int(np.sqrt(len(values))))), density=True, color="0.75")
    ax.plot(at, stats.norm.pdf(at), color="tab:blue", lw=1)
    ax.set_title(label(path_words(parameter)), fontsize=9)
    ax.set_yticks([])
    ax.tick_params(labelsize=7)
    return ax


def write_flights_page(summary: dict[str, Any], table: pd.DataFrame, directory: Path, record: CommandRecord) -> None:
    """Write report.html: table, and histograms of error / sigma."""
    found = pd.read_parquet(directory / DRAWS)
    shown = table["parameter"].tolist()[:_SHOWN]
    plots = [Plot(partial(plot_ratio, found, name), f"error / sigma of {name}", 2.6) for name in shown]
    words = "Grey: errors of the estimates over their standard deviations; blue: standard normal distribution."
    parts: list[Part] = [
        table.assign(parameter=[path_words(name) for name in table["parameter"]]),
        Heading("Errors over standard deviations"), Paragraph(words), plots,
    ]  # fmt: skip
    text = page(f"Flights: {summary['title']}", [*parts, *provenance(record)], (flights_verdict(summary, table), ""))
    with whole_file(directory / "report.html") as work:
        work.write_text(text, encoding="utf-8")


def flights_verdict(summary: dict[str, Any], table: pd.DataFrame) -> str:
    """Return the number of flights, and the range of covered errors, in words."""
    least, most = table["inside_percent"].min(), table["inside_percent"].max()
    failed = f" (the first problem: {summary['first_problem']})" if summary["first_problem"] else ""
    return (
        f"{summary['flights']} flights, {summary['adjusted']} adjusted{failed}. The intervals of 95 % cover "
        f"{least:.0f} to {most:.0f} % of the errors, by parameter."
    )
