"""How long it takes to say how well every observation is checked: redundancy numbers, w, what tests would not find.

python benchmarks/reliability.py [--problem B1000]

Times of a first call hold its compiling; those of a second one are of another adjustment of the same kind.
"""

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from blocks import SIZES, generate
from machine import machine, markdown, memory, sentence
from ours import block_of

from jaxphoto import Adjustment, adjust, covariance
from jaxphoto.statistics import (
    blunder_test,
    mdb_effects,
    minimal_detectable_biases,
    normalised_residuals,
    redundancy_numbers,
    systematic_effect_tests,
)


def main() -> None:
    """Print a table: step, first and second time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", choices=list(SIZES), default="B1000")
    arguments = parser.parse_args()
    block = block_of(generate(SIZES[arguments.problem]), arguments.problem)
    head, began = machine(), time.perf_counter()
    first = adjust(block)
    said = (
        f"{arguments.problem}: {len(block.image_points)} image points, adjusted in {time.perf_counter() - began:.0f} s"
    )
    times = [_timed(first), _timed(adjust(block, first.unknowns))]
    rows = [[step, *(f"{one[step]:.1f}" for one in times)] for step in times[0]]
    print(sentence(head), "", f"{said} with compiling; peak of memory {memory('VmHWM'):.0f} MB", "", sep="\n")
    print("\n".join(markdown(["", "first call, s", "second call, s"], rows)))


def _timed(adjusted: Adjustment) -> dict[str, float]:
    found: dict[str, float] = {}

    def of(step: str, function: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        result = function()
        found[step] = time.perf_counter() - began
        print(f"{step}: {found[step]:.1f} s", file=sys.stderr, flush=True)
        return result

    q = of("covariances", lambda: covariance(adjusted, rows=True))
    r = of("redundancy numbers", lambda: redundancy_numbers(adjusted, q))
    of("w", lambda: normalised_residuals(adjusted, r))
    of("detectable errors", lambda: minimal_detectable_biases(adjusted, r))
    test = of("every w against its critical value", lambda: blunder_test(adjusted, r))
    of("effects of undetected errors", lambda: mdb_effects(adjusted, q, r))
    blunders = [(s.group, s.row) for s in test.suspects]
    of("patterns", lambda: systematic_effect_tests(adjusted, np.asarray(q.shared_sigma), blunders))
    return found


if __name__ == "__main__":
    main()
