"""Moderated variances (empirical Bayes) from few values each.

With v degrees of freedom a variance s^2 is too small as often as too large, and as weights the small ones count most.
If true variances follow a scaled inverse chi-squared distribution with v0 degrees of freedom about s0^2, the expected
one given s^2 is

    (v0 s0^2 + v s^2) / (v0 + v)

v0 and s0^2 follow from mean and variance of log s^2 over all; if these scatter no more than by chance, v0 is infinite,
and all variances are equal. Source: Smyth (2004), Linear models and empirical Bayes methods for assessing differential
expression in microarray experiments.
"""

import numpy as np
import scipy
from jaxtyping import Float, Int

_ROUNDS = 50


def moderated_variances(variance: Float[np.ndarray, "n"], freedom: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the expected variances of positive `variance` with `freedom` degrees of freedom each (one or more)."""
    if len(variance) < 2:
        return variance
    half = freedom / 2
    log = np.log(variance) - scipy.special.digamma(half) + np.log(half)
    scatter = float(np.var(log, ddof=1) - np.mean(scipy.special.polygamma(1, half)))
    if scatter <= 0:
        return np.full(len(variance), np.exp(np.mean(log)))
    prior = _inverse_trigamma(scatter)
    common = np.exp(np.mean(log) + scipy.special.digamma(prior) - np.log(prior))
    return (prior * common + half * variance) / (prior + half)


def _inverse_trigamma(value: float) -> float:
    """Newton's method on 1 / trigamma, which is nearly linear and convex: it converges from one side."""
    x = 0.5 + 1 / value
    for _ in range(_ROUNDS):
        slope = scipy.special.polygamma(1, x)
        step = float(slope * (1 - slope / value) / scipy.special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x
