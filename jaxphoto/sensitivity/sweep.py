"""Sweep over designs: many simulated blocks, adjusted and evaluated by one compiled program.

A design is a simulated block with observations and true points. Strips, overlap, heights, control, standard deviations
and the numbers of images and points may differ between designs: blocks are padded to common sizes. The program runs
over the designs with `jax.lax.map`, in threads or workers, and returns the statistics of each design. Normal matrices
are not stored.
"""

import hashlib
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import (
    MAX_STEPS,
    NormalEquations,
    PaddedSizes,
    PaddedStructure,
    PaddedValues,
    SolveMode,
    build_problem,
    common_sizes,
    optimise,
    to_factor,
    to_optimum,
)
from jaxphoto.adjustment.model.block_values import with_start
from jaxphoto.adjustment.model.numbers import UnknownArrays
from jaxphoto.adjustment.rank import DEFECT
from jaxphoto.adjustment.weak_directions import POOR, Yardsticks, image_yardsticks, observed_yardsticks
from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block
from jaxphoto.compiling import run_compiled
from jaxphoto.devices import cores
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.initial.approximate import approximate
from jaxphoto.statistics.covariance import EOP_NAMES, Rotations, physical_covariance
from jaxphoto.statistics.determinability import corner_yardsticks, weakly_determined
from jaxphoto.unknowns import Unknowns
from jaxphoto.workers import in_parts

BATCH = 8
"""Number of designs per call of the program."""


class CheckPoints(NamedTuple):
    """Indices of check points in the padded arrays, and their true coordinates (m), NaN if unknown.

    `weight` is 1 for check points and 0 for padding.
    """

    point: Int[ArrayLike, "check"]
    weight: Float[ArrayLike, "check"]
    truth: Float[ArrayLike, "check 3"]


class PreparedDesign(NamedTuple):
    """Padded arrays of one design, with its labels and redundancy."""

    values: PaddedValues
    structure: PaddedStructure
    check: CheckPoints
    labels: tuple[str, ...]
    """Labels of the shared unknowns."""
    redundancy: int


class DesignStatistics(NamedTuple):
    """A priori statistics of one design, in metres, radians and the unknowns' own units."""

    converged: Bool[ArrayLike, ""]
    yards: Yardsticks
    """`adjustment.weak_directions.image_yardsticks`."""
    least_pivot: Float[ArrayLike, ""]
    """Smallest ratio of a pivot to its diagonal element: 1 for independent unknowns, 0 for a rank defect."""
    steps: Int[ArrayLike, ""]
    sum_of_squares: Float[ArrayLike, ""]
    """Weighted sum of squares v'Pv."""
    covariance: Float[ArrayLike, "shared shared"]
    exterior_variance: Float[ArrayLike, "6"]
    """Variances of X, Y, Z and three rotations, mean over the images."""
    mean_abs: Float[ArrayLike, "6 shared"]
    """Mean |rho| of X, Y, Z and three rotations with each shared unknown, over the images that the unknown affects."""
    max_abs: Float[ArrayLike, "6 shared"]
    point_variance: Float[ArrayLike, ""]
    """Largest variance of a coordinate of an object point."""
    check_variance: Float[ArrayLike, "3"]
    """Variance of computed coordinates, mean over the check points."""
    check_square: Float[ArrayLike, "3"]
    """Squared difference true - computed, mean over the check points."""


def prepare_design(block: Block, truth: Unknowns | None, sizes: PaddedSizes, n_check: int) -> PreparedDesign:
    """Add approximate values, datum and padding to `block`, as `jaxphoto.adjust` does.

    `sizes` and `n_check`, the padded number of check points, are common to all designs. Raises BlockError, DatumError
    and RankError as `jaxphoto.adjust` does.
    """
    problem = build_problem(block, approximate(block), block.priors, sizes, alone=True)
    s, constraints = problem.padded.own, len(problem.values.datum_eop)
    points = np.unique(block.check.who)
    check = CheckPoints(np.zeros(n_check, np.int32), np.zeros(n_check), np.full((n_check, 3), np.nan))
    check.point[: len(points)], check.weight[: len(points)] = problem.padded.places.point[points], 1.0
    if truth is not None:
        check.truth[: len(points)] = np.asarray(truth.points)[points]
    observed = 2 * len(s.image) + sum(g.components * g.n_rows for g in s.observed) + constraints
    unknown = s.n_shared + s.eop_free.sum() + s.point_free.sum()
    return PreparedDesign(problem.padded_values, problem.padded.structure, check, s.labels, int(observed - unknown))


def group_by_program(designs: Sequence[PreparedDesign]) -> list[list[int]]:
    """Group the indices of designs by compiled program."""
    groups: dict[object, list[int]] = {}
    for k, design in enumerate(designs):
        groups.setdefault(_program(design), []).append(k)
    return list(groups.values())


def _program(design: PreparedDesign) -> tuple:
    """Return what determines the program of a design: types of arrays, and all other values."""
    arrays, rest = eqx.partition((design.values, design.structure), eqx.is_array)
    types = tuple((v.shape, v.dtype.str) for v in jax.tree.leaves(arrays))
    return types, jax.tree.structure(arrays), tuple(jax.tree.leaves(rest))


def evaluate(
    designs: Sequence[PreparedDesign], rotations: Rotations, max_steps: int, seconds: dict[str, float]
) -> DesignStatistics:
    """Compute the statistics of designs of one program, as NumPy arrays with a leading axis over the designs."""
    parts = []
    for begin in range(0, len(designs), BATCH):
        valid = begin + np.arange(BATCH) < len(designs)
        batch = [designs[k] for k in np.where(valid, begin + np.arange(BATCH), begin)]
        arrays = jax.tree.map(lambda *v: np.stack(v), *((d.values, d.structure, d.check) for d in batch))
        statistics = run_compiled(_evaluate, (*arrays, valid, rotations, max_steps), seconds, "designs")
        parts.append(jax.tree.map(lambda v: np.asarray(v)[valid], statistics))  # noqa: B023
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


@eqx.filter_jit
def _evaluate(
    values: PaddedValues,
    s: PaddedStructure,
    check: CheckPoints,
    valid: Array,
    rotations: Rotations,
    max_steps: int,
) -> DesignStatistics:
    arrays, rest = eqx.partition((values, s, check), eqx.is_array)

    # Nest jit in jit: traced once, for its shapes and for its values.
    @jax.jit
    def evaluate_one(arrays):
        values, s, check = eqx.combine(arrays, rest)
        return _statistics(values, s, check, rotations, max_steps)

    shapes = jax.eval_shape(evaluate_one, jax.tree.map(lambda v: v[0], arrays))
    zeros = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
    return jax.lax.map(lambda d: jax.lax.cond(d[1], evaluate_one, lambda _: zeros, d[0]), (arrays, valid))


def _statistics(
    values: PaddedValues, s: PaddedStructure, check: CheckPoints, rotations: Rotations, max_steps: int
) -> DesignStatistics:
    """Adjust, factorise at the optimum, and compute covariance and statistics."""

    def solve(start: UnknownArrays, task: SolveMode):
        optimum = optimise(with_start(values, start), s, task)
        return optimum.state, optimum

    # Solve to the optimum, then once more for the undamped factor; in a loop, so the code is compiled once.
    tasks = jax.tree.map(lambda *each: np.stack(each), to_optimum(max_steps), to_factor())
    start = UnknownArrays(values.position, values.rotation, values.shared, values.points)
    state, optima = jax.lax.scan(solve, start, tasks)
    at_optimum, factored = with_start(values, state), jax.tree.map(lambda v: v[1], optima.factored)
    equations = NormalEquations(at_optimum, s, factored)
    cofactors, _ = equations.cofactors(of_rows=False)
    covariance, points = physical_covariance(cofactors, equations.scale, at_optimum.rotation, rotations)

    n = 6 * s.n_images
    variance = jnp.maximum(jnp.diagonal(covariance), 0.0)
    inverse = jnp.where(variance > 0, 1 / jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    rho = jnp.abs(covariance[:n, n:] * inverse[:n, None] * inverse[n:]).reshape(s.n_images, 6, -1)
    touches = jnp.any(jnp.asarray(s.column)[:, :, None] == jnp.arange(s.n_shared), axis=1)
    rho = jnp.where(touches[:, None], rho, 0.0)
    free = (jnp.sum(jnp.asarray(s.eop_free), axis=0) > 0).astype(float)
    is_check, n_check = check.weight[:, None] > 0, jnp.sum(check.weight)
    error = check.truth - at_optimum.points[:, check.point].T
    return DesignStatistics(
        converged=optima.converged[0],
        yards=image_yardsticks(equations.scale),
        least_pivot=equations.least_pivot(),
        steps=optima.steps[0],
        sum_of_squares=equations.at.sum_of_squares(),
        covariance=covariance[n:, n:],
        exterior_variance=free @ variance[:n].reshape(-1, 6) / jnp.sum(free),
        mean_abs=jnp.sum(rho, axis=0) / jnp.sum(touches, axis=0),
        max_abs=jnp.max(rho, axis=0),
        point_variance=jnp.max(jnp.diagonal(points, axis1=1, axis2=2), initial=0.0),
        check_variance=check.weight @ jnp.diagonal(points[check.point], axis1=1, axis2=2) / n_check,
        check_square=jnp.sum(jnp.where(is_check, error**2, 0.0), axis=0) / n_check,
    )


class Design(NamedTuple):
    """Block with the parameters that distinguish it in its sweep, by name (`{"station_m": 0.1, "cross": True}`).

    `truth` contains the true coordinates of the check points (`simulation.Simulation.truth`); None if unknown.
    """

    parameters: Mapping[str, Any]
    block: Block
    truth: Unknowns | None = None


class Sweep(eqx.Module):
    """Standard deviations, correlations and check points of every design, with a leading axis over the designs.

    Standard deviations are a priori (sigma naught 1), in metres, radians, mm and the coefficients' own units.
    Quantities that a design lacks (a fixed unknown, check points) are NaN. All statistics of a design that did not
    converge or has a rank defect are NaN; those of a design with weakly determined unknowns are not.
    """

    parameters: tuple[Mapping[str, Any], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    """Parameter path of each shared unknown of any design, such as `interior[kodak].c_mm`."""
    eop_names: tuple[str, ...] = eqx.field(static=True)
    """Names of the exterior orientation elements: X, Y, Z and three rotations."""
    converged: Bool[np.ndarray, "designs"]
    determined: Bool[np.ndarray, "designs"]
    """False for designs with a rank defect or weakly determined unknowns."""
    weak: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """Weakly determined unknowns of each design, by the criteria of the verdict on an adjustment: labels, and `points`
    if a coordinate of an object point is weakly determined (`statistics.determinability`).
    """
    steps: Int[np.ndarray, "designs"]
    redundancy: Int[np.ndarray, "designs"]
    sigma0: Float[np.ndarray, "designs"]
    """Square root of the a posteriori variance factor of the simulated observations."""
    sigma: Float[np.ndarray, "designs shared"]
    correlation: Float[np.ndarray, "designs shared shared"]
    exterior_sigma: Float[np.ndarray, "designs 6"]
    """Standard deviations of the exterior orientation elements, root mean square over the images."""
    mean_abs: Float[np.ndarray, "designs 6 shared"]
    """Mean |rho| of each exterior orientation element with each shared unknown, over the images of its camera, mount or
    strip.
    """
    max_abs: Float[np.ndarray, "designs 6 shared"]
    check_sigma: Float[np.ndarray, "designs 3"]
    """Predicted standard deviation of X, Y, Z (m), root mean square over the check points."""
    check_rmse: Float[np.ndarray, "designs 3"]
    """Root mean square of true - computed X, Y, Z (m) of the check points, with the simulated observations."""
    programs: int = eqx.field(static=True)
    """Number of compiled programs."""
    seconds: dict[str, float] = eqx.field(static=True)
    """Time (s) of prepare (approximate values, padding), compile (or load) and designs (computation), summed over
    threads or workers.
    """

    def __len__(self) -> int:
        return len(self.parameters)


class _Evaluated(NamedTuple):
    """Designs of one part: labels, redundancy, program and statistics of each, and the time spent (s)."""

    labels: list[tuple[str, ...]]
    redundancy: list[int]
    program: list[str]
    statistics: list[DesignStatistics]
    seconds: dict[str, float]


class _Evaluation(NamedTuple):
    """Preparation and evaluation of designs; a study of `in_parts`."""

    sizes: PaddedSizes
    n_check: int
    rotations: Rotations
    max_steps: int

    def compute(self, part: Sequence[tuple[int, Design]]) -> _Evaluated:
        """Evaluate designs, with their numbers."""
        began, prepared = time.perf_counter(), list[PreparedDesign]()
        for k, design in part:
            try:
                prepared.append(prepare_design(design.block, design.truth, self.sizes, self.n_check))
            except JaxphotoError as error:
                raise type(error)(f"{_name(k, design)}: {error}") from error
        seconds = {"prepare": time.perf_counter() - began}
        statistics: dict[int, DesignStatistics] = {}
        for group in group_by_program(prepared):
            together = evaluate([prepared[k] for k in group], self.rotations, self.max_steps, seconds)
            statistics |= {k: jax.tree.map(lambda v, n=n: v[n], together) for n, k in enumerate(group)}
        labels, redundancy = [p.labels for p in prepared], [p.redundancy for p in prepared]
        program = [hashlib.sha256(repr(_program(p)).encode()).hexdigest() for p in prepared]
        return _Evaluated(labels, redundancy, program, [statistics[k] for k in range(len(part))], seconds)


def sweep(
    designs: Sequence[Design],
    rotations: Rotations = "omega_phi_kappa",
    *,
    max_steps: int = MAX_STEPS,
    client: Any = None,
) -> Sweep:
    """Adjust and evaluate every design, with the results of `adjust`, `covariance` and `correlations`.

    `rotations` selects the rotations of the correlations (see `jaxphoto.covariance`). One program serves all designs
    with the same unknowns shared by images (cameras, mounts, strips with shifts) and the same kinds of observations;
    further programs are compiled as needed. A design that does not converge is not an error: see `Sweep.converged`.
    `client`: a `dask.distributed.Client`, whose workers evaluate the designs (docs/cluster.md), with the same results.

    Raises InputError without designs, for parameter names or camera unknowns that differ between designs, and for a
    truth of another block. Raises the errors of `jaxphoto.adjust`, with the name of the design, for a design without
    datum, with an undetermined free unknown, or without approximate values.
    """
    _check(designs, rotations)
    n_check = max(len(np.unique(design.block.check.who)) for design in designs)
    study = _Evaluation(common_sizes(design.block for design in designs), n_check, rotations, max_steps)
    numbered = list(enumerate(designs))
    parts = [numbered[first : first + BATCH] for first in range(0, len(designs), BATCH)]
    found, seconds = {}, dict[str, float]()
    for number, result in in_parts(study, enumerate(parts), client, cores()):
        found[number] = result
        for name, spent in result.seconds.items():
            seconds[name] = seconds.get(name, 0.0) + spent
    every = [found[k] for k in range(len(parts))]
    labels_of = [labels for part in every for labels in part.labels]
    _check_cameras(designs, labels_of)
    labels = tuple(dict.fromkeys(label for of_design in labels_of for label in of_design))
    statistics = _with_labels([one for part in every for one in part.statistics], labels_of, labels)
    redundancy = np.array([n for part in every for n in part.redundancy])
    programs = len({program for part in every for program in part.program})
    return _sweep(designs, statistics, redundancy, labels, rotations, programs, seconds)


def _check(designs: Sequence[Design], rotations: Rotations) -> None:
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations must be one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    if not len(designs):
        raise InputError("a sweep needs at least one design: give a list of Design(parameters, block)")
    for k, design in enumerate(designs):
        if list(design.parameters) != list(designs[0].parameters):
            raise InputError(
                f"{_name(k, design)} has the parameters {_listed(design.parameters)}, but the first design has "
                f"{_listed(designs[0].parameters)}: give all designs of a sweep the same, in the same order"
            )
        n = len(design.block.points)
        if design.truth is not None and len(design.truth.points) != n:
            raise InputError(
                f"{_name(k, design)} has true coordinates of {len(design.truth.points)} points, but its block has {n}: "
                "give those of the same points, in the order of the block"
            )


def _check_cameras(designs: Sequence[Design], labels_of: Sequence[tuple[str, ...]]) -> None:
    """Raise InputError unless all designs have the same camera unknowns as the first."""
    parameters = [[label for label in labels if label.startswith("interior[")] for labels in labels_of]
    for k, labels in enumerate(parameters):
        if labels != parameters[0]:
            raise InputError(
                f"{_name(k, designs[k])} estimates {_listed(labels)}, but the first design "
                f"{_listed(parameters[0])}: give all designs of a sweep the same cameras with the same unknowns"
            )


def _with_labels(
    statistics: Sequence[DesignStatistics], labels_of: Sequence[tuple[str, ...]], labels: tuple[str, ...]
) -> DesignStatistics:
    """Stack statistics expanded to all `labels`; NaN for labels that a design lacks."""
    q, expanded = len(labels), list[DesignStatistics]()
    for one, own in zip(statistics, labels_of, strict=True):
        index = np.array([labels.index(label) for label in own], int)
        covariance, mean_abs, max_abs, shared = (np.full((*rows, q), np.nan) for rows in ((q,), (6,), (6,), ()))
        covariance[np.ix_(index, index)] = one.covariance
        mean_abs[:, index], max_abs[:, index], shared[index] = one.mean_abs, one.max_abs, one.yards.shared
        yards = one.yards._replace(shared=shared)
        expanded.append(one._replace(covariance=covariance, mean_abs=mean_abs, max_abs=max_abs, yards=yards))
    return jax.tree.map(lambda *v: np.stack(v), *expanded)


def _sweep(
    designs: Sequence[Design],
    statistics: DesignStatistics,
    redundancy: np.ndarray,
    labels: tuple[str, ...],
    rotations: Rotations,
    programs: int,
    seconds: dict[str, float],
) -> Sweep:
    converged = np.asarray(statistics.converged)
    valid = converged & (np.asarray(statistics.least_pivot) > DEFECT)

    def masked(values):
        """Replace values of invalid designs by NaN."""
        return np.where(valid.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)

    variance = np.maximum(np.diagonal(statistics.covariance, axis1=1, axis2=2), 0.0)
    sigma = masked(np.sqrt(variance))
    weak = tuple(
        _weak(design.block, statistics, labels, sigma[k], k) if valid[k] else () for k, design in enumerate(designs)
    )
    return Sweep(
        parameters=tuple(design.parameters for design in designs),
        labels=labels,
        eop_names=EOP_NAMES[rotations],
        converged=converged,
        determined=(np.asarray(statistics.least_pivot) > DEFECT) & np.array([not names for names in weak]),
        weak=weak,
        steps=np.asarray(statistics.steps),
        redundancy=redundancy,
        sigma0=masked(np.where(redundancy > 0, np.sqrt(statistics.sum_of_squares / np.maximum(redundancy, 1)), 1.0)),
        sigma=sigma,
        correlation=statistics.covariance / (sigma[:, :, None] * sigma[:, None, :]),
        exterior_sigma=masked(np.sqrt(statistics.exterior_variance)),
        mean_abs=masked(statistics.mean_abs),
        max_abs=masked(statistics.max_abs),
        check_sigma=masked(np.sqrt(statistics.check_variance)),
        check_rmse=masked(np.sqrt(statistics.check_square)),
        programs=programs,
        seconds=seconds,
    )


def _weak(
    block: Block, statistics: DesignStatistics, labels: tuple[str, ...], sigma: np.ndarray, k: int
) -> tuple[str, ...]:
    """Return the weakly determined unknowns of design `k`."""
    yards = observed_yardsticks(jax.tree.map(lambda v: np.asarray(v)[k], statistics.yards), block, labels)
    corner = corner_yardsticks(block, block.start.unknowns.interior, labels, yards)
    rho = np.asarray(statistics.max_abs)[k].max(axis=0)
    weak = weakly_determined(labels, sigma, yards, corner, rho)
    return (*weak, "points") if np.sqrt(statistics.point_variance[k]) > POOR * yards.ground else weak


def _name(k: int, design: Design) -> str:
    parameters = ", ".join(f"{name} {value}" for name, value in design.parameters.items())
    return f"design {k + 1} ({parameters})" if parameters else f"design {k + 1}"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "nothing"
