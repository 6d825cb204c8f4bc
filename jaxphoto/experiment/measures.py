"""What experiments print: functions of the adjusted variants of one layout that give the cells of one table.

Rows are named by variant, columns as the papers' tables name them. A measure over some variants only takes their names
and may call them otherwise: `{"4": "system 4"}` prints the variant `system 4` in row `4`.
"""

from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np
import pandas as pd

from jaxphoto.experiment.declaration import Cells, Measure, Results
from jaxphoto.io.recipe import truth_tables
from jaxphoto.observations import AXES
from jaxphoto.report import Tables
from jaxphoto.statistics import angle_differences, point_differences, residual_spread

_UNITS = {"k1": "_mm-2", "k2": "_mm-4", "k3": "_mm-6", "p1": "_mm-1", "p2": "_mm-1"}
_ANGLES = ("omega", "phi", "kappa")
Rows = Mapping[str, str]
"""Row of a table -> variant."""


def named(variants: Iterable[str]) -> dict[str, str]:
    """Rows named as their variants."""
    return {name: name for name in variants}


def iops(rows: Rows) -> Measure:
    """Estimated interior orientation and its a posteriori sigmas: c_mm, sigma_c_mm, ..., k1_mm-2 (000 T2, 004 T3)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            for s in results[variant].significance:
                column = s.parameter + _UNITS.get(s.parameter, "")
                cells[row, column], cells[row, f"sigma_{column}"] = s.value, s.sigma
        return cells

    return measure


def residuals(rows: Rows, *, image: str = "mm", ground: str = "m") -> Measure:
    """RMSE of residuals of image points, control and stations, and the a posteriori variance factor (000 T3, 004 T4).

    The papers print the variance factor under the name sigma0. `image` is mm or px, `ground` m or mm.
    """
    named_axes = {"image_points": "rmse_{}_" + image, "control_points": "rmse_{}_" + ground}
    named_axes["stations"] = "rmse_{}s_" + ground

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            adjusted = results[variant].adjusted
            pixel = next(iter(adjusted.block.sensors.values())).pixel_mm
            factors = {"mm": 1 / pixel if image == "px" else 1.0, "m": 1000.0 if ground == "mm" else 1.0}
            for spread in residual_spread(adjusted):
                if spread.group in named_axes:
                    cells[row, named_axes[spread.group].format(spread.axis)] = spread.rmse * factors[spread.unit]
            cells[row, "sigma0"] = float(adjusted.sigma0) ** 2
        return cells

    return measure


def mean_correlations(rows: Rows, columns: Mapping[str, str]) -> Measure:
    """Mean absolute correlation of omega, phi, kappa with the IOP over the images, row `variant/angle` (000 T4)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            for camera in results[variant].correlations.values():
                for i, name in enumerate(camera.eop_names):
                    for j, parameter in enumerate(camera.parameters):
                        if name in _ANGLES and parameter in columns:
                            cells[f"{row}/{name}", columns[parameter]] = float(camera.mean_abs[i, j])
        return cells

    return measure


def check_points(rows: Rows) -> Measure:
    """Mean and RMSE of surveyed minus computed at check points (000 T5, 004 T5)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            table = results[variant].check_points
            cells |= _spread(row, [f"d{a}_m" for a in AXES], table[[f"d{a}_m" for a in AXES]].to_numpy())
            cells[row, "n_check_points"] = len(table)
        return cells

    return measure


def tie_point_differences(pairs: Iterable[tuple[str, str]]) -> Measure:
    """First minus second: coordinates of the tie points that both hold, row `first-second` (000 T6)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for first, second in pairs:
            one, two = results[first].adjusted, results[second].adjusted
            points, differences = point_differences(one, two)
            ties = np.isin(points, _tie_points(results[first]))
            cells |= _spread(f"{first}-{second}", [f"d{a}_m" for a in AXES], differences[ties])
        return cells

    return measure


def orientation_differences(pairs: Iterable[tuple[str, str]]) -> Measure:
    """First minus second: omega, phi, kappa in arc seconds, row `first-second` (000 T7)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for first, second in pairs:
            _, differences = angle_differences(results[first].adjusted, results[second].adjusted)
            columns = [f"{a}_arcsec" for a in _ANGLES]
            cells |= _spread(f"{first}-{second}", columns, np.degrees(differences) * 3600)
        return cells

    return measure


def principal_point(rows: Rows) -> Measure:
    """Principal point (mm) and sigma naught in um on the image (003 T1)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            table = results[variant].interior.set_index("parameter")["value"]
            cells |= {(row, "xH"): float(table["xp_mm"]), (row, "yH"): float(table["yp_mm"])}
            cells[row, "sigma0"] = _sigma0_um(results[variant])
        return cells

    return measure


def misalignment(rows: Rows) -> Measure:
    """Boresight (deg), with its sigma, and sigma naught in um on the image (003 T2, T3)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            for name, (value, sigma) in boresight(results[variant]).items():
                cells[row, name], cells[row, f"sigma_{name}"] = value, sigma
            cells[row, "sigma0"] = _sigma0_um(results[variant])
        return cells

    return measure


def misalignment_agreement(pairs: Mapping[str, tuple[str, str]]) -> Measure:
    """|first - second| of the boresight over the sigma of the difference, as of independent estimates; row -> pair."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, (first, second) in pairs.items():
            one, two = boresight(results[first]), boresight(results[second])
            for name, (value, sigma) in one.items():
                cells[row, f"{name}_over_sigma"] = abs(value - two[name][0]) / np.hypot(sigma, two[name][1])
        return cells

    return measure


def boresight_correlation(rows: Rows) -> Measure:
    """Correlation of the boresight's d omega with y_p (what cross strips are flown for)."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            covariance = results[variant].covariance
            names = [label.split("].")[1] for label in covariance.labels]
            a, b = names.index("boresight_x_rad"), names.index("yp_mm")
            matrix = np.asarray(covariance.matrix)
            cells[row, "rho(domega,yp)"] = matrix[a, b] / np.sqrt(matrix[a, a] * matrix[b, b])
        return cells

    return measure


def recovered(rows: Rows, truths: Mapping[str, str] = MappingProxyType({})) -> Measure:
    """Estimated mounts and strips beside their truth, row `row/parameter`; `ratio` is |estimate - truth| / sigma.

    `truths` names the true parameter of the truth's tables where the estimated one has another name there.
    """

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for row, variant in rows.items():
            true = truth_tables(results.simulations[variant])["georeferencing"].set_index("parameter")["value"]
            table = results[variant].georeferencing
            for parameter, value, sigma in zip(table["parameter"], table["value"], table["sigma"], strict=True):
                name, truth = f"{row}/{parameter}", float(true[truths.get(parameter, parameter)])
                cells |= {(name, "truth"): truth, (name, "estimate"): value, (name, "sigma"): sigma}
                cells[name, "ratio"] = abs(value - truth) / sigma
        return cells

    return measure


def effects(rows: Rows, reference: str) -> Measure:
    """Estimated interior orientation minus that of the variant `reference`, RMSE at check points, sigma naught."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        estimates, discrepancies = iops(named([reference, *rows.values()]))(results), check_points(rows)(results)
        for row, variant in rows.items():
            for s in results[variant].significance:
                column = s.parameter + _UNITS.get(s.parameter, "")
                cells[row, f"change_{column}"] = estimates[variant, column] - estimates[reference, column]
            cells |= {(row, c): discrepancies[row, c] for c in (f"rmse_d{axis}_m" for axis in AXES)}
            cells[row, "sigma0"] = float(results[variant].adjusted.sigma0)
        return cells

    return measure


def boresight(tables: Tables) -> dict[str, tuple[float, float]]:
    """Value and sigma (deg) of domega, dphi and dkappa."""
    table: pd.DataFrame = tables.georeferencing
    rows = table[table["parameter"].str.contains("boresight")]
    return dict(zip(("domega", "dphi", "dkappa"), zip(rows["value"], rows["sigma"], strict=True), strict=True))


def _sigma0_um(tables: Tables) -> float:
    return 1000 * float(tables.adjusted.sigma0) * float(np.asarray(tables.adjusted.block.image_points.sigma).mean())


def _tie_points(tables: Tables) -> list[str]:
    block = tables.adjusted.block
    surveyed = {*block.control.who.tolist(), *block.fixed.who.tolist(), *block.check.who.tolist()}
    return [name for k, name in enumerate(block.points) if k not in surveyed]


def _spread(row: str, columns: list[str], values: np.ndarray) -> Cells:
    mean, rmse = np.nanmean(values, axis=0), np.sqrt(np.nanmean(values**2, axis=0))
    cells = {(row, f"mean_{c}"): float(m) for c, m in zip(columns, mean, strict=True)}
    return cells | {(row, f"rmse_{c}"): float(r) for c, r in zip(columns, rmse, strict=True)}
