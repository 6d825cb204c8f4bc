"""Designs side by side: blocks of any size padded to common sizes, adjusted and judged by one program.

The program runs through its designs with `jax.lax.map`, on as many devices as there are, and keeps of each only what a
study asks for: no block's normal matrix outlives its turn.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import (
    NormalEquations,
    PaddedStructure,
    PaddedValues,
    Sizes,
    Task,
    lay_out,
    optimise,
    to_factor,
    to_optimum,
)
from jaxphoto.adjustment.model.block_values import with_start
from jaxphoto.adjustment.model.numbers import UnknownArrays
from jaxphoto.arrays import Numbers
from jaxphoto.block import Block
from jaxphoto.compiling import run_compiled
from jaxphoto.devices import AXIS, mesh_of, usable
from jaxphoto.initial import approximate
from jaxphoto.statistics.covariance import Rotations, in_units
from jaxphoto.unknowns import Unknowns

# Designs that one call of the program holds in memory, at least one a device.
_AT_ONCE = 32


class Check(NamedTuple):
    """Places of check points in the padded arrays, and their true coordinates (m), NaN where nobody knows them.

    `weight` is 1, and 0 for what only fills up the list.
    """

    point: Int[Numbers, "check"]
    weight: Float[Numbers, "check"]
    truth: Float[Numbers, "check 3"]


class Prepared(NamedTuple):
    """One design as it is computed with, and what is known of it beforehand."""

    values: PaddedValues
    structure: PaddedStructure
    check: Check
    labels: tuple[str, ...]
    """Of the shared unknowns, in their order."""
    redundancy: int


class Findings(NamedTuple):
    """What a study keeps of one design; in metres, radians and the unknowns' own units, a priori."""

    converged: Bool[Numbers, ""]
    least_pivot: Float[Numbers, ""]
    """What is left of the weakest unknown when those before it are eliminated: 1 unharmed, 0 at a rank defect."""
    steps: Int[Numbers, ""]
    square_sum: Float[Numbers, ""]
    """v'Pv."""
    covariance: Float[Numbers, "shared shared"]
    exterior_variance: Float[Numbers, "6"]
    """Of X, Y, Z and three rotations, mean over the images."""
    mean_abs: Float[Numbers, "6 shared"]
    """|rho| of X, Y, Z and three rotations with each shared unknown, mean over the images that it touches."""
    max_abs: Float[Numbers, "6 shared"]
    check_variance: Float[Numbers, "3"]
    """Mean over the check points, of computed coordinates."""
    check_square: Float[Numbers, "3"]
    """Mean over the check points of (true - computed) squared."""


def prepare_design(block: Block, truth: Unknowns | None, sizes: Sizes, n_check: int) -> Prepared:
    """`block` with approximate values, datum and padding, as `jaxphoto.adjust` computes with it.

    `sizes` and `n_check`, the length of the list of check points, are those of all designs. Raises what
    `jaxphoto.adjust` raises before it computes: BlockError, DatumError, RankError.
    """
    laid = lay_out(block, approximate(block), block.priors, sizes, alone=True)
    s, constraints = laid.padded.own, len(laid.values.datum_eop)
    who = np.unique(block.check.who)
    check = Check(np.zeros(n_check, np.int32), np.zeros(n_check), np.full((n_check, 3), np.nan))
    check.point[: len(who)], check.weight[: len(who)] = laid.padded.places.point[who], 1.0
    if truth is not None:
        check.truth[: len(who)] = np.asarray(truth.points)[who]
    observed = 2 * len(s.image) + sum(g.components * g.n_rows for g in s.observed) + constraints
    unknown = s.n_shared + s.eop_free.sum() + s.point_free.sum()
    return Prepared(laid.padded_values, laid.padded.structure, check, s.labels, int(observed - unknown))


def alike(designs: Sequence[Prepared]) -> list[list[int]]:
    """Indices of the designs that one program serves, by program."""
    groups: dict[object, list[int]] = {}
    for k, design in enumerate(designs):
        arrays, rest = eqx.partition((design.values, design.structure), eqx.is_array)
        types = tuple((v.shape, v.dtype.str) for v in jax.tree.leaves(arrays))
        key = (types, jax.tree.structure(arrays), tuple(jax.tree.leaves(rest)))
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def find(designs: Sequence[Prepared], rotations: Rotations, max_steps: int, seconds: dict[str, float]) -> Findings:
    """The findings of designs that are `alike`, as NumPy arrays with a leading axis over them."""
    devices = usable(_AT_ONCE)
    each = -(-_AT_ONCE // devices)
    size = each * devices
    # Dealt out like cards, so that a last hand of few designs keeps all devices busy.
    dealt = np.arange(size).reshape(each, devices).T.ravel()
    parts = []
    for begin in range(0, len(designs), size):
        wanted = begin + dealt < len(designs)
        chosen = [designs[k] for k in np.where(wanted, begin + dealt, begin)]
        stacked = jax.tree.map(lambda *v: np.stack(v), *((d.values, d.structure, d.check) for d in chosen))
        found = run_compiled(_find, (*stacked, wanted, devices, rotations, max_steps), seconds, "designs")
        back = np.argsort(dealt)[: len(designs) - begin]
        parts.append(jax.tree.map(lambda v: np.asarray(v)[back], found))  # noqa: B023
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


@eqx.filter_jit
def _find(
    values: PaddedValues,
    s: PaddedStructure,
    check: Check,
    wanted: Array,
    devices: int,
    rotations: Rotations,
    max_steps: int,
) -> Findings:
    arrays, rest = eqx.partition((values, s, check), eqx.is_array)

    # Compiled within what is compiled: so it is traced once, for its shapes and for its numbers.
    @jax.jit
    def of_one(arrays):
        values, s, check = eqx.combine(arrays, rest)
        return _findings(values, s, check, rotations, max_steps)

    def of_each(arrays, wanted):
        shapes = jax.eval_shape(of_one, jax.tree.map(lambda v: v[0], arrays))
        nothing = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shapes)
        return jax.lax.map(lambda one: jax.lax.cond(one[1], of_one, lambda _: nothing, one[0]), (arrays, wanted))

    if devices == 1:
        return of_each(arrays, wanted)
    of_designs: Any = P(AXIS)
    run = jax.shard_map(of_each, mesh=mesh_of(devices), in_specs=of_designs, out_specs=of_designs, check_vma=False)
    return run(arrays, wanted)


def _findings(values: PaddedValues, s: PaddedStructure, check: Check, rotations: Rotations, max_steps: int) -> Findings:
    """Adjustment, factor at the optimum, covariance, and what is kept of them."""

    def solved(start: UnknownArrays, task: Task):
        found = optimise(with_start(values, start), s, task)
        return found.state, found

    # To the optimum, and there once more for the undamped factor: a loop, so that it is one piece of code.
    tasks = jax.tree.map(lambda *each: np.stack(each), to_optimum(max_steps), to_factor())
    start = UnknownArrays(values.position, values.rotation, values.shared, values.points)
    state, found = jax.lax.scan(solved, start, tasks)
    there, factored = with_start(values, state), jax.tree.map(lambda v: v[1], found.factored)
    equations = NormalEquations(there, s, factored)
    cofactors, _ = equations.cofactors(of_rows=False)
    covariance, points = in_units(cofactors, equations.scale, there.rotation, rotations)

    n = 6 * s.n_images
    variance = jnp.maximum(jnp.diagonal(covariance), 0.0)
    inverse = jnp.where(variance > 0, 1 / jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0)
    rho = jnp.abs(covariance[:n, n:] * inverse[:n, None] * inverse[n:]).reshape(s.n_images, 6, -1)
    touches = jnp.any(jnp.asarray(s.column)[:, :, None] == jnp.arange(s.n_shared), axis=1)
    rho = jnp.where(touches[:, None], rho, 0.0)
    own = (jnp.sum(jnp.asarray(s.eop_free), axis=0) > 0).astype(float)
    is_check, n_check = check.weight[:, None] > 0, jnp.sum(check.weight)
    off = check.truth - there.points[:, check.point].T
    return Findings(
        converged=found.converged[0],
        least_pivot=equations.least_pivot(),
        steps=found.steps[0],
        square_sum=equations.at.square_sum(),
        covariance=covariance[n:, n:],
        exterior_variance=own @ variance[:n].reshape(-1, 6) / jnp.sum(own),
        mean_abs=jnp.sum(rho, axis=0) / jnp.sum(touches, axis=0),
        max_abs=jnp.max(rho, axis=0),
        check_variance=check.weight @ jnp.diagonal(points[check.point], axis1=1, axis2=2) / n_check,
        check_square=jnp.sum(jnp.where(is_check, off**2, 0.0), axis=0) / n_check,
    )
