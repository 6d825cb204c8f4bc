"""The arrays of data and results: numpy's or JAX's, whichever the moment asks for."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

Numbers = jax.Array | np.ndarray
"""numpy where numbers lie still (reading, results), JAX where they are traced (compiled, differentiated)."""


def still(values) -> Numbers:
    """The same numbers as NumPy's, whose every operation need not be compiled; traced ones as they are."""
    return values if isinstance(values, jax.core.Tracer) else np.asarray(values)


def joined(parts: Sequence) -> Numbers:
    """`parts` one after another along their first axis, NumPy's unless one is being traced."""
    parts = [still(part) for part in parts]
    traced = any(isinstance(part, jax.core.Tracer) for part in parts)
    return jnp.concatenate(parts) if traced else np.concatenate(parts)
