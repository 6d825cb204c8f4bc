"""Measures: functions that compute the cells of one table from the adjusted variants of one layout.

Row names are variant names, column names are taken from the tables of the papers. A measure takes the names of its
variants. A mapping assigns other row names: `{"4": "system 4"}` shows the variant `system 4` in row `4`.
"""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType

import numpy as np
import pandas as pd

from jaxphoto.experiment.experiment import Cells, Measure, Results
from jaxphoto.io.recipe import truth_tables
from jaxphoto.observations import AXES
from jaxphoto.report import Tables
from jaxphoto.statistics import angle_differences, point_differences, residual_spread

_UNITS = {"k1": "_mm-2", "k2": "_mm-4", "k3": "_mm-6", "p1": "_mm-1", "p2": "_mm-1"}
_ANGLES = ("omega", "phi", "kappa")
_OFF = [f"d{axis}_m" for axis in AXES]
Rows = Mapping[str, str]
"""Mapping from row name to variant name."""


def named(variants: Iterable[str]) -> dict[str, str]:
    """Map each name to the variant of the same name."""
    return {name: name for name in variants}


def _by_row(rows: Rows, columns: Callable[[Tables], Mapping[str, float]]) -> Measure:
    """Return a measure with one row per variant and the given columns."""
    return lambda results: {
        (row, column): value for row, variant in rows.items() for column, value in columns(results[variant]).items()
    }


def _by_pair(pairs: Iterable[tuple[str, str]], columns: Callable[[Tables, Tables], Mapping[str, float]]) -> Measure:
    """Return a measure with one row `first-second` per pair of variants and the given columns."""
    pairs = list(pairs)
    return lambda results: {
        (f"{first}-{second}", column): value
        for first, second in pairs
        for column, value in columns(results[first], results[second]).items()
    }


def iops(rows: Rows) -> Measure:
    """Return the estimated interior orientation and its a posteriori sigmas.

    Columns: c_mm, sigma_c_mm, ..., k1_mm-2 (000 T2, 004 T3).
    """
    return _by_row(rows, lambda tables: _interior(tables) | {f"sigma_{c}": s for c, s in _interior(tables, 1).items()})


def _interior(tables: Tables, place: int = 0) -> dict[str, float]:
    """Return the estimated parameters; with `place` 1, their sigmas."""
    return {s.parameter + _UNITS.get(s.parameter, ""): (s.value, s.sigma)[place] for s in tables.significance}


def residuals(rows: Rows, *, image: str = "mm", ground: str = "m") -> Measure:
    """Compute the RMSE of the residuals of image points, control and stations, and the a posteriori variance factor.

    Tables 000 T3 and 004 T4. The papers call the variance factor sigma0. `image` is mm or px, `ground` m or mm.
    """
    names = {
        "image_points": "rmse_{}_" + image,
        "control_points": "rmse_{}_" + ground,
        "stations": "rmse_{}s_" + ground,
    }

    def columns(tables: Tables) -> dict[str, float]:
        pixel = next(iter(tables.adjusted.block.sensors.values())).pixel_mm
        factors = {"mm": 1 / pixel if image == "px" else 1.0, "m": 1000.0 if ground == "mm" else 1.0}
        spreads = (s for s in residual_spread(tables.adjusted) if s.group in names)
        rmse = {names[s.group].format(s.axis): s.rmse * factors[s.unit] for s in spreads}
        return rmse | {"sigma0": float(tables.adjusted.sigma0) ** 2}

    return _by_row(rows, columns)


def mean_correlations(rows: Rows, columns: Mapping[str, str]) -> Measure:
    """Compute the mean |rho| of omega, phi, kappa with the IOP over the images, row `variant/angle` (000 T4)."""
    return lambda results: {
        (f"{row}/{name}", columns[parameter]): float(camera.mean_abs[i, j])
        for row, variant in rows.items()
        for camera in results[variant].correlations.values()
        for i, name in enumerate(camera.eop_names)
        for j, parameter in enumerate(camera.parameters)
        if name in _ANGLES and parameter in columns
    }


def check_points(rows: Rows) -> Measure:
    """Compute mean and RMSE of surveyed minus computed at check points (000 T5, 004 T5), and the RMSE expected from
    their standard deviations.
    """

    def columns(tables: Tables) -> dict[str, float]:
        check = tables.check_points
        expected = {f"expected_rmse_{d}": float(np.sqrt((check[f"sigma_{d}"] ** 2).mean())) for d in _OFF}
        return _discrepancies(tables) | expected | {"n_check_points": len(check)}

    return _by_row(rows, columns)


def _discrepancies(tables: Tables) -> dict[str, float]:
    return _spread(_OFF, tables.check_points[_OFF].to_numpy())


def tie_point_differences(pairs: Iterable[tuple[str, str]]) -> Measure:
    """Compute the coordinate differences first - second of common tie points, row `first-second` (000 T6)."""

    def columns(first: Tables, second: Tables) -> dict[str, float]:
        points, differences = point_differences(first.adjusted, second.adjusted)
        return _spread(_OFF, differences[np.isin(points, _tie_points(first))])

    return _by_pair(pairs, columns)


def orientation_differences(pairs: Iterable[tuple[str, str]]) -> Measure:
    """Compute the differences first - second of omega, phi, kappa in arc seconds, row `first-second` (000 T7)."""

    def columns(first: Tables, second: Tables) -> dict[str, float]:
        _, differences = angle_differences(first.adjusted, second.adjusted)
        return _spread([f"{a}_arcsec" for a in _ANGLES], np.degrees(differences) * 3600)

    return _by_pair(pairs, columns)


def principal_point(rows: Rows) -> Measure:
    """Return the principal point (mm) and sigma naught in um on the image (003 T1)."""

    def columns(tables: Tables) -> dict[str, float]:
        value = tables.interior.set_index("parameter")["value"]
        return {"xH": float(value["xp_mm"]), "yH": float(value["yp_mm"]), "sigma0": _sigma0_um(tables)}

    return _by_row(rows, columns)


def misalignment(rows: Rows) -> Measure:
    """Return the boresight (deg) with its sigma, and sigma naught in um on the image (003 T2, T3)."""

    def columns(tables: Tables) -> dict[str, float]:
        values = boresight(tables)
        cells = {name: value for name, (value, _) in values.items()}
        return cells | {f"sigma_{name}": sigma for name, (_, sigma) in values.items()} | {"sigma0": _sigma0_um(tables)}

    return _by_row(rows, columns)


def misalignment_agreement(pairs: Mapping[str, tuple[str, str]]) -> Measure:
    """Compute |first - second| of the boresight over the sigma of the difference, for independent estimates.

    Maps each row to its pair of variants.
    """
    return lambda results: {
        (row, f"{name}_over_sigma"): abs(one - two) / np.hypot(sigma, other)
        for row, pair in pairs.items()
        for (name, (one, sigma)), (two, other) in zip(
            boresight(results[pair[0]]).items(), boresight(results[pair[1]]).values(), strict=True
        )
    }


def boresight_correlation(rows: Rows) -> Measure:
    """Return the correlation of the boresight's d omega with y_p, which cross strips reduce."""

    def columns(tables: Tables) -> dict[str, float]:
        names = [label.split("].")[1] for label in tables.covariance.labels]
        k = [names.index("boresight_x_rad"), names.index("yp_mm")]
        matrix = np.asarray(tables.covariance.matrix)[np.ix_(k, k)]
        return {"rho(domega,yp)": matrix[0, 1] / np.sqrt(matrix[0, 0] * matrix[1, 1])}

    return _by_row(rows, columns)


def recovered(rows: Rows, truths: Mapping[str, str] = MappingProxyType({})) -> Measure:
    """Compare estimated mounts and strips with their true values, row `row/parameter`; `ratio` is |error| / sigma.

    `truths` maps estimated parameters to true parameters where their names differ.
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
    """Compute the interior orientation relative to the variant `reference`, RMSE at check points and sigma naught."""

    def measure(results: Results) -> Cells:
        expected, cells = _interior(results[reference]), Cells()
        for row, tables in ((row, results[variant]) for row, variant in rows.items()):
            cells |= {(row, f"change_{c}"): value - expected[c] for c, value in _interior(tables).items()}
            cells |= {(row, c): value for c, value in _discrepancies(tables).items() if c.startswith("rmse_")}
            cells[row, "sigma0"] = float(tables.adjusted.sigma0)
        return cells

    return measure


def boresight(tables: Tables) -> dict[str, tuple[float, float]]:
    """Return value and sigma (deg) of domega, dphi and dkappa."""
    table: pd.DataFrame = tables.georeferencing
    rows = table[table["parameter"].str.contains("boresight")]
    return dict(zip(("domega", "dphi", "dkappa"), zip(rows["value"], rows["sigma"], strict=True), strict=True))


def _sigma0_um(tables: Tables) -> float:
    return 1000 * float(tables.adjusted.sigma0) * float(np.asarray(tables.adjusted.block.image_points.sigma).mean())


def _tie_points(tables: Tables) -> list[str]:
    block = tables.adjusted.block
    surveyed = {*block.control.who.tolist(), *block.fixed.who.tolist(), *block.check.who.tolist()}
    return [name for k, name in enumerate(block.points) if k not in surveyed]


def _spread(columns: list[str], values: np.ndarray) -> dict[str, float]:
    mean, rmse = np.nanmean(values, axis=0), np.sqrt(np.nanmean(values**2, axis=0))
    cells = {f"mean_{c}": float(m) for c, m in zip(columns, mean, strict=True)}
    return cells | {f"rmse_{c}": float(r) for c, r in zip(columns, rmse, strict=True)}
