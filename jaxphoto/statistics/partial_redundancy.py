"""Redundancy by parts: S_kl = tr(R_k R_l), by which residuals of one part answer to the variance of another.

With R = I - H, H = J Q J' of whitened observations, and R_kl the block of the rows of part k and the columns of part l,

    S_kl = |R_kl|^2    (the sum of its squares),    r_k = tr R_kk = sum_l S_kl,    E[v_k' P_k v_k] = sum_l S_kl s_l

where s_l is the variance factor of part l; the middle one because R is idempotent. Off the diagonal |R_kl| = |H_kl|,
which takes products H z (`NormalEquations.seen`): exactly, z is each unit vector of part k in turn; or, of a large
part, the mean of |H_l z|^2 over vectors z of random signs in part k (Hutchinson). Its standard deviation is below
sqrt(S_kl / (2 p)) for p vectors, because no singular value of an off-diagonal block of a projector exceeds 1/2. The
diagonal follows from the redundancy numbers, which are exact, and so does the part that no vector is spent on: the
largest. Source: K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999), 3.6; M. F. Hutchinson
(1989), A stochastic estimator of the trace of the influence matrix.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int32, UInt32

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.arrays import still
from jaxphoto.compiling import run_compiled
from jaxphoto.statistics.covariance import covariance
from jaxphoto.statistics.partition import Parts
from jaxphoto.statistics.reliability import redundancy_numbers

PROBES = 64
"""Random vectors a part; a part of no more observations is exact. The standard deviations of variance components,
which alone depend on it, are off by less than a per cent where a part has a redundancy of some tens."""
# Vectors that are computed with side by side, and the numbers that they may have together.
_AT_ONCE, _NUMBERS = 32, 8_000_000
# Parts are numbered up to a multiple of this: what is compiled serves all partitions of so many.
_PARTS = 8


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
    numbers = {k: np.asarray(v) for k, v in redundancy_numbers(adjusted, covariance(adjusted)).named.items()}
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
    of = _laid(adjusted, parts)
    at = [np.flatnonzero(of == k) for k in range(n)]
    trust = np.array([np.inf if len(places) <= probes else 1.0 for places in at])
    trust[np.argmax([len(places) for places in at])] = 0.0
    seen = np.zeros((n, n))
    whose = np.concatenate(
        [np.full((t > 0) * min(len(places), probes), k) for k, (places, t) in enumerate(zip(at, trust, strict=True))]
    )
    if not len(whose):
        return seen, trust
    unit = np.concatenate(
        [places if t == np.inf else np.full((t > 0) * probes, -1) for places, t in zip(at, trust, strict=True)]
    )
    equations = adjusted.equations.on_one_device.weighed
    batch = int(np.clip(_NUMBERS // len(of), 1, _AT_ONCE))
    slots = -(-(n + 1) // _PARTS) * _PARTS
    for first in range(0, len(whose), batch):
        # Always as many, so that they are compiled for once.
        some = np.minimum(first + np.arange(batch), len(whose) - 1)
        vectors = _Vectors(some.astype(np.uint32), whose[some].astype(np.int32), unit[some].astype(np.int32))
        found = still(run_compiled(_squares, (equations, of, vectors, slots), adjusted.seconds, "covariance"))
        own = np.arange(batch) < len(whose) - first
        np.add.at(seen, whose[some[own]], found[own, :n])
    return seen / np.where(trust == 1.0, probes, 1.0)[:, None], trust


class _Vectors(eqx.Module):
    """Which z: numbers that make seeds, the part of each, and the place of its one, -1 where signs are random."""

    number: UInt32[np.ndarray, "z"]
    part: Int32[np.ndarray, "z"]
    unit: Int32[np.ndarray, "z"]


def _laid(adjusted: Adjustment, parts: Parts) -> Int32[np.ndarray, "places"]:
    """The part of everything in the arrays that are computed with, as one list; one part more for what is padding."""
    padding = len(parts.labels) + 1.0
    image, *others = (np.asarray(of, float) for of in parts.of.values())
    datum = np.full(adjusted.n_constraints, padding)
    own = dataclasses.replace(adjusted.residuals, image=image, others=tuple(others), datum=datum)
    laid = adjusted.tiled.pad_residuals(own, padding)
    return np.concatenate([np.ravel(v) for v in jax.tree.leaves(laid)]).astype(np.int32)


@eqx.filter_jit
def _squares(
    equations: NormalEquations, of: Int32[Array, "places"], vectors: _Vectors, n: int
) -> Float[Array, "z parts"]:
    """|H_l z|^2 of every part l of the residuals, for each of some vectors z."""
    _, back = ravel_pytree(jax.tree.map(lambda v: jnp.zeros(v.shape), jax.eval_shape(equations.at.residuals)))
    key, place = jax.random.key(0), jnp.arange(len(of))

    def one(v: _Vectors) -> Float[Array, "parts"]:
        sign = jax.random.rademacher(jax.random.fold_in(key, v.number), of.shape, float)
        z = jnp.where(v.unit < 0, jnp.where(of == v.part, sign, 0.0), jnp.where(place == v.unit, 1.0, 0.0))
        return jax.ops.segment_sum(ravel_pytree(equations.seen(back(z)))[0] ** 2, of, n)

    return jax.vmap(one)(vectors)
