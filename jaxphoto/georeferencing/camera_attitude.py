"""Attitudes of cameras recorded by drones, as rotation matrices.

Two conventions are in use. Gimbal angles are zero if the camera looks level to the north: yaw, pitch and roll rotate
the axes forward (optical axis), right, down, and the nadir is at pitch -90 degrees, where yaw and roll are degenerate.
Angles of a camera in the belly are zero if it looks down with the top of its picture to the north. Both rotate about
down, right and forward in this order, in north, east, down.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

# Columns: north, east and down in axes east, north, up; its own inverse.
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Columns: the camera's axes x (right), y (up in the picture), z (back) in forward, right, down.
_FROM_GIMBAL = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_FROM_BELLY = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
USUAL_SIGMA_DEG = (1.0, 1.0, 5.0)
"""Roll, pitch and yaw, for files without them: a gimbal keeps tenths of a degree relative to accelerometers with a zero
error, and yaw is that of a compass."""


class CameraAttitude(NamedTuple):
    """Attitude of the camera at the exposure."""

    level_from_camera: Float[np.ndarray, "3 3"]
    """From x right, y up in the picture, z back to east, true north, up at the place of the photograph."""
    sigma_deg: tuple[float, float, float] = USUAL_SIGMA_DEG
    """Roll, pitch and yaw of a camera in the belly."""


def level_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """`level_from_camera` of gimbal angles, pitch 0 to the horizon and -90 degrees to the nadir.

    R3(yaw) R2(pitch) R1(roll) of north-east-down (DJI, manuals: "NED, the rotation order is ZYX").
    """
    return _ENU_NED @ _turned(yaw_deg, pitch_deg, roll_deg) @ _FROM_GIMBAL


def level_from_belly(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    """`level_from_camera` of angles of a camera that looks down at pitch 0, top of the picture forward.

    That of the aircraft with the camera mounted so: the habit of Pix4D (support article 202558969), and of the body
    axes right, forward, up of docs/conventions.md with `image_x = "right"`.
    """
    return _ENU_NED @ _turned(yaw_deg, pitch_deg, roll_deg) @ _FROM_BELLY


def level_from_body(roll_pitch_yaw_deg: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """From the aircraft's axes right, forward, up to east, north, up."""
    roll, pitch, yaw = roll_pitch_yaw_deg
    return level_from_belly(yaw, pitch, roll)


def _turned(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Float[np.ndarray, "3 3"]:
    return scipy.spatial.transform.Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
