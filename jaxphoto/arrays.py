"""The arrays of data and results: numpy's or JAX's, whichever the moment asks for."""

import jax
import numpy as np

Numbers = jax.Array | np.ndarray
"""numpy where numbers lie still (reading, results), JAX where they are traced (compiled, differentiated)."""
