"""Least-squares adjustment: from block, start values and priors to unknowns and normal equations."""

import dataclasses
import functools
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.arguments import check_arguments, check_residuals
from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.iteration_log import log_iterations
from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock, pad_structure
from jaxphoto.adjustment.layout.rays import MINIMAL_SIZES, PaddedSizes, sizes_of
from jaxphoto.adjustment.model.block_values import unknowns_of, values_of, with_datum, with_start
from jaxphoto.adjustment.model.numbers import UnknownArrays, Values, state_at, zero_increments
from jaxphoto.adjustment.model.structure import ObservedRows, Structure, observed_in, structure_of
from jaxphoto.adjustment.normal_equations import NormalEquations, optimise
from jaxphoto.adjustment.precision_check import warn_of_precision_loss
from jaxphoto.adjustment.rank import check_priors, check_rank
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.adjustment.solver.elimination import FactoredNormal
from jaxphoto.adjustment.solver.levenberg_marquardt import IterationHistory, to_factor, to_optimum, zero_system
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import unit_scale, weigh_datum
from jaxphoto.adjustment.solver.similarity import n_open_motions
from jaxphoto.arrays import gathered, is_float, is_traced, to_numpy
from jaxphoto.block import Block
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.compiling.lru_cache import LruCache
from jaxphoto.devices import usable
from jaxphoto.errors import InputError
from jaxphoto.losses import AbstractLoss
from jaxphoto.static_values import Content
from jaxphoto.unknowns import Unknowns

MAX_STEPS = 100


def solve(
    block: Block,
    start: Unknowns,
    priors: Unknowns,
    max_steps: int = MAX_STEPS,
    sizes: PaddedSizes = MINIMAL_SIZES,
    meanwhile: Callable[[NormalEquations, dict[str, float]], None] = lambda equations, seconds: None,
    losses: Mapping[str, AbstractLoss] = MappingProxyType({}),
) -> Adjustment:
    """Adjust `block` by least squares from `start`; `priors` specifies which unknowns are free.

    A pure function of the arrays in its arguments. `jax.grad`, `jax.jvp` and `jax.vmap` apply (exactly, by the implicit
    function theorem), with concrete ids and index arrays. `start` requires all images and points; `jaxphoto.adjust`
    computes missing ones first.

    `sizes` are minimum padded sizes (`common_sizes`). `meanwhile` is called during compilation with the abstract result
    and its times, to `prepare` further programs.

    `losses` replace squared residuals by group of observations. The unknowns then minimise the total loss. Residuals
    and normal equations of the result are evaluated at this optimum without losses: `jaxphoto.robust` computes
    statistics from them.

    Raises DatumError if the datum is determined neither by observations nor by constraints, RankError if the
    observations do not determine an unknown or cannot separate unknowns.
    """
    laid = build_problem(block, start, priors, sizes)
    if not laid.traced and is_traced(block.start.unknowns):
        # The result does not depend on block.start: its derivative would silently be zero.
        raise InputError(
            "a JAX transformation traces block.start, but the argument start replaces it: change start, or omit it"
        )
    numbers, plain = laid.padded_values, laid.padded.structure
    structure = plain.with_losses(losses)
    seconds: dict[str, float] = {}
    history: IterationHistory | None = None
    if laid.traced:
        # Stored with the layout, where it is already hashed.
        padded = dataclasses.replace(laid.padded, structure=structure) if losses else laid.padded
        found, state = _differentiable(numbers, padded, max_steps)
    else:
        arguments = (numbers, structure, to_optimum(max_steps))
        # Compile the slowest program first; trace the others meanwhile.
        if prepare(_optimise, arguments, seconds):
            prepare(_residuals, (numbers, plain), seconds)
            meanwhile(NormalEquations(numbers, plain, _factored_like(numbers, plain)), seconds)
        found = run_compiled(_optimise, arguments, seconds, "solve")
        # Arrays returned by several devices have a different type from those passed in.
        state = UnknownArrays(*map(to_numpy, found.state))
        history = IterationHistory(*(to_numpy(v)[: int(found.steps)] for v in found.history))
    steps, converged = found.steps, found.converged
    assert steps is not None and converged is not None, "only of a tangent is this unknown"
    # Discard the normal equations: they are the largest array and can be recomputed.
    del found
    adjusted = _at(state, laid, block, start, priors, seconds)
    adjusted = dataclasses.replace(adjusted, steps=steps, converged=converged, history=history, sizes=sizes)
    if laid.traced:
        return adjusted
    # Concrete arrays, also inside a traced function.
    with jax.ensure_compile_time_eval():
        log_iterations(adjusted)
        check_residuals(block, adjusted.residuals.named)
        if adjusted.diverged_points.any():
            return dataclasses.replace(adjusted, converged=np.array(False))
        check_rank(adjusted)
    return adjusted


@functools.partial(jax.jit, static_argnums=(1, 2))
def _differentiable(values: PaddedValues, padded: PaddedBlock, max_steps: int) -> Any:
    """Return the optimum and its state as one program: without it, derivatives would compile every operation
    separately.
    """
    from jaxphoto.adjustment.implicit import find_optimum
    from jaxphoto.adjustment.vmap_rule import image_row_lists

    s = padded.structure
    found = find_optimum(weigh_datum(values, s), s, to_optimum(max_steps), image_row_lists(padded))
    return found, state_at(found.increments, unit_scale(s), values, s)


def linearise(block: Block, unknowns: Unknowns, priors: Unknowns, sizes: PaddedSizes = MINIMAL_SIZES) -> Adjustment:
    """Evaluate residuals and normal equations of `block` at `unknowns`, which need not be its optimum.

    Used to evaluate all observations after an adjustment of a subset. Raises the errors that `solve` raises before it
    computes.
    """
    laid = build_problem(block, unknowns, priors, sizes)
    v = laid.padded_values
    return _at(UnknownArrays(v.position, v.rotation, v.shared, v.points), laid, block, unknowns, priors, {})


def _at(state: UnknownArrays, laid: "Problem", block: Block, start: Unknowns, priors: Unknowns, seconds) -> Adjustment:
    """Evaluate residuals and normal equations at `state`."""
    padded, numbers = laid.padded, with_start(laid.padded_values, state)
    structure, factored = padded.structure, None
    # Statistics require the factored normal matrix. Derivatives of the unknowns do not: omit it there.
    if not laid.traced:
        again = run_compiled(_optimise, (numbers, structure, to_factor()), seconds, "covariance")
        factored = gathered(again.factored)
        del again
    residuals = run_compiled(_residuals, (numbers, structure), seconds, "residuals")
    state = padded.crop_state(state)
    return Adjustment(
        block=block,
        priors=priors,
        unknowns=unknowns_of(state, start, padded.own),
        residuals=padded.crop_residuals(residuals),
        values=with_start(laid.values, state),
        padded=padded,
        padded_values=numbers,
        factored=factored,
        steps=np.array(0),
        converged=np.array(False),
        seconds=seconds,
    )


class Problem(NamedTuple):
    """Problem to solve: index arrays and values, in block order and padded."""

    padded: PaddedBlock
    values: Values
    padded_values: PaddedValues

    @property
    def traced(self) -> bool:
        """True if a JAX transformation traces any value."""
        return is_traced(self.values)


def build_problem(
    block: Block, start: Unknowns, priors: Unknowns, sizes: PaddedSizes = MINIMAL_SIZES, alone: bool = False
) -> Problem:
    """Constrain the datum of a block and pad it; for one device if `alone`.

    Raises the errors that `solve` raises before it computes.
    """
    check_arguments(block, start, priors)
    check_priors(block, priors)
    warn_of_precision_loss(block, start, priors)
    observed = observed_in(block, priors)
    structure, padded_blocks = _layouts.get(
        _layout_key(block, priors, observed), lambda: (structure_of(block, priors, observed), {})
    )
    values = values_of(block, start, priors, structure, observed)
    constraints = close_datum(block, values, structure)
    values = with_datum(values, constraints.eop, constraints.points)
    constrained, coupled = len(constraints.eop) > 0, bool(structure.coupled)
    # Use one device: such rows may couple points of two devices, and the closed form of the constraints in statistics
    # is valid only for undetermined motions.
    alone = alone or is_traced(values) or coupled or (constrained and not n_open_motions(values, structure))
    shards = 1 if alone else _devices_worth_using(len(structure.image))
    dense = constrained or coupled
    key = sizes, shards, dense
    if key not in padded_blocks:
        padded_blocks[key] = pad_structure(structure, sizes, shards=shards, dense=dense)
    padded = padded_blocks[key]
    return Problem(padded, values, padded.pad(values))


# Cache several layouts, as a study may alternate between a few blocks. Index arrays of 1,000 images and a million image
# points take 30 MB.
_LAYOUTS = 4
_layouts: LruCache[tuple[Structure, dict[Hashable, PaddedBlock]]] = LruCache(_LAYOUTS)


def _layout_key(block: Block, priors: Unknowns, observed: ObservedRows) -> Hashable:
    """Return all properties that determine a layout: ids, indices, free parameters and shapes, without values."""
    leaves, tree = jax.tree.flatten((block, priors))
    # JAX sorts dictionary keys, but unknowns require insertion order.
    order = tuple(entry.label for entry in observed.entries)
    return tree, order, *(np.shape(v) if is_float(v) else Content(np.asarray(v)) for v in leaves)


def _factored_like(values: PaddedValues, structure: PaddedStructure) -> FactoredNormal:
    """Return abstract arrays of the right types, without allocating memory."""
    zero = jax.eval_shape(lambda: zero_increments(structure))
    system = jax.eval_shape(zero_system, zero, values, structure)
    reduced, factor, scale = jax.tree.map(
        lambda v: np.broadcast_to(0.0, v.shape), (system.reduced, system.factor, zero)
    )
    return FactoredNormal(reduced, factor, scale)


# Minimum number of image rows per device; with fewer, communication takes longer than computation.
_ROWS_PER_DEVICE = 20_000


def _devices_worth_using(rows: int) -> int:
    return usable(rows // _ROWS_PER_DEVICE)


def common_sizes(blocks: Iterable[Block]) -> PaddedSizes:
    """Return sizes that fit all `blocks`: with them, `solve` compiles once for blocks that differ only in values."""
    return functools.reduce(operator.or_, (sizes_of(structure_of(b, b.priors)) for b in blocks), MINIMAL_SIZES)


_optimise = eqx.filter_jit(optimise)


@eqx.filter_jit
def _residuals(values: PaddedValues, structure: PaddedStructure) -> PaddedResiduals:
    s = structure.on_one_device
    return Linearised(zero_increments(s), unit_scale(s), values, s).residuals()
