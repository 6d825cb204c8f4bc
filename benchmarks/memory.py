"""Random adjustments in one process, for hours: does its memory stay flat, and does every one of them end as it should?

python benchmarks/memory.py [--hours 2] [--out memory.csv]

Each time a block is drawn: its size, its camera's model, its terrain and noise, now and then blunders, defects that are
refused, and what is asked of it: covariances, residuals and tables, snooping, variance components. An adjustment may be
refused in a sentence where the block has a defect; any other exception is a failure. Memory is what is resident after
each, in MB; it is flat where the mean of the last quarter is that of the second within 1 %. Sizes are few, so that all
programs are compiled soon: a process keeps the hundred used last, some 10 MB each.
"""

import argparse
import collections
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from machine import HERE, machine, memory, sentence

sys.path.insert(0, str(HERE.parent))

# Not counted: compiling the kinds of blocks that come again and again, and the first of everything.
_FIRST = 100
_FLAT = 0.01
_MODELS = ("brown", "smac")
_SIZES = (70, 110)
# An image point that is wrong is off by so many standard deviations.
_BLUNDER = 100.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="CSV: adjustment, seconds, resident_mb, what")
    arguments = parser.parse_args()
    print(sentence(machine()), flush=True)
    rng = np.random.default_rng(arguments.seed)
    began, told, rows = time.perf_counter(), 0.0, []
    count: collections.Counter[str] = collections.Counter()
    while (seconds := time.perf_counter() - began) < 3600 * arguments.hours:
        what = _one(rng, len(rows))
        count[what] += 1
        rows.append((len(rows), seconds, memory("VmRSS"), what))
        if seconds - told > 300:
            told = seconds
            print(f"{len(rows)} adjustments, {seconds:.0f} s, {rows[-1][2]:.0f} MB: {dict(count)}", flush=True)
    table = pd.DataFrame(rows, columns=["adjustment", "seconds", "resident_mb", "what"])
    if arguments.out:
        table.to_csv(arguments.out, index=False)
    flat = table["resident_mb"].to_numpy()[_FIRST:]
    if len(flat) < 8:
        raise SystemExit(f"{len(rows)} adjustments say nothing: give more hours")
    quarters = [float(part.mean()) for part in np.array_split(flat, 4)]
    growth = quarters[3] / quarters[1] - 1
    failed = sum(n for what, n in count.items() if what.startswith("failed"))
    print(f"{len(rows)} adjustments, {dict(count)}")
    print(f"mean resident MB by quarter: {', '.join(f'{q:.0f}' for q in quarters)}; growth {100 * growth:+.2f} %")
    return int(failed > 0 or growth > _FLAT)


def _one(rng: np.random.Generator, number: int) -> str:
    """Draw a block and adjust it; what came of it in a word or two."""
    import jaxphoto
    from jaxphoto.errors import JaxphotoError
    from jaxphoto.procedures.adjust import adjust_for_tables
    from jaxphoto.report import Tables, verdict_of
    from jaxphoto.statistics import variance_components

    asked = rng.choice(["report", "report", "snoop", "weights", "covariance", "defect"])
    try:
        block = _block(rng, asked)
    except JaxphotoError:
        return "not simulated: an image sees too little"
    try:
        if asked == "snoop":
            jaxphoto.snoop(block)
        elif asked == "weights":
            variance_components(jaxphoto.adjust(block))
        elif asked == "covariance":
            jaxphoto.covariance(jaxphoto.adjust(block))
        else:
            verdict_of(Tables(adjust_for_tables(block)))
    except JaxphotoError as error:
        return f"{asked} refused" if asked == "defect" else f"failed ({asked}, number {number}): {error}"
    except Exception as error:
        return f"failed ({asked}, number {number}): {type(error).__name__}: {error}"
    return str(asked)


def _block(rng: np.random.Generator, asked: str):
    """A small block of any of some kinds; with blunders where it is to be snooped, without a datum as a defect."""
    import dataclasses

    from jaxphoto.io import recipe_from
    from jaxphoto.observations import CameraPositions, ControlCoordinates
    from jaxphoto.simulation import simulate
    from tests.simulation.small import changed

    changes = {
        "cameras.kodak.distortion": str(rng.choice(_MODELS)),
        "cameras.kodak.interior": {"c_mm": 34.0},
        "cameras.kodak.truth": {"c_mm": float(rng.normal(34.0, 0.3)), "xp_mm": float(rng.normal(0, 0.1))},
        "cameras.kodak.unknowns": {"c_mm": "free", "xp_mm": "free", "yp_mm": "free"},
        "points.ties": int(rng.choice(_SIZES)),
        "terrain": {"kind": "random", "count": 12, "rms_m": float(rng.uniform(5, 60)), "length_m": 700.0},
        "noise": {"image_mm": 0.004, "control_m": 0.03, "station_m": 0.1, "attitude_deg": 0.01},
    }
    block = simulate(recipe_from(changed(changes)), int(rng.integers(2**31))).block
    if asked == "defect":
        return dataclasses.replace(block, control=ControlCoordinates.none(), stations=CameraPositions.none())
    if asked == "snoop":
        p = block.image_points
        xy = np.array(p.xy)
        wrong = rng.choice(len(xy), 3, replace=False)
        xy[wrong] += _BLUNDER * np.asarray(p.sigma)[wrong] * rng.choice([-1, 1], (3, 2))
        return dataclasses.replace(block, image_points=dataclasses.replace(p, xy=xy))
    return block


if __name__ == "__main__":
    sys.exit(main())
