"""Residuals by group and axis, discrepancies at check points, and differences between two adjustments.

Source: paper 000, Tables 3 (residual RMSE), 5 (check points), 6 and 7 (points and angles of two experiments).
"""

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
