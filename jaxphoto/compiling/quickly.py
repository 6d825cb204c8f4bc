"""Quick compilation of what runs once per block."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from jaxphoto.compiling.options import quick_to_compile

_Result = TypeVar("_Result")
# JAX keeps the program of every shape for ever, up to 5 MB each, and every block has other shapes.
_SHAPES = 16


def jit_quickly(function: Callable[..., _Result], static_argnums: int | tuple[int, ...] = ()) -> Callable[..., _Result]:
    """Return `jax.jit` of a function that runs once per block: hardly optimised, and keeping few shapes.

    Under a transformation of JAX it is the plain function, because compiler options belong to a whole program.
    """

    shapes: set[tuple] = set()

    @functools.cache
    def jitted() -> Any:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=quick_to_compile())

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> _Result:
        leaves = jax.tree.leaves((arguments, named))
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return function(*arguments, **named)
        shape = jax.tree.structure((arguments, named)), *map(np.shape, leaves)
        if shape not in shapes and len(shapes) >= _SHAPES:
            jitted().clear_cache()
            shapes.clear()
        shapes.add(shape)
        with jax.ensure_compile_time_eval():
            return jitted()(*arguments, **named)

    return call
