"""What a simulated scan leaves in the block folder: the cloud and its trajectory, and of the truth the scanner's."""

from pathlib import Path

import jax
import numpy as np

from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Scanner, Trajectory
from jaxphoto.io import clouds
from jaxphoto.io.trajectory import Records, write_flight_csv
from jaxphoto.observations import AXES
from jaxphoto.rotation import matrix_from_quaternion, roll_pitch_yaw_from_matrix
from jaxphoto.simulation.chunks import in_chunks

CLOUD, TRAJECTORY = "cloud.laz", "trajectory.csv"
_CHUNK = 4096


def write_scan(cloud: Cloud, trajectory: Trajectory, folder: Path) -> None:
    """Write the cloud and the trajectory, both in the frame of the block."""
    clouds.write_cloud(cloud, folder / CLOUD)
    position = np.asarray(trajectory.position)
    angles = np.rad2deg(in_chunks(_roll_pitch_yaw, _CHUNK, trajectory.quaternion))
    unknown = np.full(position.shape, np.nan)
    records = Records(TRAJECTORY, np.asarray(trajectory.time), position, False, angles, unknown, unknown)
    write_flight_csv(records, folder / TRAJECTORY)


def scanner_rows(scanner: Scanner) -> list[tuple[str, float]]:
    """parameter, value of the scanner, as the result tables name them."""
    angles = zip(("right", "forward", "up"), np.degrees(scanner.boresight), strict=True)
    rows = [(f"scanner.boresight_{axis}_deg", float(v)) for axis, v in angles]
    for name, shift in scanner.shifts.items():
        rows += [(f"scanner[{name}].shift_{a}_m", float(v)) for a, v in zip(AXES, np.asarray(shift), strict=True)]
    return rows


@jax.jit
@jax.vmap
def _roll_pitch_yaw(quaternion):
    return roll_pitch_yaw_from_matrix(matrix_from_quaternion(quaternion))
