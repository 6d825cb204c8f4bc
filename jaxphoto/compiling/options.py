"""What XLA is asked for on a CPU: how much compiling is worth its time."""

import os

import jax

Options = dict[str, bool | int | str]
# XLA cuts a program into 32 parts, so that many cores make its code, of which each costs again: with two parts all
# compiling of a flight of eleven photographs takes a quarter less of the processor, and no longer on two cores.
_PARTS = 2


def _options(level: int, fusion_emitters: bool) -> Options:
    return {
        "xla_backend_optimization_level": level,
        "xla_cpu_use_fusion_emitters": fusion_emitters,
        "xla_cpu_parallel_codegen_split_count": _PARTS,
    }


# For what runs once a block, where all that counts is compiling: a quarter of the default's time on jax 0.10.2.
QUICK_TO_COMPILE = _options(0, fusion_emitters=False)
# For the adjustment: a third to two thirds of the default's time, and what comes out runs as fast (docs/solver.md).
_ADJUSTMENT = _options(1, fusion_emitters=False)
# For what runs thousands of times: four times the time to compile, and a quarter less to run (docs/monte_carlo.md).
_THOROUGH = _options(3, fusion_emitters=True)


def options_here(thorough: bool = False) -> Options | None:
    """Ours on a CPU, unless the user chose a level of optimisation."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu" or chosen:
        return None
    return _THOROUGH if thorough else _ADJUSTMENT
