"""Redundancy by parts: S_kl = tr(R_k R_l), by which residuals of one part answer to the variance of another.

With R = I - H, H = J Q J' of whitened observations, and R_kl the block of the rows of part k and the columns of part l,

    S_kl = |R_kl|^2    (the sum of its squares),    r_k = tr R_kk = sum_l S_kl,    E[v_k' P_k v_k] = sum_l S_kl s_l

where s_l is the variance factor of part l; the middle one because R is idempotent. Off the diagonal |R_kl| = |H_kl|,
which takes products H z (`Responses`): exactly, z is each unit vector of part k in turn; or, of a large
part, the mean of |H_l z|^2 over vectors z of random signs in part k (Hutchinson). Its standard deviation is below
sqrt(S_kl / (2 p)) for p vectors, because no singular value of an off-diagonal block of a projector exceeds 1/2. The
diagonal follows from the redundancy numbers, which are exact, and so does the part that no vector is spent on: the
largest. Where that holds all image points, their rows need not be gone through for each vector: |H z|^2 = z'H z, which
the part tells that z is in. Source: K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999),
3.6; M. F. Hutchinson (1989), A stochastic estimator of the trace of the influence matrix.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.observations import ImageRows
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import covariance
from jaxphoto.statistics.partition import Parts
from jaxphoto.statistics.reliability import redundancy_numbers
from jaxphoto.statistics.responses import Responses

PROBES = 64
"""Random vectors a part; a part of no more observations is exact. The standard deviations of variance components,
which alone depend on it, are off by less than a per cent where a part has a redundancy of some tens."""


@shown
class PartialRedundancy(eqx.Module):
    """Of the parts of a partition and, last, of all observations that are in none."""

    square_sums: Float[np.ndarray, "parts"]
    """v_k' P_k v_k."""
    redundancy: Float[np.ndarray, "parts"]
    """r_k, which add up to the redundancy."""
    matrix: Float[np.ndarray, "parts parts"]
    """S."""
    uncertainty: Float[np.ndarray, "parts parts"]
    """A bound of the standard deviation of each number of `matrix`; zero where it is exact."""


def partial_redundancy(adjusted: Adjustment, parts: Parts, probes: int = PROBES) -> PartialRedundancy:
    """S, r and v'Pv by part, with `probes` random vectors for each part that has more observations than that."""
    n = len(parts.labels) + 1
    numbers = {k: np.asarray(v) for k, v in redundancy_numbers(adjusted, covariance(adjusted, rows=True)).named.items()}
    squares = {name: np.asarray(v) ** 2 for name, v in adjusted.residuals.named.items()}
    seen, trust = _products(adjusted, parts, probes)
    # Of two estimates the better one; where they are alike, their mean.
    share = np.where(trust[:, None] == trust, 0.5, trust[:, None] > trust)
    off = share * seen + share.T * seen.T
    np.fill_diagonal(off, 0.0)
    redundancy = _by_part(numbers, parts, n)
    exact = np.maximum(trust[:, None], trust) == np.inf
    uncertainty = np.where(exact, 0.0, np.sqrt(off / (2 * probes) * np.where(trust[:, None] == trust, 0.5, 1.0)))
    np.fill_diagonal(uncertainty, 0.0)
    return PartialRedundancy(
        square_sums=_by_part(squares, parts, n),
        redundancy=redundancy,
        matrix=off + np.diag(redundancy - off.sum(axis=1)),
        uncertainty=uncertainty + np.diag(np.sqrt((uncertainty**2).sum(axis=1))),
    )


def _by_part(numbers: dict[str, np.ndarray], parts: Parts, n: int) -> Float[np.ndarray, "parts"]:
    pairs = ((of, numbers[name]) for name, of in parts.of.items())
    return np.sum([np.bincount(np.ravel(of), np.ravel(v), minlength=n) for of, v in pairs], axis=0)


def _products(adjusted: Adjustment, parts: Parts, probes: int) -> tuple[np.ndarray, np.ndarray]:
    """|H_kl|^2 off the diagonal, row by row, and how far to trust each: infinitely if exact, not if it was left out."""
    n = len(parts.labels) + 1
    largest = int(np.argmax(sum(np.bincount(np.ravel(of), minlength=n) for of in parts.of.values())))
    # No vector is in the largest part. Where all image points are of it, what is left of z'Hz = |Hz|^2 is theirs.
    without = all((of == largest).all() for name, of in parts.of.items() if name == ImageRows.group)
    responses = Responses.of(adjusted, image_rows=not without)
    # What the datum adds is in one part more.
    of = np.full(responses.count, n)
    for name, place in responses.places.items():
        of[place] = parts.of[name]
    at = [np.flatnonzero(of == k) for k in range(n)]
    trust = np.array([np.inf if len(places) <= probes else 1.0 for places in at])
    trust[largest] = 0.0
    # Each unit vector of a part, or -1 for random signs in it.
    units = [places if t == np.inf else np.full((t > 0) * probes, -1) for places, t in zip(at, trust, strict=True)]
    whose, unit = np.repeat(np.arange(n), [len(u) for u in units]), np.concatenate(units)

    def vector(k: int) -> Float[np.ndarray, "n"]:
        z, own = np.zeros(responses.count), at[whose[k]] if unit[k] < 0 else unit[k : k + 1]
        z[own] = np.random.default_rng(k).choice([-1.0, 1.0], len(own)) if unit[k] < 0 else 1.0
        return z

    seen = np.zeros((n, n))
    for j, (_, h) in enumerate(responses.to_errors(vector, len(whose))):
        squares = np.bincount(of, h**2, minlength=n + 1)
        if without:
            # Of a part that hardly meets the largest, rounding may leave less than nothing.
            squares[largest] = max(0.0, vector(j) @ h - squares.sum() + squares[largest])
        seen[whose[j]] += squares[:n]
    return seen / np.where(trust == 1.0, probes, 1.0)[:, None], trust
