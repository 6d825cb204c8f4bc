"""What XLA is asked for on a CPU: how much compiling is worth its time."""

import os

import jax

Options = dict[str, bool | int | str]
# For what runs once a block, where all that counts is compiling: a quarter of the default's time on jax 0.10.2.
QUICK_TO_COMPILE: Options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# For the adjustment: a third to two thirds of the default's time, and what comes out runs as fast (docs/solver.md).
_ADJUSTMENT: Options = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False}
# A sixth faster, but twice the time to compile: for blocks that are solved for seconds.
_LARGE: Options = {"xla_backend_optimization_level": 1}
# Arguments from this size on (bytes) make a program a large one.
_FROM = 5_000_000


def options_here(size: int) -> Options | None:
    """Ours on a CPU, for a program with arguments of `size` bytes, unless the user chose a level of optimisation."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu" or chosen:
        return None
    return _LARGE if size >= _FROM else _ADJUSTMENT
