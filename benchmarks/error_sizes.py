"""Do the sizes of errors in findings hold? Simulated flights of P31 with one error each answer.

python benchmarks/error_sizes.py --flights 500

Errors of 1 to 1000 standard deviations (log-uniform) are added to the example block, with new noise each time: to one
observation, to all stations or control points (another datum), or to the stations of one strip. Where a finding names
the error with its size and sigma, the interval of 95 % is held against the truth.
"""

import argparse
import re
import time

import equinox as eqx
import jax
import numpy as np
from variance_components import flight

from jaxphoto import Block, Tables, Unknowns, adjust
from jaxphoto.report import verdict_of
from jaxphoto.simulation import remeasure

KINDS = ("control point", "station", "image point", "all stations", "all control points", "strip")
_NUMBER = r"([+-][\d.e+-]+) \+- ([\d.e+-]+)"


def disturbed(block: Block, kind: str, rng: np.random.Generator) -> tuple[Block, str, float]:
    """Return the block with one error, the pattern of its size in a finding, and its size (m, mm)."""
    size = 10 ** rng.uniform(0, 3) * rng.choice([-1.0, 1.0])
    if kind == "image point":
        rows, row, axis = block.image_points, rng.integers(len(block.image_points)), rng.integers(2)
        size *= float(np.asarray(rows.sigma)[row, axis])
        xy = np.array(rows.xy)
        xy[row, axis] += size
        label = rows.words_of(np.array([axis]), np.array([row]), block.images, block.points)[0]
        pattern = f"{re.escape(label)}: error {_NUMBER} mm in {'xy'[axis]}"
        return block.with_observations({"image_points": eqx.tree_at(lambda r: r.xy, rows, xy)}), pattern, size
    name = "control_points" if "control" in kind else "stations"
    rows = block.named_observations[name]
    axis = rng.integers(3)
    chosen = np.asarray(rows.axis) == axis
    if kind in ("control point", "station"):
        row = rng.choice(np.flatnonzero(chosen))
        chosen = np.arange(len(rows)) == row
        label = f"{rows.words_of(np.array([0]), np.array([row]), block.images, block.points)[0]}: error"
    elif kind == "strip":
        strip = rng.choice(sorted(set(block.image_strip)))
        chosen &= np.array(block.image_strip)[rows.who] == strip
        label = f"{'XYZ'[axis]} of strip {strip}"
    else:
        label = "XYZ"[axis]
    size *= float(np.median(np.asarray(rows.sigma)[chosen]))
    value = np.asarray(rows.value) + np.where(chosen, size, 0.0)
    if kind == "all control points":
        # Findings name the opposite shift of the stations.
        size = -size
    pattern = f"{re.escape(label)} {_NUMBER}"
    return block.with_observations({name: eqx.tree_at(lambda r: r.value, rows, value)}), pattern, size


def stated(block: Block, start: Unknowns, pattern: str) -> tuple[float, float] | None:
    """Return size and sigma of the error in the findings, if they name it."""
    for finding in verdict_of(Tables(adjust(block, start))).findings:
        if finding.code in ("blunder", "systematic") and (found := re.search(pattern, finding.text)):
            return float(found[1]), float(found[2])
    return None


def main() -> None:
    """Print, by kind: errors named with a size, their coverage, and the median of sigma over its a priori value."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=500)
    parser.add_argument("kinds", nargs="*", default=KINDS)
    arguments = parser.parse_args()
    block, truth = flight()
    observed = lambda b: (b.image_points.xy, b.stations.value, b.control.value)  # noqa: E731
    drawn = jax.jit(lambda key: observed(remeasure(block, truth, key)))
    for kind in arguments.kinds:
        began, ratios = time.perf_counter(), list[float]()
        for seed in range(arguments.flights):
            new = eqx.tree_at(observed, block, jax.tree.map(np.asarray, drawn(jax.random.key(seed))))
            wrong, pattern, size = disturbed(new, kind, np.random.default_rng(seed))
            try:
                found = stated(wrong, truth, pattern)
            except ValueError as error:
                print(f"{kind}, seed {seed}: {error}")
                continue
            if found is not None:
                ratios.append((found[0] - size) / found[1])
        r = np.abs(ratios)
        print(
            f"{kind}: {len(r)} of {arguments.flights} named, {100 * np.mean(r < 1.96):.1f} % covered, largest "
            f"{r.max(initial=0.0):.1f} sigma, {time.perf_counter() - began:.0f} s"
        )


if __name__ == "__main__":
    main()
