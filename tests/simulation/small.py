"""A small recipe that tests change key by key, and functions to simulate it."""

import copy
import functools
from pathlib import Path
from typing import Any

from jaxphoto.io import recipe_from
from jaxphoto.simulation import Simulation, simulate

RECIPES = Path(__file__).parent / "recipes"
SMALL: dict[str, Any] = {
    "cameras": {
        "kodak": {
            "width_px": 4500,
            "height_px": 3000,
            "pixel_mm": 0.008,
            "distortion": "brown",
            "interior": {"c_mm": 34.0, "k1": -8e-5},
            "truth": {"c_mm": 34.25, "xp_mm": 0.064, "yp_mm": 0.273, "k1": -9.12e-5, "k2": 1.0435e-7},
            "unknowns": {"c_mm": "free", "k1": "free"},
        }
    },
    "flight": {
        "height_m": 1000.0,
        "forward_overlap_percent": 60.0,
        "side_overlap_percent": 50.0,
        "speed_m_per_s": 60.0,
        "strips": [
            {"name": "A", "heading_deg": 75.0, "images": 5, "across_spacings": 0.5},
            {"name": "B", "heading_deg": 255.0, "images": 5, "across_spacings": 0.5},
            {"name": "C", "heading_deg": 345.0, "images": 4, "along_bases": 0.5},
        ],
    },
    "jitter": {"position_m": 15.0, "angle_deg": 2.0, "crab_deg": 3.0, "rate_deg_per_s": 0.5},
    "terrain": {"kind": "rolling"},
    "points": {"ties": 40},
    "targets": [{"count": 8, "role": "control"}, {"count": 4, "role": "check"}],
    "sigmas": {"image_mm": 0.004, "control_m": 0.03, "station_m": 0.1, "attitude_deg": 0.01},
    "noise": {"image_mm": 0.0, "control_m": 0.0, "station_m": 0.0, "attitude_deg": 0.0},
}


def changed(changes: dict[str, Any], base: dict[str, Any] = SMALL) -> dict[str, Any]:
    """A copy of `base` with `changes` by path ("flight.strips.0.images"); None removes a key."""
    values = copy.deepcopy(base)
    for path, value in changes.items():
        *parents, last = path.split(".")
        place: Any = values
        for key in parents:
            place = place[int(key)] if isinstance(place, list) else place.setdefault(key, {})
        if value is None:
            del place[int(last) if isinstance(place, list) else last]
        else:
            # A copy: a later change may lie within it.
            place[int(last) if isinstance(place, list) else last] = copy.deepcopy(value)
    return values


def made(changes: dict[str, Any] | None = None, seed: int = 1) -> Simulation:
    """The small recipe, changed, simulated. Without noise, unless the changes say otherwise."""
    return simulate(recipe_from(changed(changes or {})), seed)


@functools.cache
def plain() -> Simulation:
    """The small recipe as it stands: no noise, no mount, no bias."""
    return made()
