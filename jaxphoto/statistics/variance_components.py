"""Variance components: how much larger or smaller the variances of parts of the observations are than was stated.

REML of normal observations. With v_k' P_k v_k and S of `partial_redundancy` at the present weights, Helmert's step is

    s = S^-1 q,    q_k = v_k' P_k v_k,    covariance 2 S^-1,

after which the sigmas of part k are multiplied by sqrt(s_k) and the block is adjusted anew (by half the step where it
leads back), until all s_k are one: then q_k = r_k for every part, the equation of restricted maximum likelihood. As r_k
is exact, so are the components; only their standard deviations depend on random vectors, where S does. Where a step
would lead to a variance that is not positive, it is Foerstner's: s_k = q_k / r_k.

Sources: F. R. Helmert, Die Ausgleichungsrechnung (1907); W. Foerstner, Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten (1979); K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999), 3.6;
H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58 (1971).
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import MAX_STEPS, Adjustment, solve
from jaxphoto.block import Block
from jaxphoto.errors import InputError, counted
from jaxphoto.observations import AbstractObservations
from jaxphoto.short_repr import shown
from jaxphoto.statistics.partial_redundancy import PROBES, PartialRedundancy, partial_redundancy
from jaxphoto.statistics.partition import Partition, Parts, parts_of
from jaxphoto.tracing import outside_transformations

MAX_ROUNDS = 60
LEAST_DEGREES = 2.0
"""Degrees of freedom at which a component's standard deviation is as large as itself. With no more than these, it is
not told from zero, and the weight that follows from it, 1 / s, has no mean."""
# A round changes a variance by no more than this factor: further off, S is another.
_FARTHEST = 4.0
# No component is off from the optimum by more than this part of its standard deviation.
_TOLERANCE = 1e-3
# Rounds in which a part has too few degrees of freedom and its variance falls, which leaves it fewer: it goes to zero.
_FALLS = 3
# A part of less redundancy is not checked at all: what is left of it is rounding.
_UNCHECKED = 1e-6
# Smallest eigenvalue of S, scaled to a unit diagonal, that is not rounding.
_SINGULAR = 1e-10


@shown
class VarianceComponents(eqx.Module):
    """Variance components of the parts of a partition, and the adjustment with them.

    A `factor` multiplies the variances that were stated, sqrt(factor) their standard deviations. A part that cannot
    support one keeps the stated ones (factor 1, no sigma); `sentences` say why.
    """

    labels: tuple[str, ...] = eqx.field(static=True)
    factor: Float[np.ndarray, "parts"]
    sigma: Float[np.ndarray, "parts"]
    """Standard deviations of the factors; NaN where a part keeps what was stated."""
    correlation: Float[np.ndarray, "parts parts"]
    """Of the factors; NaN likewise."""
    observations: Int[np.ndarray, "parts"]
    redundancy: Float[np.ndarray, "parts"]
    """Of the parts, after the adjustment with the components."""
    sigma_uncertainty: Float[np.ndarray, "parts"]
    """Relative standard deviations of `sigma` from random vectors; zero where traces are exact."""
    supported: Bool[np.ndarray, "parts"]
    sentences: dict[str, str] = eqx.field(static=True)
    """Of each part that cannot support a component, why, and what to do."""
    adjusted: Adjustment
    """Converged with standard deviations times sqrt(factor), which its block has."""
    rounds: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)

    @property
    def degrees(self) -> Float[np.ndarray, "parts"]:
        """Degrees of freedom: a factor scatters as chi-square over these does, with the variance 2 / degrees."""
        return 2 * (self.factor / self.sigma) ** 2


class _Step(NamedTuple):
    """Helmert's step of the parts that are estimated, at the present weights, where every factor is one."""

    change: Float[np.ndarray, "free"]
    """s - 1."""
    covariance: Float[np.ndarray, "free free"]
    """2 S^-1."""

    @property
    def sigma(self) -> Float[np.ndarray, "free"]:
        """Standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def is_weak(self) -> Bool[np.ndarray, "free"]:
        """Whether there are no more than `LEAST_DEGREES` degrees of freedom."""
        return self.sigma**2 >= 2 / LEAST_DEGREES

    @property
    def falls(self) -> Bool[np.ndarray, "free"]:
        """Whether a part has no more than these, and less after the step, while those that have more stay about."""
        moving = ~self.is_weak & (np.abs(self.change) > self.sigma)
        return self.is_weak & (self.change < 0) & ~moving.any()


@outside_transformations
def variance_components(
    adjusted: Adjustment,
    partition: Partition = ("xy-z",),
    *,
    max_rounds: int = MAX_ROUNDS,
    max_steps: int = MAX_STEPS,
    probes: int = PROBES,
) -> VarianceComponents:
    """Estimate a variance component for every part of the observations, and adjust with them.

    `partition` is a sequence of splits (`SPLITS`; none for one part a group), or observations by label
    (`Selection`); observations of no label keep their weight, as what is known beforehand does. A component that cannot
    be told from zero (no more than `LEAST_DEGREES` degrees of freedom) is not estimated. Traces take `probes` random
    vectors in parts that have more observations.

    Raises InputError for an adjustment that has not converged, for a partition that is none, and without a round.
    """
    if max_rounds < 1 or probes < 1:
        raise InputError(f"max_rounds and probes are 1 at least, got {max_rounds} and {probes}")
    if not bool(adjusted.converged):
        raise InputError(f"variance components are those of an optimum, but the block is {adjusted.outcome.value}")
    block, priors, sizes, parts = adjusted.block, adjusted.priors, adjusted.sizes, parts_of(adjusted, partition)
    factor, free = np.ones(len(parts.labels)), np.ones(len(parts.labels), bool)
    sentences: dict[str, str] = {}
    falls, last, rounds, settled = np.zeros(len(factor), int), np.zeros(len(factor)), 0, False
    while rounds < max_rounds:
        rounds += 1
        now = partial_redundancy(adjusted, parts, probes)
        step = _helmert(now, free)
        settled = bool((np.abs(step.change) <= _TOLERANCE * step.sigma).all())
        falls[free] = np.where(step.falls, falls[free] + 1, 0)
        weak = _cannot(parts, factor, free, falls, now, step, settled)
        if settled and weak is None:
            break
        before = factor.copy()
        if weak is not None:
            k, sentences[parts.labels[k]] = weak
            factor[k], free[k] = 1.0, False
        else:
            # A step back was too far before: where few observations speak, residuals bend more than they should.
            change = np.where(step.change * last[free] < 0, step.change / 2, step.change)
            factor[free] *= _positive(change, now, free)
            last[free] = step.change
        settled = False
        if (factor != before).any():
            # Of a large block an adjustment is hundreds of megabytes: the last one goes before the next is made.
            reached, adjusted = adjusted.unknowns, None  # type: ignore[assignment]
            adjusted = solve(_reweighted(block, parts, factor), reached, priors, max_steps, sizes)
        if not bool(adjusted.converged):
            break
    return _result(parts, factor, free, sentences, adjusted, now, rounds, settled)


def _helmert(now: PartialRedundancy, free: np.ndarray) -> _Step:
    """The step of the parts that are `free`; what S cannot tell apart has a standard deviation that shows it."""
    s = now.matrix[:-1, :-1][np.ix_(free, free)]
    unit = 1 / np.sqrt(np.maximum(np.diagonal(s), _UNCHECKED**2))
    value, vector = np.linalg.eigh(s * unit[:, None] * unit)
    inverse = (vector / np.maximum(value, _SINGULAR)) @ vector.T * unit[:, None] * unit
    return _Step(inverse @ (now.square_sums - now.redundancy)[:-1][free], 2 * inverse)


def _cannot(
    parts: Parts,
    factor: np.ndarray,
    free: np.ndarray,
    falls: np.ndarray,
    now: PartialRedundancy,
    step: _Step,
    settled: bool,
) -> tuple[int, str] | None:
    """The part that supports a component least, if it supports none, and the sentence that says so.

    One at a time: without it, others may be told apart. What has not settled is not judged by its standard deviation:
    a part that was stated far too precise has next to no redundancy at first.
    """
    known = np.flatnonzero(free).tolist()
    if not known:
        return None
    least = min(known, key=lambda k: now.redundancy[k])
    if now.redundancy[least] < _UNCHECKED:
        return least, _sentence(parts, least, "no other observation checks it")
    judged = step.is_weak & (settled | (falls[free] >= _FALLS))
    if not judged.any():
        return None
    worst = int(np.argmax(np.where(judged, step.sigma, 0.0)))
    k, sigma = known[worst], factor[free][worst] * step.sigma[worst]
    told = f"its estimate {factor[k]:.2g} has the standard deviation {sigma:.2g}"
    return k, _sentence(parts, k, f"{told}, with redundancy {now.redundancy[k]:.2g}")


def _sentence(parts: Parts, k: int, why: str) -> str:
    return (
        f"{parts.labels[k]} ({counted(parts.counts[k], 'observation')}) cannot support a variance component: {why}; "
        "the standard deviations stay as stated, join it with another part or observe more"
    )


def _positive(change: np.ndarray, now: PartialRedundancy, free: np.ndarray) -> np.ndarray:
    """By what to multiply the variances: Helmert's components, or Foerstner's where these are no variances."""
    foerstner = now.square_sums[:-1][free] / now.redundancy[:-1][free]
    return np.clip(np.where(change > -1, 1 + change, foerstner), 1 / _FARTHEST, _FARTHEST)


def _reweighted(block: Block, parts: Parts, factor: np.ndarray) -> Block:
    """The block with its variances times `factor`."""
    scale = np.sqrt(np.append(factor, 1.0))

    def scaled(name: str, rows: AbstractObservations) -> AbstractObservations:
        return rows.with_sigmas_times(scale[parts.of[name]].T.reshape(np.shape(rows.sigmas)))

    return block.with_observations({name: scaled(name, rows) for name, rows in block.named_observations.items()})


def _result(
    parts: Parts,
    factor: np.ndarray,
    free: np.ndarray,
    sentences: dict[str, str],
    adjusted: Adjustment,
    now: PartialRedundancy,
    rounds: int,
    settled: bool,
) -> VarianceComponents:
    step, n = _helmert(now, free), len(factor)
    sigma, uncertainty, correlation = (np.full(shape, np.nan) for shape in (n, n, (n, n)))
    sigma[free] = factor[free] * step.sigma
    correlation[np.ix_(free, free)] = step.covariance / step.sigma[:, None] / step.sigma
    # d(S^-1) = -S^-1 dS S^-1; a number off the diagonal of S stands there twice.
    products = (step.covariance[:, :, None] * step.covariance[:, None]) ** 2 / 4
    spread = np.einsum("kij,ij->k", products, now.uncertainty[:-1, :-1][np.ix_(free, free)] ** 2)
    uncertainty[free] = np.sqrt(2 * spread) / (2 * step.sigma**2)
    return VarianceComponents(
        labels=parts.labels,
        factor=factor,
        sigma=sigma,
        correlation=correlation,
        observations=parts.counts,
        redundancy=now.redundancy[:-1],
        sigma_uncertainty=uncertainty,
        supported=free,
        sentences=sentences,
        adjusted=adjusted,
        rounds=rounds,
        converged=settled,
    )
