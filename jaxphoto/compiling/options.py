"""Compiler options of XLA on a CPU: compile time against run time.

No option is needed for a correct result. Options change between versions of jaxlib, so each is tested for support.
"""

import functools
import os

import jax

Options = dict[str, bool | int | str]
# Number of parts into which XLA splits a program. The default is 32 parts, which many cores compile in parallel, each
# with overhead. With two parts, compiling a flight of eleven photographs takes a quarter less CPU time, and the same
# time on two cores.
_PARTS = 2


def _options(level: int, fusion_emitters: bool) -> Options:
    return {
        "xla_backend_optimization_level": level,
        # Available up to jaxlib 0.11; the older code generator compiles faster.
        "xla_cpu_use_fusion_emitters": fusion_emitters,
        "xla_cpu_parallel_codegen_split_count": _PARTS,
    }


# Options of the adjustment (docs/solver.md).
_ADJUSTMENT = _options(1, fusion_emitters=False)
# Options of programs that run thousands of times: four times the compile time, a quarter less run time
# (docs/monte_carlo.md).
_THOROUGH = _options(3, fusion_emitters=True)


def quick_to_compile() -> Options:
    """Return options for programs that run once per block: only their compile time matters."""
    return _known(_options(0, fusion_emitters=False))


def options_here(thorough: bool = False) -> Options | None:
    """Return options for the programs of an adjustment; None on other devices, or if the user chose a level."""
    chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
    if jax.default_backend() != "cpu" or chosen or jax.config.values.get("jax_disable_most_optimizations"):
        return None
    return _known(_THOROUGH if thorough else _ADJUSTMENT)


def _known(options: Options) -> Options:
    """Return the options that this jaxlib accepts."""
    pairs = tuple(options.items())
    return options if _are_known(pairs) else dict(pair for pair in pairs if _are_known((pair,)))


@functools.cache
def _are_known(options: tuple[tuple[str, bool | int | str], ...]) -> bool:
    """Return True if this jaxlib accepts the options, tested with an empty program."""
    try:
        jax.jit(lambda: 0, compiler_options=dict(options)).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
