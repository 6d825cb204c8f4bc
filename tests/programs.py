"""What compiled programs are made of."""

import re

import jax


def batched_lapack_calls(function, *arguments) -> list[str]:
    """Calls of LAPACK on several matrices at once in the program of `function`, as lines of StableHLO."""
    text = jax.jit(function).lower(*arguments).as_text()
    calls = [line for line in text.splitlines() if "custom_call @lapack" in line]
    return [line for line in calls if re.search(r": \(tensor<\d+x\d+x\d+x", line)]
