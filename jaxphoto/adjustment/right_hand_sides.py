"""x of N x = b of many right-hand sides, a few at a time, by one program of a block for all that asks so."""

from collections.abc import Iterator
from operator import itemgetter

import equinox as eqx
import jax
import numpy as np

from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.normal_equations import NormalEquations
from jaxphoto.arrays import is_traced, still
from jaxphoto.compiling import prepare, run_compiled

# Right-hand sides that are solved for side by side: making F of a large block anew costs more than they do. Together
# they have no more numbers than this, as several arrays of them are held.
_AT_ONCE, _NUMBERS = 48, 8_000_000


def solve_many(equations: NormalEquations, b: Increments, seconds: dict[str, float]) -> Increments:
    """x of N x = b of right-hand sides along a leading axis, in scaled increments.

    `equations` are those of one device, weighed: others are others' programs.
    """
    if is_traced((equations, b)):
        return _solve(equations, b)
    batches = in_batches(b, at_once(equations.scale))
    parts = [jax.tree.map(still, run_compiled(_solve, (equations, one), seconds, "covariance")) for one in batches]
    return joined(parts, equations.scale, len(b.shared))


def joined(parts: list[Increments], one: Increments, many: int) -> Increments:
    """Batches of increments like `one` in a row, without what the last was filled up with; of none, too."""
    return jax.tree.map(lambda like, *v: np.concatenate([np.zeros((0, *like.shape)), *v])[:many], one, *parts)


def prepare_solving(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Have what `solve_many` needs compiled in the background."""
    prepare(_solve, (equations, blank(equations.scale, at_once(equations.scale))), seconds)


def blank(one: Increments, many: int) -> Increments:
    """So many right-hand sides of no memory, for their shapes."""
    return jax.tree.map(lambda v: np.broadcast_to(0.0, (many, *v.shape)), one)


def at_once(one: Increments) -> int:
    """How many right-hand sides like `one` are solved for side by side."""
    return int(np.clip(_NUMBERS // sum(np.size(v) for v in jax.tree.leaves(one)), 1, _AT_ONCE))


def in_batches(tree: Increments, size: int) -> Iterator[Increments]:
    """Of `size` each, the last filled up with zeros."""
    for first in range(0, len(tree.shared), size):
        some = jax.tree.map(itemgetter(slice(first, first + size)), tree)
        rest = size - len(some.shared)
        yield jax.tree.map(lambda v: np.concatenate([v, np.zeros((rest, *v.shape[1:]))]), some) if rest else some  # noqa: B023


@eqx.filter_jit
def _solve(equations: NormalEquations, b: Increments) -> Increments:
    return jax.vmap(equations.solve)(b)
