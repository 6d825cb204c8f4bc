"""Error of an interpolated height: noise and interpolation bias.

A height is a weighted sum of those of the points, H = sum w_i Z_i. With the local surface Z(x) of `local_surface`, the
noise v of a height and A = `rows`,

    v = sigma_Z^2 + |g|^2 sigma_XY^2    (+ the excess that the residuals show)
    b = sum w_i Z(x_i) - Z(0) + sigma_XY^2 (h_xx + h_yy) / 2

where b is the bias: of weights that do not reproduce a slope or curvature, and of horizontal errors, over which the
cloud averages a curved surface. It has a variance itself, t^2, and counts as far as it exceeds that: the error is
assumed normal,

    N(k b, s^2),    k = max(0, 1 - 2 t^2 / b^2),    s^2 = |w - k c A|^2 v + k (1 - k) t^2 + roughness

where c b is the bias per coefficient. The returned standard deviation is that of the zero-mean normal distribution with
the same probability of 95 % within 1.96 sigma.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.lidar.local_surface import LocalFit, Neighbours, terms


class LidarNoise(NamedTuple):
    """Standard deviations of a laser point (m): in height and in each horizontal coordinate."""

    sigma_z: Float[ArrayLike, ""] | float
    sigma_xy: Float[ArrayLike, ""] | float


def noise_variance(fit: LocalFit, noise: LidarNoise) -> Float[ArrayLike, ""]:
    """Return the variance of a point's height over the surface (m^2): on a slope, horizontal errors contribute."""
    slope = jnp.sum(fit.coefficients[1:3] ** 2)
    on_slope = noise.sigma_z**2 + slope * noise.sigma_xy**2
    # A slope that is not significant is none.
    by_chance = on_slope * jnp.sum(fit.rows[1:3] ** 2)
    return noise.sigma_z**2 + jnp.maximum(slope - by_chance, 0.0) * noise.sigma_xy**2


def excess(fit: LocalFit, variance: Float[ArrayLike, ""], quantile: float) -> Float[Array, ""]:
    """Return the residual variance over the expected one, relative to the normal `quantile` of chance.

    The quantile of chi-square over its degrees of freedom is that of Wilson and Hilferty (1931).
    """
    part = 2 / (9 * jnp.maximum(fit.freedom, 1.0))
    return fit.variance / (variance * (1 - part + quantile * jnp.sqrt(part)) ** 3)


def height_sigma(
    near: Neighbours, weight: Float[ArrayLike, "points"], fit: LocalFit, noise: LidarNoise
) -> Float[Array, ""]:
    """Return the standard deviation (m) of the height with these weights, as above."""
    expected = noise_variance(fit, noise)
    rough = excess(fit, expected, _ONE_IN_TWENTY) > 1
    variance = jnp.where(rough, fit.variance, expected)
    influence = weight @ terms(near.xy) - jnp.eye(6)[0]
    influence = influence + noise.sigma_xy**2 / 2 * jnp.array([0.0, 0, 0, 1, 0, 1])
    bias = influence @ fit.coefficients
    of_bias = influence @ fit.rows
    uncertain = jnp.sum(of_bias**2) * variance
    known = jnp.maximum(0.0, 1 - _DOUBT * uncertain / jnp.where(bias == 0, 1.0, bias**2)) * (bias != 0)
    spread = jnp.sum((weight - known * of_bias) ** 2) * variance
    spread += known * (1 - known) * uncertain + jnp.where(rough, variance - expected, 0.0)
    return normal_equivalent(known * bias, jnp.sqrt(spread))


_ONE_IN_TWENTY = 1.645
# Multiple of its variance that a squared bias must exceed.
_DOUBT = 2.0


def normal_equivalent(mean: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Return s for which |e| <= 1.96 s in 95 % of errors e of N(mean, sigma^2)."""
    # Without noise only the bias counts.
    sigma = jnp.maximum(sigma, 1e-9 * jnp.abs(mean) + 1e-300)
    t = jnp.abs(mean) / sigma
    q = jnp.maximum(_BOUND, t + _ONE_IN_TWENTY)
    for _ in range(4):
        # Newton's method; the probability is concave in q, so it converges from below.
        within = norm.cdf(q - t) - norm.cdf(-q - t)
        q = q + (0.95 - within) / (norm.pdf(q - t) + norm.pdf(q + t))
    return sigma * q / _BOUND


_BOUND = 1.959963984540054
