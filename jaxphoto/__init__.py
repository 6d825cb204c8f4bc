"""jaxphoto: differentiable photogrammetry on JAX."""

import os

# SciPy's OpenBLAS, which jax uses for LAPACK, spins threads that fight XLA's own pool (docs/solver.md).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

jax.config.update("jax_enable_x64", True)
