"""A trajectory's records brought to the object frame of a block, and back."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Trajectory
from jaxphoto.io.trajectory.records import Records
from jaxphoto.rotation import (
    matrix_from_quaternion,
    matrix_from_roll_pitch_yaw,
    quaternion_from_matrix,
    roll_pitch_yaw_from_matrix,
)


def positions_in(records: Records, frame: Frame) -> Float[np.ndarray, "records 3"]:
    """X, Y, Z (m) of the records in the frame of the block. Raises InputError where they do not go with it."""
    position = records.coordinates
    if frame.kind == "epsg":
        position = frame.map.local_from_place(position) if records.geographic else frame.map.local(position)
    elif records.geographic:
        raise InputError(
            f"{records.file}: the trajectory gives longitude and latitude, which a frame of kind "
            f'"{frame.kind}" cannot place; write kind = "epsg" under [frame] in block.toml, or convert the file'
        )
    for k in np.flatnonzero(~np.isfinite(position).all(axis=1))[:1]:
        raise InputError(
            f"{records.file}: the coordinates at {records.time[k]:.3f} s lie where EPSG:{frame.code} does not reach; "
            "correct them or the code"
        )
    return position


def trajectory_in(
    records: Records, frame: Frame, sigma_m: Float[np.ndarray, "records 3"], sigma_rad: Float[np.ndarray, "records 3"]
) -> Trajectory:
    """The trajectory in the frame of the block, with the standard deviations given. Raises as `positions_in`."""
    position = positions_in(records, frame)
    quaternion = _quaternions(_levelled(records, frame, position), np.deg2rad(records.roll_pitch_yaw_deg))
    arrays = (records.time, position, quaternion, sigma_m, sigma_rad)
    return Trajectory(*map(jnp.asarray, arrays))


def records_of(trajectory: Trajectory, file: str) -> Records:
    """Records in the object frame, without standard deviations: what `trajectory_in` makes `trajectory` of."""
    position = np.asarray(trajectory.position)
    angles = np.rad2deg(np.asarray(_roll_pitch_yaw(np.asarray(trajectory.quaternion))))
    unknown = np.full(position.shape, np.nan)
    return Records(file, np.asarray(trajectory.time), position, False, angles, unknown, unknown)


def with_poses(records: Records, trajectory: Trajectory, frame: Frame) -> Records:
    """The same records with the positions and attitudes of `trajectory`, in the frame of the block: `trajectory_in`
    of the result is that."""
    position = np.asarray(trajectory.position)
    turn = np.swapaxes(_levelled(records, frame, position), 1, 2)
    angles = np.rad2deg(np.asarray(_turned_angles(turn, np.asarray(trajectory.quaternion))))
    return with_positions(records, position, frame)._replace(roll_pitch_yaw_deg=angles)


def with_positions(records: Records, position: Float[np.ndarray, "records 3"], frame: Frame) -> Records:
    """The same records at other positions (m), given in the frame of the block."""
    if frame.kind != "epsg":
        return records._replace(coordinates=position)
    coordinates = frame.map.map(position)
    return records._replace(coordinates=frame.map.place(coordinates) if records.geographic else coordinates)


def _levelled(records: Records, frame: Frame, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """From the axes that roll, pitch and yaw of records refer to, to those of the frame, at positions in it."""
    if frame.kind != "epsg":
        return np.broadcast_to(np.eye(3), (len(position), 3, 3))
    true_north = records.geographic or frame.yaw == "true"
    return frame.map.local_from_level(position) if true_north else frame.map.local_from_grid(position)


@jit_quickly
@jax.vmap
def _turned_angles(turn, quaternion):
    return roll_pitch_yaw_from_matrix(turn @ matrix_from_quaternion(quaternion))


@jit_quickly
@jax.vmap
def _quaternions(turn, angles):
    return quaternion_from_matrix(turn @ matrix_from_roll_pitch_yaw(angles))


@jit_quickly
@jax.vmap
def _roll_pitch_yaw(quaternion):
    return roll_pitch_yaw_from_matrix(matrix_from_quaternion(quaternion))
