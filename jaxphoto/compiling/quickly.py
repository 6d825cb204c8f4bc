"""Compiling what runs once a block: quickly, and only as long as it is needed."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import jax

from jaxphoto.compiling.options import QUICK_TO_COMPILE

_Result = TypeVar("_Result")
# JAX alone keeps what it compiles for every shape for ever, up to 5 MB each; and each block has other ones.
_SHAPES = 16


def jit_quickly(function: Callable[..., _Result], static_argnums: int | tuple[int, ...] = ()) -> Callable[..., _Result]:
    """`jax.jit` of what runs once a block: hardly optimised, and forgotten when many shapes have come."""
    jitted: Any = jax.jit(function, static_argnums=static_argnums, compiler_options=QUICK_TO_COMPILE)

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> _Result:
        if jitted._cache_size() > _SHAPES:
            jitted.clear_cache()
        return jitted(*arguments, **named)

    return call
