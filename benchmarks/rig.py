"""What a rig of five cameras gains, and whether its relative orientations lie within their standard deviations.

python benchmarks/rig.py --draws 100 [--late] [--out DIR]

A nadir camera of 35 mm and four oblique heads of 50 mm, 45 degrees to the left, right, ahead and back (pixels of 6 um),
1000 m high: two strips of six exposures to and fro and one of five across, 150 tie points and more, measured to 3 um,
six control points to 3 cm, stations of the nadir camera to 5 cm where there are any, no attitudes. The rig bends by
1 mm and 0.001 degrees from exposure to exposure. All five cameras are calibrated (c, x_p, y_p, k1); of the rig nothing
is known beforehand. One flight is flown, and measured anew each time.

`--late`: the heads expose 1 to 4 ms after the nadir camera in air that turns the aircraft by 2 degrees/s; their delays
are unknown, their places measured to 1 cm. Beside it the same blocks adjusted as if all cameras exposed at once.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxphoto import Block, adjust, covariance
from jaxphoto.io import recipe_from
from jaxphoto.observations import CameraPositions
from jaxphoto.parameters import numbers_of
from jaxphoto.simulation import Simulation, remeasure, simulate
from jaxphoto.unknowns import FREE, Unknowns, Weighted
from jaxphoto.variants import some_images

HEADS = {"left": ([0, 45, 0], [-0.2, 0, 0]), "right": ([0, -45, 0], [0.2, 0, 0]), "ahead": ([45, 0, 0], [0, 0.2, 0]),
         "back": ([-45, 0, 0], [0, -0.2, 0])}  # fmt: skip
"""Turns (degrees) and places (m) as the block starts with them; true ones are a tenth of a degree and 1 cm away."""
NADIR = "nadir"
RULER_M = 0.01


def camera(c_mm: float) -> dict:
    """A camera of the recipe."""
    return {
        "width_px": 4000, "height_px": 3000, "pixel_mm": 0.006, "distortion": "brown", "interior": {"c_mm": c_mm},
        "truth": {"c_mm": c_mm + 0.03, "xp_mm": 0.02, "yp_mm": -0.01, "k1": -1e-5},
        "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1"), "free"),
    }  # fmt: skip


def head(turn_deg: list, place_m: list) -> dict:
    """A head of the recipe."""
    true = {"turn_deg": [v + 0.1 for v in turn_deg], "place_m": [v + 0.01 for v in place_m]}
    return {"turn_deg": turn_deg, "place_m": place_m, "turn": "free", "place": "free", "truth": true}


RECIPE = {
    "cameras": {NADIR: camera(35.0)} | {name: camera(50.0) for name in HEADS},
    "rig_cameras": {name: head(*of) for name, of in HEADS.items()},
    "flight": {
        "height_m": 1000.0, "forward_overlap_percent": 60.0, "side_overlap_percent": 50.0,
        "strips": [
            {"name": "A", "heading_deg": 90.0, "images": 6, "count": 2},
            {"name": "X", "heading_deg": 0.0, "images": 5},
        ],
    },
    "jitter": {"position_m": 10.0, "angle_deg": 1.0, "crab_deg": 1.0},
    "terrain": {"kind": "rolling"},
    # Oblique heads see far beyond the swaths of the nadir camera.
    "points": {"ties": 400, "ends": 4.0, "across": 4.5},
    "targets": [{"role": "control", "at_m": [[-450, -120], [-450, 120], [450, -120], [450, 120], [0, 0], [0, 300]]}],
    "sigmas": {"image_mm": 0.003, "control_m": 0.03, "station_m": 0.05, "rig_place_m": 0.001, "rig_turn_deg": 0.001},
}  # fmt: skip


LATE_S = {"left": 0.001, "right": 0.002, "ahead": 0.003, "back": 0.004}


def late(recipe: dict) -> dict:
    """The recipe with heads that expose late."""
    heads: dict[str, dict] = {}
    for name, own in recipe["rig_cameras"].items():
        heads[name] = own | {"delay": "free", "truth": own["truth"] | {"delay_s": LATE_S[name]}}
    return recipe | {"rig_cameras": heads, "jitter": recipe["jitter"] | {"rate_deg_per_s": 2.0}}


def with_ruler(block: Block, truth: Unknowns, seed: int) -> Block:
    """Places of the heads known beforehand, by a ruler that is laid on anew."""
    rng, heads = np.random.default_rng(seed), dict(block.priors.more["rig_cameras"])
    for name, own in truth.more["rig_cameras"].items():
        place = np.asarray(own.place) + RULER_M * rng.standard_normal(3)
        heads[name] = dataclasses.replace(heads[name], place=Weighted(place, RULER_M), delay=FREE)
    more = block.priors.more | {"rig_cameras": heads}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, more=more))


def apart(block: Block) -> Block:
    """The same photographs of five cameras that know nothing of one another."""
    start = dataclasses.replace(block.start.unknowns, more={})
    return dataclasses.replace(
        block, more=(), start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more={}),
    )  # fmt: skip


def alone(block: Block) -> Block:
    """The photographs of the nadir camera."""
    return some_images(apart(block), np.array(block.image_camera) == NADIR)


def measured(block: Block) -> Block:
    """A rig whose places were measured beforehand, to `RULER_M`."""
    return block.weigh("place", RULER_M)


def unguided(block: Block) -> Block:
    """Without a trajectory."""
    return dataclasses.replace(block, stations=CameraPositions.none())


CASES: dict[str, Callable[[Block], Block]] = {
    "the nadir camera alone": alone,
    "five cameras, each for itself": apart,
    "a rig of which nothing is known": lambda block: block,
    "a rig whose places are known to 1 cm": measured,
}


def true_start(block: Block, truth: Unknowns) -> Block:
    """The block that starts at the truth: sigmas are those of the geometry, not of chance."""
    own = dataclasses.replace(truth, more=truth.more if block.start.unknowns.more else {})
    if len(block.images) < len(truth.exterior.position):
        return block
    return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=own))


def gains(simulation: Simulation) -> Iterator[dict]:
    """The standard deviation of c (um) of each camera in all cases, a priori."""
    for told, guided in (("GNSS", lambda b: b), ("no GNSS", unguided)):
        for case, of in CASES.items():
            block = true_start(of(guided(simulation.block)), simulation.truth)
            found = adjust(block)
            sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
            own = {name: 1e3 * float(sigma[f"interior[{name}].c_mm"]) for name in block.start.unknowns.interior}
            yield {"trajectory": told, "case": case, "outcome": found.outcome.name, "sigma_c": own}


def draws(simulation: Simulation, n: int, first: int, change: Callable[[Block, int], Block]) -> Iterator[dict]:
    """Errors over standard deviations of the rig and of all cameras, measured anew; `change` is of block and seed."""
    block, truth = simulation.block, simulation.truth
    where = lambda b: (b.image_points.xy, b.stations.value, b.control.value, *(rows.off for rows in b.more))  # noqa: E731
    measure = jax.jit(lambda key: where(remeasure(block, truth, key)))
    block = true_start(block, truth)
    for seed in range(first, first + n):
        own = eqx.tree_at(where, block, tuple(map(np.asarray, measure(jax.random.key(seed)))))
        found = adjust(change(own, seed))
        sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
        row = {"seed": seed, "outcome": found.outcome.name, "sigma0": float(found.sigma0)}
        for name, rig in truth.more["rig_cameras"].items():
            estimated = numbers_of(found.unknowns.more["rig_cameras"][name])
            of_each = zip(rig.labels(name), estimated, numbers_of(rig), strict=True)
            for label, value, true in (one for one in of_each if one[0] in sigma):
                row[label] = float((value - true) / sigma[label] / found.sigma0)
        for name, interior in truth.interior.items():
            label = f"interior[{name}].c_mm"
            row[label] = float((found.unknowns.interior[name].c - interior.c) / sigma[label] / found.sigma0)
        yield row


def main() -> None:
    """Tell the gains, then the coverage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, help="seed of the first")
    parser.add_argument("--late", action="store_true", help="heads that expose late, in place of the gains")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    simulation = simulate(recipe_from(late(RECIPE) if args.late else RECIPE), 1)
    print(f"{len(simulation.block.images)} images, {len(simulation.block.points)} points")
    if args.late:
        truth = simulation.truth
        print("delays unknown")
        coverage(draws(simulation, args.draws, args.first, lambda b, seed: with_ruler(b, truth, seed)), args.out)
        print("as if all exposed at once")
        coverage(draws(simulation, args.draws, args.first, lambda b, seed: at_once(with_ruler(b, truth, seed))), None)
        return
    for row in gains(simulation):
        told = ", ".join(f"{name} {value:.2f}" for name, value in row["sigma_c"].items())
        print(f"{row['trajectory']}, {row['case']} ({row['outcome']}): sigma of c in um: {told}", flush=True)
    coverage(draws(simulation, args.draws, args.first, lambda block, _: block), args.out)


def at_once(block: Block) -> Block:
    """Whose cameras are taken to expose at once."""
    rig: dict[str, Any] = block.start.unknowns.more["rig_cameras"]
    heads = {name: dataclasses.replace(own, delay=np.zeros(())) for name, own in rig.items()}
    unknowns = dataclasses.replace(block.start.unknowns, more=block.start.unknowns.more | {"rig_cameras": heads})
    return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=unknowns)).fix("delay")


def coverage(found: Iterator[dict], out: Path | None) -> None:
    """Tell how errors compare with their standard deviations, and keep each row in a file."""
    began, rows = time.perf_counter(), []
    for row in found:
        rows.append(row)
        if out:
            out.mkdir(parents=True, exist_ok=True)
            with (out / "rig.jsonl").open("a") as file:
                file.write(json.dumps(row) + "\n")
    good = [row for row in rows if row["outcome"] == "CONVERGED"]
    sigma0 = np.mean([row["sigma0"] for row in good])
    print(f"{len(good)} of {len(rows)} converged in {time.perf_counter() - began:.0f} s; sigma0 {sigma0:.3f}")
    for what, word in (("turns", ".turn_"), ("places", ".place_"), ("delays", ".delay_"), ("c", ".c_mm")):
        z = np.array([[v for label, v in row.items() if word in label] for row in good])
        if z.size:
            rms, inside = np.sqrt(np.mean(z**2)), np.mean(np.abs(z) < 1.96)
            print(f"{what}: {z.shape[1]} parameters, rms of error over sigma {rms:.3f}, inside 95 %: {inside:.1%}")


if __name__ == "__main__":
    main()
