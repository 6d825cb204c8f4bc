"""The adjustment itself: block, start and priors in; unknowns with their normal equations out."""

import functools
import operator
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.layout import LEAST, Sizes, sizes_of
from jaxphoto.adjustment.normal import At, residuals_at
from jaxphoto.adjustment.optimum import Optimum, find_optimum, iterate, unit_scale, weigh_datum, zero_increments
from jaxphoto.adjustment.padding import crop_residuals, crop_state, pad_structure, pad_values
from jaxphoto.adjustment.precision import warn_of_lost_digits
from jaxphoto.adjustment.rank import check_priors, check_rank
from jaxphoto.adjustment.residuals import Residuals, State, Values, state_at
from jaxphoto.adjustment.result import Adjustment, Factored, Padded, Unfactored
from jaxphoto.adjustment.shards import gathered, on_one_device, usable
from jaxphoto.adjustment.similarity import open_motions
from jaxphoto.adjustment.solver import zero_system
from jaxphoto.adjustment.structure import Structure, observed_in, structure_of
from jaxphoto.adjustment.values import at_state, unknowns_of, values_of, with_datum
from jaxphoto.arrays import Numbers, still
from jaxphoto.block import Block
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.unknowns import Unknowns

MAX_STEPS = 100


def solve(
    block: Block,
    start: Unknowns,
    priors: Unknowns,
    max_steps: int = MAX_STEPS,
    sizes: Sizes = LEAST,
    meanwhile: Callable[[Padded, dict[str, float]], None] = lambda padded, seconds: None,
) -> Adjustment:
    """Least-squares adjustment of `block` from `start`, with what `priors` leaves free.

    A pure function of the numbers in its arguments: `jax.grad`, `jax.jvp` and `jax.vmap` go through it (by the implicit
    function theorem, exactly), as long as ids and index arrays stay concrete. `start` needs all images and points;
    `jaxphoto.adjust` finds what is missing first.

    `sizes` are sizes to compile for at least (`common_sizes`). `meanwhile` is called while the adjustment compiles,
    with arrays of the types that its result will have, to `prepare` what will be wanted of it, and with its seconds.

    Raises DatumError where the observations leave the datum open and no constraint closes it, RankError where they
    do not see an unknown or cannot tell unknowns apart.
    """
    check_priors(block, priors)
    warn_of_lost_digits(block, start)
    observed = observed_in(block, priors)
    structure = structure_of(block, priors, observed)
    values = values_of(block, start, priors, structure, observed)
    constraints = close_datum(block, concrete(values, block), structure)
    values = with_datum(values, constraints.eop, constraints.points)
    traced = any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(values))
    constrained, coupled = len(constraints.eop) > 0, bool(structure.coupled)
    # Such rows may join points of two devices; of constraints, statistics have only the open motions in closed form.
    alone = traced or coupled or (constrained and not open_motions(values, structure))
    shards = 1 if alone else _devices_worth_using(len(structure.image))
    wide, places = pad_structure(structure, sizes, shards=shards, dense=constrained or coupled)
    numbers = pad_values(values, structure, wide, places)
    seconds: dict[str, float] = {}
    padded = None
    if traced:
        optimum = find_optimum(weigh_datum(numbers, wide), structure=wide, max_steps=max_steps)
        state = state_at(optimum.increments, unit_scale(wide), numbers, wide)
    else:
        arguments = (numbers, wide, max_steps, np.array(False))
        # The longest first: the other is traced while it compiles.
        prepare(_optimise, arguments, seconds)
        prepare(_residuals, (numbers, wide), seconds)
        meanwhile(Padded(wide, numbers, _factored_like(numbers, wide), places), seconds)
        optimum, state, _ = run_compiled(_optimise, arguments, seconds, "solve")
        # What comes back from several devices is of another type to a program than what went in.
        state = State(*map(still, state))
    numbers = at_state(numbers, state)
    # Statistics need the factored normal matrix; a derivative of the unknowns does not, and would pay for it dearly.
    if not traced:
        _, _, factored = run_compiled(_optimise, (numbers, wide, max_steps, np.array(True)), seconds, "covariance")
        padded = Padded(wide, numbers, gathered(factored), places)
    residuals = run_compiled(_residuals, (numbers, wide), seconds, "residuals")
    state = crop_state(state, places)
    adjusted = Adjustment(
        block=block,
        priors=priors,
        unknowns=unknowns_of(state, start, structure),
        residuals=crop_residuals(residuals, structure, places),
        values=at_state(values, state),
        structure=structure,
        padded=padded,
        unfactored=Unfactored(wide, numbers, places) if padded is None else None,
        steps=optimum.steps,
        converged=optimum.converged,
        seconds=seconds,
    )
    if not traced:
        check_rank(adjusted)
    return adjusted


def _factored_like(values: Values, structure: Structure) -> Factored:
    """Arrays of the right types that take no memory."""
    zero = zero_increments(structure)
    system = jax.eval_shape(zero_system, zero, values, structure)
    reduced, factor, scale = jax.tree.map(
        lambda v: np.broadcast_to(0.0, v.shape), (system.reduced, system.factor, zero)
    )
    return Factored(reduced, factor, scale, values.datum_eop.shape[0])


# Image rows that keep a device busy for longer than adding its sums to those of others takes.
_ROWS_PER_DEVICE = 20_000


def _devices_worth_using(rows: int) -> int:
    return usable(rows // _ROWS_PER_DEVICE)


def common_sizes(blocks: Iterable[Block]) -> Sizes:
    """Sizes that all of `blocks` fit into: `solve` with them compiles once for all that differ in numbers only."""
    return functools.reduce(operator.or_, (sizes_of(structure_of(b, b.priors)) for b in blocks), LEAST)


@eqx.filter_jit
def _optimise(
    values: Values, structure: Structure, max_steps: int, only_factor: Bool[Numbers, ""]
) -> tuple[Optimum, State, Factored]:
    """The optimum; or, of values that are at theirs, the undamped normal equations, factored."""
    optimum, system, scale = iterate(weigh_datum(values, structure), structure, max_steps, only_factor)
    state = state_at(optimum.increments, unit_scale(structure), values, structure)
    return optimum, state, Factored(system.reduced, system.factor, scale, values.datum_eop.shape[0])


@eqx.filter_jit
def _residuals(values: Values, structure: Structure) -> Residuals:
    s = on_one_device(structure)
    return residuals_at(At(zero_increments(s), unit_scale(s), values, s))


def concrete(tree: Values, block: Block) -> Values:
    """The same values with numbers for what is being traced: the datum depends on where things are, roughly."""
    known = block.start.unknowns
    place = {"position": known.exterior.position, "points": known.points}
    still = {k: np.asarray(v, float).T for k, v in place.items() if not isinstance(v, jax.core.Tracer)}

    def number(path, v):
        if not isinstance(v, jax.core.Tracer):
            return np.asarray(v)
        # Standard deviations that are being traced weigh as one.
        filler = np.ones if getattr(path[-1], "name", "") in ("sigma", "sigma_xy", "whitener") else np.zeros
        return still.get(path[0].name, filler(v.shape))

    return jax.tree_util.tree_map_with_path(number, tree)
