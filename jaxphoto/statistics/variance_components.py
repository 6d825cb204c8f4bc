"""Partitions of the observations: who shares a variance component with whom.

A partition is declared by splits of the groups of observations, or by a selection of observations for each label:

    variance_components(adjusted, ("xy-z", "camera"))
    variance_components(adjusted, {"height": Selection("control_points", axes="Z"), "GNSS": Selection("stations")})

What is known beforehand of unknowns (`Weighted`, `KnownParameters`) is no sample of anything: it keeps its weight.


Redundancy by parts: S_kl = tr(R_k R_l), by which residuals of one part answer to the variance of another.

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


Variance components: how much larger or smaller the variances of parts of the observations are than was stated.

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

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxphoto.adjustment import MAX_STEPS, Adjustment, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import InputError, counted
from jaxphoto.observations import AXES, AbstractObservations, Correlated, ImageRows
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import covariance
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import Responses
from jaxphoto.statistics.reliability import redundancy_numbers
from jaxphoto.tracing import outside_transformations


@shown
class Selection(NamedTuple):
    """Observations of one group; all of them, or only those along some axes, of some cameras, images or points."""

    group: str
    axes: Collection[str] = ()
    cameras: Collection[str] = ()
    images: Collection[str] = ()
    points: Collection[str] = ()


Partition = Sequence[str] | Mapping[str, Selection | Sequence[Selection]]
"""Splits, words of `SPLITS`, none for one part a group; or what belongs to each label."""


@shown
class Parts(NamedTuple):
    """A partition of the observations of one adjustment."""

    labels: tuple[str, ...]
    of: dict[str, Int[np.ndarray, "..."]]
    """The part of every observation by the names of their groups, shaped like the residuals; the number of parts where
    it is in none."""

    @property
    def counts(self) -> Int[np.ndarray, "parts"]:
        """Observations of each part."""
        parts = np.concatenate([np.ravel(v) for v in self.of.values()])
        return np.bincount(parts, minlength=len(self.labels) + 1)[: len(self.labels)]


Names = Shaped[np.ndarray, "..."]
_Split = Callable[[AbstractObservations, Block], Names | None]


def _by_axis(rows: AbstractObservations, block: Block) -> Names | None:
    return None if isinstance(rows, Correlated) else rows.axis_names()


def _plan_and_height(rows: AbstractObservations, block: Block) -> Names | None:
    axis = _by_axis(rows, block)
    if axis is None or not set(axis.ravel()) <= set(AXES):
        return None
    return np.where(axis == "Z", "Z", "X-Y").astype(object)


def _by_camera(rows: AbstractObservations, block: Block) -> Names | None:
    return rows.names_of("image", block.image_camera) if rows.group == IMAGE_POINTS else None


def _by_image(rows: AbstractObservations, block: Block) -> Names | None:
    return rows.names_of("image", block.images) if rows.group == IMAGE_POINTS else None


SPLITS: dict[str, _Split] = {"xy-z": _plan_and_height, "axis": _by_axis, "camera": _by_camera, "image": _by_image}
"""What parts a group: X and Y from Z; each axis from the others; image points by camera; image points by image."""


def observed_rows(adjusted: Adjustment) -> dict[str, AbstractObservations]:
    """The rows that may have variance components, by the names of their groups: all but what is known beforehand."""
    known = observation_groups(adjusted)
    return {name: known[name] for name in adjusted.block.named_observations}


def parts_of(adjusted: Adjustment, partition: Partition) -> Parts:
    """The parts of an adjustment's observations, in the order of the partition.

    Raises InputError for a split, a group or a name that there is not, for a label without observations, for
    observations with two labels, and where rows that a covariance joins would be parted.
    """
    rows = observed_rows(adjusted)
    if isinstance(partition, Mapping):
        names, labels = _selected(adjusted, rows, partition), tuple(partition)
    else:
        names = _split(adjusted, rows, partition)
        labels = tuple(dict.fromkeys(label for of in names.values() for label in of.ravel().tolist()))
    place = {"": len(labels)} | {label: k for k, label in enumerate(labels)}
    numbered = {name: np.vectorize(place.__getitem__, otypes=[int])(of) for name, of in names.items()}
    given = adjusted.residuals.named
    return Parts(labels, {name: numbered.get(name, np.full(np.shape(v), len(labels))) for name, v in given.items()})


def _split(adjusted: Adjustment, rows: Mapping[str, AbstractObservations], words: Sequence[str]) -> dict[str, Names]:
    words = (words,) if isinstance(words, str) else words
    if unknown := [word for word in words if word not in SPLITS]:
        raise InputError(f"there is no split {unknown[0]!r} of observations: there are {', '.join(SPLITS)}")
    found = {}
    for name, own in rows.items():
        label = np.full(np.shape(adjusted.residuals[name]), name, object)
        for word in words:
            further = SPLITS[word](own, adjusted.block)
            if further is not None and len(set(further.ravel())) > 1:
                label = label + " " + further
        found[name] = label
    return found


def _selected(
    adjusted: Adjustment, rows: Mapping[str, AbstractObservations], partition: Mapping[str, Any]
) -> dict[str, Names]:
    found = {name: np.full(np.shape(adjusted.residuals[name]), "", object) for name in rows}
    for label, chosen in partition.items():
        for selection in [chosen] if isinstance(chosen, Selection) else chosen:
            if selection.group not in rows:
                raise InputError(
                    f"{label}: the block observes no {selection.group!r} that could have a variance component; "
                    f"there are {', '.join(rows)}"
                )
            mask = _mask(label, selection, rows[selection.group], adjusted.block, found[selection.group].shape)
            if twice := set(found[selection.group][mask]) - {""}:
                raise InputError(f"{label} and {min(twice)} share observations: leave them in one of the two")
            found[selection.group][mask] = label
        if not label or not any((of == label).any() for of in found.values()):
            raise InputError(f"a part {label!r} of the partition has no name or no observations: leave it out")
    for name, own in rows.items():
        if isinstance(own, Correlated) and found[name].ndim > 1 and (found[name] != found[name][:1]).any():
            raise InputError(f"{name}: rows that a covariance joins share a variance component; select whole sets")
    return found


def _mask(
    label: str, selection: Selection, rows: AbstractObservations, block: Block, shape: tuple[int, ...]
) -> np.ndarray:
    """Which numbers of a group a selection means. Raises InputError for names that none of them has."""
    known = {
        "axes": rows.axis_names(),
        "cameras": rows.names_of("image", block.image_camera),
        "images": rows.names_of("image", block.images),
        "points": rows.names_of("point", block.points),
    }
    mask = np.ones(shape, bool)
    for what, names in known.items():
        wanted = getattr(selection, what)
        wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
        if missing := set(wanted) - set(names.ravel().tolist()):
            raise InputError(f"{label}: no row of {selection.group} is of the {what} {', '.join(sorted(missing))}")
        if wanted:
            mask &= np.broadcast_to(np.isin(names, wanted), shape)
    return mask


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
