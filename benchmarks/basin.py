"""Starts that are far off: how many adjustments reach the optimum, and whether any other place is called good.

python benchmarks/basin.py [--block examples/cross_block] [--starts 1000] [--points]
"""

import argparse
import collections
import dataclasses
import time
import warnings
from pathlib import Path

import equinox as eqx
import numpy as np

import jaxphoto
from jaxphoto import Block, JaxphotoError
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.procedures.adjust import adjust_for_tables, start_of
from jaxphoto.report import Tables, verdict_of
from jaxphoto.rotation import small_rotation

# Starts are off by up to so much: positions (m) and heights, angles (degrees), c (part of it).
_METRES, _DEGREES, _OF_C = 100.0, 10.0, 0.1
# The optimum is known to 1e-5 of standard deviations; another one is far from it.
_SAME = 1e-6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--block", type=Path, default=Path(__file__).parents[1] / "examples" / "cross_block")
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--points", action="store_true", help="points are given, too, as far off")
    arguments = parser.parse_args()
    block = jaxphoto.read_block(arguments.block)
    best = float(jaxphoto.adjust(block).sum_of_squares)
    rng = np.random.default_rng(arguments.seed)
    count: collections.Counter[str] = collections.Counter()
    began = time.perf_counter()
    for k in range(arguments.starts):
        count[_end(far_off(block, rng, arguments.points), best)] += 1
        if k % 100 == 99 or k == arguments.starts - 1:
            print(f"{k + 1} starts, {(time.perf_counter() - began) / (k + 1):.2g} s each: {dict(count)}", flush=True)


def far_off(block: Block, rng: np.random.Generator, points: bool = False) -> Block:
    """The block with all exterior orientations and principal distances given wrongly, and points not given or so."""
    start, n = block.start.unknowns, len(block.images)
    truth = start_of(block).exterior if not np.all(block.start.image_known) else start.exterior
    position = np.asarray(truth.position) + rng.uniform(-_METRES, _METRES, (n, 3))
    turns = np.radians(rng.uniform(-_DEGREES, _DEGREES, (n, 3)))
    truly = np.asarray(truth.camera_from_object)
    matrices = np.array([np.asarray(small_rotation(turn)) @ m for turn, m in zip(turns, truly, strict=True)])
    interior = {
        name: set_parameter(own, "c_mm", float(get_parameter(own, "c_mm")) * (1 + rng.uniform(-_OF_C, _OF_C)))
        for name, own in start.interior.items()
    }
    exterior = dataclasses.replace(start.exterior, position=position, camera_from_object=matrices)
    unknowns = dataclasses.replace(start, exterior=exterior, interior=interior)
    known = dataclasses.replace(block.start, unknowns=unknowns, image_known=np.ones(n, bool))
    if points:
        near = np.asarray(start_of(block).points)
        near = near + rng.uniform(-_METRES, _METRES, near.shape)
        unknowns = dataclasses.replace(unknowns, points=near)
        known = dataclasses.replace(known, unknowns=unknowns, point_known=np.ones(len(near), bool))
    return eqx.tree_at(lambda b: b.start, block, known)


def _end(block: Block, best: float) -> str:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = adjust_for_tables(block)
    except JaxphotoError:
        return "refused"
    if bool(found.converged) and abs(float(found.sum_of_squares) / best - 1) < _SAME:
        return "at the optimum"
    good = bool(found.converged) and verdict_of(Tables(found)).severity != "error"
    return "elsewhere, and said to be good" if good else "elsewhere, and red"


if __name__ == "__main__":
    main()
