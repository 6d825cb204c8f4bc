"""Calling compiled functions so that compiling and computing are told apart."""

import time
from typing import Any

import equinox as eqx
import jax

_executables: dict[object, Any] = {}


def run_compiled(function: Any, arguments: tuple, seconds: dict[str, float], name: str) -> Any:
    """Call `function` (made by `eqx.filter_jit`), compiling it first and apart.

    Adds to `seconds["compile"]` what compiling took, and to `seconds[name]` what the call took. Under a
    transformation of JAX it is a plain call.
    """
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
        return function(*arguments)
    began = time.perf_counter()
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    shapes = tuple((v.shape, v.dtype) for v in jax.tree.leaves(dynamic))
    key = (function, shapes, jax.tree.structure(dynamic), tuple(jax.tree.leaves(static)), jax.tree.structure(static))
    if key not in _executables:
        _executables[key] = function.lower(*arguments).compile()
    ready = time.perf_counter()
    result = jax.block_until_ready(_executables[key](*arguments))
    seconds["compile"] = seconds.get("compile", 0.0) + ready - began
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - ready
    return result
