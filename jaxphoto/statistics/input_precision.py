"""Precision of the observations as given: values rounded to steps above sigma, and implausibly small sigmas.

A column is rounded if all its values are multiples of a step above its standard deviation (`jaxphoto.rounding`) and its
residuals do not prove the opposite: coordinates of a printed board are multiples of its pitch without being rounded.
Rounding errors of standard deviation tau = s / sqrt(12) contribute at least sum(r_i^2 tau^2 / sigma_i^2) to v'Pv, with
redundancy numbers r_i; a smaller v'Pv excludes them.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.observations import AbstractObservations, CameraPositions, Correlated, ImagePoints
from jaxphoto.observations.base import AXES, AbstractCoordinates
from jaxphoto.observations.columns import FILE_UNITS, columns_of
from jaxphoto.rounding import M_PER_DEGREE, rounding_error, rounding_step
from jaxphoto.statistics.quantiles import chi_square_tails
from jaxphoto.statistics.reliability import LEAST_CHECKED, Redundancy

# Fraction of the contribution of rounding errors to v'Pv below which values are not rounded.
_EXACT = 0.25
# p-value of v'Pv or of the largest w below which the residuals of a column exceed its standard deviations.
_LEVEL = 1e-3
# Relative standard deviation of the most precise distance meters (Kern Mekometer ME5000: 0.2 mm + 0.2 mm/km; Rüeger,
# Electronic Distance Measurement, 1996), applied to the extent of the block, and half of their constant part.
_RELATIVE, _LARGE_M = 2e-7, 1e-4
# Cameras in flight: kinematic GNSS reaches 5 mm; a fifth of it, for blocks beyond the range of laser trackers.
_KINEMATIC_M, _TRACKER_RANGE_M = 1e-3, 160.0
# Most precise targets: 1/100 to 1/200 px (Luhmann, Close Range Photogrammetry, 2019, sect. 5.4.2); a fifth of it.
_PIXELS = 1e-3
# Most precise attitudes: 1 second of arc of star trackers (Liebe, IEEE Trans. Aerosp. Electron. Syst. 38, 2002);
# a tenth of it, in degrees.
_DEGREES = 0.1 / 3600


class _Column(NamedTuple):
    """One column of a table of observations, in the units of the file."""

    table: str
    name: str
    unit: str
    values: Float[np.ndarray, "n"]
    sigma: Float[np.ndarray, "n"]
    rows: Bool[np.ndarray, "..."]
    """Mask of its observations in the shape of the residuals of its group."""


class RoundedColumn(NamedTuple):
    """Column whose values are multiples of a step above its standard deviation."""

    table: str
    column: str
    unit: str
    n: int
    step: float
    sigma: float
    exceeded: bool
    """True if the residuals of the column exceed its standard deviations."""

    @property
    def error(self) -> float:
        """Standard deviation of the error of rounding."""
        return rounding_error(self.step)


class SmallSigma(NamedTuple):
    """Group with standard deviations that no instrument reaches."""

    table: str
    axes: tuple[str, ...]
    unit: str
    n: int
    """Number of such standard deviations, of `total`."""
    total: int
    sigma: float
    """Smallest standard deviation."""
    limit: float


def rounded_columns(adjusted: Adjustment, redundancy: Redundancy) -> list[RoundedColumn]:
    """Return the columns of observations that are rounded to a step above their standard deviation."""
    found = []
    for group, rows in _groups(adjusted):
        v = rows.physical(np.asarray(adjusted.residuals[group])) / np.asarray(rows.sigmas).T
        r = np.asarray(redundancy[group])
        # The same values may be multiples of a step in several forms: of the coarsest in the file.
        steps: dict[bytes, tuple[float, float, float, _Column]] = {}
        for column in _columns(adjusted.block, group, rows):
            sigma = float(np.median(column.sigma))
            if step := rounding_step(column.values, sigma, column.unit):
                key = column.rows.tobytes()
                if key not in steps or step / sigma > steps[key][0]:
                    steps[key] = (step / sigma, step, sigma, column)
        for _, step, sigma, column in steps.values():
            of, numbers = v[column.rows], r[column.rows]
            vpv, total = float((of**2).sum()), float(numbers.sum())
            if vpv < _EXACT * float((numbers**2 * rounding_error(step) ** 2 / column.sigma**2).sum()):
                continue
            checked = numbers > LEAST_CHECKED
            w = np.abs(of[checked]) / np.sqrt(numbers[checked])
            exceeded = len(w) > 0 and len(w) * chi_square_tails(float(w.max(initial=0.0)) ** 2, 1)[1] < _LEVEL
            exceeded |= total >= 1 and vpv > total and chi_square_tails(vpv, total)[1] < _LEVEL
            found.append(RoundedColumn(group, column.name, column.unit, len(of), step, sigma, exceeded))
    return found


def small_sigmas(adjusted: Adjustment) -> list[SmallSigma]:
    """Return the groups of observations with standard deviations that no instrument reaches."""
    block, u = adjusted.block, adjusted.unknowns
    places = np.concatenate([np.asarray(u.points), np.asarray(u.exterior.position)])
    extent = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) else 0.0
    metres, found = min(_RELATIVE * extent, _LARGE_M), []
    for group, rows in _groups(adjusted):
        sigmas = np.asarray(rows.sigmas).T
        if isinstance(rows, ImagePoints):
            unit, limit = "px", _PIXELS
            sigmas = sigmas / np.array([block.sensors[name].pixel_mm for name in block.image_camera])[rows.image]
        elif rows.unit == "rad":
            unit, limit, sigmas = "deg", _DEGREES, np.rad2deg(sigmas)
        else:
            flown = isinstance(rows, CameraPositions) and extent > _TRACKER_RANGE_M
            unit, limit = rows.unit, _KINEMATIC_M if flown else metres
        small = sigmas < limit
        if unit in ("px", "deg", "m") and small.any():
            axes = tuple(dict.fromkeys(filter(None, rows.axis_of_numbers[np.atleast_2d(small)])))
            found.append(SmallSigma(group, axes, unit, int(small.sum()), small.size, float(sigmas.min()), limit))
    return found


def _groups(adjusted: Adjustment) -> Iterator[tuple[str, AbstractObservations]]:
    """Yield the observed groups of the block with residuals, by name."""
    named = adjusted.residuals.named
    yield from ((name, rows) for name, rows in adjusted.block.named_observations.items() if len(rows) and name in named)


def _columns(block: Block, table: str, rows: AbstractObservations) -> Iterator[_Column]:
    """Yield the columns of a group; coordinates and image points also in other forms in which files may give them."""
    values, sigma = np.asarray(rows.observation), np.asarray(rows.sigmas)
    shape = values.shape
    if isinstance(rows, Correlated):
        rows = rows.flat
        values, sigma = (v.reshape(np.shape(rows.observation)) for v in (values, sigma))

    def column(name: str, unit: str, values: np.ndarray, sigma: np.ndarray, at: np.ndarray) -> _Column:
        mask = np.zeros(sigma.size, bool)
        mask[at] = True
        return _Column(table, name, unit, values, sigma.ravel()[at], mask.reshape(shape).T)

    if isinstance(rows, AbstractCoordinates):
        for name, unit, at, there in _coordinates(block, rows, values):
            scale = 1 / M_PER_DEGREE if unit == "deg" else 1.0
            made = column(name, unit, there, sigma, at)
            yield made._replace(sigma=scale * made.sigma)
        return
    unit = FILE_UNITS.get(rows.unit, rows.unit)
    flat = np.arange(values.size).reshape(values.shape)
    if isinstance(rows, ImagePoints):
        sensors = [block.sensors[camera] for camera in block.image_camera]
        image = np.asarray(rows.image)
        pixel = np.array([sensor.pixel_mm for sensor in sensors])[image]
        half = np.array([(sensor.width_px, sensor.height_px) for sensor in sensors])[image] / 2
        at_px = values / np.stack([pixel, -pixel], axis=1) + half
        for k, name in enumerate(("column_px", "row_px")):
            yield column(name, "px", at_px[:, k], sigma, flat[:, k])._replace(sigma=sigma[:, k] / pixel)
    for c in columns_of(type(rows)):
        if c.field == rows.observed:
            made = column(c.name, unit, values[c.of_rows] / c.scale, sigma, flat[c.of_rows])
            yield made._replace(sigma=made.sigma / c.scale)


def _coordinates(
    block: Block, rows: AbstractCoordinates, values: np.ndarray
) -> Iterator[tuple[str, str, np.ndarray, np.ndarray]]:
    """Yield column, unit, rows and values of coordinates in the system of the files."""
    who, axis = np.asarray(rows.who), np.asarray(rows.axis)
    if block.frame.kind != "epsg":
        for k, name in enumerate(AXES):
            if len(at := np.flatnonzero(axis == k)):
                yield f"{name}_m", "m", at, values[at]
        return
    # The system of the files needs all three coordinates.
    row = np.full((int(who.max(initial=-1)) + 1, 3), -1)
    row[who, axis] = np.arange(len(who))
    row = row[(row >= 0).all(axis=1)]
    if not len(row):
        return
    on_map = block.frame.map.map(values[row])
    views = [] if block.frame.map.geographic else [(tuple(f"{name}_m" for name in AXES), on_map)]
    for names, there in [*views, (_PLACE, block.frame.map.place(on_map))]:
        for k, name in enumerate(names):
            yield name, name.rsplit("_", 1)[1], row[:, k], there[:, k]


_PLACE = ("longitude_deg", "latitude_deg", "height_m")
