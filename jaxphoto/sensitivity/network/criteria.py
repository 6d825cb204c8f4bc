"""What a network can be designed for: criteria of its covariance, the smaller the better.

Each is a plain function; `functools.partial(sigma_of, name="c_mm")` makes a criterion of it, and so does any function
of yours from a `NetworkCovariance` to a number that JAX can differentiate. A largest value has kinks where another one
becomes the largest; with `power` p it is the p-norm, which has none and is greater by at most the p-th root of how many
there are: that is for the search, the value to report is the one without.

Source of A, D and E: Pukelsheim, Optimal Design of Experiments (1993); for networks, Grafarend and Sanso (1985).
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import cholesky, eigh
from jaxphoto.sensitivity.network.covariance import EXTERIOR, NetworkCovariance


def a_criterion(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """A: the mean variance, trace(Q) / n, of a covariance matrix whose unknowns have one unit."""
    return jnp.trace(matrix) / len(matrix)


def d_criterion(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """D: det(Q)^(1/n), the mean size of the ellipsoid of errors; units of the unknowns change it by a factor only."""
    scale = jnp.sqrt(jnp.diagonal(matrix))
    log = 2 * jnp.sum(jnp.log(jnp.diagonal(cholesky(matrix / scale[:, None] / scale))))
    return jnp.exp((log + 2 * jnp.sum(jnp.log(scale))) / len(matrix))


def e_criterion(matrix: Float[Array, "n n"], power: float | None = None) -> Float[Array, ""]:
    """E: the largest eigenvalue, the variance of what is determined worst, of unknowns of one unit."""
    return _largest(eigh(matrix)[0], power)


def sigma_of(covariance: NetworkCovariance, name: str) -> Float[Array, ""]:
    """Standard deviation of the interior parameter `name` in its own unit. Raises InputError where it is fixed."""
    k = covariance.column(name)
    return jnp.sqrt(covariance.interior[k, k])


def point_rmse(covariance: NetworkCovariance, points: Sequence[int] | slice = slice(None)) -> Float[Array, ""]:
    """Expected RMSE (m) of a coordinate of the ground points `points`: sqrt of the mean variance over points and axes.

    What check points there would show, were they surveyed without error. A point that fewer than two images see makes
    it very large.
    """
    chosen = points if isinstance(points, slice) else np.asarray(points)
    return jnp.sqrt(jnp.mean(jnp.diagonal(covariance.points[chosen], axis1=1, axis2=2)))


def largest_correlation(
    covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str], power: float | None = None
) -> Float[Array, ""]:
    """Maximum |rho| over all images of `exterior` (X, Y, Z, omega, phi, kappa) with `interior` (c_mm ...) parameters.

    Raises InputError for a parameter that is fixed or does not exist.
    """
    return _largest(jnp.abs(_chosen(covariance, exterior, interior)).reshape(-1), power)


def mean_correlation(
    covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str]
) -> Float[Array, ""]:
    """Mean |rho| over all images of `exterior` with `interior` parameters (paper 000, Table 4); else as the largest."""
    return jnp.mean(jnp.abs(_chosen(covariance, exterior, interior)))


def _chosen(covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str]) -> Array:
    if unknown := [name for name in exterior if name not in EXTERIOR]:
        raise InputError(f"a criterion asks for {unknown[0]} of the images, which have {', '.join(EXTERIOR)}")
    rows, columns = [EXTERIOR.index(name) for name in exterior], [covariance.column(name) for name in interior]
    return covariance.correlation[:, rows][:, :, columns]


def _largest(values: Float[Array, "n"], power: float | None) -> Float[Array, ""]:
    top = jnp.max(values)
    if power is None:
        return top
    # In units of the largest, so that no power overflows.
    return top * jnp.sum((values / top) ** power) ** (1 / power)
