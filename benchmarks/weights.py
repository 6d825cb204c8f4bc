"""Does the printed sigma of the camera cover the truth if the stated sigmas are wrong? Simulated flights answer.

python benchmarks/weights.py --flights 200 image_1px rtk

Each flight of a recipe is adjusted with the stated standard deviations and with those of `estimate_weights`. The
table gives, for both, the fraction of intervals of 95 % that cover the true value.
"""

import argparse
import copy
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from jaxphoto import Adjustment, Unknowns, adjust, covariance, estimate_weights
from jaxphoto.camera import get_parameter
from jaxphoto.io.recipe import recipe_from
from jaxphoto.simulation import simulate
from jaxphoto.statistics import significance

CAMERA = {
    "width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "agisoft",
    "interior": {"c_mm": 8.76},
    "truth": {
        "c_mm": 8.72, "xp_mm": -0.033, "yp_mm": 0.053, "b1": -1.9e-4, "b2": -1.6e-4, "k1": 0.0049, "k2": -0.0114,
        "k3": 0.011, "p1": -0.0015, "p2": 0.0012,
    },
    "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "b1", "b2", "k1", "k2", "k3", "p1", "p2"), "free"),
}  # fmt: skip
FLAT = {
    "title": "flat nadir block with control",
    "cameras": {"cam": CAMERA},
    "flight": {
        "height_m": 79.0, "forward_overlap_percent": 80.0, "side_overlap_percent": 65.0,
        "strips": [
            {"name": "E", "heading_deg": 137.0, "images": 10, "count": 2},
            {"name": "N", "heading_deg": 47.0, "images": 10, "count": 2},
        ],
    },
    "jitter": {"position_m": 0.3, "angle_deg": 0.05},
    "terrain": {"kind": "random", "count": 12, "rms_m": 0.5, "length_m": 60.0},
    "points": {"ties": 800},
    "targets": [{"count": 5, "role": "control"}],
    "sigmas": {"image_mm": 0.0024, "target_mm": 0.0024, "control_m": 0.05},
    "noise": {"image_mm": 0.0007, "target_mm": 0.0007},
    "start": {"position_m": 1.0, "angle_deg": 0.3},
}  # fmt: skip
RTK = copy.deepcopy(FLAT) | {"title": "block with RTK stations"}
RTK["flight"]["strips"] = [
    {"name": "E", "heading_deg": 90.0, "images": 8, "count": 4},
    {"name": "N", "heading_deg": 0.0, "images": 8},
]
del RTK["targets"]
RTK["sigmas"]["station_m"] = RTK["noise"]["station_m"] = [0.02, 0.02, 0.04]
LIDAR = copy.deepcopy(FLAT) | {"title": "block with lidar heights", "targets": [{"count": 60, "role": "vertical"}]}
LIDAR["sigmas"] |= {"station_m": [0.05, 0.05, 0.1], "control_m": 0.1}
LIDAR["noise"]["station_m"] = [0.05, 0.05, 0.1]
STRIPS = copy.deepcopy(RTK) | {"title": "stations with a shift of each strip", "strips": {
    "default": {
        "shift_m": [0.0, 0.0, 0.0], "shift": "free", "truth": {"shift_sigma_m": [0.3, 0.3, 0.3]},
    },
}, "targets": [{"count": 6, "role": "control"}]}  # fmt: skip


def _changed(recipe: dict[str, Any], **noise: Any) -> dict[str, Any]:
    changed = copy.deepcopy(recipe)
    changed["noise"] |= noise
    return changed


RECIPES = {
    "image_1px": FLAT,
    "as_stated": _changed(FLAT, image_mm=0.0024, target_mm=0.0024),
    "control_3x": _changed(FLAT, control_m=0.15),
    "lidar": LIDAR,
    "lidar_3x": _changed(LIDAR, control_m=0.3),
    "strips": STRIPS,
    "rtk": RTK,
    "rtk_control": RTK | {"targets": [{"count": 6, "role": "control"}]},
    "rtk_3x": _changed(RTK, station_m=[0.06, 0.06, 0.12]),
}
"""Stated image sigma 1 px, true 0.3 px (except `as_stated`); the noise of control or stations is that stated, or three
times larger.
"""


class Flight(NamedTuple):
    """Errors over standard deviations of the camera's parameters, with stated and with estimated weights."""

    stated: dict[str, float]
    estimated: dict[str, float]
    factors: dict[str, float]


def _errors(adjusted: Adjustment, truth: Unknowns) -> dict[str, float]:
    camera = next(iter(truth.interior))
    found, true = adjusted.unknowns.interior[camera], truth.interior[camera]
    return {
        s.parameter: (float(get_parameter(found, s.parameter)) - float(get_parameter(true, s.parameter))) / s.sigma
        for s in significance(adjusted, covariance(adjusted, rows=True))
    }


def flights(name: str, seeds: range) -> Iterator[Flight]:
    """Yield the errors of every flight that converges."""
    recipe = recipe_from(RECIPES[name], name)
    for seed in seeds:
        simulated = simulate(recipe, seed)
        adjusted = adjust(simulated.block)
        if bool(adjusted.converged):
            estimated = estimate_weights(adjusted)
            best = estimated.adjusted if estimated else adjusted
            factors = estimated.sigma_factors if estimated else {}
            yield Flight(_errors(adjusted, simulated.truth), _errors(best, simulated.truth), factors)


def coverage(errors: list[dict[str, float]]) -> dict[str, float]:
    """Return the fraction of errors within the interval of 95 % by parameter."""
    limit = stats.norm.isf(0.025)
    return {name: float(np.mean([abs(e[name]) < limit for e in errors])) for name in errors[0]}


def main() -> None:
    """Print the coverage of each parameter with stated and with estimated weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipes", nargs="*", default=list(RECIPES))
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    for name in arguments.recipes:
        began = time.perf_counter()
        found = list(flights(name, range(arguments.first, arguments.first + arguments.flights)))
        print(f"{name}: {len(found)} of {arguments.flights} converged, {time.perf_counter() - began:.0f} s")
        for weights in ("stated", "estimated"):
            cover = coverage([getattr(f, weights) for f in found])
            print(f"  {weights:10s}" + "  ".join(f"{p} {100 * v:.0f} %" for p, v in cover.items()))
        labels = dict.fromkeys(label for f in found for label in f.factors)
        for label in labels:
            factors = [f.factors[label] for f in found if label in f.factors]
            print(f"  {label}: sigma times {np.median(factors):.3f} (median), in {len(factors)} flights")


if __name__ == "__main__":
    main()
