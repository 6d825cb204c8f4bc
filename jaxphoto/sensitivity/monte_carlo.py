"""Monte Carlo simulation of an adjustment: thousands of re-adjustments of a block, each iterated to convergence.

All draws share the factor of the nominal normal matrix (`chords`). Draws for which this iteration does not contract are
adjusted individually and counted. The batch size depends only on the block, so a draw does not depend on other draws.
"""

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import Adjustment, solve
from jaxphoto.adjustment.chords import Found, find_optima
from jaxphoto.adjustment.draw_gradients import Common, Varying, held_in, path_name
from jaxphoto.adjustment.model.block_values import values_of, with_datum
from jaxphoto.adjustment.model.numbers import UnknownArrays
from jaxphoto.adjustment.row_lists import batch_size, row_lists
from jaxphoto.argument_checks import require
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block, Start
from jaxphoto.compiling import call_compiled
from jaxphoto.devices import cores
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.sensitivity.perturbation import Perturbation, Recorded, in_order_of
from jaxphoto.short_repr import pretty_repr
from jaxphoto.tracing import outside_transformations
from jaxphoto.workers import in_parts

# Minimum number of draws for optimised compilation.
_MANY = 500
# Maximum number of draws per part: its overheads, 30 ms, are below 2 % of the time for a small block. Minimum number of
# parts, as work for several cores.
_PART, _PARTS = 4000, 32


@pretty_repr
class Draws(eqx.Module):
    """Re-adjustments of a block, one per draw along the first axis.

    `recorded`: values drawn by the perturbation. `shared`: estimated interior, mount and strip parameters `labels` (own
    units). `exterior`: X, Y, Z (m) and omega, phi, kappa (rad) of all images. `points`: all object points (m).
    `exterior` and `points` are None unless requested.
    """

    recorded: dict[str, Float[np.ndarray, "draws"]]
    shared: Float[np.ndarray, "draws shared"]
    exterior: Float[np.ndarray, "draws images 6"] | None
    points: Float[np.ndarray, "draws points 3"] | None
    converged: Bool[np.ndarray, "draws"]
    steps: Int[np.ndarray, "draws"]
    fallback: Bool[np.ndarray, "draws"]
    """True if the draw was adjusted individually because iterations with the nominal factor did not contract."""
    labels: tuple[str, ...] = eqx.field(static=True)


@outside_transformations
def monte_carlo(
    adjusted: Adjustment,
    perturb: Perturbation,
    draws: int,
    seed: int = 0,
    *,
    exterior: bool = False,
    points: bool = False,
    client: Any = None,
) -> Draws:
    """Re-adjust the block of `adjusted` `draws` times, each with values drawn by `perturb`.

    `perturb(key, block)` returns the block with other values, alone or with a dict of scalars to record; see
    `jaxphoto.bias` for common perturbations. It is mapped over keys by `jax.vmap`: the key of draw k is
    `jax.random.fold_in(jax.random.key(seed), k)`. The initial values of its block are the adjusted unknowns. Ids,
    indices and shapes must not change. `client`: a `dask.distributed.Client`, whose workers compute the draws
    (docs/cluster.md), with the same results.

    Raises InputError for less than one draw.
    """
    check_draws(draws)
    if not callable(perturb):
        raise InputError(
            f"{perturb!r} is no function of a key and a block; give one, such as jaxphoto.bias(block, ...)"
        )
    change = DrawnChange(perturb, seed)
    return readjust(adjusted, change, np.arange(draws), exterior=exterior, points=points, client=client)


@outside_transformations
def readjust(
    adjusted: Adjustment,
    change: Callable[[Any, Block], Block | tuple[Block, Recorded]],
    entries: Any,
    *,
    exterior: bool = False,
    points: bool = False,
    client: Any = None,
) -> Draws:
    """Re-adjust the block of `adjusted` for each entry along the first axis of `entries`, a tree of arrays.

    `change(entry, block)` returns the block with other values, in the same form as `perturb` of `monte_carlo`.
    """
    require(adjusted, Adjustment, "give the result of jaxphoto.adjust(block)")
    if not callable(change):
        raise InputError(f"{change!r} is no function of a block; give one, such as jaxphoto.bias(block, ...)")
    run = Readjustment(adjusted, change, entries, exterior=exterior, points=points)
    size, whole = run.part_size(), jax.tree.map(to_numpy, entries)
    parts = [jax.tree.map(lambda v, k=k: v[k : k + size], whole) for k in range(0, _count(whole), size)]
    found = dict(in_parts(run, enumerate(parts), client, cores()))
    return join_draws([found[k] for k in range(len(parts))])


def check_draws(draws: int) -> None:
    """Raise InputError for less than one draw."""
    if draws < 1:
        raise InputError(f"the number of draws must be positive, got {draws}")


class DrawnChange(eqx.Module):
    """Perturbation as a change that depends on the index of a draw."""

    perturb: Perturbation
    seed: int = eqx.field(static=True)

    def __call__(self, draw: Int[Array, ""], block: Block) -> Block | tuple[Block, Recorded]:
        """Return the block of draw `draw`."""
        return self.perturb(jax.random.fold_in(jax.random.key(self.seed), draw), block)


class Readjustment:
    """Re-adjustment of a block with other values, compiled once; a study of `in_parts`. `seconds`: time of compilation.

    `example` has the structure and length of the entries of `batches`; compilation is optimised for many draws.
    """

    def __init__(
        self,
        adjusted: Adjustment,
        change: Callable,
        example: Any,
        *,
        exterior: bool = False,
        points: bool = False,
    ):
        if not bool(adjusted.converged):
            raise InputError(f"draws need a converged adjustment, but the block is {adjusted.outcome.value}")
        equations = adjusted.equations.on_one_device
        padded = dataclasses.replace(adjusted.padded, structure=equations.structure)
        self.adjusted = dataclasses.replace(
            adjusted, padded=padded, padded_values=equations.values, factored=equations.factored
        )
        self.change, self.exterior, self.points = change, exterior, points
        self.seconds = {"compile": 0.0}
        self.count, self.first = _count(example), jax.tree.map(lambda v: to_numpy(v)[:1], example)
        self.many = self.count >= _MANY
        start = Start(
            adjusted.unknowns, *(np.ones(len(n), bool) for n in (adjusted.block.images, adjusted.block.points))
        )
        self.nominal = dataclasses.replace(adjusted.block, start=start, priors=adjusted.priors)
        self.common = common_of(self.adjusted)
        self.names = self._varying_fields(self.first)
        self._values = jax.jit(jax.vmap(self._varying_values, out_axes=(-1, 0)))

    @property
    def batch_size(self) -> int:
        """Number of draws per batch."""
        return batch_size(self.adjusted.structure)

    def part_size(self, most: int = _PART) -> int:
        """Return the number of draws per part: full batches, up to `most` draws, and a sufficient number of parts."""
        return self.batch_size * max(1, min(most, self.count // _PARTS) // self.batch_size)

    def warm_up(self) -> None:
        """Compile the programs of `batches`."""
        began = time.perf_counter()
        self._fetch(*self._start(self.first, first_only=False), 1)
        self.seconds["compile"] = time.perf_counter() - began

    def compute(self, part: Any) -> Draws:
        """Return the draws of the entries of a part."""
        return join_draws(list(self.batches(part)))

    def __reduce__(self):
        # Equinox' bound methods cannot be pickled.
        owner, method = getattr(self.change, "__self__", self.change), getattr(self.change, "__name__", "__call__")
        arguments = self.adjusted, owner, method, self.first, self.count, self.exterior, self.points
        return _readjustment, arguments

    def batches(self, entries: Any) -> Iterator[Draws]:
        """Yield the re-adjustments of `entries` in batches."""
        running = None
        for batch in self._split(entries):
            # Start the next batch before fetching the last one, so that host and device work in parallel.
            following = batch, self._start(batch, first_only=False)
            if running is not None:
                yield self._finish(*running)
            running = following
        if running is not None:
            yield self._finish(*running)

    def first_order(self, entries: Any) -> Draws:
        """Re-adjust to first order by one step with the nominal factor: exact in the limit of small changes."""
        return join_draws([self._fetch(*self._start(b, first_only=True), _count(b)) for b in self._split(entries)])

    def _split(self, entries: Any) -> Iterator[Any]:
        for first in range(0, _count(entries), self.batch_size):
            yield jax.tree.map(lambda v, k=first: to_numpy(v)[k : k + self.batch_size], entries)

    def _start(self, entries: Any, first_only: bool) -> tuple[Found, Recorded]:
        """Start a batch asynchronously, padded by its last entry."""
        padding = self.batch_size - _count(entries)
        entries = jax.tree.map(lambda v: np.concatenate([v, np.repeat(v[-1:], padding, axis=0)]), entries)
        varying, recorded = self._values(entries)
        arguments = varying, self.common, first_only
        return call_compiled(find_optima, *arguments, thorough=self.many and not first_only), recorded

    def _fetch(self, optima: Found, recorded: Recorded, n: int) -> Draws:
        """Return the first `n` draws of a batch."""
        state = self.adjusted.padded.crop_state(UnknownArrays(*(_draws_first(v)[:n] for v in optima.state)))
        labels, scalars = self.adjusted.structure.labels, {name: np.asarray(v)[:n] for name, v in recorded.items()}
        steps, converged = np.asarray(optima.steps)[:n], np.asarray(optima.settled)[:n]
        return Draws(scalars, *self._estimates(state), converged, steps, np.zeros(n, bool), labels)

    def _estimates(self, state: UnknownArrays) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Return `shared`, `exterior` and `points` of `Draws`."""
        shared = to_numpy(state.shared)[:, self.adjusted.structure.free]
        points = _by_object(state.points) if self.points else None
        return shared, self._exterior(state) if self.exterior else None, points

    def _finish(self, entries: Any, running: tuple[Found, Recorded]) -> Draws:
        """Fetch a batch, and adjust draws individually if their iteration did not contract."""
        draws = self._fetch(*running, _count(entries))
        for k in map(int, np.flatnonzero(~draws.converged)):
            draws = _with_row(draws, k, self._adjust_one(jax.tree.map(lambda v, k=k: v[k], entries)))
        return draws

    def _adjust_one(self, entry: Any) -> Draws:
        """Compute one draw by a full adjustment; NaN if it fails."""
        block, _ = self._changed(entry)
        try:
            adjusted = solve(block, block.start.unknowns, block.priors)
            v, converged, steps = adjusted.values, bool(adjusted.converged), int(adjusted.steps)
        except JaxphotoError:
            v, converged, steps = jax.tree.map(lambda x: np.full_like(x, np.nan), self.adjusted.values), False, 0
        state = UnknownArrays(*(to_numpy(x)[None] for x in (v.position, v.rotation, v.shared, v.points)))
        return Draws({}, *self._estimates(state), np.array([converged]), np.array([steps]), np.array([True]), ())

    def _exterior(self, state: UnknownArrays) -> Float[np.ndarray, "draws images 6"]:
        """Return X, Y, Z, omega, phi, kappa. Angles are continuous with the nominal ones."""
        angles = np.asarray(call_compiled(_angles, _by_object(state.rotation)))
        nominal = np.asarray(call_compiled(_angles, np.asarray(self.adjusted.values.rotation).transpose(2, 0, 1)[None]))
        angles = nominal + (angles - nominal + np.pi) % (2 * np.pi) - np.pi
        return np.concatenate([_by_object(state.position), angles], axis=2)

    def _varying_values(self, entry: Any) -> tuple[Varying, Recorded]:
        """Return the values of one draw that differ from the nominal ones."""
        values, recorded = self._all_values(entry)
        return {name: jnp.asarray(values[name], float) for name in self.names}, recorded

    def _changed(self, entry: Any) -> tuple[Block, Recorded]:
        changed = self.change(entry, self.nominal)
        block, recorded = changed if isinstance(changed, tuple) else (changed, {})
        _check_same(block, self.nominal)
        return in_order_of(self.nominal, block), recorded

    def _all_values(self, entry: Any) -> tuple[dict[str, Any], Recorded]:
        block, recorded = self._changed(entry)
        s, v = self.adjusted.structure, self.adjusted.values
        changed = values_of(block, block.start.unknowns, block.priors, s)
        changed = with_datum(changed, v.datum_eop, v.datum_points)
        structure, nominal = self.common.structure, self.common.values
        padded = self.adjusted.padded.pad(changed)
        values = {path_name(path): v for path, v in jax.tree_util.tree_leaves_with_path(padded)}
        # Start free unknowns at the optimum, whatever the initial values of the block.
        for name, mask in held_in(structure, len(v.shared)).items():
            if isinstance(values[name], jax.core.Tracer):
                values[name] = jnp.where(mask, values[name], getattr(nominal, name))
        return values | {"xy": changed.xy, "sigma_xy": changed.sigma_xy}, recorded

    def _varying_fields(self, entries: Any) -> tuple[str, ...]:
        """Return the names of the leaves of `Values` that differ between draws."""
        varying: list[str] = []

        def trace(entry):
            values, _ = self._all_values(entry)
            varying.extend(name for name, v in values.items() if isinstance(v, jax.core.Tracer))
            return 0

        # Use vmap without jit: only leaves that depend on the entry are traced.
        jax.vmap(trace, out_axes=None)(entries)
        if not varying:
            raise InputError("the perturbation changes no value of the block: return the block with other values")
        return tuple(varying)


def _readjustment(adjusted, owner, method, first, count, exterior, points) -> Readjustment:
    """Return a `Readjustment` in another process."""
    change = owner if method == "__call__" or not hasattr(owner, method) else getattr(owner, method)
    example = jax.tree.map(lambda v: np.broadcast_to(v, (count, *v.shape[1:])), first)
    return Readjustment(adjusted, change, example, exterior=exterior, points=points)


def common_of(adjusted: Adjustment, batch: int | None = None) -> Common:
    """Return the nominal adjustment, which all draws start from, with image rows in batches of `batch`."""
    equations, values = adjusted.equations.weighed, adjusted.values
    lists = row_lists(adjusted.structure, adjusted.padded.places, batch)
    return Common(equations.at, equations.factored, np.asarray(values.xy), np.asarray(values.sigma_xy), lists)


def join_draws(parts: Iterable[Draws]) -> Draws:
    """Concatenate the draws of `parts`."""
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


def _draws_first(values: Array) -> Any:
    return np.moveaxis(np.asarray(values), -1, 0)


def _by_object(values: Any) -> np.ndarray:
    """Move the axes: draws first, then images or points, then components."""
    return np.moveaxis(to_numpy(values), -1, 1)


def _count(entries: Any) -> int:
    return len(jax.tree.leaves(entries)[0])


def _check_same(block: Any, nominal: Block) -> None:
    """Raise InputError if `block` differs from the nominal block in anything except floating-point values."""
    # Priors replaced by `eqx.tree_at` may be in a plain dictionary, which JAX distinguishes from an ordered one.
    one, other = (
        dataclasses.replace(b, priors=dataclasses.replace(b.priors)) if isinstance(b, Block) else b
        for b in (block, nominal)
    )
    kind: Any = jax.tree.structure(other)
    same = isinstance(block, Block) and kind == jax.tree.structure(one)
    if not same or not all(map(_is_number_or_same, jax.tree.leaves(one), jax.tree.leaves(other))):
        raise InputError(
            "a perturbation must return its block with other values of observations or parameters, alone or with a "
            "dict of scalars to record: ids, indices, shapes and free unknowns must not change"
        )


def _is_number_or_same(new: Any, old: Any) -> bool:
    """Return True if a leaf is unchanged, or contains floating-point values of the same shape."""
    if np.asarray(old).dtype.kind not in "f":
        return new is old or (not isinstance(new, jax.core.Tracer) and np.array_equal(new, old))
    return np.shape(new) == np.shape(old)


def _with_row(draws: Draws, k: int, row: Draws) -> Draws:
    def replaced(name: str):
        old = getattr(draws, name)
        if old is None:
            return None
        new = np.array(old)
        new[k] = getattr(row, name)[0]
        return new

    changed = ("shared", "exterior", "points", "converged", "steps", "fallback")
    return dataclasses.replace(draws, **{name: replaced(name) for name in changed})


@eqx.filter_jit
def _angles(rotation: Float[Array, "draws images 3 3"]) -> Float[Array, "draws images 3"]:
    return jax.vmap(jax.vmap(omega_phi_kappa_from_matrix))(rotation)
