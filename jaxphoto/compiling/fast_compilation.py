"""Fast compilation of functions that run once per block."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from jaxphoto.compiling.options import quick_to_compile

_Result = TypeVar("_Result")
# Maximum number of cached shapes per function. A compiled program takes up to 5 MB, and every block has different
# shapes.
_SHAPES = 16


def jit_quickly(function: Callable[..., _Result], static_argnum: int | None = None) -> Callable[..., _Result]:
    """Return `jax.jit` of a function that runs once per block: minimal optimisation, few cached shapes.

    Under a transformation of JAX it is the plain function, because compiler options apply to a whole program.
    """
    programs: dict[tuple, jax.stages.Compiled] = {}

    @functools.cache
    def jitted() -> Any:
        return jax.jit(function, static_argnums=static_argnum, compiler_options=quick_to_compile())

    @functools.wraps(function)
    def call(*arguments: Any) -> _Result:
        dynamic = [None if k == static_argnum else v for k, v in enumerate(arguments)]
        leaves, structure = jax.tree.flatten(dynamic)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return function(*arguments)
        static = None if static_argnum is None else arguments[static_argnum]
        key = structure, static, *((np.shape(v), getattr(v, "dtype", type(v))) for v in leaves)
        if key not in programs:
            if len(programs) >= _SHAPES:
                programs.clear()
                jitted().clear_cache()
            programs[key] = jitted().lower(*arguments).compile()
        return programs[key](*(v for k, v in enumerate(arguments) if k != static_argnum))

    return call
