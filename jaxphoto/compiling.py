"""Compiling: how much of it is worth its time, and calling what is compiled so that the two are told apart."""

import os
import time
from typing import Any

import equinox as eqx
import jax

Options = dict[str, bool | int | str]
# For what runs once a block, where all that counts is compiling: a quarter of the default's time on jax 0.10.2.
QUICK_TO_COMPILE: Options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# For the adjustment: a third to two thirds of the default's time, and what comes out runs as fast (docs/solver.md).
_ADJUSTMENT: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}

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
        _executables[key] = function.lower(*arguments).compile(compiler_options=_options())
    ready = time.perf_counter()
    result = jax.block_until_ready(_executables[key](*arguments))
    seconds["compile"] = seconds.get("compile", 0.0) + ready - began
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - ready
    return result


def _options() -> Options | None:
    """Ours on a CPU, unless the user chose a level of optimisation."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    return _ADJUSTMENT if jax.default_backend() == "cpu" and not chosen else None
