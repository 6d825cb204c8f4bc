"""Evaluate an expression once where XLA would duplicate it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def once(function: Callable, witness: Any, *given: Any) -> Any:
    """Evaluate `function(*given)` once: XLA on a CPU fuses cheap operations into each of their users, despite barriers.

    XLA does not fuse a conditional branch. This branch is always taken, but XLA cannot infer that: the condition
    depends on `witness`, an argument of the program whose values are never negative.
    """
    # jit caches the trace of eval_shape.
    function = jax.jit(function)
    shape = jax.eval_shape(function, *given)
    nothing = lambda *_: jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shape)  # noqa: E731
    return jax.lax.cond(jnp.asarray(witness).ravel()[0] >= 0, function, nothing, *given)
