"""Whether a covariance tells the errors of an orientation: whether its equations are straight as far as they reach.

Errors x of u unknowns with the normal matrix N have x' N x / sigma^2 = u on average, and by so many sigma^2 the squared
residuals there are larger than at their least. Where they are far larger or hardly so, as near a dangerous surface,
of few points, and of flat figures seen from afar, the errors are on a curve that no covariance describes.
"""

import numpy as np
from jaxtyping import Float

_DRAWN = 16
_QUANTILES = 0.1, 0.9
_BENT = 3.0  # times as much as expected, or as little: the mean square of normalised errors is still right below


def typical_errors(normal: Float[np.ndarray, "u u"], sigma: float) -> Float[np.ndarray, "steps u"]:
    """Errors of the size that a normal matrix and the sigma of its observations say, in many directions and back."""
    values, vectors = np.linalg.eigh(normal)
    drawn = np.random.default_rng(0).normal(size=(_DRAWN, len(normal)))
    drawn *= np.sqrt(len(normal)) / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.concatenate([drawn, -drawn]) * sigma / np.sqrt(np.maximum(values, 1e-300)) @ vectors.T


def bends(growth: Float[np.ndarray, " steps"], unknowns: int, sigma: float) -> bool:
    """Whether the growth of the squared residuals at `typical_errors` is not what it would be of linear equations."""
    least, most = np.quantile(growth / (unknowns * sigma**2), _QUANTILES)
    return not (least > 1 / _BENT and most < _BENT)
