"""Variance components of parts of the observations, by restricted maximum likelihood (REML).

Partition. Parts are defined by splitting the groups of observations, or by selecting observations for each label:

    variance_components(adjusted, ("xy-z", "camera"))
    variance_components(adjusted, {"height": Selection("control_points", axes="Z"), "GNSS": Selection("stations")})

Prior information (`Weighted`, `KnownParameters`) is not a sample and retains its weight.

Partial redundancy. With R = I - H, H = J Q J' of whitened observations, and R_kl the block of the rows of part k and
the columns of part l,

    S_kl = tr(R_k R_l) = |R_kl|^2 (sum of squares),    r_k = tr R_kk = sum_l S_kl,    E[v_k' P_k v_k] = sum_l S_kl s_l

where s_l is the variance factor of part l; the second follows because R is idempotent. Off the diagonal |R_kl| = |H_kl|
is computed from products H z (`HatMatrix`). For a small part it is exact, with every unit vector of part k as z. For a
large part it is the mean of |H_l z|^2 over vectors z of random signs in part k (Hutchinson). Its standard deviation is
below sqrt(S_kl / (2 p)) for p vectors, because no singular value of an off-diagonal block of a projector exceeds 1/2.
The diagonal follows from the redundancy numbers, which are exact, and so does the largest part, which needs no vectors.
If that part contains all image points, their rows are skipped: |H z|^2 = z'H z gives their sum.

Variance components. With v_k' P_k v_k and S at the current weights, Helmert's step is

    s = S^-1 q,    q_k = v_k' P_k v_k,    covariance 2 S^-1.

The sigmas of part k are multiplied by sqrt(s_k) and the block is readjusted (half the step after an overshoot), until
all s_k are one: then q_k = r_k for every part, the equation of restricted maximum likelihood. The components are exact,
because r_k is; only their standard deviations depend on random vectors, through S. If a step gives a variance that is
not positive, Förstner's step s_k = q_k / r_k is used.

Sources: F. R. Helmert, Die Ausgleichungsrechnung (1907); W. Förstner, Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten (1979); K. R. Koch, Parameter Estimation and Hypothesis Testing in Linear Models (1999), 3.6; H. D.
Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58 (1971); M. F.
Hutchinson (1989), A stochastic estimator of the trace of the influence matrix.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxphoto.adjustment import MAX_STEPS, Adjustment, solve
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import InputError, counted, few
from jaxphoto.observations import AXES, AbstractObservations, Correlated, ImagePoints
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.covariance import covariance
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.reliability import redundancy_numbers
from jaxphoto.tracing import outside_transformations


@pretty_repr
class Selection(NamedTuple):
    """Observations of one group: all of them, or only some axes, cameras, images or points."""

    group: str
    axes: Collection[str] = ()
    cameras: Collection[str] = ()
    images: Collection[str] = ()
    points: Collection[str] = ()


@pretty_repr
class Parts(NamedTuple):
    """Partition of the observations of one adjustment."""

    labels: tuple[str, ...]
    part_of: dict[str, Int[np.ndarray, "..."]]
    """Part of every observation by group name, shaped like the residuals. Observations without a part have the index
    `len(labels)`.
    """

    @property
    def counts(self) -> Int[np.ndarray, "parts"]:
        """Number of observations in each part."""
        parts = np.concatenate([np.ravel(v) for v in self.part_of.values()])
        return np.bincount(parts, minlength=len(self.labels) + 1)[: len(self.labels)]

    def only(self, labels: Sequence[str]) -> "Parts":
        """Return the parts `labels`; all other observations are without a part."""
        number = np.array([labels.index(k) if k in labels else len(labels) for k in (*self.labels, "")])
        return Parts(tuple(labels), {name: number[part] for name, part in self.part_of.items()})


Partition = Sequence[str] | Mapping[str, Selection | Sequence[Selection]] | Parts
"""Names of splits (`SPLITS`), the selections of each label, or parts. Without splits, each group is one part."""
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
"""Splits by name: X and Y versus Z; every axis; image points by camera; image points by image."""


def observed_rows(adjusted: Adjustment) -> dict[str, AbstractObservations]:
    """Return the groups of observations that can have variance components: all except prior information."""
    groups = observation_groups(adjusted)
    return {name: groups[name] for name in adjusted.block.named_observations}


def partition_observations(adjusted: Adjustment, partition: Partition) -> Parts:
    """Assign the observations of an adjustment to parts, in the order of the partition.

    Raises InputError for an unknown split, group or name, a label without observations, observations with two labels,
    and correlated rows in different parts.
    """
    if isinstance(partition, Parts):
        return partition
    rows = observed_rows(adjusted)
    if isinstance(partition, Mapping):
        names, labels = _selected(adjusted, rows, partition), tuple(partition)
    else:
        names = _split(adjusted, rows, partition)
        labels = tuple(dict.fromkeys(label for part in names.values() for label in part.ravel().tolist()))
    number = {"": len(labels)} | {label: k for k, label in enumerate(labels)}
    index = {name: np.full(np.shape(v), len(labels)) for name, v in adjusted.residuals.named.items()}
    return Parts(
        labels, index | {name: np.vectorize(number.__getitem__, otypes=[int])(part) for name, part in names.items()}
    )


def _split(adjusted: Adjustment, rows: Mapping[str, AbstractObservations], splits: Sequence[str]) -> dict[str, Names]:
    splits = (splits,) if isinstance(splits, str) else splits
    if unknown := [split for split in splits if split not in SPLITS]:
        raise InputError(f"unknown split {unknown[0]!r} of observations: choose among {', '.join(SPLITS)}")
    labels = {}
    for name, observations in rows.items():
        label = np.full(np.shape(adjusted.residuals[name]), name, object)
        for split in splits:
            names = SPLITS[split](observations, adjusted.block)
            if names is not None and len(set(names.ravel())) > 1:
                label = label + " " + names
        labels[name] = label
    return labels


def _selected(
    adjusted: Adjustment, rows: Mapping[str, AbstractObservations], partition: Mapping[str, Any]
) -> dict[str, Names]:
    labels = {name: np.full(np.shape(adjusted.residuals[name]), "", object) for name in rows}
    for label, selections in partition.items():
        for selection in [selections] if isinstance(selections, Selection) else selections:
            if selection.group not in rows:
                raise InputError(
                    f"{label}: group {selection.group!r} is not observed in this block or cannot have a variance "
                    f"component: choose among {', '.join(rows)}"
                )
            mask = _mask(label, selection, rows[selection.group], adjusted.block, labels[selection.group].shape)
            if twice := set(labels[selection.group][mask]) - {""}:
                raise InputError(f"{label} and {min(twice)} share observations: remove them from one of the two")
            labels[selection.group][mask] = label
        if not label or not any((part == label).any() for part in labels.values()):
            raise InputError(f"part {label!r} of the partition has no name or no observations: remove it")
    for name, observations in rows.items():
        if isinstance(observations, Correlated) and labels[name].ndim > 1 and (labels[name] != labels[name][:1]).any():
            raise InputError(f"{name}: correlated rows must share a variance component; select whole sets")
    return labels


def _mask(
    label: str, selection: Selection, rows: AbstractObservations, block: Block, shape: tuple[int, ...]
) -> np.ndarray:
    """Return the mask of the selected observations of a group. Raises InputError for names that no row has."""
    names_by_kind = {
        "axes": rows.axis_names(),
        "cameras": rows.names_of("image", block.image_camera),
        "images": rows.names_of("image", block.images),
        "points": rows.names_of("point", block.points),
    }
    mask = np.ones(shape, bool)
    for kind, names in names_by_kind.items():
        selected = getattr(selection, kind)
        selected = (selected,) if isinstance(selected, str) else tuple(selected)
        if missing := set(selected) - set(names.ravel().tolist()):
            raise InputError(f"{label}: no row of {selection.group} has the {kind} {', '.join(sorted(missing))}")
        if selected:
            mask &= np.broadcast_to(np.isin(names, selected), shape)
    return mask


PROBES = 64
"""Number of random vectors per part; parts with at most this many observations are computed exactly. Only the standard
deviations of the components depend on it: their error is below 1 % for parts with a redundancy of some tens.
"""


@pretty_repr
class PartialRedundancy(eqx.Module):
    """Redundancy by parts of a partition. The last element is for all observations without a part."""

    square_sums: Float[np.ndarray, "parts"]
    """Sums of squares v_k' P_k v_k."""
    redundancy: Float[np.ndarray, "parts"]
    """Redundancy r_k of each part; the sum is the total redundancy."""
    matrix: Float[np.ndarray, "parts parts"]
    """Matrix S of the module's docstring."""
    uncertainty: Float[np.ndarray, "parts parts"]
    """Upper bound of the standard deviation of each element of `matrix`; zero for exact elements."""


def partial_redundancy(adjusted: Adjustment, parts: Parts, probes: int = PROBES) -> PartialRedundancy:
    """Compute S, r and v'Pv by part, with `probes` random vectors for parts with more than `probes` observations."""
    n = len(parts.labels) + 1
    numbers = {k: np.asarray(v) for k, v in redundancy_numbers(adjusted, covariance(adjusted, rows=True)).named.items()}
    squares = {name: np.asarray(v) ** 2 for name, v in adjusted.residuals.named.items()}
    estimate, weight = _products(adjusted, parts, probes)
    # Use the better of two estimates, or the mean of two equally good ones.
    share = np.where(weight[:, None] == weight, 0.5, weight[:, None] > weight)
    off_diagonal = share * estimate + share.T * estimate.T
    np.fill_diagonal(off_diagonal, 0.0)
    redundancy = _by_part(numbers, parts, n)
    exact = np.maximum(weight[:, None], weight) == np.inf
    uncertainty = np.where(
        exact, 0.0, np.sqrt(off_diagonal / (2 * probes) * np.where(weight[:, None] == weight, 0.5, 1.0))
    )
    np.fill_diagonal(uncertainty, 0.0)
    return PartialRedundancy(
        square_sums=_by_part(squares, parts, n),
        redundancy=redundancy,
        matrix=off_diagonal + np.diag(redundancy - off_diagonal.sum(axis=1)),
        uncertainty=uncertainty + np.diag(np.sqrt((uncertainty**2).sum(axis=1))),
    )


def _by_part(numbers: dict[str, np.ndarray], parts: Parts, n: int) -> Float[np.ndarray, "parts"]:
    pairs = ((index, numbers[name]) for name, index in parts.part_of.items())
    return np.sum([np.bincount(np.ravel(index), np.ravel(v), minlength=n) for index, v in pairs], axis=0)


def _products(adjusted: Adjustment, parts: Parts, probes: int) -> tuple[np.ndarray, np.ndarray]:
    """Estimate |H_kl|^2 off the diagonal by row, and the weight of each row.

    The weight is infinite for exact rows and zero for the largest part.
    """
    n = len(parts.labels) + 1
    largest = int(np.argmax(sum(np.bincount(np.ravel(index), minlength=n) for index in parts.part_of.values())))
    # The largest part gets no vectors. If it contains all image points, its |Hz|^2 is z'Hz minus the other parts.
    skip_images = all((index == largest).all() for name, index in parts.part_of.items() if name == ImagePoints.group)
    hat_matrix = HatMatrix.of(adjusted, image_rows=not skip_images)
    # Index n: datum constraints.
    part = np.full(hat_matrix.count, n)
    for name, place in hat_matrix.places.items():
        part[place] = parts.part_of[name]
    at = [np.flatnonzero(part == k) for k in range(n)]
    weight = np.array([np.inf if len(places) <= probes else 1.0 for places in at])
    weight[largest] = 0.0
    # Observation index of each unit vector of a part; -1 for vectors of random signs.
    units = [places if w == np.inf else np.full((w > 0) * probes, -1) for places, w in zip(at, weight, strict=True)]
    part_of_unit, unit = np.repeat(np.arange(n), [len(u) for u in units]), np.concatenate(units)

    def vector(k: int) -> Float[np.ndarray, "n"]:
        z, support = np.zeros(hat_matrix.count), at[part_of_unit[k]] if unit[k] < 0 else unit[k : k + 1]
        z[support] = np.random.default_rng(k).choice([-1.0, 1.0], len(support)) if unit[k] < 0 else 1.0
        return z

    squares = np.zeros((n, n))
    for j, (_, h) in enumerate(hat_matrix.apply(vector, len(part_of_unit))):
        by_part = np.bincount(part, h**2, minlength=n + 1)
        if skip_images:
            # Clip at zero: rounding may make the difference negative for a part that is nearly independent of the
            # largest.
            by_part[largest] = max(0.0, vector(j) @ h - by_part.sum() + by_part[largest])
        squares[part_of_unit[j]] += by_part[:n]
    return squares / np.where(weight == 1.0, probes, 1.0)[:, None], weight


MAX_ITERATIONS = 60
MIN_DEGREES = 2.0
"""Degrees of freedom at which the standard deviation of a component equals the component. With at most this many
degrees of freedom it does not differ significantly from zero, and its weight 1 / s has no mean.
"""
# Maximum factor of a variance per iteration: S changes with larger factors.
_MAX_FACTOR = 4.0
# Convergence limit: maximum change of a component in its standard deviations.
_TOLERANCE = 1e-3
# Number of iterations with too few degrees of freedom and a decreasing variance after which a component is diagnosed as
# zero.
_MAX_DECREASES = 3
# Redundancy below which a part is uncontrolled: smaller values are rounding errors.
_UNCHECKED = 1e-6
# Minimum eigenvalue of S, scaled to a unit diagonal; smaller values are rounding errors.
_SINGULAR = 1e-10


@pretty_repr
class VarianceComponents(eqx.Module):
    """Variance components of the parts of a partition, and the adjustment with them.

    `factor` multiplies the a priori variances, sqrt(factor) the standard deviations. A part that does not support a
    component keeps its a priori standard deviations (factor 1, sigma NaN); `warnings` gives the reason.
    """

    labels: tuple[str, ...] = eqx.field(static=True)
    factor: Float[np.ndarray, "parts"]
    sigma: Float[np.ndarray, "parts"]
    """Standard deviations of the factors; NaN for unsupported parts."""
    correlation: Float[np.ndarray, "parts parts"]
    """Correlation matrix of the factors; NaN for unsupported parts."""
    observations: Int[np.ndarray, "parts"]
    redundancy: Float[np.ndarray, "parts"]
    """Redundancy of each part in the adjustment with the components."""
    sigma_uncertainty: Float[np.ndarray, "parts"]
    """Relative standard deviations of `sigma` due to random vectors; zero for exact traces."""
    supported: Bool[np.ndarray, "parts"]
    warnings: dict[str, str] = eqx.field(static=True)
    """Reason and advice for each part that does not support a component."""
    adjusted: Adjustment
    """Converged adjustment of the block with standard deviations multiplied by sqrt(factor)."""
    iterations: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)

    @property
    def degrees(self) -> Float[np.ndarray, "parts"]:
        """Degrees of freedom of the factors: 2 / variance, as for chi-square divided by its degrees of freedom."""
        return 2 * (self.factor / self.sigma) ** 2

    @property
    def sigma_factors(self) -> dict[str, float]:
        """Factors of the standard deviations of the supported parts, by label."""
        of_parts = zip(self.labels, np.sqrt(self.factor).tolist(), self.supported, strict=True)
        return {label: factor for label, factor, supported in of_parts if supported}

    @property
    def words(self) -> str:
        """The factors of the standard deviations in words."""
        # sigma of a factor of the variance is 2 sqrt(factor) times that of its root.
        sigma = dict(zip(self.labels, (self.sigma / np.sqrt(self.factor) / 2).tolist(), strict=True))
        pairs = self.sigma_factors.items()
        factors = few([f"{label.replace('_', ' ')} {f:.3g} +- {sigma[label]:.2g}" for label, f in pairs])
        return f"standard deviations are estimated from the residuals, times the stated ones: {factors}"


class _Step(NamedTuple):
    """Helmert's step of the estimated parts at the current weights, where every factor is one."""

    change: Float[np.ndarray, "free"]
    """Change s - 1 of the factors."""
    covariance: Float[np.ndarray, "free free"]
    """Covariance 2 S^-1 of the factors."""

    @property
    def sigma(self) -> Float[np.ndarray, "free"]:
        """Standard deviations of the factors."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def is_weak(self) -> Bool[np.ndarray, "free"]:
        """True for parts with at most `MIN_DEGREES` degrees of freedom."""
        return self.sigma**2 >= 2 / MIN_DEGREES

    @property
    def decreases(self) -> Bool[np.ndarray, "free"]:
        """True for a weak part whose variance decreases while all other parts are near their optimum."""
        moving = ~self.is_weak & (np.abs(self.change) > self.sigma)
        return self.is_weak & (self.change < 0) & ~moving.any()


@outside_transformations
def variance_components(
    adjusted: Adjustment,
    partition: Partition = ("xy-z",),
    *,
    max_iterations: int = MAX_ITERATIONS,
    max_steps: int = MAX_STEPS,
    probes: int = PROBES,
) -> VarianceComponents:
    """Estimate a variance component for every part of the observations, and adjust with them.

    `partition`: names of splits (`SPLITS`; without splits, each group is one part), or observations by label
    (`Selection`). Prior information and observations without a label retain their weight. A component that does not
    differ from zero (at most `MIN_DEGREES` degrees of freedom) is not estimated. Traces use `probes` random vectors for
    parts with more than `probes` observations.

    Raises InputError for an adjustment that has not converged, an invalid partition, and a number of iterations or
    random vectors below one.
    """
    if max_iterations < 1 or probes < 1:
        raise InputError(f"max_iterations and probes must be positive, got {max_iterations} and {probes}")
    if not bool(adjusted.converged):
        raise InputError(
            f"adjustment is {adjusted.outcome.value}; adjust to convergence before estimating variance components"
        )
    block, priors, sizes = adjusted.block, adjusted.priors, adjusted.sizes
    parts = partition_observations(adjusted, partition)
    factor, free = np.ones(len(parts.labels)), np.ones(len(parts.labels), bool)
    warnings: dict[str, str] = {}
    decreases, last, iterations, converged = np.zeros(len(factor), int), np.zeros(len(factor)), 0, False
    while iterations < max_iterations:
        iterations += 1
        current = partial_redundancy(adjusted, parts, probes)
        step = _helmert(current, free)
        converged = bool((np.abs(step.change) <= _TOLERANCE * step.sigma).all())
        decreases[free] = np.where(step.decreases, decreases[free] + 1, 0)
        weak = _unsupported(parts, factor, free, decreases, current, step, converged)
        if converged and weak is None:
            break
        before = factor.copy()
        if weak is not None:
            k, warnings[parts.labels[k]] = weak
            factor[k], free[k] = 1.0, False
        else:
            # Halve the step after an overshoot: the residuals of small parts respond nonlinearly.
            change = np.where(step.change * last[free] < 0, step.change / 2, step.change)
            factor[free] *= _positive(change, current, free)
            last[free] = step.change
        converged = False
        if (factor != before).any():
            # Release the last adjustment (hundreds of MB for a large block) before the next one.
            unknowns, adjusted = adjusted.unknowns, None  # type: ignore[assignment]
            adjusted = solve(_reweighted(block, parts, factor), unknowns, priors, max_steps, sizes)
        if not bool(adjusted.converged):
            break
    return _result(parts, factor, free, warnings, adjusted, current, iterations, converged)


def _helmert(current: PartialRedundancy, free: np.ndarray) -> _Step:
    """Compute Helmert's step of the `free` parts. Parts that S cannot separate get a large standard deviation."""
    s = current.matrix[:-1, :-1][np.ix_(free, free)]
    unit = 1 / np.sqrt(np.maximum(np.diagonal(s), _UNCHECKED**2))
    value, vector = np.linalg.eigh(s * unit[:, None] * unit)
    inverse = (vector / np.maximum(value, _SINGULAR)) @ vector.T * unit[:, None] * unit
    return _Step(inverse @ (current.square_sums - current.redundancy)[:-1][free], 2 * inverse)


def _unsupported(
    parts: Parts,
    factor: np.ndarray,
    free: np.ndarray,
    decreases: np.ndarray,
    current: PartialRedundancy,
    step: _Step,
    converged: bool,
) -> tuple[int, str] | None:
    """Return the part with the weakest unsupported component, if any, and the warning.

    Only one part is removed at a time: without it, others may become separable. Before convergence the standard
    deviation is not a criterion: a part with far too small a priori sigmas has little redundancy at first.
    """
    candidates = np.flatnonzero(free).tolist()
    if not candidates:
        return None
    least = min(candidates, key=lambda k: current.redundancy[k])
    if current.redundancy[least] < _UNCHECKED:
        return least, _warning(parts, least, "no other observation checks it")
    rejected = step.is_weak & (converged | (decreases[free] >= _MAX_DECREASES))
    if not rejected.any():
        return None
    worst = int(np.argmax(np.where(rejected, step.sigma, 0.0)))
    k, sigma = candidates[worst], factor[free][worst] * step.sigma[worst]
    estimate = f"its estimate {factor[k]:.2g} has the standard deviation {sigma:.2g}"
    return k, _warning(parts, k, f"{estimate}, with redundancy {current.redundancy[k]:.2g}")


def _warning(parts: Parts, k: int, reason: str) -> str:
    return (
        f"{parts.labels[k]} ({counted(parts.counts[k], 'observation')}) cannot support a variance component: {reason}; "
        "its a priori standard deviations are kept, join it with another part or observe more"
    )


def _positive(change: np.ndarray, current: PartialRedundancy, free: np.ndarray) -> np.ndarray:
    """Return the factors of the variances: Helmert's components, or Förstner's if these are not positive."""
    foerstner = current.square_sums[:-1][free] / current.redundancy[:-1][free]
    return np.clip(np.where(change > -1, 1 + change, foerstner), 1 / _MAX_FACTOR, _MAX_FACTOR)


def _reweighted(block: Block, parts: Parts, factor: np.ndarray) -> Block:
    """Return the block with its variances multiplied by `factor`."""
    scale = np.sqrt(np.append(factor, 1.0))

    def scaled(name: str, rows: AbstractObservations) -> AbstractObservations:
        return rows.with_sigmas_times(scale[parts.part_of[name]].T.reshape(np.shape(rows.sigmas)))

    return block.with_observations({name: scaled(name, rows) for name, rows in block.named_observations.items()})


def _result(
    parts: Parts,
    factor: np.ndarray,
    free: np.ndarray,
    warnings: dict[str, str],
    adjusted: Adjustment,
    current: PartialRedundancy,
    iterations: int,
    converged: bool,
) -> VarianceComponents:
    step, n = _helmert(current, free), len(factor)
    sigma, uncertainty, correlation = (np.full(shape, np.nan) for shape in (n, n, (n, n)))
    sigma[free] = factor[free] * step.sigma
    correlation[np.ix_(free, free)] = step.covariance / step.sigma[:, None] / step.sigma
    # d(S^-1) = -S^-1 dS S^-1; every off-diagonal element of S occurs twice.
    products = (step.covariance[:, :, None] * step.covariance[:, None]) ** 2 / 4
    spread = np.einsum("kij,ij->k", products, current.uncertainty[:-1, :-1][np.ix_(free, free)] ** 2)
    uncertainty[free] = np.sqrt(2 * spread) / (2 * step.sigma**2)
    return VarianceComponents(
        labels=parts.labels,
        factor=factor,
        sigma=sigma,
        correlation=correlation,
        observations=parts.counts,
        redundancy=current.redundancy[:-1],
        sigma_uncertainty=uncertainty,
        supported=free,
        warnings=warnings,
        adjusted=adjusted,
        iterations=iterations,
        converged=converged,
    )
