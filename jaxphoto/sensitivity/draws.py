"""Monte Carlo of an adjustment: other numbers in the same block, re-adjusted to convergence, thousands of times.

All draws share the factor of the nominal normal matrix (`chords`); those that do not contract are adjusted by
themselves and counted. Draws come in batches of a size that follows from the block and the number of devices, so a draw
does not depend on those before or after it.
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
from jaxphoto.adjustment.many import Common, Varying, held_in, path_name
from jaxphoto.adjustment.model.block_values import values_of, with_datum
from jaxphoto.adjustment.model.numbers import UnknownArrays
from jaxphoto.adjustment.row_lists import batch_size, row_lists
from jaxphoto.arrays import still
from jaxphoto.block import Block, Start
from jaxphoto.compiling import call_compiled
from jaxphoto.devices import usable
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.sensitivity.perturbation import Perturbation, Recorded, in_order_of
from jaxphoto.short_repr import shown
from jaxphoto.tracing import outside_transformations

# Draws that are worth compiling thoroughly.
_MANY = 500
# More than any machine has.
_MOST_DEVICES = 1024


@shown
class Draws(eqx.Module):
    """Re-adjustments of a block, one a draw along the first axis.

    `recorded` holds what the perturbation drew; `shared` the estimated interior, mount and strip parameters of `labels`
    (own units); `exterior` X, Y, Z (m) and omega, phi, kappa (rad) of all images; `points` all object points (m). The
    latter two are None unless asked for.
    """

    recorded: dict[str, Float[np.ndarray, "draws"]]
    shared: Float[np.ndarray, "draws shared"]
    exterior: Float[np.ndarray, "draws images 6"] | None
    points: Float[np.ndarray, "draws points 3"] | None
    converged: Bool[np.ndarray, "draws"]
    steps: Int[np.ndarray, "draws"]
    fallback: Bool[np.ndarray, "draws"]
    """Whether the draw was adjusted by itself, because steps with the nominal factor did not contract."""
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
) -> Draws:
    """Re-adjust the block of `adjusted` `draws` times, each with the numbers that `perturb` draws.

    `perturb(key, block)` returns the block with other numbers, alone or with a dict of scalars to record; see
    `jaxphoto.bias` for the usual ones. It is mapped over keys by `jax.vmap`: draw k has
    `jax.random.fold_in(jax.random.key(seed), k)`. The block it is given starts at the adjusted unknowns. Ids, indices
    and shapes stay as they are.

    Raises InputError where there is nothing to draw.
    """
    check_draws(draws)
    return readjust(adjusted, Drawn(perturb, seed), np.arange(draws), exterior=exterior, points=points)


@outside_transformations
def readjust(
    adjusted: Adjustment,
    change: Callable[[Any, Block], Block | tuple[Block, Recorded]],
    given: Any,
    *,
    exterior: bool = False,
    points: bool = False,
) -> Draws:
    """Re-adjust the block of `adjusted` once for each entry of `given`, a tree of arrays along their first axis.

    `change(entry, block)` returns the block with other numbers, as `perturb` of `monte_carlo` does.
    """
    run = Readjustment(adjusted, change, given, exterior=exterior, points=points)
    return joined_draws(list(run.batches(given)))


def check_draws(draws: int) -> None:
    """Raises InputError where `draws` is no number of draws."""
    if draws < 1:
        raise InputError(f"the number of draws is 1 at least, got {draws}")


class Drawn(eqx.Module):
    """A perturbation as a change by the number of a draw."""

    perturb: Perturbation
    seed: int = eqx.field(static=True)

    def __call__(self, draw: Int[Array, ""], block: Block) -> Block | tuple[Block, Recorded]:
        """The block of this draw."""
        return self.perturb(jax.random.fold_in(jax.random.key(self.seed), draw), block)


class Readjustment:
    """What is needed to re-adjust a block with other numbers, prepared once; `seconds` says what compiling took.

    `example` is like what `batches` will be given, in number, too: many draws are worth better compiled code.
    """

    def __init__(
        self, adjusted: Adjustment, change: Callable, example: Any, *, exterior: bool = False, points: bool = False
    ):
        if not bool(adjusted.converged):
            raise InputError(f"draws begin at the optimum of the block as it is, which is {adjusted.outcome.value}")
        equations = adjusted.equations.on_one_device
        padded = dataclasses.replace(adjusted.padded, structure=equations.structure)
        self.adjusted = dataclasses.replace(
            adjusted, padded=padded, padded_values=equations.values, factored=equations.factored
        )
        self.change, self.exterior, self.points = change, exterior, points
        self.seconds = {"compile": 0.0}
        self.many = _count(example) >= _MANY
        start = Start(
            adjusted.unknowns, *(np.ones(len(n), bool) for n in (adjusted.block.images, adjusted.block.points))
        )
        self.nominal = dataclasses.replace(adjusted.block, start=start, priors=adjusted.priors)
        # Of several processes, each draws for itself.
        self.devices = usable(_MOST_DEVICES) if jax.process_count() == 1 else 1
        self.common = common_of(self.adjusted)
        self.names = self._varying_fields(jax.tree.map(lambda v: v[:1], example))
        self._numbers = jax.jit(jax.vmap(self._numbers_of, out_axes=(-1, 0)))

    @property
    def batch_size(self) -> int:
        """Draws that are computed side by side."""
        return self.devices * batch_size(self.adjusted.structure)

    def warm_up(self, given: Any) -> None:
        """Have everything compiled that `batches` needs."""
        began = time.perf_counter()
        some = jax.tree.map(lambda v: still(v)[:1], given)
        self._gathered(*self._begin(some, first_only=False), 1)
        self.seconds["compile"] = time.perf_counter() - began

    def batches(self, given: Any) -> Iterator[Draws]:
        """The re-adjustments, batch by batch."""
        begun = None
        for entries in self._split(given):
            # The next batch is begun before the last one is fetched: neither waits for the other.
            following = entries, self._begin(entries, first_only=False)
            if begun is not None:
                yield self._finished(*begun)
            begun = following
        if begun is not None:
            yield self._finished(*begun)

    def first_order(self, given: Any) -> Draws:
        """The same to first order, by one step with the nominal factor: exact in the limit of small changes."""
        return joined_draws([self._gathered(*self._begin(e, first_only=True), _count(e)) for e in self._split(given)])

    def _split(self, given: Any) -> Iterator[Any]:
        for first in range(0, _count(given), self.batch_size):
            yield jax.tree.map(lambda v, k=first: still(v)[k : k + self.batch_size], given)

    def _begin(self, entries: Any, first_only: bool) -> tuple[Found, Recorded]:
        """Send a batch on its way; the last entry fills it up to its size."""
        more = self.batch_size - _count(entries)
        entries = jax.tree.map(lambda v: np.concatenate([v, np.repeat(v[-1:], more, axis=0)]), entries)
        varying, recorded = self._numbers(entries)
        arguments = varying, self.common, self.devices, first_only
        return call_compiled(find_optima, *arguments, thorough=self.many and not first_only), recorded

    def _gathered(self, found: Found, recorded: Recorded, n: int) -> Draws:
        """Of a batch, its first `n` draws."""
        state = self.adjusted.padded.crop_state(UnknownArrays(*(_draws_first(v)[:n] for v in found.state)))
        labels, kept = self.adjusted.structure.labels, {name: np.asarray(v)[:n] for name, v in recorded.items()}
        steps, settled = np.asarray(found.steps)[:n], np.asarray(found.settled)[:n]
        return Draws(kept, *self._estimates(state), settled, steps, np.zeros(n, bool), labels)

    def _estimates(self, state: UnknownArrays) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """`shared`, `exterior` and `points` of `Draws`."""
        shared = still(state.shared)[:, self.adjusted.structure.free]
        points = _by_object(state.points) if self.points else None
        return shared, self._exterior(state) if self.exterior else None, points

    def _finished(self, entries: Any, begun: tuple[Found, Recorded]) -> Draws:
        """A batch, in which draws that did not contract are adjusted by themselves."""
        draws = self._gathered(*begun, _count(entries))
        for k in map(int, np.flatnonzero(~draws.converged)):
            draws = _with_row(draws, k, self._alone(jax.tree.map(lambda v, k=k: v[k], entries)))
        return draws

    def _alone(self, entry: Any) -> Draws:
        """One draw by a full adjustment; not a number where there is none."""
        block, _ = self._changed(entry)
        try:
            solved = solve(block, block.start.unknowns, block.priors)
            v, converged, steps = solved.values, bool(solved.converged), int(solved.steps)
        except JaxphotoError:
            v, converged, steps = jax.tree.map(lambda x: np.full_like(x, np.nan), self.adjusted.values), False, 0
        state = UnknownArrays(*(still(x)[None] for x in (v.position, v.rotation, v.shared, v.points)))
        found, taken, alone = np.array([converged]), np.array([steps]), np.array([True])
        return Draws({}, *self._estimates(state), found, taken, alone, ())

    def _exterior(self, state: UnknownArrays) -> Float[np.ndarray, "draws images 6"]:
        """X, Y, Z, omega, phi, kappa; angles run on from the nominal ones, without a jump at 180 degrees."""
        angles = np.asarray(call_compiled(_angles, _by_object(state.rotation)))
        nominal = np.asarray(call_compiled(_angles, np.asarray(self.adjusted.values.rotation).transpose(2, 0, 1)[None]))
        angles = nominal + (angles - nominal + np.pi) % (2 * np.pi) - np.pi
        return np.concatenate([_by_object(state.position), angles], axis=2)

    def _numbers_of(self, entry: Any) -> tuple[Varying, Recorded]:
        """The numbers of one draw that differ from the nominal ones."""
        numbers, recorded = self._all_numbers_of(entry)
        return {name: jnp.asarray(numbers[name], float) for name in self.names}, recorded

    def _changed(self, entry: Any) -> tuple[Block, Recorded]:
        changed = self.change(entry, self.nominal)
        block, recorded = changed if isinstance(changed, tuple) else (changed, {})
        _check_same(block, self.nominal)
        return in_order_of(self.nominal, block), recorded

    def _all_numbers_of(self, entry: Any) -> tuple[dict[str, Any], Recorded]:
        block, recorded = self._changed(entry)
        s, v = self.adjusted.structure, self.adjusted.values
        changed = values_of(block, block.start.unknowns, block.priors, s)
        changed = with_datum(changed, v.datum_eop, v.datum_points)
        wide, nominal = self.common.structure, self.common.values
        padded = self.adjusted.padded.pad(changed)
        numbers = {path_name(path): v for path, v in jax.tree_util.tree_leaves_with_path(padded)}
        # What is free begins at the optimum, wherever the block says that it starts.
        for name, mask in held_in(wide, len(v.shared)).items():
            if isinstance(numbers[name], jax.core.Tracer):
                numbers[name] = jnp.where(mask, numbers[name], getattr(nominal, name))
        return numbers | {"xy": changed.xy, "sigma_xy": changed.sigma_xy}, recorded

    def _varying_fields(self, entries: Any) -> tuple[str, ...]:
        """The leaves of `Values` that differ between draws."""
        varying: list[str] = []

        def look(entry):
            numbers, _ = self._all_numbers_of(entry)
            varying.extend(name for name, v in numbers.items() if isinstance(v, jax.core.Tracer))
            return 0

        # Mapped, but not compiled: only what depends on the entry is traced.
        jax.vmap(look, out_axes=None)(entries)
        if not varying:
            raise InputError("the perturbation changes no number of the block: return the block with others in it")
        return tuple(varying)


def common_of(adjusted: Adjustment, at_once: int | None = None) -> Common:
    """The nominal adjustment, from whose optimum all draws begin; `at_once` image rows are computed with at a time."""
    equations, values = adjusted.equations.weighed, adjusted.values
    lists = row_lists(adjusted.structure, adjusted.padded.places, at_once)
    return Common(equations.at, equations.factored, np.asarray(values.xy), np.asarray(values.sigma_xy), lists)


def joined_draws(parts: Iterable[Draws]) -> Draws:
    """The draws of all `parts`, in their order."""
    parts = list(parts)
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


def _draws_first(values: Array) -> Any:
    return np.moveaxis(np.asarray(values), -1, 0)


def _by_object(values: Any) -> np.ndarray:
    """Draws first, then images or points, then their components."""
    return np.moveaxis(still(values), -1, 1)


def _count(entries: Any) -> int:
    return len(jax.tree.leaves(entries)[0])


def _check_same(block: Any, nominal: Block) -> None:
    """Raises InputError where `block` differs from the nominal one in more than numbers."""
    kind: Any = jax.tree.structure(nominal)
    same = isinstance(block, Block) and kind == jax.tree.structure(block)
    if not same or not all(map(_is_number_or_same, jax.tree.leaves(block), jax.tree.leaves(nominal))):
        raise InputError(
            "a perturbation returns the block that it is given, with other numbers in it, alone or with a dict of "
            "numbers to record: ids, indices, shapes and what is free stay"
        )


def _is_number_or_same(new: Any, old: Any) -> bool:
    """Whether a leaf of a block is as it was, or other numbers of the same shape."""
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
