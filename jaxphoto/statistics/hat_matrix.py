"""Products with the hat matrix H = J N^-1 J' and with N^-1 J', in batches of directions.

With J the derivatives of whitened residuals (observed minus computed), an error z of the observations moves the
unknowns by -N^-1 J' z and the adjusted observations by H z = J N^-1 J' z. A unit error of observation i moves unknown k
by -(J N^-1 e_k)_i. Products z' H z of many errors do not need J x: they are inner products of J' z and N^-1 J' z.
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
from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.compiling import prepare, run_compiled

# Maximum number of directions per batch; maximum number of elements of an array, of which several coexist.
_MAX_BATCH, _MAX_ELEMENTS = 16, 20_000_000
Column = Callable[[int], Float[np.ndarray, "n"]]


class HatMatrix(eqx.Module):
    """Products of the hat matrix with errors of the observations, computed in batches."""

    adjusted: Adjustment
    equations: NormalEquations
    """Normal equations on one device, with weights applied."""
    laid: Int32[np.ndarray, "places"]
    """Observation index of every element of the padded arrays; `count` for padding."""
    count: int
    places: dict[str, Int[np.ndarray, "..."]]
    """Index of each observation by group name, shaped like the residuals."""
    image_rows: bool = eqx.field(static=True, default=True)
    """False if no error is in image points. H z is then zero for image rows: skipping them saves most of the time."""

    @classmethod
    def of(cls, adjusted: Adjustment, *, image_rows: bool = True) -> "HatMatrix":
        """Index the observations of an adjustment and prepare its normal equations."""
        leaves, structure = jax.tree.flatten(adjusted.residuals)
        ends = np.cumsum([np.size(v) for v in leaves])
        numbers = [np.arange(e - np.size(v), e, dtype=float) for v, e in zip(leaves, ends, strict=True)]
        shaped = [n.reshape(np.shape(v)) for n, v in zip(numbers, leaves, strict=True)]
        numbered = jax.tree.unflatten(structure, shaped)
        padded: NonImageResiduals = adjusted.padded.pad_residuals(numbered, float(ends[-1]))
        if not image_rows:
            padded = NonImageResiduals(padded.others, padded.datum, padded.names)
        padded_index = np.concatenate([np.ravel(v) for v in jax.tree.leaves(padded)]).astype(np.int32)
        places = {name: np.asarray(v).astype(int) for name, v in numbered.named.items()}
        return cls(adjusted, adjusted.equations.on_one_device.weighed, padded_index, int(ends[-1]), places, image_rows)

    @property
    def residuals(self) -> Float[np.ndarray, "count"]:
        """Whitened residuals in the order of the observation indices; zero for datum constraints."""
        residuals = np.zeros(self.count)
        for name, place in self.places.items():
            residuals[place] = np.asarray(self.adjusted.residuals[name])
        return residuals

    def apply(self, column: Column, count: int) -> Iterator[tuple[Float[np.ndarray, "shared"], np.ndarray]]:
        """Yield the changes of the shared unknowns (own units) and H z for each error z = `column(k)`.

        Errors are whitened, in the order of the observation indices.
        """
        size = at_once(self.equations.scale)
        for first in range(0, count, size):
            x = self.solve(self._jt_products(column, range(first, min(first + size, count))))
            yield from zip(self._shared_changes(x), self._j_products(x), strict=True)

    def influence_on(self, shared: Sequence[int]) -> Iterator[Float[np.ndarray, "n"]]:
        """Yield the sensitivity of each `shared` unknown (index in `Structure.labels`) to every observation.

        It is the change of the unknown (own unit) for an error of one standard deviation.
        """
        b = jax.tree.map(lambda v: np.zeros((len(shared), *v.shape)), self.equations.scale)
        b.shared[np.arange(len(shared)), np.array(shared, int)] = 1.0
        for k, influence in zip(shared, self._j_products(self.solve(b)), strict=True):
            yield -influence * self._scale[k]

    def products(self, column: Column, count: int) -> tuple[Float[np.ndarray, "count count"], Float[np.ndarray, "m s"]]:
        """Return z' H z of all pairs of errors z = `column(k)`, and the changes of the shared unknowns."""
        jt_z = self._jt_products(column, range(count))
        products, changes = np.zeros((count, count)), np.zeros((count, len(self._scale)))
        # The solutions of all directions take hundreds of MB in a large block: discard them batch by batch.
        for first in range(0, count, size := at_once(self.equations.scale)):
            batch = slice(first, first + size)
            x = self.solve(jax.tree.map(itemgetter(batch), jt_z))
            products[:, batch], changes[batch] = inner_products(jt_z, x), self._shared_changes(x)
        return products, changes

    @property
    def _scale(self) -> Float[np.ndarray, "shared"]:
        return to_numpy(self.equations.scale.shared)

    def _shared_changes(self, x: Increments) -> Float[np.ndarray, "m shared"]:
        return -to_numpy(x.shared) * self._scale

    def _jt_products(self, column: Column, directions: range) -> Increments:
        """Compute J' z of each direction."""

        def batches() -> Iterator[Float[np.ndarray, "batch places"]]:
            batch = _batch(len(self.laid))
            for first in directions[::batch]:
                z = np.zeros((batch, len(self.laid)))
                for row, k in enumerate(range(first, min(first + batch, directions.stop))):
                    z[row] = np.append(column(k), 0.0)[self.laid]
                yield z

        program = _pull if self.image_rows else _pull_others
        parts = [jax.tree.map(to_numpy, self._run(program, z)) for z in batches()]
        # The number of directions is zero if all parameters are fixed or there are no candidate effects.
        return joined(parts, self.equations.scale, len(directions))

    def solve(self, b: Increments) -> Increments:
        """Solve N x = b for right-hand sides along a leading axis, in scaled increments."""
        return solve_many(self.equations, b, self.adjusted.seconds)

    def _j_products(self, x: Increments) -> Iterator[Float[np.ndarray, "n"]]:
        """Yield J x of each direction, in the order of the observation indices."""
        valid, count, program = self.laid < self.count, len(x.shared), _push if self.image_rows else _push_others
        for first, batch in zip(range(0, count, size := _batch(len(self.laid))), in_batches(x, size), strict=True):
            for row in to_numpy(self._run(program, batch))[: count - first]:
                product = np.zeros(self.count)
                product[self.laid[valid]] = row[valid]
                yield product

    def _run(self, program: Callable, argument: Any) -> Any:
        return run_compiled(program, (self.equations, argument), self.adjusted.seconds, "covariance")


def inner_products(a: Increments, b: Increments) -> Float[ArrayLike, "m n"]:
    """Return the inner products a' b of all increments in `a` and `b`, along leading axes.

    Sum by kind of unknown: concatenating all increments of a large block takes 100 MB.
    """
    products: Any = np.zeros((len(a.shared), len(b.shared)))
    for pair in zip(a, b, strict=True):
        v, w = (part.reshape(len(part), math.prod(part.shape[1:])) for part in map(to_numpy, pair))
        products = products + v @ w.T
    return products


def prepare_hat_matrix(adjusted: Adjustment) -> None:
    """Compile the programs of `HatMatrix` in the background."""
    if jax.process_count() > 1:
        # Argument types of arrays sharded over several processes cannot be predicted here.
        return
    hat, seconds = HatMatrix.of(adjusted), adjusted.seconds
    equations, n = hat.equations, len(hat.laid)
    prepare(_pull, (equations, np.broadcast_to(0.0, (_batch(n), n))), seconds)
    prepare_solving(equations, seconds)
    prepare(_push, (equations, blank(equations.scale, _batch(n))), seconds)


def _batch(n_elements: int) -> int:
    """Return the batch size for directions of `n_elements` each: a power of two."""
    most = int(np.clip(_MAX_ELEMENTS // max(n_elements, 1), 1, _MAX_BATCH))
    return 1 << most.bit_length() - 1


@eqx.filter_jit
def _pull(equations: NormalEquations, z: Float[Array, "k places"]) -> Increments:
    zero = jax.tree.map(lambda v: jnp.zeros(v.shape), jax.eval_shape(equations.at.residuals))
    return equations.jt_product(jax.vmap(ravel_pytree(zero)[1])(z))


@eqx.filter_jit
def _pull_others(equations: NormalEquations, z: Float[Array, "k places"]) -> Increments:
    one = jax.eval_shape(equations.j_product_others, blank(equations.scale, 1))
    zero = jax.tree.map(lambda v: jnp.zeros(v.shape[1:]), one)
    return equations.jt_product_others(jax.vmap(ravel_pytree(zero)[1])(z))


@eqx.filter_jit
def _push_others(equations: NormalEquations, x: Increments) -> Float[Array, "k places"]:
    return _rows(equations.j_product_others(x))


@eqx.filter_jit
def _push(equations: NormalEquations, x: Increments) -> Float[Array, "k places"]:
    return _rows(equations.j_product(x))


def _rows(residuals: NonImageResiduals) -> Float[Array, "k places"]:
    return jax.vmap(lambda one: ravel_pytree(one)[0])(residuals)
