"""Flat nadir flights at one height, lens drawn from the prior: is the true c inside the stated 95 %?

    python benchmarks/lens_priors.py --flights 200 [--also-free] [--out DIR]

Every flight has another lens, drawn from `jaxphoto.camera.lens_prior` about the nominal values that EXIF would tell,
and positions by a receiver of --station-m (twice as bad in height). With --also-free each is adjusted once more without
what is known of the lens.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from jaxphoto import Outcome, adjust, covariance
from jaxphoto.camera import get_parameter
from jaxphoto.camera.lens_prior import lens_prior, prior_sigmas
from jaxphoto.errors import JaxphotoError
from jaxphoto.io import recipe_from
from jaxphoto.procedures.known_lens import KnownLens, with_known_lens
from jaxphoto.simulation import simulate

NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2", "p1", "p2")
RECIPE = {
    "cameras": {
        "drone": {
            "width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "brown",
            "interior": {"c_mm": 8.8}, "unknowns": dict.fromkeys(NAMES, "free"),
        }
    },
    "flight": {
        "height_m": 100.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 60.0, "speed_m_per_s": 8.0,
        "strips": [{"name": "S", "heading_deg": 0.0, "images": 6, "count": 3}],
    },
    "jitter": {"position_m": 0.5, "angle_deg": 0.3, "crab_deg": 1.0},
    "terrain": {"kind": "flat", "roughness_m": 0.5},
    "points": {"ties": 300, "min_images": 3},
    "sigmas": {"image_mm": 0.0012, "station_m": 2.0},
    "start": {"position_m": 1.0, "angle_deg": 0.5},
}  # fmt: skip


def drawn(rng, prior, nominal, sensor) -> dict[str, float]:
    """A lens of the prior that folds nothing within the format."""
    sigma = prior_sigmas(prior, nominal, sensor)
    corner = np.hypot(sensor.width_mm, sensor.height_mm) / 2
    r = np.linspace(0, 1.25 * corner, 60)
    while True:
        lens = {n: float(get_parameter(nominal, n)) + sigma[n] * rng.normal() for n in NAMES}
        slope = 1 - 3 * lens["k1"] * r**2 - 5 * lens["k2"] * r**4
        if slope.min() > 0.3 and slope.max() < 3:
            return lens


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--station-m", type=float, default=2.0)
    parser.add_argument("--model", default="FC6310R")
    parser.add_argument("--also-free", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    prior, rows, began = lens_prior("DJI", args.model), [], time.perf_counter()
    RECIPE["sigmas"]["station_m"] = [args.station_m, args.station_m, 2 * args.station_m]
    for k in range(args.first, args.first + args.flights):
        rng = np.random.default_rng(1000 + k)
        plain = recipe_from(RECIPE)
        ((name, camera),) = plain.cameras.items()
        sensor = plain.sensors[name]
        RECIPE["cameras"]["drone"]["truth"] = lens = drawn(rng, prior, camera.start, sensor)
        try:
            block, _, _ = simulate(recipe_from(RECIPE), k)
        except JaxphotoError as error:
            print(k, "not flown:", error)
            continue
        cases = {"prior": with_known_lens(block, name, KnownLens(camera.start, prior, 0.0))}
        if args.also_free:
            cases["free"] = block
        for case, given in cases.items():
            adjusted = adjust(given)
            labels = [label.removeprefix(f"interior[{name}].") for label in adjusted.structure.labels]
            sigma = dict(zip(labels, np.asarray(covariance(adjusted).shared_sigma), strict=True))
            row = {"flight": k, "case": case, "outcome": adjusted.outcome.value, "sigma0": float(adjusted.sigma0)}
            # Of the lens that was drawn: where a flight tells nothing of c, its error is this.
            row["c_drawn"] = (lens["c_mm"] - float(camera.start.c)) / prior_sigmas(prior, camera.start, sensor)["c_mm"]
            for n in NAMES:
                value = float(get_parameter(adjusted.unknowns.interior[name], n))
                row |= {f"{n}_off": value - lens[n], f"{n}_sigma": float(sigma[n])}
            rows.append(row)
    print(f"{len(rows)} adjustments in {time.perf_counter() - began:.0f} s")
    far = 4 * prior_sigmas(prior, camera.start, sensor)["c_mm"]
    for case in ("prior", "free")[: 1 + args.also_free]:
        own = [r for r in rows if r["case"] == case]
        good = [r for r in own if r["outcome"] == Outcome.CONVERGED.value]
        # c off by four standard deviations of the lens.
        ran = [r for r in good if abs(r["c_mm_off"]) > far]
        print(f"{case}: {len(own)} flights, {len(good)} converged, of these {len(ran)} ran away")
        z = np.array([r["c_drawn"] for r in good])
        print(
            f"  c of the lenses inside 95 %: {100 * np.mean(np.abs(z) < 1.96):.1f} %, rms {np.sqrt(np.mean(z**2)):.2f}"
        )
        for n in NAMES:
            z = np.array([r[f"{n}_off"] / r[f"{n}_sigma"] for r in good])
            sigma = np.median([r[f"{n}_sigma"] for r in good])
            print(
                f"  {n}: inside the stated 95 %: {100 * np.mean(np.abs(z) < 1.96):.1f} %, "
                f"rms of error over sigma {np.sqrt(np.mean(z**2)):.2f}, median sigma {sigma:.3g}"
            )
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with (args.out / "lens_priors.jsonl").open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


if __name__ == "__main__":
    main()
