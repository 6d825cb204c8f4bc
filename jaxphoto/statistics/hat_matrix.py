"""How unknowns and adjusted observations move with the observed ones, a few directions at a time.

With J the derivatives of whitened residuals (observed minus computed), an error z of the observations moves the
unknowns by -N^-1 J' z and what was adjusted by H z = J N^-1 J' z; unknown k moves by -(J N^-1 e_k)_i with
observation i. Products z' H z of many errors need no J x: they are those of J' z with N^-1 J' z.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from operator import itemgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Int32

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.adjustment.model.numbers import Increments, NonImageResiduals
from jaxphoto.adjustment.right_hand_sides import at_once, blank, in_batches, joined, prepare_solving, solve_many
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import prepare, run_compiled

# Directions that are computed with side by side. Together they have no more numbers than this, as several arrays of
# them are held.
_AT_ONCE, _NUMBERS = 16, 20_000_000


Column = Callable[[int], Float[np.ndarray, "n"]]


class Responses(eqx.Module):
    """What directions of errors of the observations do, computed in batches."""

    adjusted: Adjustment
    equations: NormalEquations
    """Of one device, weighed once for all."""
    laid: Int32[np.ndarray, "places"]
    """The number, in the block's own order, of everything in the arrays that are computed with; `count`: padding."""
    count: int
    places: dict[str, Int[np.ndarray, "..."]]
    """The number of each observation by the name of its group, shaped like the residuals."""
    image_rows: bool = eqx.field(static=True, default=True)
    """Whether errors are in image points, too; without these, H z is not computed there (zero stands for it), which
    takes most of the time."""

    @classmethod
    def of(cls, adjusted: Adjustment, *, image_rows: bool = True) -> "Responses":
        """Of an adjustment."""
        leaves, structure = jax.tree.flatten(adjusted.residuals)
        ends = np.cumsum([np.size(v) for v in leaves])
        numbers = [np.arange(e - np.size(v), e, dtype=float) for v, e in zip(leaves, ends, strict=True)]
        shaped = [n.reshape(np.shape(v)) for n, v in zip(numbers, leaves, strict=True)]
        numbered = jax.tree.unflatten(structure, shaped)
        padded: NonImageResiduals = adjusted.padded.pad_residuals(numbered, float(ends[-1]))
        if not image_rows:
            padded = NonImageResiduals(padded.others, padded.datum, padded.names)
        laid = np.concatenate([np.ravel(v) for v in jax.tree.leaves(padded)]).astype(np.int32)
        places = {name: np.asarray(v).astype(int) for name, v in numbered.named.items()}
        return cls(adjusted, adjusted.equations.on_one_device.weighed, laid, int(ends[-1]), places, image_rows)

    @property
    def residuals(self) -> Float[np.ndarray, "count"]:
        """Of the adjustment, whitened, in the order of `places`; zero for what closes the datum."""
        found = np.zeros(self.count)
        for name, place in self.places.items():
            found[place] = np.asarray(self.adjusted.residuals[name])
        return found

    def to_errors(self, column: Column, many: int) -> Iterator[tuple[Float[np.ndarray, "shared"], np.ndarray]]:
        """Of each error z = `column(k)`, whitened and in the order of `places`: the shared unknowns' motion, in their
        own units, and H z."""
        size = at_once(self.equations.scale)
        for first in range(0, many, size):
            x = self.solved(self._pulled(column, range(first, min(first + size, many))))
            yield from zip(self._moved(x), self._pushed(x), strict=True)

    def of_unknowns(self, shared: Sequence[int]) -> Iterator[Float[np.ndarray, "n"]]:
        """By how much each of some `shared` unknowns (places in `Structure.labels`) moves, in its unit, with an error
        of one standard deviation of each observation."""
        b = jax.tree.map(lambda v: np.zeros((len(shared), *v.shape)), self.equations.scale)
        b.shared[np.arange(len(shared)), np.array(shared, int)] = 1.0
        for k, moved in zip(shared, self._pushed(self.solved(b)), strict=True):
            yield -moved * self._scale[k]

    def products(self, column: Column, many: int) -> tuple[Float[np.ndarray, "many many"], Float[np.ndarray, "m s"]]:
        """z' H z of all errors z = `column(k)` with one another, and the shared unknowns' motions, as `to_errors`."""
        pulled = self._pulled(column, range(many))
        found, moved = np.zeros((many, many)), np.zeros((many, len(self._scale)))
        # Of a large block each set of all directions takes hundreds of MB: those that are solved for are let go.
        for first in range(0, many, size := at_once(self.equations.scale)):
            some = slice(first, first + size)
            x = self.solved(jax.tree.map(itemgetter(some), pulled))
            found[:, some], moved[some] = products_of(pulled, x), self._moved(x)
        return found, moved

    @property
    def _scale(self) -> Float[np.ndarray, "shared"]:
        return still(self.equations.scale.shared)

    def _moved(self, x: Increments) -> Float[np.ndarray, "m shared"]:
        return -still(x.shared) * self._scale

    def _pulled(self, column: Column, wanted: range) -> Increments:
        """J' z of each."""

        def batches() -> Iterator[Float[np.ndarray, "batch places"]]:
            batch = _batch(len(self.laid))
            for first in wanted[::batch]:
                z = np.zeros((batch, len(self.laid)))
                for row, k in enumerate(range(first, min(first + batch, wanted.stop))):
                    z[row] = np.append(column(k), 0.0)[self.laid]
                yield z

        pull = _pull if self.image_rows else _pull_others
        parts = [jax.tree.map(still, self._run(pull, z)) for z in batches()]
        # There may be none: blocks whose parameters are all held, or that have nothing to look for patterns in.
        return joined(parts, self.equations.scale, len(wanted))

    def solved(self, b: Increments) -> Increments:
        """x of N x = b of right-hand sides along a leading axis, in scaled increments."""
        return solve_many(self.equations, b, self.adjusted.seconds)

    def _pushed(self, x: Increments) -> Iterator[Float[np.ndarray, "n"]]:
        """J x of each, in the order of `places`."""
        kept, many, push = self.laid < self.count, len(x.shared), _push if self.image_rows else _push_others
        for first, some in zip(range(0, many, size := _batch(len(self.laid))), in_batches(x, size), strict=True):
            for row in still(self._run(push, some))[: many - first]:
                own = np.zeros(self.count)
                own[self.laid[kept]] = row[kept]
                yield own

    def _run(self, program: Callable, given: Any) -> Any:
        return run_compiled(program, (self.equations, given), self.adjusted.seconds, "covariance")


def products_of(a: Increments, b: Increments) -> Float[Numbers, "m n"]:
    """a'b of each of `a` with each of `b`, along leading axes.

    Kind by kind: of a large block each copy of all of them takes 100 MB.
    """
    found: Any = np.zeros((len(a.shared), len(b.shared)))
    for pair in zip(a, b, strict=True):
        v, w = (one.reshape(len(one), math.prod(one.shape[1:])) for one in map(still, pair))
        found = found + v @ w.T
    return found


def prepare_responses(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Have what `Responses` needs compiled in the background."""
    if jax.process_count() > 1:
        # What comes from several processes is of types of its own.
        return
    equations = equations.on_one_device.weighed
    shapes = jax.tree.leaves(jax.eval_shape(lambda e: e.at.residuals(), equations))
    n = sum(math.prod(v.shape) for v in shapes)
    prepare(_pull, (equations, np.broadcast_to(0.0, (_batch(n), n))), seconds)
    prepare_solving(equations, seconds)
    prepare(_push, (equations, blank(equations.scale, _batch(n))), seconds)


def _batch(numbers: int) -> int:
    """A power of two, which can be halved where rows have many numbers."""
    most = int(np.clip(_NUMBERS // max(numbers, 1), 1, _AT_ONCE))
    return 1 << most.bit_length() - 1


@eqx.filter_jit
def _pull(equations: NormalEquations, z: Float[Array, "k places"]) -> Increments:
    zero = jax.tree.map(lambda v: jnp.zeros(v.shape), jax.eval_shape(equations.at.residuals))
    return equations.pull(jax.vmap(ravel_pytree(zero)[1])(z))


@eqx.filter_jit
def _pull_others(equations: NormalEquations, z: Float[Array, "k places"]) -> Increments:
    one = jax.eval_shape(equations.push_others, blank(equations.scale, 1))
    zero = jax.tree.map(lambda v: jnp.zeros(v.shape[1:]), one)
    return equations.pull_others(jax.vmap(ravel_pytree(zero)[1])(z))


@eqx.filter_jit
def _push_others(equations: NormalEquations, x: Increments) -> Float[Array, "k places"]:
    return _rows(equations.push_others(x))


@eqx.filter_jit
def _push(equations: NormalEquations, x: Increments) -> Float[Array, "k places"]:
    return _rows(equations.push(x))


def _rows(residuals: NonImageResiduals) -> Float[Array, "k places"]:
    return jax.vmap(lambda one: ravel_pytree(one)[0])(residuals)
