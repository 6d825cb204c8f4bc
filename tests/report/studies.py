"""Small results of studies with known numbers, for their plots and pages."""

import functools
import math

import numpy as np

from jaxphoto import Tables
from jaxphoto.camera import Brown, InteriorOrientation, Sensor, Smac
from jaxphoto.lidar import HeightFlag
from jaxphoto.procedures import Step
from jaxphoto.procedures.boresight import BoresightEstimate
from jaxphoto.procedures.compare import Cut, Halves
from jaxphoto.procedures.lidar import LidarControl, Round, Simultaneous
from jaxphoto.procedures.model_choice import Candidate, Judged, ModelChoice
from jaxphoto.stability import Analysis, image_grid
from jaxphoto.stability.band import ErrorBand
from jaxphoto.stability.comparison import analyse
from tests.blocks import SENSOR, adjusted

GOPRO = Sensor(3000, 2250, 0.00155)
ROUNDS = (Round(1, 40, 3, 0.2, np.inf, 0.12), Round(2, 41, 2, 0.01, 0.004, 0.05))
# By candidate: estimated parameters, BIC, RMS of adjusted and of left-out image points (px).
MODELS = {"brown:k1": (4, 5210.0, 0.61, 0.63), "brown": (8, 1010.4, 0.31, 0.33), "smac:a$": (6, 1004.0, 0.32, 0.32)}


@functools.cache
def boresight_steps() -> tuple[Step, ...]:
    """Four steps whose misalignment is known better and better, with shifts of two strips in the second."""
    a = adjusted("cross")
    covariance = Tables(a).covariance

    def step(number: int, estimates: list[tuple[str, float, float, str]]) -> Step:
        told = tuple(BoresightEstimate(*estimate) for estimate in estimates)
        return Step(number, a, covariance, told, (f"what step {number} says",), True)

    shifts = [(f"strips[{s}].shift_{x}_m", 0.1 * k, 0.05, "m") for s in ("E1", "E2") for k, x in enumerate("XYZ")]
    turned = {
        n: [(f"mounts[imu].boresight_{x}_deg", 0.01 * k - 0.1 / n, 0.03 / n, "deg") for k, x in enumerate("xyz")]
        for n in (3, 4)
    }
    return step(1, []), step(2, shifts), step(3, turned[3]), step(4, turned[4])


def halves_found() -> Halves:
    """A factor that grows from left to right from 1 to 2, and a band that grows upwards from 0.1 to 0.3 px."""
    cells = image_grid(SENSOR, 7, 5)
    right, up = ((v - v.min()) / np.ptp(v) for v in cells.T)
    n = len(adjusted("cross").block.images)
    cuts = tuple(
        Cut(np.arange(n) % 2 == k, sigma0=(1.0, 1.1), offsets_px=np.full((len(cells), 2), 0.1)) for k in (0, 1)
    )
    band = ErrorBand(1.5, 0.1, 1 + right, 0.2 + 0.4 * up, 0.1 + 0.2 * up, np.ones(2), np.ones(2))
    return Halves(
        adjusted("cross"), "one", "image", "rot", cells, np.eye(5), np.full(len(cells), 0.1), cuts, (), band
    )  # fmt: skip


def model_choice_of(n_left_out: int = 100) -> ModelChoice:
    """The three of `MODELS`, and one that could not be adjusted."""
    judged = [
        Judged(Candidate(name, Brown, ("k1",)), "", p, 900, 700, 600.0, rms, cv if n_left_out else math.nan, bic=bic)
        for name, (p, bic, rms, cv) in MODELS.items()
    ]
    failed = Judged(Candidate("opencv", Brown, ("k1",)), "it did not converge")
    return ModelChoice((*judged, failed), n_left_out, "smac:a$", "smac:a$" if n_left_out else "")


def lidar_control_of(residual_m: float = 0.05) -> LidarControl:
    """Every third height is left out, every fourth refused; those that are used are off by plus or minus the same."""
    a = adjusted("cross")
    points = np.arange(len(a.block.points))
    height = np.asarray(a.unknowns.points)[:, 2] + residual_m * np.where(points % 2, 1.0, -1.0)
    refused, used = points % 4 == 1, points % 3 > 0
    height[refused] = np.nan
    flag = np.where(refused, int(next(iter(HeightFlag))), 0)
    return LidarControl(a.block, a, points, height, np.full(len(points), 0.1), flag, used & ~refused, ROUNDS, True)


def simultaneous_of(before_m: float, after_m: float) -> Simultaneous:
    """Every second point so far above the cloud's surface, the others as far below; of one it is not known."""
    a = adjusted("cross")
    points = np.arange(len(a.block.points))
    side = np.where(points == 3, np.nan, np.where(points % 2, 1.0, -1.0))
    # Without cloud and scanner, which no picture shows.
    result = object.__new__(Simultaneous)
    told = {"adjusted": a, "points": points, "apart_before": before_m * side, "apart": after_m * side}
    for name, value in told.items():
        object.__setattr__(result, name, value)
    return result


def ray_offsets() -> Analysis:
    """Two calibrations of a small camera, aligned by three rotations."""
    one, two = (
        InteriorOrientation(c, -0.0736, 0.0878, Smac(k1=k1, k2=-1.19e-3))
        for c, k1 in ((2.6989, -3.94e-2), (2.6987, -3.93e-2))
    )
    return analyse(one, two, image_grid(GOPRO))["rot"]
