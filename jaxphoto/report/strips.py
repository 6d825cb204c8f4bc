"""What a strip adjustment found, as tables: differences of strips, the scanner, and the errors of its trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from rich.console import Console

from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.lidar.raster import Raster
from jaxphoto.procedures.lidar import StripAdjustment, StripDifference, StripRound
from jaxphoto.procedures.lidar.strip_adjustment import PHOTOGRAPHS
from jaxphoto.report.plots import new_figure
from jaxphoto.report.results import write_results
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.statistics import correlation_matrix
from jaxphoto.writing import whole_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of correlations.
_DIGITS = 6


def differences_table(differences: Sequence[StripDifference]) -> pd.DataFrame:
    """One row for two strips: planes, mean and root mean square of their gaps (m) before and after."""
    return pd.DataFrame(differences, columns=list(StripDifference._fields))


def strip_rounds_table(rounds: Sequence[StripRound]) -> pd.DataFrame:
    """round, planes, points, left_out, rms_m, largest_change (in standard deviations)."""
    return pd.DataFrame(rounds, columns=["round", *StripRound._fields[1:]])


def all_correlations(result: StripAdjustment) -> pd.DataFrame:
    """Of all unknowns of scanner, trajectory and cameras: a row and a column each, named by `parameter`."""
    labels = list(result.adjusted.structure.labels)
    rho = correlation_matrix(result.covariance)[-len(labels) :, -len(labels) :]
    return pd.DataFrame(rho, columns=labels).set_index(pd.Index(labels, name="parameter"))


def calibration_table(result: StripAdjustment) -> pd.DataFrame:
    """parameter, value, sigma, and the parameter that it is least told from: `with`, rho. Angles in degrees.

    Of scanner, cameras and mounts: of all unknowns but the trajectory's.
    """
    known, s = result.covariance, result.adjusted.structure
    rho, sigma = correlation_matrix(known), np.asarray(known.shared_sigma)
    value = np.asarray(result.adjusted.values.shared)[s.free]
    first, rows = len(rho) - len(s.free), []
    for k, label in enumerate(s.labels):
        if label.startswith(TrajectoryKnot.kind):
            continue
        to = np.abs(rho[first + k, first:])
        to[k] = -1.0
        other = int(np.argmax(to))
        unit = 180 / np.pi if label.endswith("_rad") else 1.0
        rows.append(
            (
                label.replace("_rad", "_deg"),
                unit * value[k],
                unit * sigma[k],
                s.labels[other],
                rho[first + k, first + other],
            )
        )
    return pd.DataFrame(rows, columns=["parameter", "value", "sigma", "with", "rho"])


def trajectory_errors_table(result: StripAdjustment) -> pd.DataFrame:
    """strip, time_s, and the coefficients of its spline there with sigmas: X_m ... right_deg ...; 0 where held."""
    known, s, owners = (
        result.covariance,
        result.adjusted.structure,
        iter(result.adjusted.unknowns.more[TrajectoryKnot.kind]),
    )
    of_label = dict(zip(s.labels, np.asarray(known.shared_sigma), strict=True))
    errors, rows = result.errors, []
    zero = np.zeros(3)
    for name, spline in zip(result.cloud.strips, errors.splines, strict=True):
        for k, time in enumerate(spline.times):
            labels = TrajectoryKnot(zero, zero).labels(next(owners))  # type: ignore[arg-type]
            sigma = np.array([of_label.get(label, 0.0) for label in labels])
            value = np.concatenate([errors.position[spline.first + k], errors.attitude[spline.first + k]])
            value[3:], sigma[3:] = np.rad2deg(value[3:]), np.rad2deg(sigma[3:])
            rows.append((name, time, *value, *sigma))
    columns = ["X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg"]
    return pd.DataFrame(rows, columns=["strip", "time_s", *columns, *(f"sigma_{c}" for c in columns)])


@contextmanager
def write_strips(result: StripAdjustment, directory: Path) -> Iterator[Path]:
    """strips.csv, rounds.csv, scanner.csv, trajectory_errors.csv and correlation.csv, of photographs `adjustment`, too.

    Yields the folder while it is not yet in its place, for what else belongs there. Raises InputError where `directory`
    holds something that is not an earlier result.
    """
    with whole_folder(directory) as work:
        differences_table(result.differences).to_csv(work / "strips.csv", index=False)
        strip_rounds_table(result.rounds).to_csv(work / "rounds.csv", index=False)
        calibration_table(result).to_csv(work / "scanner.csv", index=False)
        trajectory_errors_table(result).to_csv(work / "trajectory_errors.csv", index=False)
        all_correlations(result).round(_DIGITS).to_csv(work / "correlation.csv")
        if result.before is not None:
            tables, times = Tables(result.adjusted), result.adjusted.seconds
            write_results(tables, verdict_of(tables), work / "adjustment", dict(times))
        yield work


def differences_figure(before: Raster, after: Raster) -> Figure:
    """Gaps of strips over the ground before and after, in the same colours, which reach 95 % of those before."""
    figure = new_figure(10.0, 4.6)
    both = figure.subplots(1, 2, sharex=True, sharey=True)
    limit = 100 * float(np.nanpercentile(np.abs(before.heights), 95)) or 1.0
    for axes, raster, name in zip(both, (before, after), ("before", "after"), strict=True):
        (west, south), (east, north) = raster.extent
        shown = axes.imshow(
            100 * raster.heights, extent=(west, east, south, north), cmap="RdBu_r", vmin=-limit, vmax=limit
        )
        rms = float(np.sqrt(np.nanmean(raster.heights**2)))
        axes.set_title(f"{name}: {100 * rms:.2g} cm RMS", loc="left")
        axes.set(xlabel="X (m)", aspect="equal")
        axes.ticklabel_format(useOffset=False, style="plain")
    both[0].set_ylabel("Y (m)")
    figure.colorbar(shown, ax=list(both), label="later strip above earlier (cm)", shrink=0.8)
    return figure


def print_strips(result: StripAdjustment, console: Console) -> None:
    """What the rounds came to, how far strips were apart, and the scanner, a line each."""
    last = result.rounds[-1]
    end = "nothing changes any more" if result.still else "it still changes: ask for more rounds"
    ties = f" and {last.points} tie points on them" if last.points else ""
    console.print(f"{last.number} rounds, {end}; {last.planes} planes{ties}, {last.left_out} left out", highlight=False)
    for d in result.differences:
        before = f"{d.rms_before_m:.3f} m" if np.isfinite(d.rms_before_m) else "unknown"
        strips = f"{d.one} and strip {d.other}" if d.one == PHOTOGRAPHS else f"strips {d.one} and {d.other}"
        console.print(
            f"  {strips}: from {before} to {d.rms_m:.3f} m apart (RMS of {d.planes} planes, whose "
            f"noise is {d.noise_m:.3f} m)",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    for row in calibration_table(result).itertuples():
        console.print(f"  {row.parameter}: {row.value:.6g} (sigma {row.sigma:.2g})", highlight=False, markup=False)
