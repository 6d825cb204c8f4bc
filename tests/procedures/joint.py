"""The flight of `strips` with photographs on the same erroneous trajectory, simulated once, and adjusted once."""

import functools

import numpy as np

from jaxphoto.camera import get_parameter
from jaxphoto.procedures.lidar import Photographs, StripAdjustment, adjust_strips
from jaxphoto.simulation import Simulation
from tests.procedures.strips import NOISE_M, PRIORS, SETTINGS, STRIPS
from tests.simulation.small import made

CAMERA = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
BORESIGHT_DEG = [0.1, -0.2, 0.15]
_ARM = [0.1, 0.2, 0.3]
_SIGMAS = {"image_mm": 0.004, "station_m": 0.01, "attitude_deg": 0.002, "lidar_m": [NOISE_M] * 3}
JOINT = STRIPS | {
    "flight.strips": [
        {"name": "A", "heading_deg": 90.0, "images": 4},
        {"name": "B", "heading_deg": 270.0, "images": 4, "across_spacings": 0.3},
        {"name": "C", "heading_deg": 0.0, "images": 4},
    ],
    "points": {"ties": 150},
    "sigmas": _SIGMAS,
    "noise": _SIGMAS,
    "cameras.kodak.unknowns": dict.fromkeys(CAMERA, "free"),
    "mounts": {
        "default": {
            "lever_arm_m": _ARM,
            "boresight": "free",
            "truth": {"lever_arm_m": _ARM, "boresight_deg": BORESIGHT_DEG},
        }
    },
    "lidar.same_trajectory": True,
}


def simulated(seed: int) -> Simulation:
    """Such a flight; another seed has another one over other ground, with other errors."""
    return made(JOINT, seed)


def photographs(flight: Simulation) -> Photographs:
    """Those of a simulated flight, on the clock of its trajectory."""
    assert flight.block.flight_time is not None
    return Photographs(flight.block, np.asarray(flight.block.flight_time))


def adjusted_together(flight: Simulation) -> StripAdjustment:
    """Trajectory, scanner and camera at once."""
    return adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS, photographs=photographs(flight))


def truth(flight: Simulation) -> dict[str, float]:
    """By label, what camera, mount and scanner truly are."""
    camera, errors = flight.truth.interior["kodak"], flight.errors
    known = {f"interior[kodak].{name}": float(get_parameter(camera, name)) for name in CAMERA}
    turned = zip("xyz", np.asarray(flight.truth.mounts["default"].boresight), strict=True)
    known |= {f"mounts[default].boresight_{axis}_rad": float(v) for axis, v in turned}
    turned = zip(("right", "forward", "up"), errors.boresight, strict=True)
    known |= {f"scanner.boresight_{axis}_rad": float(v) for axis, v in turned}
    of_scanner = errors.calibration
    return known | {
        "scanner_calibration.range_offset_m": float(of_scanner.range_offset),
        "scanner_calibration.angle_scale_ppm": float(of_scanner.angle_scale),
    }


@functools.cache
def flown(seed: int = 5) -> Simulation:
    return simulated(seed)


@functools.cache
def fitted(seed: int = 5) -> StripAdjustment:
    return adjusted_together(flown(seed))
