"""Do cameras that change lie within their standard deviations: with temperature, along splines, from strip to strip?

python benchmarks/live_cameras.py --flights 100 [--out DIR]

A small survey: an aircraft 1000 m high with a camera of 35 mm (pixels of 6 um), four strips of five photographs to and
fro and one across with five minutes between them, 200 tie points measured to 2 um, stations to 3, 3 and 5 cm, attitudes
to 0.0025 and 0.005 degrees, four control points. What changes is drawn anew for every flight, as the recipe says, and
measured anew; c, x_p, y_p, k1, k2 and the boresight are estimated with it.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from camera_drift import RECIPE

from jaxphoto import adjust, covariance
from jaxphoto.io import recipe_from
from jaxphoto.parameters import numbers_of
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.simulation.camera_changes import draw_changes
from jaxphoto.simulation.flight import fly
from jaxphoto.statistics import SIGNIFICANCE_LEVEL, camera_drifts, camera_spline_differences, strip_differences

# The camera, the aircraft and how well both are known are those of the other benchmark.
FLIGHT = {name: RECIPE[name] for name in ("cameras", "mounts", "jitter", "sigmas")} | {
    "flight": {
        "height_m": 1000.0, "forward_overlap_percent": 60.0, "side_overlap_percent": 30.0, "turn_s": 300.0,
        "strips": [
            {"name": "S", "heading_deg": 0.0, "images": 5, "count": 4},
            {"name": "X", "heading_deg": 90.0, "images": 5},
        ],
    },
    "terrain": {"kind": "rolling"},
    "points": {"ties": 200},
    "targets": [{"role": "control", "count": 4}],
}  # fmt: skip
RATES = ("c_rate", "xp_rate", "yp_rate")
MORE = ("c_more", "xp_more", "yp_more")
SPLINES = ("c_spline", "xp_spline", "yp_spline")
CASES = {
    "temperature": {
        "temperature": {"begin_c": 25.0, "air_c": 5.0, "time_constant_s": 600.0},
        "thermal_rates": {"mapper": dict.fromkeys(RATES, "free")
                          | {"truth": {key: {"sigma_mm_per_K": 0.0005} for key in RATES}}},
    },
    "spline": {
        "camera_splines": {"mapper": {"knots": 6, "interval_s": 500.0}
                           | {key: {"walk_mm": 0.006} for key in SPLINES}
                           | {"truth": {key: {"walk_mm": 0.006} for key in SPLINES}}},
    },
    # The camera of the block is that of the first strip.
    "strips": {
        "strip_cameras": {"default": dict.fromkeys(MORE, "free"), "S1": dict.fromkeys(MORE, "fixed")},
        "camera_walk": {"c_mm": 0.006, "xp_mm": 0.006, "yp_mm": 0.006},
    },
}  # fmt: skip


def flights(case: str, n: int, first: int) -> Iterator[dict]:
    """Errors over standard deviations of what changes in every flight of a case, and of c; what the test says."""
    recipe = recipe_from(FLIGHT | CASES[case])
    block, truth, _ = simulate(recipe, 1)
    flight = fly(recipe, recipe.plan, 0.0, 1)
    observed = lambda b: (b.image_points.xy, b.stations.value, b.attitudes.roll_pitch_yaw, b.control.value)  # noqa: E731
    measure = jax.jit(lambda truth, key: observed(remeasure(block, truth, key)))
    for seed in range(first, first + n):
        changes = draw_changes(recipe, flight, block.flight_time, seed)
        more = {kind: {name: own.truth for name, own in owners.items()} for kind, owners in changes.items()}
        more = jax.tree.map(np.asarray, more)
        true = dataclasses.replace(truth, more=more)
        new = jax.tree.map(np.asarray, measure(true, jax.random.key(seed)))
        found = adjust(eqx.tree_at(observed, block, new))
        cov = covariance(found)
        sigma = dict(zip(found.structure.labels, found.sigma0 * np.asarray(cov.shared_sigma), strict=True))
        row = {"case": case, "flight": seed, "outcome": found.outcome.name, "sigma0": float(found.sigma0)}
        c = "interior[mapper].c_mm"
        row[c] = float((found.unknowns.interior["mapper"].c - truth.interior["mapper"].c) / sigma[c])
        for kind, owners in more.items():
            for name, own in owners.items():
                pairs = zip(own.labels(name), numbers_of(found.unknowns.more[kind][name]), numbers_of(own), strict=True)
                row |= {label: float((v - t) / sigma[label]) for label, v, t in pairs if label in sigma}
        tests = [d.change for d in camera_drifts(found, cov)] + [w.more for w in camera_spline_differences(found, cov)]
        if (strips := strip_differences(found, cov)) is not None:
            tests.append(strips.more)
        yield row | {"p_value": tests[0].p_value}


def told(case: str, rows: list[dict]) -> None:
    """Print how errors compare to their standard deviations."""
    good = [row for row in rows if row["outcome"] == "CONVERGED"]
    z = np.array([[v for label, v in row.items() if "[" in label and "interior" not in label] for row in good])
    c = np.array([row["interior[mapper].c_mm"] for row in good])
    claimed = np.mean([row["p_value"] < SIGNIFICANCE_LEVEL for row in good])
    print(
        f"{case}: {len(good)} of {len(rows)} converged, sigma0 {np.mean([row['sigma0'] for row in good]):.3f}; "
        f"{z.shape[1]} parameters, rms of error over sigma {np.sqrt(np.mean(z**2)):.3f}, inside 95 %: "
        f"{np.mean(np.abs(z) < 1.96):.1%}; c {np.sqrt(np.mean(c**2)):.3f}, {np.mean(np.abs(c) < 1.96):.1%}; "
        f"a change claimed in {claimed:.1%}",
        flush=True,
    )


def main() -> None:
    """Fly, and tell of each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, help="seed of the first flight")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    for case in CASES:
        rows, began = [], time.perf_counter()
        for row in flights(case, args.flights, args.first):
            rows.append(row)
            if args.out:
                args.out.mkdir(parents=True, exist_ok=True)
                with (args.out / "live_cameras.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
        print(f"{time.perf_counter() - began:.0f} s")
        told(case, rows)


if __name__ == "__main__":
    main()
