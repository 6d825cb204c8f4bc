"""Cholesky factors of many positive definite 3 x 3 matrices, by component."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def cholesky_3x3(v: Float[Array, "3 3 n"]) -> Float[Array, "6 n"]:
    """Return the factor in closed form: LAPACK on a batch of 3 x 3 matrices is many times slower."""
    l11 = jnp.sqrt(v[0, 0])
    l21, l31 = v[1, 0] / l11, v[2, 0] / l11
    l22 = jnp.sqrt(v[1, 1] - l21**2)
    l32 = (v[2, 1] - l31 * l21) / l22
    return jnp.stack([l11, l21, l22, l31, l32, jnp.sqrt(v[2, 2] - l31**2 - l32**2)])


def whiten(w, l) -> tuple[Array, Array, Array]:  # noqa: E741
    """Return L^-1 w, by component."""
    l11, l21, l22, l31, l32, l33 = l
    y1 = w[0] / l11
    y2 = (w[1] - y1 * l21) / l22
    return y1, y2, (w[2] - y1 * l31 - y2 * l32) / l33


def unwhiten(w, l) -> tuple[Array, Array, Array]:  # noqa: E741
    """Return L^-T w, by component."""
    l11, l21, l22, l31, l32, l33 = l
    x3 = w[2] / l33
    x2 = (w[1] - l32 * x3) / l22
    return (w[0] - l21 * x2 - l31 * x3) / l11, x2, x3
