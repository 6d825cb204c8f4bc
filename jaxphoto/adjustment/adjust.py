"""The adjustment itself: block, start and priors in; unknowns with their normal equations out."""

import dataclasses
import functools
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.arguments import check_arguments
from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.implicit import find_optimum
from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock, pad_structure
from jaxphoto.adjustment.layout.rays import LEAST, Sizes, sizes_of
from jaxphoto.adjustment.lost_digits import warn_of_lost_digits
from jaxphoto.adjustment.model.block_values import unknowns_of, values_of, with_datum, with_start
from jaxphoto.adjustment.model.numbers import UnknownArrays, Values, state_at, zero_increments
from jaxphoto.adjustment.model.structure import ObservedRows, Structure, observed_in, structure_of
from jaxphoto.adjustment.normal_equations import NormalEquations, optimise
from jaxphoto.adjustment.rank import check_priors, check_rank
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.adjustment.side_by_side import image_row_lists
from jaxphoto.adjustment.solver.elimination import FactoredNormal
from jaxphoto.adjustment.solver.levenberg_marquardt import Course, to_factor, to_optimum, zero_system
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import unit_scale, weigh_datum
from jaxphoto.adjustment.solver.similarity import n_open_motions
from jaxphoto.adjustment.told import tell_course
from jaxphoto.arrays import gathered, is_float, is_traced, still
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
    sizes: Sizes = LEAST,
    meanwhile: Callable[[NormalEquations, dict[str, float]], None] = lambda equations, seconds: None,
    losses: Mapping[str, AbstractLoss] = MappingProxyType({}),
) -> Adjustment:
    """Least-squares adjustment of `block` from `start`, with what `priors` leaves free.

    A pure function of the numbers in its arguments: `jax.grad`, `jax.jvp` and `jax.vmap` go through it (by the implicit
    function theorem, exactly), as long as ids and index arrays stay concrete. `start` needs all images and points;
    `jaxphoto.adjust` finds what is missing first.

    `sizes` are sizes to compile for at least (`common_sizes`). `meanwhile` is called while the adjustment compiles,
    with arrays of the types that its result will have, to `prepare` what will be wanted of it, and with its seconds.

    `losses`, by group of observations, say what its rows cost in place of their squares. The unknowns are then where
    all costs together are least, while residuals and normal equations of the result are those of least squares there:
    `jaxphoto.robust` makes statistics of them.

    Raises DatumError where the observations leave the datum open and no constraint closes it, RankError where they
    do not see an unknown or cannot tell unknowns apart.
    """
    laid = lay_out(block, start, priors, sizes)
    if not laid.traced and is_traced(block.start.unknowns):
        # The result does not depend on them, and a derivative would be zero without a word.
        raise InputError(
            "a JAX transformation traces block.start, but the argument start was given and counts in its place: "
            "change start, or leave it out"
        )
    numbers, plain = laid.padded_values, laid.padded.structure
    structure = plain.with_losses(losses)
    seconds: dict[str, float] = {}
    course: Course | None = None
    if laid.traced:
        # As it is kept with the layout, it is hashed already.
        padded = dataclasses.replace(laid.padded, structure=structure) if losses else laid.padded
        found, state = _differentiable(numbers, padded, max_steps)
    else:
        arguments = (numbers, structure, to_optimum(max_steps))
        # The longest first: the others are traced while it compiles.
        if prepare(_optimise, arguments, seconds):
            prepare(_residuals, (numbers, plain), seconds)
            meanwhile(NormalEquations(numbers, plain, _factored_like(numbers, plain)), seconds)
        found = run_compiled(_optimise, arguments, seconds, "solve")
        # What comes back from several devices is of another type to a program than what went in.
        state = UnknownArrays(*map(still, found.state))
        course = Course(*(still(v)[: int(found.steps)] for v in found.course))
    steps, converged = found.steps, found.converged
    assert steps is not None and converged is not None, "only of a tangent is this unknown"
    # Its normal equations are the largest that there is, and made again.
    del found
    adjusted = _at(state, laid, block, start, priors, seconds)
    adjusted = dataclasses.replace(adjusted, steps=steps, converged=converged, course=course, sizes=sizes)
    if laid.traced:
        return adjusted
    # Numbers, also where a user's function around this is traced.
    with jax.ensure_compile_time_eval():
        tell_course(adjusted)
        if adjusted.astray.any():
            return dataclasses.replace(adjusted, converged=np.array(False))
        check_rank(adjusted)
    return adjusted


@functools.partial(jax.jit, static_argnums=(1, 2))
def _differentiable(values: PaddedValues, padded: PaddedBlock, max_steps: int) -> Any:
    """The optimum and the state there. Operation by operation, its derivatives would be a thousand programs."""
    s = padded.structure
    found = find_optimum(weigh_datum(values, s), s, to_optimum(max_steps), image_row_lists(padded))
    return found, state_at(found.increments, unit_scale(s), values, s)


def linearise(block: Block, unknowns: Unknowns, priors: Unknowns, sizes: Sizes = LEAST) -> Adjustment:
    """`block` where the unknowns are, not at its optimum: residuals and normal equations there, by `solve`'s programs.

    What an adjustment of some of the observations says of all of them. Raises what `solve` raises before it computes.
    """
    laid = lay_out(block, unknowns, priors, sizes)
    v = laid.padded_values
    return _at(UnknownArrays(v.position, v.rotation, v.shared, v.points), laid, block, unknowns, priors, {})


def _at(state: UnknownArrays, laid: "LaidOut", block: Block, start: Unknowns, priors: Unknowns, seconds) -> Adjustment:
    """All that an adjustment tells with the unknowns as they are in `state`."""
    padded, numbers = laid.padded, with_start(laid.padded_values, state)
    structure, factored = padded.structure, None
    # Statistics need the factored normal matrix; a derivative of the unknowns does not, and would pay for it dearly.
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


class LaidOut(NamedTuple):
    """A block as it is computed with: index arrays and numbers, as given and in padded sizes."""

    padded: PaddedBlock
    values: Values
    padded_values: PaddedValues

    @property
    def traced(self) -> bool:
        """Whether any number is traced by a transformation of JAX."""
        return is_traced(self.values)


def lay_out(block: Block, start: Unknowns, priors: Unknowns, sizes: Sizes = LEAST, alone: bool = False) -> LaidOut:
    """The block with its datum closed, in padded sizes; for one device where it is to be `alone`.

    Raises what `solve` raises before it computes.
    """
    check_arguments(block, start, priors)
    check_priors(block, priors)
    warn_of_lost_digits(block, start, priors)
    observed = observed_in(block, priors)
    structure, padded_blocks = _layouts.get(
        _layout_key(block, priors, observed), lambda: (structure_of(block, priors, observed), {})
    )
    values = values_of(block, start, priors, structure, observed)
    constraints = close_datum(block, values, structure)
    values = with_datum(values, constraints.eop, constraints.points)
    constrained, coupled = len(constraints.eop) > 0, bool(structure.coupled)
    # Such rows may join points of two devices; of constraints, statistics have only the open motions in closed form.
    alone = alone or is_traced(values) or coupled or (constrained and not n_open_motions(values, structure))
    shards = 1 if alone else _devices_worth_using(len(structure.image))
    dense = constrained or coupled
    key = sizes, shards, dense
    if key not in padded_blocks:
        padded_blocks[key] = pad_structure(structure, sizes, shards=shards, dense=dense)
    padded = padded_blocks[key]
    return LaidOut(padded, values, padded.pad(values))


# A study may alternate between a few blocks. The index arrays of 1,000 images and a million image points are 30 MB.
_LAYOUTS = 4
_layouts: LruCache[tuple[Structure, dict[Hashable, PaddedBlock]]] = LruCache(_LAYOUTS)


def _layout_key(block: Block, priors: Unknowns, observed: ObservedRows) -> Hashable:
    """Return all that a layout depends on: ids, indices, what is free, and shapes, but no value of a number."""
    leaves, tree = jax.tree.flatten((block, priors))
    # JAX sorts the keys of a dictionary, unknowns keep their order.
    order = tuple(entry.label for entry in observed.entries)
    return tree, order, *(np.shape(v) if is_float(v) else Content(np.asarray(v)) for v in leaves)


def _factored_like(values: PaddedValues, structure: PaddedStructure) -> FactoredNormal:
    """Arrays of the right types that take no memory."""
    zero = zero_increments(structure)
    system = jax.eval_shape(zero_system, zero, values, structure)
    reduced, factor, scale = jax.tree.map(
        lambda v: np.broadcast_to(0.0, v.shape), (system.reduced, system.factor, zero)
    )
    return FactoredNormal(reduced, factor, scale)


# Image rows that keep a device busy for longer than adding its sums to those of others takes.
_ROWS_PER_DEVICE = 20_000


def _devices_worth_using(rows: int) -> int:
    return usable(rows // _ROWS_PER_DEVICE)


def common_sizes(blocks: Iterable[Block]) -> Sizes:
    """Sizes that all of `blocks` fit into: `solve` with them compiles once for all that differ in numbers only."""
    return functools.reduce(operator.or_, (sizes_of(structure_of(b, b.priors)) for b in blocks), LEAST)


_optimise = eqx.filter_jit(optimise)


@eqx.filter_jit
def _residuals(values: PaddedValues, structure: PaddedStructure) -> PaddedResiduals:
    s = structure.on_one_device
    return Linearised(zero_increments(s), unit_scale(s), values, s).residuals()
