"""Linearity test: whether the covariance of an adjustment describes its errors.

Errors x of u unknowns with the normal matrix N have x' N x / sigma^2 = u on average. In a linear adjustment the sum of
squared residuals increases by the same multiple of sigma^2. If it increases far more or hardly at all, the errors lie
on a curve that no covariance describes: near a dangerous surface, with few points, or with flat figures seen from afar.
"""

import numpy as np
from jaxtyping import Float

_SAMPLES = 16
_QUANTILES = 0.1, 0.9
_FACTOR = 3.0  # maximum ratio of the increase to the expected one, and of its inverse


def typical_errors(normal: Float[np.ndarray, "u u"], sigma: float) -> Float[np.ndarray, "steps u"]:
    """Draw errors of one-sigma size in random directions and their opposites, for a normal matrix and observation
    sigma.
    """
    values, vectors = np.linalg.eigh(normal)
    drawn = np.random.default_rng(0).normal(size=(_SAMPLES, len(normal)))
    drawn *= np.sqrt(len(normal)) / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.concatenate([drawn, -drawn]) * sigma / np.sqrt(np.maximum(values, 1e-300)) @ vectors.T


def is_nonlinear(growth: Float[np.ndarray, " steps"], unknowns: int, sigma: float) -> bool:
    """Return True if the increase of the squared residuals at `typical_errors` deviates from a linear adjustment."""
    least, most = np.quantile(growth / (unknowns * sigma**2), _QUANTILES)
    return not (least > 1 / _FACTOR and most < _FACTOR)
