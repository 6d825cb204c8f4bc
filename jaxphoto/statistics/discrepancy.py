"""Residuals by group and axis, discrepancies at check points, and differences between two adjustments.

Source: paper 000, Tables 3 (residual RMSE), 5 (check points), 6 and 7 (points and angles of two experiments).


Positional accuracy by check points, as ASPRS Edition 2 wants it: the survey's own error belongs to it.

    RMSE_H = sqrt(RMSE_x^2 + RMSE_y^2 + s_H^2),  RMSE_V = sqrt(RMSE_z^2 + s_V^2),  RMSE_3D = sqrt(RMSE_H^2 + RMSE_V^2)

RMSE_x, RMSE_y, RMSE_z are root mean squares of what the check points differ by, s_H and s_V those of the survey's
standard deviations. Accuracy classes are any number of centimetres; thirty check points are the least for a claim, and
a mean beyond a quarter of the RMSE has to be looked into. Of few check points chance alone leaves such a mean (of
three in three of four cases): it has to be beyond what Student's t allows, too.
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
from jaxphoto.observations import AXES, AbstractObservations, ControlRows
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.short_repr import shown
from jaxphoto.statistics.quantiles import student_limit


@shown
class Spread(eqx.Module):
    """Number, mean, root mean square and largest absolute value of one group along one axis."""

    group: str
    axis: str
    n: int
    mean: float
    rmse: float
    max_abs: float
    unit: str


def observation_groups(adjusted: Adjustment) -> dict[str, AbstractObservations]:
    """The rows of every group of `adjusted.residuals`, image points first, with the numbers they were adjusted with."""
    s, block = adjusted.structure, adjusted.block
    groups = zip(s.observed, adjusted.values.groups, strict=True)
    first_last = lambda v: np.moveaxis(np.asarray(v), -1, 0)  # noqa: E731
    others = {g.name: jax.tree.map(first_last, rows_of(g, numbers)) for g, numbers in groups}
    return {IMAGE_POINTS: block.image_points, **others}


def physical_residuals(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Observed minus computed by group, in mm (image), m and rad; shaped like `adjusted.residuals`."""
    rows = observation_groups(adjusted)
    return {name: rows[name].physical(v) for name, v in adjusted.residuals.named.items()}


def a_priori_sigmas(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Standard deviations of the observations as given, by group, in the units of `physical_residuals`."""
    return {name: np.asarray(rows.sigmas).T for name, rows in observation_groups(adjusted).items()}


def residual_spread(adjusted: Adjustment) -> list[Spread]:
    """RMSE of the residuals per group and axis (paper 000, Table 3); RMSE divides by n."""
    found = []
    groups = observation_groups(adjusted)
    for group, v in physical_residuals(adjusted).items():
        rows = groups[group]
        if v.size and rows.unit:
            axis = np.broadcast_to(rows.axis_names(), v.shape)
            names = [a for a in dict.fromkeys((*AXES, *rows.axes, *axis.ravel())) if (axis == a).any()]
            found += [spread_of(group, "" if len(names) == 1 else a, v[axis == a], rows.unit) for a in names]
    return found


def check_discrepancies(adjusted: Adjustment) -> ControlRows:
    """Surveyed minus computed coordinates (m) of the check points, with the survey's sigmas (paper 000, Table 5)."""
    check = adjusted.block.check
    points = np.asarray(adjusted.unknowns.points)
    return ControlRows(check.who, check.axis, np.asarray(check.value) - points[check.who, check.axis], check.sigma)


def point_differences(first: Adjustment, second: Adjustment) -> tuple[tuple[str, ...], Float[np.ndarray, "n 3"]]:
    """First minus second: coordinates (m) of the points that both hold (paper 000, Table 6)."""
    common, a, b = _common(first.block.points, second.block.points)
    return common, np.asarray(first.unknowns.points)[a] - np.asarray(second.unknowns.points)[b]


def angle_differences(first: Adjustment, second: Adjustment) -> tuple[tuple[str, ...], Float[np.ndarray, "n 3"]]:
    """First minus second: omega, phi, kappa (rad, in (-pi, pi]) of the images that both hold (paper 000, Table 7)."""
    common, a, b = _common(first.block.images, second.block.images)
    angles = jax.vmap(omega_phi_kappa_from_matrix)
    one, two = (np.asarray(angles(x.unknowns.exterior.camera_from_object)) for x in (first, second))
    return common, -((-(one[a] - two[b]) + np.pi) % (2 * np.pi) - np.pi)


def spread_of(group: str, axis: str, values: np.ndarray, unit: str) -> Spread:
    """Mean, RMSE (over n) and maximum of some values; they must not be empty."""
    return Spread(
        group,
        axis,
        len(values),
        float(values.mean()),
        float(np.sqrt((values**2).mean())),
        float(np.abs(values).max()),
        unit,
    )


def _common(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[tuple[str, ...], list[int], list[int]]:
    place = {name: k for k, name in enumerate(second)}
    both = [(name, k, place[name]) for k, name in enumerate(first) if name in place]
    return tuple(n for n, _, _ in both), [a for _, a, _ in both], [b for _, _, b in both]


LEAST_CHECK_POINTS = 30
"""Fewer cannot support a claim of accuracy."""
SUSPECT_MEAN = 0.25
"""Of the RMSE of an axis: a larger mean error has to be looked into."""
# Share of means without any shift that are beyond Student's t.
_LEVEL = 0.05
# Of a class in centimetres; the tested value is rounded up to so many.
_DIGITS = 2


@shown
class ComponentAccuracy(NamedTuple):
    """One kind of position, tested; metres."""

    name: str
    """horizontal, vertical or three-dimensional."""
    symbol: str
    n: int
    """Check points that were surveyed in all its axes."""
    fit_m: float
    """Root mean square of surveyed minus computed, axes added,"""
    survey_m: float
    """and of the standard deviations of the survey, added likewise; NaN where one of them is not known."""

    @property
    def rmse_m(self) -> float:
        """What may be stated: survey included, where it is known."""
        return math.hypot(self.fit_m, 0.0 if math.isnan(self.survey_m) else self.survey_m)

    @property
    def class_cm(self) -> float:
        """The accuracy class that is met: `rmse_m` in centimetres, rounded up to two digits."""
        cm = 100 * self.rmse_m
        if cm == 0:
            return 0.0
        step = 10.0 ** (math.floor(math.log10(cm)) + 1 - _DIGITS)
        # A hair above a step is rounding of the root, not a worse class.
        return float(f"{math.ceil(round(cm / step, 9)) * step:.10g}")

    @property
    def claimed(self) -> bool:
        """Whether there are check points enough, and all sigmas of their survey, to claim the class."""
        return self.n >= LEAST_CHECK_POINTS and not math.isnan(self.survey_m)


@shown
class AxisErrors(NamedTuple):
    """Surveyed minus computed of one axis: over how many check points, mean and root mean square (m)."""

    axis: str
    n: int
    mean_m: float
    rmse_m: float

    @property
    def biased(self) -> bool:
        """Whether the mean is beyond the standard's rule, and beyond what chance leaves of so many check points."""
        if self.n < 2 or abs(self.mean_m) <= SUSPECT_MEAN * self.rmse_m:
            return False
        scatter = math.sqrt(max(self.rmse_m**2 - self.mean_m**2, 0.0) / (self.n - 1))
        return abs(self.mean_m) > student_limit(self.n - 1, _LEVEL) * scatter


@shown
class PositionalAccuracy(NamedTuple):
    """Check points against an adjusted block."""

    tested: tuple[ComponentAccuracy, ...]
    """Horizontal, vertical and three-dimensional, as far as check points have the axes."""
    axes: tuple[AxisErrors, ...]


def positional_accuracy(discrepancies: ControlRows) -> PositionalAccuracy:
    """Tested accuracy of `discrepancies`, surveyed minus computed with the survey's sigmas (`check_discrepancies`).

    A sigma of zero is one that nobody gave.
    """
    who, row = np.unique(discrepancies.who, return_inverse=True)
    off, sigma = np.full((2, len(who), 3), np.nan)
    off[row, discrepancies.axis] = np.asarray(discrepancies.value, float)
    given = np.asarray(discrepancies.sigma, float)
    sigma[row, discrepancies.axis] = np.where(given > 0, given, np.nan)
    plan = _tested("horizontal", "RMSE_H", off[:, :2], sigma[:, :2])
    height = _tested("vertical", "RMSE_V", off[:, 2:], sigma[:, 2:])
    both = [math.hypot(p, h) for p, h in zip(plan[3:], height[3:], strict=True)]
    space = ComponentAccuracy("three-dimensional", "RMSE_3D", min(plan.n, height.n), *both)
    errors = []
    for k, axis in enumerate(AXES):
        own = off[np.isfinite(off[:, k]), k]
        if len(own):
            errors.append(AxisErrors(axis, len(own), float(own.mean()), float(np.sqrt((own**2).mean()))))
    return PositionalAccuracy(tuple(t for t in (plan, height, space) if t.n), tuple(errors))


def _tested(
    name: str, symbol: str, off: Float[np.ndarray, "points axes"], sigma: Float[np.ndarray, "points axes"]
) -> ComponentAccuracy:
    whole = np.isfinite(off).all(axis=1)
    if not whole.any():
        return ComponentAccuracy(name, symbol, 0, math.nan, math.nan)
    square = lambda v: math.sqrt(float((v[whole] ** 2).sum(axis=1).mean()))  # noqa: E731
    return ComponentAccuracy(name, symbol, int(whole.sum()), square(off), square(sigma))
