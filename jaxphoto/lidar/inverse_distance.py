"""Weights of points by inverse distance."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import Numbers


def inverse_distance_weights(
    squared: Float[Numbers, "m"], used: Bool[Numbers, "m"], power: Float[Numbers, ""]
) -> Float[Array, "m"]:
    """w = d^-p over their sum, from the squares d^2 of distances in any unit; of the points `used`, zero of all others.

    Points at the place itself (d = 0) alone count where there are any; differentiable there too. All are zero where no
    point is used.
    """
    least = jnp.min(jnp.where(used, jax.lax.stop_gradient(squared), jnp.inf))
    least = jnp.where(jnp.any(used), least, 1.0)
    exact = squared == 0
    # Double where: neither a distance nor a ratio of zero has a NaN derivative.
    ratio = jnp.where(exact, 1.0, least / jnp.where(exact, 1.0, squared))
    some = used & (ratio > 0)
    weight = jnp.where(some, jnp.where(some, ratio, 1.0) ** (power / 2), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-300)
