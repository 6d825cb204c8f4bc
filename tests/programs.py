"""What compiled programs are made of."""

import re

import jax


def batched_lapack_calls(function, *arguments) -> list[str]:
    """Calls of LAPACK on several matrices at once in the program of `function`, as lines of StableHLO."""
    return batched_in(jax.jit(function).lower(*arguments).as_text())


def batched_in(program: str) -> list[str]:
    """The same of a program as text."""
    calls = [line for line in program.splitlines() if "custom_call @lapack" in line]
    return [line for line in calls if re.search(r": \(tensor<\d+x\d+x\d+x", line)]
