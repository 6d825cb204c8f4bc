"""Does the test whether a camera changed in flight claim what it should, and find what it should?

python benchmarks/camera_drift.py --flights 200 [--out DIR]

A survey of an hour: an aircraft 1000 m high at 60 m/s with a camera of 35 mm (pixels of 6 um, 17 cm on the ground),
seven strips of eight photographs to and fro and one of five across at begin and end, stations to 3 cm and 5 cm,
attitudes to 0.0025 and 0.005 degrees with a boresight that is unknown, six control points. c changes by 5 um in an
hour, or x_p by 3 um, or both, or nothing; the block estimates rates of c, x_p and y_p beside c, x_p, y_p, k1 and k2.
One flight is flown, and measured anew each time.
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

from jaxphoto import adjust, covariance
from jaxphoto.camera import CameraRates
from jaxphoto.io import recipe_from
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.statistics import SIGNIFICANCE_LEVEL, camera_drifts
from jaxphoto.unknowns import Unknowns

TRUE = {"none": (0.0, 0.0), "c": (5.0, 0.0), "x_p": (0.0, 3.0), "both": (5.0, 3.0)}
"""What c and x_p change by in an hour (um)."""
NAMES = ("c", "x_p", "y_p")
RECIPE = {
    "cameras": {
        "mapper": {
            "width_px": 7000, "height_px": 5000, "pixel_mm": 0.006, "distortion": "brown",
            "interior": {"c_mm": 35.0},
            "truth": {"c_mm": 35.04, "xp_mm": 0.02, "yp_mm": -0.03, "k1": -1e-5, "k2": 1e-9},
            "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2"), "free"),
        }
    },
    "mounts": {"default": {"boresight": "free"}},
    "camera_rates": {"mapper": dict.fromkeys(("c_rate", "xp_rate", "yp_rate"), "free")},
    "flight": {
        "height_m": 1000.0, "forward_overlap_percent": 60.0, "side_overlap_percent": 30.0, "speed_m_per_s": 60.0,
        "turn_s": 390.0,
        "strips": [
            {"name": "X", "heading_deg": 90.0, "images": 5},
            {"name": "S", "heading_deg": 0.0, "images": 8, "count": 7},
            {"name": "Y", "heading_deg": 270.0, "images": 5},
        ],
    },
    "jitter": {"position_m": 10.0, "angle_deg": 2.0, "crab_deg": 2.0},
    "terrain": {"kind": "random", "rms_m": 40.0, "length_m": 800.0, "count": 8},
    "points": {"ties": 600},
    "targets": [{"role": "control", "count": 6}],
    "sigmas": {"image_mm": 0.002, "control_m": 0.03, "station_m": [0.03, 0.03, 0.05],
               "attitude_deg": [0.0025, 0.0025, 0.005]},
}  # fmt: skip


def drawn(flights: int, first: int) -> Iterator[dict]:
    """The test of every case of every flight; changes are in um over the flight."""
    block, truth, _ = simulate(recipe_from(RECIPE), 1)
    observed = lambda b: (b.image_points.xy, b.stations.value, b.attitudes.roll_pitch_yaw, b.control.value)  # noqa: E731
    measure = jax.jit(lambda rates, key: observed(remeasure(block, changed(truth, rates), key)))
    for seed in range(first, first + flights):
        for number, (case, (c, x_p)) in enumerate(TRUE.items()):
            rates = CameraRates(*1e-3 * np.array([c, x_p, 0.0, 0.0]))
            new = measure(rates, jax.random.fold_in(jax.random.key(seed), number))
            own = eqx.tree_at(observed, block, jax.tree.map(np.asarray, new))
            found = adjust(own, changed(truth, block.start.unknowns.more[CameraRates.kind]["mapper"]))
            (drift,) = camera_drifts(found, covariance(found))
            test = drift.change
            yield {
                "case": case, "flight": seed, "outcome": found.outcome.name, "sigma0": float(found.sigma0),
                "images": len(block.images), "hours": drift.span, "p_value": test.p_value,
                "p_values": test.p_values.tolist(), "change": (1e3 * test.value).tolist(),
                "true": [drift.span * c, drift.span * x_p, 0.0],
                "sigma": (1e3 * test.sigma).tolist(), "detectable": (1e3 * test.detectable).tolist(),
            }  # fmt: skip


def changed(unknowns: Unknowns, rates: CameraRates) -> Unknowns:
    """The same with a camera of these rates."""
    return dataclasses.replace(unknowns, more={CameraRates.kind: {"mapper": rates}})


def told(case: str, rows: list[dict]) -> None:
    """Print how often a change is claimed, and the errors of the rates beside their standard deviations."""
    good = [row for row in rows if row["outcome"] == "CONVERGED"]
    column = {key: np.array([row[key] for row in good]) for key in good[0] if key not in ("case", "outcome")}
    claimed, alone = (np.mean(column[key] < SIGNIFICANCE_LEVEL, axis=0) for key in ("p_value", "p_values"))
    z = (column["change"] - column["true"]) / column["sigma"]
    print(
        f"{case}: {len(good)} of {len(rows)} converged, {np.median(column['hours']):.2f} h, sigma0 "
        f"{np.median(column['sigma0']):.3f}; a change claimed in {claimed:.1%}"
    )
    for k, name in enumerate(NAMES):
        change, inside = column["change"][:, k], np.mean(np.abs(z[:, k]) < 1.96)
        sigma, least = (np.median(column[key][:, k]) for key in ("sigma", "detectable"))
        print(
            f"  {name}: true {column['true'][0, k]:.2f} um, mean {change.mean():.2f}, "
            f"scatter {change.std(ddof=1):.2f}, sigma {sigma:.2f}, detectable {least:.2f}; "
            f"inside 95 %: {inside:.1%}; p < 5 % by itself: {alone[k]:.1%}"
        )


def main() -> None:
    """Draw the flights and tell of each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=1, help="seed of the first flight")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows, began = [], time.perf_counter()
    for row in drawn(args.flights, args.first):
        rows.append(row)
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
            with (args.out / "camera_drift.jsonl").open("a") as file:
                file.write(json.dumps(row) + "\n")
    print(f"{len(rows)} adjustments of {rows[0]['images']} images in {time.perf_counter() - began:.0f} s")
    for case in TRUE:
        told(case, [row for row in rows if row["case"] == case])


if __name__ == "__main__":
    main()
