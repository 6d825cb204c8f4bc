"""Solution of N x = b for many right-hand sides with one program per block."""

from collections.abc import Iterator
from operator import itemgetter

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.normal_equations import NormalEquations
from jaxphoto.arrays import is_traced, to_numpy
from jaxphoto.compiling import prepare, run_compiled

# Maximum number of right-hand sides solved at a time: recomputing F of a large block costs more than solving for them.
# Maximum number of their elements in total: several such arrays are in memory.
_AT_ONCE, _NUMBERS = 48, 8_000_000


def solve_many(equations: NormalEquations, b: Increments, seconds: dict[str, float]) -> Increments:
    """Solve N x = b for right-hand sides along a leading axis, in scaled increments.

    `equations` must be on one device with scaled datum constraints; any other form would require a second program.
    """
    if is_traced((equations, b)):
        return _solve(equations, b)
    batches = in_batches(b, at_once(equations.scale))
    parts = [jax.tree.map(to_numpy, run_compiled(_solve, (equations, one), seconds, "covariance")) for one in batches]
    return joined(parts, equations.scale, len(b.shared))


def joined(parts: list[Increments], one: Increments, many: int) -> Increments:
    """Concatenate batches of increments like `one`, without padding; the list may be empty."""
    return jax.tree.map(lambda like, *v: np.concatenate([np.zeros((0, *like.shape)), *v])[:many], one, *parts)


def prepare_solving(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Compile the programs of `solve_many` in the background."""
    prepare(_solve, (equations, blank(equations.scale, at_once(equations.scale))), seconds)


def blank(one: Increments, many: int) -> Increments:
    """Return abstract right-hand sides, without allocating memory."""
    return jax.tree.map(lambda v: np.broadcast_to(0.0, (many, *v.shape)), one)


def at_once(one: Increments) -> int:
    """Return the number of right-hand sides like `one` that are solved at a time."""
    return int(np.clip(_NUMBERS // sum(np.size(v) for v in jax.tree.leaves(one)), 1, _AT_ONCE))


def in_batches(tree: Increments, size: int) -> Iterator[Increments]:
    """Split into batches of `size`, the last padded with zeros."""
    for first in range(0, len(tree.shared), size):
        some = jax.tree.map(itemgetter(slice(first, first + size)), tree)
        rest = size - len(some.shared)
        yield jax.tree.map(lambda v: np.concatenate([v, np.zeros((rest, *v.shape[1:]))]), some) if rest else some  # noqa: B023


@eqx.filter_jit
def _solve(equations: NormalEquations, b: Increments) -> Increments:
    return jax.vmap(equations.solve)(b)
