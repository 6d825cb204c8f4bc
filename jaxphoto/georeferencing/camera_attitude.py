"""Attitudes of cameras recorded by drones, as rotation matrices.

Two conventions are in use. Gimbal angles are zero if the optical axis is horizontal to the north: yaw, pitch and roll
rotate the axes forward (optical axis), right, down, and the nadir is at pitch -90 degrees, where yaw and roll are
degenerate. Body angles are zero if the camera looks down with the top of the image to the north. Both rotate about
down, right and forward in this order, in the frame north, east, down.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

# Columns: north, east and down in the axes east, north, up. The matrix is its own inverse.
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Columns: camera axes x (right), y (up in the image), z (back) in the axes forward, right, down.
_FROM_GIMBAL = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_FROM_BELLY = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
USUAL_SIGMA_DEG = (1.0, 1.0, 5.0)
"""Default standard deviations of roll, pitch and yaw: tenths of a degree for the gimbal plus the bias of its
accelerometers; yaw is from a compass.
"""


class CameraAttitude(NamedTuple):
    """Attitude of the camera at the exposure."""

    level_from_camera: Float[np.ndarray, "3 3"]
    """Rotation from x right, y up in the image, z back to east, true north, up at the position of the photograph."""
    sigma_deg: tuple[float, float, float] = USUAL_SIGMA_DEG
    """Standard deviations of roll, pitch and yaw as body angles."""


def level_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return `level_from_camera` for gimbal angles: pitch 0 at the horizon, -90 degrees at the nadir.

    R3(yaw) R2(pitch) R1(roll) in north, east, down (DJI, manuals: "NED, the rotation order is ZYX").
    """
    return _ENU_NED @ _turned(yaw_deg, pitch_deg, roll_deg) @ _FROM_GIMBAL


def level_from_belly(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return `level_from_camera` for body angles: at pitch 0 the camera looks down, top of the image forward.

    The angles are the attitude of an aircraft with the camera mounted this way: convention of Pix4D (support article
    202558969), equal to the body axes of docs/conventions.md with `image_x = "right"`.
    """
    return _ENU_NED @ _turned(yaw_deg, pitch_deg, roll_deg) @ _FROM_BELLY


def level_from_body(roll_pitch_yaw_deg: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from the body axes right, forward, up to east, north, up."""
    roll, pitch, yaw = roll_pitch_yaw_deg
    return level_from_belly(yaw, pitch, roll)


def _turned(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    return scipy.spatial.transform.Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
