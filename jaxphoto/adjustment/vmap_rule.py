"""Adjustments of many draws of one block: the batching rule of the solver under `jax.vmap`.

The first draw is adjusted by Levenberg-Marquardt. With its factored normal matrix all others take chord steps from its
optimum to their own (`chords`), some draws at a time. The first draw that does not contract is adjusted by
Levenberg-Marquardt, and its factor is tried on the remaining draws; after a few factors the last ones are adjusted
individually. All draws converge to the results of a loop over single adjustments, and memory grows only with the
results.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment.chords import chord_steps
from jaxphoto.adjustment.draw_gradients import Common, Varying, held_in, path_name, states
from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock
from jaxphoto.adjustment.model.numbers import Increments, UnknownArrays
from jaxphoto.adjustment.row_lists import RowList, batch_size, row_lists
from jaxphoto.adjustment.solver.elimination import FactoredNormal
from jaxphoto.adjustment.solver.levenberg_marquardt import FactoredSystem, SolveMode
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import Optimum, iterate
from jaxphoto.rotation import small_angles

# Maximum number of factorisations tried before the remaining draws are adjusted individually.
_FACTORS = 3
# Leaves of `Values` that hold start values; leaves that define the datum and are computed from the start values.
_STARTS, _DATUM = {"position", "rotation", "shared", "points"}, {"datum_eop", "datum_points"}


class ImageRowLists(NamedTuple):
    """Image rows of a block for `many`, and the rays they correspond to."""

    lists: tuple[RowList, ...]
    slot: Int[np.ndarray, "rows"]
    """Index of the ray."""
    draws: int
    """Number of draws computed together."""


def image_row_lists(padded: PaddedBlock) -> ImageRowLists:
    """Return the row lists of a block."""
    return ImageRowLists(row_lists(padded.own, padded.places), padded.places.row, batch_size(padded.own))


def optimum_of(values: PaddedValues, structure: PaddedStructure, task: SolveMode, rows: ImageRowLists) -> Optimum:
    """Find the optimum from the start in `values`, without history; for many draws under `jax.vmap`."""

    @jax.custom_batching.custom_vmap
    def one(values: PaddedValues) -> Optimum:
        # The history has no derivative, and is not needed under differentiation.
        return iterate(values, structure, task)[0]._replace(history=None)

    @one.def_vmap
    def rule(draws: int, batched: list[Any], values: PaddedValues) -> tuple[Optimum, Optimum]:
        found = _optima(_Draws(draws, batched[0], structure, task, rows), values)
        return found, jax.tree.map(lambda _: True, found)

    return one(values)


class _Draws(NamedTuple):
    """Draws before they are computed."""

    number: int
    batched: PaddedValues
    """True for each leaf whose first axis is the draws."""
    structure: PaddedStructure
    task: SolveMode
    rows: ImageRowLists

    @property
    def names(self) -> set[str]:
        """Names of leaves that differ between draws; datum constraints are derived from others."""
        leaves = jax.tree_util.tree_leaves_with_path(self.batched)
        return {path_name(path) for path, batched in leaves if batched} - _DATUM

    def together(self, values: PaddedValues) -> bool:
        """Return True if draws may start at the optimum of another draw."""
        if self.structure.has_losses or self.names <= {"position", "rotation", "points"}:
            # If only the start varies, the result of each start is required.
            return False
        # Datum constraints relative to the start differ for every start.
        return not (self.names & _STARTS and values.datum_eop.shape[-3])

    def some(self, values: PaddedValues, begin: Array, size: int) -> PaddedValues:
        """Return the values of `size` draws starting at index `begin`."""
        cut = lambda v, batched: jax.lax.dynamic_slice_in_dim(v, begin, size) if batched else v  # noqa: E731
        return jax.tree.map(cut, values, self.batched)

    def one(self, values: PaddedValues, draw: Array) -> PaddedValues:
        """Return the values of a draw."""
        return jax.tree.map(lambda v, b: v[0] if b else v, self.some(values, draw, 1), self.batched)


def _optima(draws: _Draws, values: PaddedValues) -> Optimum:
    """Find the optimum of every draw, draws first."""

    @jax.custom_batching.custom_vmap
    def many(values: PaddedValues) -> Optimum:
        return _found(draws, values)

    @many.def_vmap
    def rule(outer: int, outer_batched: list[Any], values: PaddedValues) -> tuple[Optimum, Optimum]:
        """Flatten nested draws."""
        n = draws.number

        def joined(v: Array, is_outer: bool, is_inner: bool) -> Array:
            if is_inner and not is_outer:
                v = jnp.broadcast_to(v, (outer, *v.shape))
            if is_outer and not is_inner:
                return jnp.repeat(v, n, axis=0)
            return v.reshape(outer * n, *v.shape[2:]) if is_inner else v

        values = jax.tree.map(joined, values, outer_batched[0], draws.batched)
        batched = jax.tree.map(lambda a, b: a or b, outer_batched[0], draws.batched)
        found = _optima(draws._replace(number=outer * n, batched=batched), values)
        found = jax.tree.map(lambda v: v.reshape(outer, n, *v.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return many(values)


class _Found(NamedTuple):
    optima: Optimum
    done: Bool[Array, "draws"]
    factors: Int[Array, ""]
    """Number of factors tried on all remaining draws."""


def _found(draws: _Draws, values: PaddedValues) -> Optimum:
    together = draws.together(values)

    def adjust_next(found: _Found) -> _Found:
        k = jnp.argmin(found.done)
        # XLA must not infer that the value is positive (see `compiling.once`), as it would from a constant.
        free = draws.structure.eop_free * jnp.where(k >= 0, 1.0, 0.0)
        own = draws._replace(structure=eqx.tree_at(lambda s: s.eop_free, draws.structure, free))
        nominal = draws.one(values, k)
        optimum, system, scale = iterate(nominal, own.structure, draws.task)
        optimum = optimum._replace(history=None)
        optima = jax.tree.map(lambda all, one: all.at[k].set(one), found.optima, optimum)
        found = _Found(optima, found.done.at[k].set(True), found.factors + 1)
        if not together:
            return found
        common = _common(nominal, optimum, system, scale, own)
        assert optimum.converged is not None, "only of a tangent is this unknown"
        useful = optimum.converged & (found.factors <= _FACTORS) & ~jnp.all(found.done)
        return jax.lax.cond(useful, lambda: _with_chords(own, values, common, found), lambda: found)

    n, s = draws.number, draws.structure
    increments = Increments(jnp.zeros((n, 6, s.n_images)), jnp.zeros((n, s.n_shared)), jnp.zeros((n, 3, s.n_points)))
    nothing = Optimum(increments, jnp.zeros(n, int), jnp.zeros(n, bool), None)
    begin = _Found(nothing, jnp.zeros(n, bool), jnp.zeros((), int))
    return jax.lax.while_loop(lambda found: ~jnp.all(found.done), adjust_next, begin).optima


def _common(
    nominal: PaddedValues, optimum: Optimum, system: FactoredSystem, scale: Increments, draws: _Draws
) -> Common:
    """Return the data common to draws that start at the optimum of one of them."""
    at = jax.tree.map(lambda x, k: jnp.where(k > 0, x / jnp.where(k > 0, k, 1.0), 0.0), optimum.increments, scale)
    xy, sigma = (_by_row(v[None], draws.rows.slot)[..., 0] for v in (nominal.xy, nominal.sigma_xy))
    factored = FactoredNormal(system.reduced, system.factor, scale)
    return Common(Linearised(at, scale, nominal, draws.structure), factored, xy, sigma, draws.rows.lists)


def _with_chords(draws: _Draws, values: PaddedValues, common: Common, found: _Found) -> _Found:
    """Apply chord steps to the draws that are not done, and store the draws that converge."""
    size = min(draws.rows.draws, draws.number)

    def batch(k: Array, found: _Found) -> _Found:
        # The last batch overlaps the one before; no draw is adjusted twice.
        begin = jnp.minimum(k * size, draws.number - size)
        cut = lambda v: jax.lax.dynamic_slice_in_dim(v, begin, size)  # noqa: E731
        done = cut(found.done)

        def steps() -> _Found:
            own = draws.some(values, begin, size)
            varying = _varying(draws, own, common)
            way = chord_steps(varying, common, polished=False)
            increments = _draws_first(jax.tree.map(lambda y, k: y * k[..., None], way.y, common.scale))
            if draws.names & _STARTS:
                increments = _from_start(own, _draws_first(states(way.y, varying, common)), draws)
            taken = way.settled & ~done
            new = Optimum(increments, way.steps.astype(int), way.settled, None)

            def put(all: Array, one: Array) -> Array:
                old = cut(all)
                one = jnp.where(taken.reshape(-1, *[1] * (one.ndim - 1)), one, old)
                return jax.lax.dynamic_update_slice_in_dim(all, one, begin, 0)

            return _Found(jax.tree.map(put, found.optima, new), put(found.done, taken), found.factors)

        return jax.lax.cond(jnp.all(done), lambda: found, steps)

    return jax.lax.fori_loop(0, -(-draws.number // size), batch, found)


def _varying(draws: _Draws, values: PaddedValues, common: Common) -> Varying:
    """Return the leaves that differ between draws, draws last; of leaves with start values, only fixed ones."""
    held = held_in(draws.structure, values.shared.shape[-1])
    varying = {}
    for path, v in jax.tree_util.tree_leaves_with_path(values):
        name = path_name(path)
        if name not in draws.names:
            continue
        if name in ("xy", "sigma_xy"):
            varying[name] = _by_row(v, draws.rows.slot)
            continue
        varying[name] = jnp.moveaxis(v, 0, -1)
        if name in _STARTS:
            nominal = jnp.asarray(getattr(common.values, name))[..., None]
            varying[name] = jnp.where(jnp.asarray(held[name])[..., None], varying[name], nominal)
    return varying


def _from_start(values: PaddedValues, state: UnknownArrays, draws: _Draws) -> Increments:
    """Return increments from the start of each draw to a state, draws first."""
    s = draws.structure

    def whole(name: str, axis: int) -> Array:
        v = jnp.asarray(getattr(values, name))
        return v if v.ndim > axis else jnp.broadcast_to(v, (len(state.shared), *v.shape))

    turn = jnp.einsum("nabk,ncbk->nkac", state.rotation, whole("rotation", 3))
    angles = jnp.moveaxis(jax.vmap(jax.vmap(small_angles))(turn), 1, 2)
    eop = jnp.concatenate([state.position - whole("position", 2), angles], axis=1)
    shared = (state.shared - whole("shared", 1))[:, s.free]
    points = state.points - whole("points", 2)
    return Increments(eop * s.eop_free, shared, points * s.point_free)


def _by_row(v: Float[Array, "draws batches 2 chunks p"], ray: Int[np.ndarray, "rows"]) -> Float[Array, "2 rows draws"]:
    """Return values of rays by image row, draws last."""
    return jnp.moveaxis(v, 2, 0).reshape(2, len(v), -1)[:, :, ray].transpose(0, 2, 1)


def _draws_first(tree: Any) -> Any:
    return jax.tree.map(lambda v: jnp.moveaxis(v, -1, 0), tree)
