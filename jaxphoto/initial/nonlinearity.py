"""Test of a covariance: whether the equations are linear as far as the errors reach.

Errors x of u unknowns with the normal matrix N have x' N x / sigma^2 = u on average, and the squared residuals there
exceed their minimum by as many sigma^2. Where they grow far more or hardly at all, as near a dangerous surface, of few
points, and of flat figures seen from afar, the errors lie on a curve that no covariance describes.
"""

import numpy as np
from jaxtyping import Float

_SAMPLES = 16
_QUANTILES = 0.1, 0.9
_FACTOR = 3.0  # of the expected growth, or its inverse: the mean square of normalised errors is still right below


def typical_errors(normal: Float[np.ndarray, "u u"], sigma: float) -> Float[np.ndarray, "steps u"]:
    """Errors of the size of a normal matrix and the sigma of its observations, in many directions and back."""
    values, vectors = np.linalg.eigh(normal)
    drawn = np.random.default_rng(0).normal(size=(_SAMPLES, len(normal)))
    drawn *= np.sqrt(len(normal)) / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.concatenate([drawn, -drawn]) * sigma / np.sqrt(np.maximum(values, 1e-300)) @ vectors.T


def is_nonlinear(growth: Float[np.ndarray, " steps"], unknowns: int, sigma: float) -> bool:
    """Return True if the growth of the squared residuals at `typical_errors` is not that of linear equations."""
    least, most = np.quantile(growth / (unknowns * sigma**2), _QUANTILES)
    return not (least > 1 / _FACTOR and most < _FACTOR)
