"""A small flight with a lidar beside its camera, simulated once: known truth for procedures with clouds."""

import copy
import functools

from jaxphoto.simulation import Simulation
from tests.simulation.small import made

TRUTH = {"boresight_deg": [0.12, -0.08, 0.3], "shift_m": {"B": [-1.0, 1.1, -0.9], "C": [0.8, 1.3, 0.7]}}
SCENE = {
    "flight.height_m": 600.0,
    "points": {"ties": 90},
    "targets": None,
    "cameras.kodak.unknowns": {"c_mm": "free", "xp_mm": "free", "yp_mm": "free", "k1": "free", "k2": "free"},
    "terrain": {
        "kind": "waves",
        "waves": [
            {"amplitude_m": 15.0, "length_m": 900.0},
            {"amplitude_m": 10.0, "length_m": 700.0, "heading_deg": 30.0},
        ],
        "buildings": [{"roof": roof, "count": 30} for roof in ("flat", "gable", "monopitch")],
        "trees": [{"count": 80}],
    },
    "sigmas": {"image_mm": 0.004, "station_m": 0.1, "lidar_m": [0.3, 0.3, 0.1]},
    "noise": {"image_mm": 0.004, "station_m": 0.1, "lidar_m": [0.3, 0.3, 0.1]},
    "lidar": {"density_per_m2": 0.35},
}


TRIPLET = SCENE | {
    "flight.strips": [{"name": "A", "heading_deg": 75.0, "images": 3}],
    "flight.height_m": 600.0,
    "points": {"ties": 30},
    "jitter": {"position_m": 0.0, "angle_deg": 1.0, "crab_deg": 2.0, "rate_deg_per_s": 0.5},
    "cameras.kodak.interior": {"c_mm": 34.0, "xp_mm": 0.064, "yp_mm": 0.273, "k1": -9.12e-5, "k2": 1.0435e-7},
    "cameras.kodak.unknowns": {"c_mm": "free"},
    "start": {"position_m": 0.3, "angle_deg": 0.05},
    "lidar": {"density_per_m2": 1.0},
}


@functools.cache
def triplet(seed: int = 4) -> Simulation:
    """Three images of one strip, as in paper 001; their stations lie on a line."""
    return made(copy.deepcopy(TRIPLET), seed)


@functools.cache
def scanned(seed: int = 3) -> Simulation:
    """The scanner is as it should be."""
    return made(copy.deepcopy(SCENE), seed)


@functools.cache
def misaligned(seed: int = 3) -> Simulation:
    """The scanner has a boresight, and its strips are shifted."""
    return made(copy.deepcopy(SCENE) | {"lidar.truth": TRUTH}, seed)
