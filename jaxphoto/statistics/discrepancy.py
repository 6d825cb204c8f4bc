"""Residuals by group and axis, discrepancies at check points, differences between adjustments, positional accuracy.

Source: paper 000, Tables 3 (residual RMSE), 5 (check points), 6 and 7 (points and angles of two experiments).

Positional accuracy by check points follows ASPRS Edition 2 and includes the error of the survey:

    RMSE_H = sqrt(RMSE_x^2 + RMSE_y^2 + s_H^2),  RMSE_V = sqrt(RMSE_z^2 + s_V^2),  RMSE_3D = sqrt(RMSE_H^2 + RMSE_V^2)

RMSE_x, RMSE_y, RMSE_z are root mean squares of the discrepancies at check points, s_H and s_V root mean squares of the
survey's standard deviations. An accuracy class is an RMSE limit in centimetres. A claim requires at least 30 check
points, and a mean error above 25 % of the RMSE requires an investigation. With few check points such a mean occurs by
chance (with three points in 75 % of cases), so it must also exceed the limit of Student's t.

Source: ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2, Version 1.0 (August 2023).
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.adjustment.model.row_functions import rows_of
from jaxphoto.observations import AXES, AbstractObservations, ControlCoordinates
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.quantiles import student_limit


@pretty_repr
class Spread(eqx.Module):
    """Number, mean, root mean square and maximum absolute value of one group along one axis."""

    group: str
    axis: str
    n: int
    mean: float
    rmse: float
    max_abs: float
    unit: str


def observation_groups(adjusted: Adjustment) -> dict[str, AbstractObservations]:
    """Return the observations of every group of `adjusted.residuals`, image points first, as used in the adjustment."""
    s, block = adjusted.structure, adjusted.block
    groups = zip(s.observed, adjusted.values.groups, strict=True)
    first_last = lambda v: np.moveaxis(np.asarray(v), -1, 0)  # noqa: E731
    others = {g.name: jax.tree.map(first_last, rows_of(g, numbers)) for g, numbers in groups}
    return {IMAGE_POINTS: block.image_points, **others}


def physical_residuals(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Compute observed minus computed by group, in mm (image), m and rad; shaped like `adjusted.residuals`."""
    rows = observation_groups(adjusted)
    return {name: rows[name].physical(v) for name, v in adjusted.residuals.named.items()}


def a_priori_sigmas(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Return the a priori standard deviations of the observations by group, in the units of `physical_residuals`."""
    return {name: np.asarray(rows.sigmas).T for name, rows in observation_groups(adjusted).items()}


def residual_spread(adjusted: Adjustment) -> list[Spread]:
    """Compute the statistics of the residuals per group and axis (paper 000, Table 3). RMSE divides by n."""
    spreads = []
    groups = observation_groups(adjusted)
    for group, v in physical_residuals(adjusted).items():
        rows = groups[group]
        if v.size and rows.unit:
            axis = np.broadcast_to(rows.axis_names(), v.shape)
            names = [a for a in dict.fromkeys((*AXES, *rows.axes, *axis.ravel())) if (axis == a).any()]
            spreads += [spread_of(group, "" if len(names) == 1 else a, v[axis == a], rows.unit) for a in names]
    return spreads


def check_discrepancies(adjusted: Adjustment) -> ControlCoordinates:
    """Compute surveyed minus computed coordinates (m) of check points, and the survey's sigmas (paper 000, Table 5)."""
    check = adjusted.block.check
    points = np.asarray(adjusted.unknowns.points)
    return ControlCoordinates(
        check.who, check.axis, np.asarray(check.value) - points[check.who, check.axis], check.sigma
    )


def point_differences(first: Adjustment, second: Adjustment) -> tuple[tuple[str, ...], Float[np.ndarray, "n 3"]]:
    """Compute the difference first - second of the coordinates (m) of common points (paper 000, Table 6)."""
    common, a, b = _common(first.block.points, second.block.points)
    return common, np.asarray(first.unknowns.points)[a] - np.asarray(second.unknowns.points)[b]


def angle_differences(first: Adjustment, second: Adjustment) -> tuple[tuple[str, ...], Float[np.ndarray, "n 3"]]:
    """Compute the difference first - second of omega, phi, kappa of common images (paper 000, Table 7).

    Angles are in rad, in (-pi, pi].
    """
    common, a, b = _common(first.block.images, second.block.images)
    angles = jax.vmap(omega_phi_kappa_from_matrix)
    one, two = (np.asarray(angles(x.unknowns.exterior.camera_from_object)) for x in (first, second))
    return common, -((-(one[a] - two[b]) + np.pi) % (2 * np.pi) - np.pi)


def spread_of(group: str, axis: str, values: np.ndarray, unit: str) -> Spread:
    """Return number, mean, RMSE (over n) and maximum absolute value; `values` must not be empty."""
    rmse, max_abs = float(np.sqrt((values**2).mean())), float(np.abs(values).max())
    return Spread(group, axis, len(values), float(values.mean()), rmse, max_abs, unit)


def _common(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[tuple[str, ...], list[int], list[int]]:
    place = {name: k for k, name in enumerate(second)}
    common = [(name, k, place[name]) for k, name in enumerate(first) if name in place]
    return tuple(n for n, _, _ in common), [a for _, a, _ in common], [b for _, _, b in common]


LEAST_CHECK_POINTS = 30
"""Minimum number of check points for an accuracy claim (ASPRS)."""
SUSPECT_MEAN = 0.25
"""Ratio of a mean error to the RMSE of its axis above which it requires an investigation (ASPRS)."""
# Significance level of Student's t-test of the mean.
_LEVEL = 0.05
# Number of significant digits of an accuracy class in centimetres; the class is rounded up.
_DIGITS = 2


@pretty_repr
class ComponentAccuracy(NamedTuple):
    """Tested accuracy of one component; lengths in metres."""

    name: str
    """Component: horizontal, vertical or three-dimensional."""
    symbol: str
    n: int
    """Number of check points surveyed along all axes of the component."""
    fit_m: float
    """Root mean square of surveyed minus computed, summed over the axes."""
    survey_m: float
    """Root mean square of the survey's standard deviations, summed over the axes; NaN if one of them is unknown."""

    @property
    def rmse_m(self) -> float:
        """RMSE including the survey's standard deviations, if all of these are known."""
        return math.hypot(self.fit_m, 0.0 if math.isnan(self.survey_m) else self.survey_m)

    @property
    def class_cm(self) -> float:
        """Accuracy class: `rmse_m` in centimetres, rounded up to two significant digits."""
        cm = 100 * self.rmse_m
        if cm == 0:
            return 0.0
        step = 10.0 ** (math.floor(math.log10(cm)) + 1 - _DIGITS)
        # Round to nine digits first: the rounding error of the root must not raise the class.
        return float(f"{math.ceil(round(cm / step, 9)) * step:.10g}")

    @property
    def claimed(self) -> bool:
        """True with at least `LEAST_CHECK_POINTS` check points and all sigmas of their survey."""
        return self.n >= LEAST_CHECK_POINTS and not math.isnan(self.survey_m)


@pretty_repr
class AxisErrors(NamedTuple):
    """Surveyed minus computed along one axis: number of check points, mean and root mean square (m)."""

    axis: str
    n: int
    mean_m: float
    rmse_m: float

    @property
    def biased(self) -> bool:
        """True if the mean exceeds both the limit of the ASPRS standard and the limit of Student's t."""
        if self.n < 2 or abs(self.mean_m) <= SUSPECT_MEAN * self.rmse_m:
            return False
        scatter = math.sqrt(max(self.rmse_m**2 - self.mean_m**2, 0.0) / (self.n - 1))
        return abs(self.mean_m) > student_limit(self.n - 1, _LEVEL) * scatter


@pretty_repr
class PositionalAccuracy(NamedTuple):
    """Accuracy of an adjusted block at its check points."""

    tested: tuple[ComponentAccuracy, ...]
    """Horizontal, vertical and three-dimensional accuracy, if check points have these axes."""
    axes: tuple[AxisErrors, ...]


def positional_accuracy(discrepancies: ControlCoordinates) -> PositionalAccuracy:
    """Compute positional accuracy from `discrepancies`: surveyed minus computed, with the survey's sigmas.

    See `check_discrepancies`. A sigma of zero means unknown.
    """
    points, row = np.unique(discrepancies.who, return_inverse=True)
    error, sigma = np.full((2, len(points), 3), np.nan)
    error[row, discrepancies.axis] = np.asarray(discrepancies.value, float)
    survey = np.asarray(discrepancies.sigma, float)
    sigma[row, discrepancies.axis] = np.where(survey > 0, survey, np.nan)
    horizontal = _tested("horizontal", "RMSE_H", error[:, :2], sigma[:, :2])
    vertical = _tested("vertical", "RMSE_V", error[:, 2:], sigma[:, 2:])
    combined = [math.hypot(h, v) for h, v in zip(horizontal[3:], vertical[3:], strict=True)]
    spatial = ComponentAccuracy("three-dimensional", "RMSE_3D", min(horizontal.n, vertical.n), *combined)
    axes = []
    for k, axis in enumerate(AXES):
        d = error[np.isfinite(error[:, k]), k]
        if len(d):
            axes.append(AxisErrors(axis, len(d), float(d.mean()), float(np.sqrt((d**2).mean()))))
    return PositionalAccuracy(tuple(t for t in (horizontal, vertical, spatial) if t.n), tuple(axes))


def _tested(
    name: str, symbol: str, error: Float[np.ndarray, "points axes"], sigma: Float[np.ndarray, "points axes"]
) -> ComponentAccuracy:
    complete = np.isfinite(error).all(axis=1)
    if not complete.any():
        return ComponentAccuracy(name, symbol, 0, math.nan, math.nan)
    rms = lambda v: math.sqrt(float((v[complete] ** 2).sum(axis=1).mean()))  # noqa: E731
    return ComponentAccuracy(name, symbol, int(complete.sum()), rms(error), rms(sigma))
