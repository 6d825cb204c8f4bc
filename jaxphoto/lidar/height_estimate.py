"""Height of one place from its nearest points: weights, standard deviation, flags."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.lidar.height_error import LidarNoise, excess, height_sigma, noise_variance
from jaxphoto.lidar.inverse_distance import inverse_distance_weights
from jaxphoto.lidar.local_surface import LocalFit, Neighbours, fit_surface
from jaxphoto.lidar.sight import empty_about, surrounded
from jaxphoto.lidar.tin import delaunay_triangle

# Number of points that determine slope, curvature and roughness: a minimum, and a multiple of those used.
WIDE, TIMES = 24, 3
# Also all available points within this number of horizontal standard deviations.
APART = 4.75
# Quantiles of the normal distribution: 1 in 20, and 1 in 1000.
_SELDOM, _HARDLY = 1.645, 3.09
# Residuals in units of the lidar's noise beyond which there is no surface.
_ROUGH = 3.0
# Standard deviation of the weights of moving least squares, in units of the farthest point.
_WIDTH = 0.5


class HeightNumbers(NamedTuple):
    """Numerical settings, for which programs are not recompiled."""

    points: Int[ArrayLike, ""]
    power: Float[ArrayLike, ""]
    radius: Float[ArrayLike, ""]
    """Zero: the nearest points (m)."""
    noise: LidarNoise


class HeightEstimate(NamedTuple):
    """Estimate for one place."""

    height: Float[ArrayLike, ""]
    """Over the nearest point (m); NaN if undetermined."""
    sigma: Float[ArrayLike, ""]
    used: Int[ArrayLike, ""]
    density: Float[ArrayLike, ""]
    roughness: Float[ArrayLike, ""]
    gradient: Float[ArrayLike, "2"]
    leafy: Float[ArrayLike, ""]
    """Fraction of vegetation among the points used."""
    hole: Bool[ArrayLike, ""]
    surrounded: Bool[ArrayLike, ""]
    plane: Bool[ArrayLike, ""]
    """True if `local` used a plane."""
    misfit: Bool[ArrayLike, ""]
    """True if the points scatter about the surface more than the lidar's noise explains."""
    rough: Bool[ArrayLike, ""]
    """True if they do so by far."""
    wide: Int[ArrayLike, ""]
    """Number of points that determined the surface."""
    one_surface: Float[ArrayLike, ""]
    """Residual variance (m^2) of one smooth surface."""
    final: Bool[ArrayLike, ""]
    """True if more points would not change the result."""


@eqx.filter_jit
def estimate_heights(
    near: Neighbours, leafy: Bool[Array, "places points"], numbers: HeightNumbers, method: str
) -> HeightEstimate:
    """Estimate every place by `method`; arrays of `near` have a leading axis over the places."""
    return jax.vmap(lambda n, of: _estimate(n, of, numbers, method))(near, leafy)


def _estimate(near: Neighbours, leafy: Bool[Array, "points"], numbers: HeightNumbers, method: str) -> HeightEstimate:
    in_radius = near.there & (near.distance <= numbers.radius)
    n_used = jnp.where(numbers.radius > 0, jnp.sum(in_radius), numbers.points)
    n_around = jnp.maximum(WIDE, TIMES * n_used)
    # Points whose horizontal errors equal their distances determine no curvature.
    n_wide = jnp.maximum(n_around, jnp.sum(near.there & (near.distance <= APART * numbers.noise.sigma_xy)))
    rank = jnp.arange(len(near.z))
    used, around = near.there & (rank < n_used), near.there & (rank < n_around)
    wide, narrow = near.there & (rank < n_wide), near.there & (rank < n_wide // 2)
    curved, flat = (
        fit_surface(near, wide.astype(float), quadratic=True),
        fit_surface(near, narrow.astype(float), quadratic=False),
    )

    def misfit(fit: LocalFit, quantile: float) -> Bool[Array, ""]:
        return excess(fit, noise_variance(fit, numbers.noise), quantile) > 1

    # A local plane close to a break: points beyond it are irrelevant.
    take_flat = ~curved.interpolates | (misfit(curved, _HARDLY) & flat.interpolates & ~misfit(flat, _SELDOM))
    fit = jax.tree.map(lambda a, b: jnp.where(take_flat, a, b), flat, curved)
    final = interpolates = jnp.array(True)
    if method == "idw":
        weight = inverse_distance_weights(near.distance**2, used, numbers.power)
        weight = jnp.where(jnp.any(used), weight, jnp.nan)
    elif method == "plane":
        plane = fit_surface(near, used.astype(float), quadratic=False)
        weight, interpolates = jnp.where(plane.determined, plane.rows[0], jnp.nan), plane.interpolates
    elif method == "tin":
        triangle = delaunay_triangle(near)
        weight, final = jnp.where(triangle.inside, triangle.weight, jnp.nan), triangle.safe
        used = triangle.weight != 0
    else:
        used = around & (~take_flat | (rank < n_around // 2))
        reach = jnp.max(jnp.where(used, near.distance, 0.0))
        bell = jnp.where(used, jnp.exp(-0.5 * (near.distance / (_WIDTH * reach)) ** 2), 0.0)
        curved, flat = fit_surface(near, bell, quadratic=True), fit_surface(near, bell, quadratic=False)
        weight = jnp.where(take_flat, flat.rows[0], curved.rows[0])
    reach, n_there = jnp.max(jnp.where(around, near.distance, 0.0)), jnp.sum(around)
    expected = noise_variance(fit, numbers.noise)
    return HeightEstimate(
        height=jnp.sum(weight * jnp.where(near.there, near.z, 0.0)),
        sigma=height_sigma(near, weight, fit, numbers.noise),
        used=jnp.sum(used),
        density=(n_there - 1) / (jnp.pi * reach**2),
        roughness=jnp.sqrt(fit.variance),
        gradient=fit.coefficients[1:3],
        leafy=jnp.sum(leafy & used) / jnp.maximum(jnp.sum(used), 1),
        hole=empty_about(near.distance, around),
        surrounded=surrounded(near.xy, around) & fit.interpolates & interpolates,
        plane=take_flat & (method == "local"),
        misfit=misfit(fit, _HARDLY),
        rough=fit.variance > _ROUGH**2 * expected,
        wide=jnp.sum(wide),
        one_surface=curved.variance,
        final=final,
    )
