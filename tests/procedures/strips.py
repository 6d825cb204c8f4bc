"""A flight of three strips with all errors that a strip adjustment corrects, simulated and adjusted once."""

import copy
import dataclasses
import functools

from jaxphoto.georeferencing import ScannerCalibration
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.procedures.lidar import ScannerPriors, StripAdjustment, adjust_strips
from jaxphoto.simulation import Simulation
from jaxphoto.unknowns import FIXED, FREE, Weighted
from tests.simulation.small import made

NOISE_M = 0.03
TRUTH = {
    "boresight_deg": [0.02, -0.03, 0.04], "range_offset_m": 0.06, "angle_scale_ppm": 300.0,
    "drift_sigma_m": [0.05, 0.05, 0.05], "drift_sigma_deg": [0.003, 0.003, 0.006], "correlation_s": 60.0,
    "knots_s": 5.0,
}  # fmt: skip
STRIPS = {
    "flight.height_m": 500.0,
    "flight.strips": [
        {"name": "A", "heading_deg": 90.0, "images": 3},
        {"name": "B", "heading_deg": 270.0, "images": 3, "across_spacings": 0.3},
        {"name": "C", "heading_deg": 0.0, "images": 3},
    ],
    "points": {"ties": 30},
    "targets": None,
    "jitter": {"position_m": 8.0, "angle_deg": 1.0, "crab_deg": 2.0, "rate_deg_per_s": 0.3},
    "terrain": {
        "kind": "waves",
        "waves": [
            {"amplitude_m": 20.0, "length_m": 600.0},
            {"amplitude_m": 15.0, "length_m": 500.0, "heading_deg": 30.0},
        ],
        "buildings": [{"roof": "gable", "count": 20}],
        "trees": [{"count": 30}],
    },
    "sigmas": {"image_mm": 0.004, "station_m": 0.1, "lidar_m": [NOISE_M] * 3},
    "noise": {"image_mm": 0.004, "station_m": 0.1, "lidar_m": [NOISE_M] * 3},
    "lidar": {"density_per_m2": 0.2, "scan_angle_deg": 25.0, "truth": TRUTH},
}
SETTINGS = StripSettings(
    cell_m=8.0, most=1200, knots_s=5.0, correlation_s=60.0, sigma_position_m=0.05, sigma_attitude_deg=0.003,
    sigma_heading_deg=0.006,
)  # fmt: skip
PRIORS = ScannerPriors(FREE, ScannerCalibration(FIXED, Weighted(0.0, 0.1), FIXED, FREE, FIXED, FIXED))  # type: ignore[arg-type]

# The same with a scanner of two prisms, which looks all around.
AROUND = STRIPS | {"lidar": {"density_per_m2": 0.2, "scan_angle_deg": 25.0, "pattern": "circle", "truth": TRUTH}}
PRIORS_AROUND = ScannerPriors(FREE, dataclasses.replace(PRIORS.calibration, pattern="circle"))


@functools.cache
def flown(seed: int = 5) -> Simulation:
    return made(copy.deepcopy(STRIPS), seed)


@functools.cache
def fitted(seed: int = 5) -> StripAdjustment:
    flight = flown(seed)
    return adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS)
