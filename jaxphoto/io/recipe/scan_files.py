"""What a simulated scan leaves in the block folder: the cloud and its trajectory, and of the truth the scanner's."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Scanner, StripErrors, Trajectory
from jaxphoto.io import clouds
from jaxphoto.io.trajectory import write_flight_csv
from jaxphoto.io.trajectory.in_frame import records_of
from jaxphoto.observations import AXES
from jaxphoto.parameters import AbstractParameters, numbers_of

CLOUD, TRAJECTORY = "cloud.laz", "trajectory.csv"


def write_scan(cloud: Cloud, trajectory: Trajectory, folder: Path) -> None:
    """Write the cloud and the trajectory, both in the frame of the block."""
    clouds.write_cloud(cloud, folder / CLOUD)
    write_flight_csv(records_of(trajectory, TRAJECTORY), folder / TRAJECTORY)


def scanner_rows(scanner: Scanner, errors: StripErrors) -> list[tuple[str, float]]:
    """parameter, value of the scanner, as the result tables name them; of its calibration what is not zero."""
    angles = zip(("right", "forward", "up"), np.degrees(scanner.boresight), strict=True)
    rows = [(f"scanner.boresight_{axis}_deg", float(v)) for axis, v in angles]
    for name, shift in scanner.shifts.items():
        rows += [(f"scanner[{name}].shift_{a}_m", float(v)) for a, v in zip(AXES, np.asarray(shift), strict=True)]
    return rows + [(name, v) for name, v in in_degrees(errors.calibration, "") if v]


def in_degrees(own: AbstractParameters, owner: str) -> list[tuple[str, float]]:
    """parameter, value of declared parameters, angles in degrees."""
    told = zip(own.labels(owner), numbers_of(own), strict=True)
    return [(name.replace("_rad", "_deg"), float(np.degrees(v) if "_rad" in name else v)) for name, v in told]


def drift_table(errors: StripErrors, strips: Sequence[str]) -> pd.DataFrame:
    """strip, time_s, X_m ... right_deg ...: what the trajectory is off by at the knots of its splines."""
    of = np.repeat(np.array(strips, object), [s.size for s in errors.splines])
    time = np.concatenate([s.times for s in errors.splines])
    values = np.column_stack([errors.position, np.rad2deg(errors.attitude)])
    names = ("X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg")
    return pd.DataFrame({"strip": of, "time_s": time} | {name: values[:, k] for k, name in enumerate(names)})
