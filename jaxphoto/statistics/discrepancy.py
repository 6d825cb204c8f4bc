"""Residuals by group and axis, discrepancies at check points, differences between adjustments.

Source: paper 000, Tables 3 (residual RMSE), 5 (check points), 6 and 7 (points and angles of two experiments).

A mean error of check points above 25 % of the RMSE requires an investigation (ASPRS Positional Accuracy Standards,
Edition 2). With few check points such a mean occurs by chance (with three points in 75 % of cases), so it must also
exceed the limit of Student's t.
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


SUSPECT_MEAN = 0.25
"""Ratio of a mean error to the RMSE of its axis above which it requires an investigation (ASPRS)."""
# Significance level of Student's t-test of the mean.
_LEVEL = 0.05


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
        return bool(abs(self.mean_m) > student_limit(self.n - 1, _LEVEL) * scatter)
