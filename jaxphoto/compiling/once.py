"""Computing something once, whatever XLA thinks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def once(function: Callable, witness: Any, *given: Any) -> Any:
    """`function(*given)`, computed once: XLA on a CPU fuses what is cheap into all that uses it, barriers or not.

    It leaves a branch alone that may not be taken; that this one always is, XLA cannot know: it hangs on `witness`, an
    argument of the program whose numbers are never negative.
    """
    # jit keeps the trace that the shape takes.
    function = jax.jit(function)
    shape = jax.eval_shape(function, *given)
    nothing = lambda *_: jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shape)  # noqa: E731
    return jax.lax.cond(jnp.asarray(witness).ravel()[0] >= 0, function, nothing, *given)
