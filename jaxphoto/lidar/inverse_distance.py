"""Inverse distance weights."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import ArrayLike


def inverse_distance_weights(
    squared: Float[ArrayLike, "m"], used: Bool[ArrayLike, "m"], power: Float[ArrayLike, ""]
) -> Float[Array, "m"]:
    """Return w = d^-p over their sum, from squared distances d^2 in any unit; of the points `used`, zero for all
    others.

    If points coincide with the place (d = 0), only these count; differentiable there, too. All are zero if no point is
    used.
    """
    least = jnp.min(jnp.where(used, jax.lax.stop_gradient(squared), jnp.inf))
    least = jnp.where(jnp.any(used), least, 1.0)
    exact = squared == 0
    # Two `where`: neither a distance nor a ratio of zero has a NaN derivative.
    ratio = jnp.where(exact, 1.0, least / jnp.where(exact, 1.0, squared))
    some = used & (ratio > 0)
    weight = jnp.where(some, jnp.where(some, ratio, 1.0) ** (power / 2), 0.0)
    return weight / jnp.maximum(jnp.sum(weight), 1e-300)
