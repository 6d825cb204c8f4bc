"""Relative control beside stations that drift: standard deviations with it and without, and whether they are true.

    python benchmarks/relative_control.py --draws 100

A corridor of one strip of 25 photographs 150 m high with a camera of 16 mm (4.5 cm pixels on the ground), an overlap of
75 % and two control points at either end.
Stations are off by a process of Gauss and Markov of 5 cm and 60 s, anew in each strip, which the block knows
(`correlated`), and by a constant of each strip, which is estimated. Relative positions of successive exposures are good
to 5 mm, relative attitudes to 0.01 degrees; there are no attitudes beside them. Only noise is drawn; the flight stays.
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxphoto import Adjustment, Block, adjust, correlated, covariance, monte_carlo
from jaxphoto.io import recipe_from
from jaxphoto.observations import CameraPositions, RelativeAttitudes, RelativePositions, exponential_covariance
from jaxphoto.sensitivity import noise
from jaxphoto.simulation import Simulation, simulate

DRIFT_M, CORRELATION_S = 0.05, 60.0
NOTHING = 100.0
"""Times the standard deviation of relative control (0.5 m, 1 degree), which then says nothing beside the images."""
CAMERA = {
    "width_px": 4896, "height_px": 3264, "pixel_mm": 0.0048, "distortion": "brown", "interior": {"c_mm": 16.0},
    "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1"), "free"),
}  # fmt: skip
STRIPS = [{"name": "A", "heading_deg": 90.0, "images": 25}]
CONTROL = [[-0.5, -0.3], [-0.5, 0.3], [0.5, -0.3], [0.5, 0.3]]


def flown() -> Simulation:
    """The flight; it starts at the truth."""
    recipe = {
        "cameras": {"one": CAMERA},
        "strips": {"default": {"shift": "free"}},
        "mounts": {"default": {"lever_arm_m": [0.05, -0.1, 0.3]}},
        "flight": {
            "height_m": 150.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 50.0, "speed_m_per_s": 15.0,
            "strips": STRIPS,
        },
        "jitter": {"position_m": 2.0, "angle_deg": 3.0, "crab_deg": 3.0},
        "terrain": {"kind": "random", "count": 20, "rms_m": 5.0, "length_m": 100.0},
        "points": {"ties": 180, "ends": 0.5},
        "targets": [{"role": "control", "at": CONTROL}],
        "sigmas": {
            "image_mm": 0.0024, "control_m": 0.02, "station_m": DRIFT_M, "relative_position_m": 0.005,
            "relative_attitude_deg": 0.01,
        },
        # The draws have it.
        "noise": dict.fromkeys(
            ("image_mm", "control_m", "station_m", "relative_position_m", "relative_attitude_deg"), 0.0
        ),
    }  # fmt: skip
    found = simulate(recipe_from(recipe), 1)
    start = dataclasses.replace(found.block.start, unknowns=found.truth)
    start = dataclasses.replace(start, point_known=np.ones(len(found.block.points), bool))
    return dataclasses.replace(found, block=dataclasses.replace(found.block, start=start))


def drifting(block: Block) -> Block:
    """The block whose stations of a strip and an axis are correlated in time."""
    rows, times = block.stations, np.asarray(block.image_time)
    strip = np.array(block.image_strip)[rows.who]
    sets = []
    for name in dict.fromkeys(block.image_strip):
        own = [np.flatnonzero((strip == name) & (rows.axis == axis)) for axis in range(3)]
        matrix = exponential_covariance(times[rows.who[own[0]]], DRIFT_M, CORRELATION_S)
        sets.append(correlated(rows, np.stack(own), np.stack([matrix] * 3)))
    return dataclasses.replace(block, stations=CameraPositions.none(), more=(*block.more, *sets))


def without(block: Block, *kinds: type) -> Block:
    """The block in which observations of some kinds count for nothing; of one shape, so that it compiles once."""
    return dataclasses.replace(
        block,
        more=tuple(
            rows.with_sigmas_times(np.full(np.shape(rows.sigmas), NOTHING)) if isinstance(rows, kinds) else rows
            for rows in block.more
        ),
    )


def cases(block: Block) -> Iterator[tuple[str, Block]]:
    """The block with less and more of relative control."""
    told = drifting(block)
    yield "stations that drift", without(told, RelativePositions, RelativeAttitudes)
    yield "and relative positions", without(told, RelativeAttitudes)
    yield "and relative attitudes", without(told, RelativePositions)
    yield "and both", told


def judged(adjusted: Adjustment, draws: int, seed: int) -> dict[str, tuple[float, float, float]]:
    """Of c, of projection centres and points in plan and height: the quadratic mean of their standard deviations (m),
    that of the errors of draws, and the part of these inside 95 %."""
    cov, found = (
        covariance(adjusted),
        monte_carlo(adjusted, noise(adjusted.block), draws, seed, exterior=True, points=True),
    )
    if not found.converged.all() or found.exterior is None or found.points is None:
        raise RuntimeError(f"{np.sum(~found.converged)} draws did not converge")
    label = "interior[one].c_mm"
    variance = np.asarray(cov.matrix).diagonal()[6 * cov.n_images :]
    of_c = variance[adjusted.structure.labels.index(label), None]
    of_centres, of_points = (np.asarray(v).diagonal(axis1=1, axis2=2) for v in (cov.positions, cov.points))
    truth = adjusted.unknowns
    off_c = found.shared[:, [found.labels.index(label)]] - float(truth.interior["one"].c)
    off_centres = found.exterior[:, :, :3] - np.asarray(truth.exterior.position)
    off_points = found.points - np.asarray(truth.points)
    plan = slice(0, 2)
    of = {
        "c": (of_c * 1e-6, off_c * 1e-3),
        "centres, X and Y": (of_centres[:, plan], off_centres[..., plan]),
        "centres, Z": (of_centres[:, 2], off_centres[..., 2]),
        "points, X and Y": (of_points[:, plan], off_points[..., plan]),
        "points, Z": (of_points[:, 2], off_points[..., 2]),
    }
    return {
        name: (float(np.sqrt(v.mean())), float(np.sqrt((off**2).mean())), float((off**2 < 1.96**2 * v).mean()))
        for name, (v, off) in of.items()
    }


def main() -> None:
    """Tell the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="append the table to DIR/results.md")
    args = parser.parse_args()
    began, lines = time.perf_counter(), []
    for k, (case, told) in enumerate(cases(flown().block)):
        found = judged(adjust(told), args.draws, args.seed)
        if not k:
            lines += [f"| | {' | '.join(found)} |", f"|{' --- |' * (len(found) + 1)}"]
        scale = {"c": 1e6}
        cells = (
            f"{v[0] * scale.get(n, 1e3):.2f} ({v[1] * scale.get(n, 1e3):.2f}, {v[2]:.1%})" for n, v in found.items()
        )
        lines.append(f"| {case} | {' | '.join(cells)} |")
        print("\n".join(lines[-1 if k else -3 :]), flush=True)
    print(f"um of c, mm of all others: sigma (error of {args.draws} draws, inside 95 %); "
          f"{time.perf_counter() - began:.0f} s")  # fmt: skip
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with (args.out / "results.md").open("a") as file:
            file.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
