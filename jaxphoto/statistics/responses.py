"""How unknowns and adjusted observations move with the observed ones, a few directions at a time.

With J the derivatives of whitened residuals (observed minus computed), an error z of the observations moves the
unknowns by -N^-1 J' z and what was adjusted by H z = J N^-1 J' z; unknown k moves by -(J N^-1 e_k)_i with
observation i.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, Int32

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.arrays import still
from jaxphoto.compiling import prepare, run_compiled

# Directions that are computed with side by side, and the numbers that they may have together.
_AT_ONCE, _NUMBERS = 8, 8_000_000


class Responses(eqx.Module):
    """What directions of errors of the observations do, computed in batches."""

    adjusted: Adjustment
    laid: Int32[np.ndarray, "places"]
    """The number, in the block's own order, of everything in the arrays that are computed with; `count`: padding."""
    count: int
    places: dict[str, Int[np.ndarray, "..."]]
    """The number of each observation by the name of its group, shaped like the residuals."""

    @classmethod
    def of(cls, adjusted: Adjustment) -> "Responses":
        """Of an adjustment."""
        leaves, structure = jax.tree.flatten(adjusted.residuals)
        ends = np.cumsum([np.size(v) for v in leaves])
        numbers = [np.arange(e - np.size(v), e, dtype=float) for v, e in zip(leaves, ends, strict=True)]
        shaped = [n.reshape(np.shape(v)) for n, v in zip(numbers, leaves, strict=True)]
        numbered = jax.tree.unflatten(structure, shaped)
        padded = adjusted.tiled.pad_residuals(numbered, float(ends[-1]))
        laid = np.concatenate([np.ravel(v) for v in jax.tree.leaves(padded)]).astype(np.int32)
        places = {name: np.asarray(v).astype(int) for name, v in numbered.named.items()}
        return cls(adjusted, laid, int(ends[-1]), places)

    def to_errors(
        self, column: Callable[[int], Float[np.ndarray, "n"]], many: int
    ) -> Iterator[tuple[Float[np.ndarray, "shared"], Float[np.ndarray, "n"]]]:
        """Of each error z = `column(k)`, whitened and in the order of `places`: the shared unknowns' motion, in their
        own units, and H z."""
        yield from self._run(many, column, None)

    def of_unknowns(self, shared: Sequence[int]) -> Iterator[Float[np.ndarray, "n"]]:
        """By how much each of some `shared` unknowns (places in `Structure.labels`) moves, in its unit, with an error
        of one standard deviation of each observation."""
        scale = still(self.adjusted.equations.scale.shared)
        for k, (_, moved) in zip(shared, self._run(len(shared), None, shared), strict=True):
            yield -moved * scale[k]

    def _run(self, many: int, column, shared) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        equations = self.adjusted.equations.on_one_device.weighed
        scale = still(equations.scale.shared)
        batch = _batch(len(self.laid))
        kept = self.laid < self.count
        for first in range(0, many, batch):
            z, b = np.zeros((batch, len(self.laid))), np.zeros((batch, len(scale)))
            some = range(first, min(first + batch, many))
            for row, k in enumerate(some):
                if column is not None:
                    z[row] = np.append(column(k), 0.0)[self.laid]
                else:
                    b[row, shared[k]] = 1.0
            x, moved = map(still, run_compiled(_respond, (equations, b, z), self.adjusted.seconds, "covariance"))
            for row, _ in enumerate(some):
                own = np.empty(self.count)
                own[self.laid[kept]] = moved[row, kept]
                yield -x[row] * scale, own


def prepare_responses(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Have what `Responses` needs compiled in the background."""
    if jax.process_count() > 1:
        # What comes from several processes is of types of its own.
        return
    equations = equations.on_one_device.weighed
    shapes = jax.tree.leaves(jax.eval_shape(lambda e: e.at.residuals(), equations))
    n = sum(math.prod(v.shape) for v in shapes)
    given = (np.broadcast_to(0.0, (_batch(n), k)) for k in (len(equations.scale.shared), n))
    prepare(_respond, (equations, *given), seconds)


def _batch(numbers: int) -> int:
    return int(np.clip(_NUMBERS // numbers, 1, _AT_ONCE))


@eqx.filter_jit
def _respond(
    equations: NormalEquations, b: Float[Array, "k shared"], z: Float[Array, "k places"]
) -> tuple[Float[Array, "k shared"], Float[Array, "k places"]]:
    _, back = ravel_pytree(jax.tree.map(lambda v: jnp.zeros(v.shape), jax.eval_shape(equations.at.residuals)))
    none = equations.at.increments

    def one(b: Float[Array, "shared"], z: Float[Array, "places"]) -> tuple[Array, Array]:
        x, moved = equations.respond(none._replace(shared=b), back(z))
        return x.shared, ravel_pytree(moved)[0]

    return jax.vmap(one)(b, z)
