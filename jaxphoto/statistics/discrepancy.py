"""Residuals by group and axis, discrepancies at check points, and differences between two adjustments.

Source: paper 000, Tables 3 (residual RMSE), 5 (check points), 6 and 7 (points and angles of two experiments).
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.residuals import GROUPS
from jaxphoto.block import ATTITUDE_AXES, AXES, Rows
from jaxphoto.rotation import omega_phi_kappa_from_matrix


class Spread(eqx.Module):
    """Number, mean, root mean square and largest absolute value of one group along one axis."""

    group: str
    axis: str
    n: int
    mean: float
    rmse: float
    max_abs: float
    unit: str


def physical_residuals(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Observed minus computed by group, in mm (image), m and rad; shaped like `adjusted.residuals`."""
    sigmas = a_priori_sigmas(adjusted)
    return {name: np.asarray(getattr(adjusted.residuals, field)) * sigmas[name] for field, name in GROUPS.items()}


def a_priori_sigmas(adjusted: Adjustment) -> dict[str, Float[np.ndarray, "..."]]:
    """Standard deviations of the observations as given, by group, in the units of `physical_residuals`."""
    v = adjusted.values
    georeferencing = v.sigma_stations, v.sigma_attitudes, v.sigma_control, v.sigma_surfaces
    sigmas = (v.sigma_xy, *georeferencing, v.sigma_distances, v.sigma_priors)
    return {name: np.asarray(sigma) for name, sigma in zip(GROUPS.values(), sigmas, strict=True)}


def residual_spread(adjusted: Adjustment) -> list[Spread]:
    """RMSE of the residuals per group and axis (paper 000, Table 3); RMSE divides by n."""
    residuals, s = physical_residuals(adjusted), adjusted.structure
    groups = [("image_points", a, residuals["image_points"][k], "mm") for k, a in enumerate("xy")]
    groups += [("stations", a, residuals["stations"][s.station_axis == k], "m") for k, a in enumerate(AXES)]
    groups += [("attitudes", a, residuals["attitudes"][k], "rad") for k, a in enumerate(ATTITUDE_AXES)]
    groups += [("control_points", a, residuals["control_points"][s.control_axis == k], "m") for k, a in enumerate(AXES)]
    groups += [(name, "", residuals[name], "m") for name in ("surfaces", "distances")]
    return [spread_of(group, axis, v, unit) for group, axis, v, unit in groups if len(v)]


def check_discrepancies(adjusted: Adjustment) -> Rows:
    """Surveyed minus computed coordinates (m) of the check points, with the survey's sigmas (paper 000, Table 5)."""
    check = adjusted.block.check
    points = np.asarray(adjusted.unknowns.points)
    return Rows(check.who, check.axis, np.asarray(check.value) - points[check.who, check.axis], check.sigma)


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
