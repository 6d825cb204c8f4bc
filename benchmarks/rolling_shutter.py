"""Simulated flights with a rolling shutter: the readout time and the camera, with the model and without it.

    python benchmarks/rolling_shutter.py --flights 40 [--without-cross] [--out DIR]

A drone at 100 m and 10 m/s whose camera reads its rows in 30 ms, three strips to and fro and, unless --without-cross,
two across, in which the camera is turned with the drone. Velocities are known to 0.3 m/s, as neighbouring positions
tell them; rates of turn (0.3 degrees/s, a gimbal) are not, and are unknowns of each image.
"""

import argparse
import copy
import json
import time
from pathlib import Path

import numpy as np

from jaxphoto import adjust, covariance
from jaxphoto.camera import get_parameter
from jaxphoto.io import recipe_from
from jaxphoto.simulation import simulate

READOUT_MS = 30.0
NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
RECIPE = {
    "cameras": {
        "drone": {
            "width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "brown",
            "interior": {"c_mm": 8.8},
            "truth": {"c_mm": 8.77, "xp_mm": 0.02, "yp_mm": -0.03, "k1": -4e-4, "k2": 2e-6},
            "unknowns": dict.fromkeys(NAMES, "free"),
        }
    },
    "mounts": {"default": {"image_x": "right"}},
    "shutters": {
        "drone": {
            "readout_ms": 20.0, "readout": "free", "velocity_m_per_s": 0.3, "rate_deg_per_s": 0.3,
            "truth": {"readout_ms": READOUT_MS},
        }
    },
    "flight": {
        "height_m": 100.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 60.0, "speed_m_per_s": 10.0,
        "strips": [{"name": "S", "heading_deg": 0.0, "images": 6, "count": 3}],
    },
    "jitter": {"position_m": 1.0, "angle_deg": 1.0, "crab_deg": 3.0, "rate_deg_per_s": 0.3},
    "terrain": {"kind": "random", "rms_m": 8.0, "length_m": 150.0, "count": 8},
    "points": {"ties": 400, "min_images": 3},
    "sigmas": {"image_mm": 0.0012, "station_m": [0.02, 0.02, 0.04]},
    "start": {"position_m": 0.5, "angle_deg": 0.3},
}  # fmt: skip


def flown(seed: int, cross: bool, knows: bool):
    recipe = copy.deepcopy(RECIPE)
    if cross:
        recipe["flight"]["strips"].append({"name": "X", "heading_deg": 90.0, "images": 6, "count": 2})
    if not knows:
        recipe["shutters"]["drone"] = {"truth": {"readout_ms": READOUT_MS}}
    return simulate(recipe_from(recipe), seed)


def row_of(seed: int, case: str, block, truth) -> dict:
    found = adjust(block)
    sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
    row = {"flight": seed, "case": case, "outcome": found.outcome.name, "sigma0": float(found.sigma0)}
    for n in NAMES:
        off = float(get_parameter(found.unknowns.interior["drone"], n) - get_parameter(truth.interior["drone"], n))
        row |= {f"{n}_off": off, f"{n}_sigma": float(sigma[f"interior[drone].{n}"])}
    if found.unknowns.more:
        row["readout_off"] = float(found.unknowns.more["shutters"]["drone"].readout) - READOUT_MS
        row["readout_sigma"] = float(sigma["shutters[drone].readout_ms"])
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--without-cross", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows, began = [], time.perf_counter()
    for seed in range(args.first, args.first + args.flights):
        for case, knows in (("with the model", True), ("without", False)):
            block, truth, _ = flown(seed, not args.without_cross, knows)
            rows.append(row_of(seed, case, block, truth))
            print(json.dumps(rows[-1]), flush=True)
    print(f"{len(rows)} adjustments in {time.perf_counter() - began:.0f} s")
    for case in ("with the model", "without"):
        own = [r for r in rows if r["case"] == case]
        good = [r for r in own if r["outcome"] == "CONVERGED"]
        print(f"{case}: {len(good)} of {len(own)} converged, sigma0 {np.median([r['sigma0'] for r in good]):.2f}")
        for n in ("readout", *NAMES):
            if f"{n}_off" not in good[0]:
                continue
            off, sigma = (np.array([r[f"{n}_{k}"] for r in good]) for k in ("off", "sigma"))
            z = off / sigma
            print(
                f"  {n}: mean error {off.mean():.3g}, rms {np.sqrt(np.mean(off**2)):.3g}, "
                f"largest {np.abs(off).max():.3g}; median sigma {np.median(sigma):.3g}; "
                f"inside 95 %: {100 * np.mean(np.abs(z) < 1.96):.0f} %, "
                f"largest {np.abs(z).max():.1f} sigma"
            )
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with (args.out / "rolling_shutter.jsonl").open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


if __name__ == "__main__":
    main()
