"""What XLA is asked for on a CPU: how much compiling is worth its time."""

import os
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np

Options = dict[str, bool | int | str]
# For what runs once a block, where all that counts is compiling: a quarter of the default's time on jax 0.10.2.
QUICK_TO_COMPILE: Options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# For the adjustment: a third to two thirds of the default's time, and what comes out runs as fast (docs/solver.md).
_ADJUSTMENT: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


# For what runs thousands of times: four times the time to compile, and a quarter less to run (docs/monte_carlo.md).
_THOROUGH: Options = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}


_Function = TypeVar("_Function", bound=Callable)
_runs_little = set[Callable]()
# Numbers in the arguments of a block of some 50,000 image points, on which such a program runs for a tenth of a second.
_LITTLE = 4_000_000


def runs_little(function: _Function) -> _Function:
    """`function`, which a block needs once or a few times: of a small one compiling it is all that counts."""
    _runs_little.add(function)
    return function


def options_here(function: Callable, arguments: Any, thorough: bool = False) -> Options | None:
    """Ours on a CPU, unless the user chose a level of optimisation."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu" or chosen:
        return None
    if function in _runs_little and sum(np.size(v) for v in jax.tree.leaves(arguments) if eqx.is_array(v)) < _LITTLE:
        return QUICK_TO_COMPILE
    return _THOROUGH if thorough else _ADJUSTMENT
