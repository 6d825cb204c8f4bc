"""What XLA is asked for on a CPU: how much compiling is worth its time."""

import os

import jax

Options = dict[str, bool | int | str]
# For what runs once a block, where all that counts is compiling: a quarter of the default's time on jax 0.10.2.
QUICK_TO_COMPILE: Options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# For the adjustment: a third to two thirds of the default's time, and what comes out runs as fast (docs/solver.md).
_ADJUSTMENT: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}


# For what runs thousands of times: four times the time to compile, and a quarter less to run (docs/monte_carlo.md).
_THOROUGH: Options = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}


def options_here(thorough: bool = False) -> Options | None:
    """Ours on a CPU, unless the user chose a level of optimisation."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu" or chosen:
        return None
    return _THOROUGH if thorough else _ADJUSTMENT
