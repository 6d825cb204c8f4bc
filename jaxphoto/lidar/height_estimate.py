"""The height of one place from the points nearest to it: weights, standard deviation, and what speaks against it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.arrays import Numbers
from jaxphoto.lidar.height_error import LidarNoise, excess, height_sigma, noise_variance
from jaxphoto.lidar.inverse_distance import inverse_distance_weights
from jaxphoto.lidar.local_surface import LocalFit, Neighbours, fit_surface
from jaxphoto.lidar.sight import empty_about, surrounded
from jaxphoto.lidar.tin import delaunay_triangle

# Points around a place that tell slope, curvature and roughness: at least so many, and so many times those used.
WIDE, TIMES = 24, 3
# And all points nearer than so many horizontal standard deviations, as far as they are given.
APART = 4.75
# Quantiles of the normal distribution: 1 in 20, and 1 in 1000.
_SELDOM, _HARDLY = 1.645, 3.09
# Residuals in units of the lidar's noise that are no surface's.
_ROUGH = 3.0
# Standard deviation of the weights of moving least squares, in units of the farthest point.
_WIDTH = 0.5


class HeightNumbers(NamedTuple):
    """Settings, as numbers that programs are not compiled for."""

    points: Int[Numbers, ""]
    power: Float[Numbers, ""]
    radius: Float[Numbers, ""]
    """Zero: the nearest points (m)."""
    noise: LidarNoise


class HeightEstimate(NamedTuple):
    """What one place comes to."""

    height: Float[Numbers, ""]
    """Over the nearest point (m); NaN where the points do not give one."""
    sigma: Float[Numbers, ""]
    used: Int[Numbers, ""]
    density: Float[Numbers, ""]
    roughness: Float[Numbers, ""]
    gradient: Float[Numbers, "2"]
    leafy: Float[Numbers, ""]
    """Share of the points used that are vegetation."""
    hole: Bool[Numbers, ""]
    surrounded: Bool[Numbers, ""]
    plane: Bool[Numbers, ""]
    """Whether `local` had to take a plane."""
    misfit: Bool[Numbers, ""]
    """Whether the points scatter about the surface more than the lidar's noise lets them."""
    rough: Bool[Numbers, ""]
    """Whether they do so by far."""
    wide: Int[Numbers, ""]
    """How many points told the surface."""
    one_surface: Float[Numbers, ""]
    """Variance (m^2) that one smooth surface leaves of them."""
    final: Bool[Numbers, ""]
    """Whether more points would change nothing."""


@eqx.filter_jit
def estimate_heights(
    near: Neighbours, leafy: Bool[Array, "places points"], numbers: HeightNumbers, method: str
) -> HeightEstimate:
    """Every place by `method`; arrays of `near` have a leading axis over the places."""
    return jax.vmap(lambda n, of: _estimate(n, of, numbers, method))(near, leafy)


def _estimate(near: Neighbours, leafy: Bool[Array, "points"], numbers: HeightNumbers, method: str) -> HeightEstimate:
    in_radius = near.there & (near.distance <= numbers.radius)
    n_used = jnp.where(numbers.radius > 0, jnp.sum(in_radius), numbers.points)
    n_around = jnp.maximum(WIDE, TIMES * n_used)
    # No curve can be told of points whose horizontal errors are as large as their distances.
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

    # A plane nearby where a break is not far: what lies beyond tells nothing of the place.
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
