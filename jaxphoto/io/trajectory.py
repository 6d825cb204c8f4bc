"""GNSS/IMU trajectories: read CSV and Applanix SBET, transform to the frame of a block, and write.

See docs/georeferencing.md. SBET (smoothed best estimate of trajectory) has 17 little-endian doubles per record and no
header. Angles are in radians, the altitude is ellipsoidal. Platform heading and horizontal velocities refer to axes
rotated by the wander angle: true heading = platform heading - wander angle (FilePOSOutput.h of the CHARTS library, US
Naval Oceanographic Office). SBET has no standard deviations.
"""

import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Trajectory
from jaxphoto.georeferencing.trajectory import SHORTEST
from jaxphoto.io.text_files import read_bytes
from jaxphoto.io.text_tables import LARGEST, read_csv
from jaxphoto.rotation import (
    matrix_from_quaternion,
    matrix_from_roll_pitch_yaw,
    quaternion_from_matrix,
    roll_pitch_yaw_from_matrix,
)
from jaxphoto.rounding import M_PER_DEGREE, rounding_error, rounding_step

FIELDS = (
    "time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity", "roll", "pitch",
    "platform_heading", "wander_angle", "x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate",
    "z_rate",
)  # fmt: skip
"""Fields of an SBET record; units s, rad, m, m/s, m/s^2, rad/s."""
_SBET = np.dtype("<f8")
_RECORD_BYTES = len(FIELDS) * _SBET.itemsize
# Deviation from interpolated values, as a fraction of the step, that rounding causes; maximum fraction of such records
# in tracks that are not rounded.
_OFF, _UNEVEN = 0.1, 0.02
_MAP = ("X_m", "Y_m", "Z_m")
_PLACE = ("longitude_deg", "latitude_deg", "height_m")
_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
_SIGMA_M = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
_SIGMA_DEG = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")


class Records(NamedTuple):
    """A trajectory in the system and units of its file, one entry per record."""

    file: str
    time: np.ndarray
    coordinates: np.ndarray
    """X, Y, Z (m) in the frame of the block; if `geographic`, longitude, latitude (deg) and ellipsoidal height (m)."""
    geographic: bool
    roll_pitch_yaw_deg: np.ndarray
    """Roll, pitch, yaw (degrees); yaw from true north if `geographic`."""
    sigma_m: np.ndarray
    """Standard deviations (m); NaN if unknown, as in `sigma_deg`."""
    sigma_deg: np.ndarray


def is_sbet(path: Path) -> bool:
    """Return True for the suffixes of SBET: .sbet and .out (POSPac)."""
    return path.suffix.lower() in (".sbet", ".out")


def read_records(path: Path) -> Records:
    """Read a trajectory, SBET or CSV according to its suffix."""
    return sbet_records(read_sbet(path), path.name) if is_sbet(path) else read_flight_csv(path)


def write_moved(moved: Records, given: Path, folder: Path) -> None:
    """Write trajectory.csv; if the original file `given` is an SBET, also write an SBET of the same name."""
    write_flight_csv(moved, folder / "trajectory.csv")
    if is_sbet(given):
        write_sbet(with_records(read_sbet(given), moved), folder / given.name)


def read_flight_csv(path: Path) -> Records:
    """Read a CSV with time_s, X_m, Y_m, Z_m (or longitude_deg, latitude_deg, height_m), roll_deg, pitch_deg, yaw_deg.

    Standard deviations (sigma_X_m ... sigma_yaw_deg) are optional. Raises InputError with file and row.
    """
    table = read_csv(path, ("time_s", *_ANGLES), (*_MAP, *_PLACE, *_SIGMA_M, *_SIGMA_DEG))
    systems = [names for names in (_MAP, _PLACE) if any(name in table for name in names)]
    if len(systems) != 1 or not all(name in table for name in systems[0]):
        raise InputError(
            f"{path.name}: positions need exactly one set of columns; use either {', '.join(_MAP)} or "
            f"{', '.join(_PLACE)}"
        )
    sigma_m, sigma_deg = (np.stack([table.sigmas(n) for n in names], axis=1) for names in (_SIGMA_M, _SIGMA_DEG))
    coordinates, angles = table.matrix(systems[0]), table.matrix(_ANGLES)
    geographic = systems[0] is _PLACE
    records = Records(path.name, table.numbers("time_s"), coordinates, geographic, angles, sigma_m, sigma_deg)
    return _checked(records, table.rows, "row")


def write_flight_csv(records: Records, path: Path) -> None:
    """Write a CSV from which `read_flight_csv` restores identical values; unknown standard deviations are omitted."""
    columns = {"time_s": records.time}
    for names, values in (
        (_PLACE if records.geographic else _MAP, records.coordinates),
        (_ANGLES, records.roll_pitch_yaw_deg),
        (_SIGMA_M, records.sigma_m),
        (_SIGMA_DEG, records.sigma_deg),
    ):
        columns |= {n: column for n, column in zip(names, values.T, strict=True) if not np.isnan(column).all()}
    pd.DataFrame(columns).to_csv(path, index=False)


def _checked(records: Records, rows: np.ndarray, row: str) -> Records:
    """Check times and ranges. `rows` are record numbers, and `row` is their name in messages."""
    file, time, angles = records.file, records.time, records.roll_pitch_yaw_deg
    if len(time) < SHORTEST:
        raise InputError(
            f"{file}: {len(time)} records, but interpolation with uncertainty needs {SHORTEST}; "
            "give a longer trajectory"
        )
    for k in np.flatnonzero(np.diff(time) <= 0)[:1]:
        raise InputError(
            f"{file}, {row} {rows[k + 1]}: the time {time[k + 1]:.6f} s does not come after {time[k]:.6f} s before it; "
            "sort the records, delete duplicates, and add 604800 s to the times after the end of a GPS week"
        )
    places = records.coordinates[:, :2] if records.geographic else np.zeros((0, 2))
    for names, values, limit in ((("longitude", "latitude"), places, [360, 90]), (_ANGLES, angles, 360)):
        for k, axis in np.argwhere(np.abs(values) > limit)[:1]:
            raise InputError(
                f"{file}, {row} {rows[k]}: {names[axis]} = {values[k, axis]:g} degrees is out of range. Give longitude "
                "before latitude, and angles in the unit of the format."
            )
    return records


def read_sbet(path: Path) -> Float[np.ndarray, "records 17"]:
    """Read the records of an SBET, with columns `FIELDS`. Raises InputError for other content."""
    data = read_bytes(path)
    if len(data) % _RECORD_BYTES:
        raise InputError(
            f"{path.name}: {len(data)} bytes are not a whole number of SBET records of {_RECORD_BYTES} bytes; the file "
            "is cut off or of another format. Export it again."
        )
    values = np.frombuffer(data, _SBET).reshape(-1, len(FIELDS)).astype(float)
    for k, _ in np.argwhere(~(np.abs(values) <= LARGEST))[:1]:
        raise InputError(f"{path.name}, record {k + 1}: a number is not finite. Export the file again as SBET.")
    names = ("latitude", "longitude", "roll")
    angles = values[:, [FIELDS.index(name) for name in names]]
    for k, axis in np.argwhere(np.abs(angles) > [np.pi / 2, 2 * np.pi, np.pi])[:1]:
        raise InputError(
            f"{path.name}, record {k + 1}: a {names[axis]} of {angles[k, axis]:g} rad is out of range: the file is in "
            "degrees or of another format. Export it again as SBET in radians."
        )
    return values


def write_sbet(values: Float[np.ndarray, "records 17"], path: Path) -> None:
    """Write SBET records, with columns `FIELDS`."""
    path.write_bytes(np.ascontiguousarray(values, _SBET).tobytes())


def sbet_records(values: Float[np.ndarray, "records 17"], file: str) -> Records:
    """Convert SBET records of `file` to a trajectory with yaw from true north. Raises InputError for invalid values."""
    column = dict(zip(FIELDS, values.T, strict=True))
    heading = np.mod(column["platform_heading"] - column["wander_angle"], 2 * np.pi)
    place = np.stack([*np.rad2deg([column["longitude"], column["latitude"]]), column["altitude"]], axis=1)
    angles = np.rad2deg(np.stack([column["roll"], column["pitch"], heading], axis=1))
    unknown = np.full((len(values), 3), np.nan)
    records = Records(file, column["time"], place, True, angles, unknown, unknown)
    return _checked(records, np.arange(1, len(values) + 1), "record")


def with_records(values: Float[np.ndarray, "records 17"], records: Records) -> Float[np.ndarray, "records 17"]:
    """Replace positions and attitudes of SBET records by `records`: the inverse of `sbet_records`.

    Velocities, accelerations, rates and the wander angle are unchanged.
    """
    old = dict(zip(FIELDS, values.T, strict=True))
    longitude, latitude = np.deg2rad(records.coordinates[:, :2].T)
    roll, pitch, yaw = np.deg2rad(records.roll_pitch_yaw_deg.T)
    new = {
        "latitude": latitude, "longitude": _nearest_turn(longitude, old["longitude"]),
        "altitude": records.coordinates[:, 2], "roll": roll, "pitch": pitch,
        "platform_heading": _nearest_turn(yaw + old["wander_angle"], old["platform_heading"]),
    }  # fmt: skip
    changed = values.copy()
    for name, column in new.items():
        changed[:, FIELDS.index(name)] = column
    return changed


def _nearest_turn(angle: Float[np.ndarray, "n"], reference: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Add multiples of 2 pi to angles, so that they are nearest to `reference`."""
    return reference + np.mod(angle - reference + np.pi, 2 * np.pi) - np.pi


# In the frame of a block ------------------------------------------------------------------------------------


def positions_in(records: Records, frame: Frame) -> Float[np.ndarray, "records 3"]:
    """Transform positions to the frame of a block. Raises InputError if the systems do not fit."""
    position = records.coordinates
    if frame.kind == "epsg":
        position = frame.map.local_from_place(position) if records.geographic else frame.map.local(position)
    elif records.geographic:
        raise InputError(
            f"{records.file}: longitude and latitude cannot be converted to a frame of kind "
            f'"{frame.kind}"; write kind = "epsg" under [frame] in block.toml, or convert the file'
        )
    for k in np.flatnonzero(~np.isfinite(position).all(axis=1))[:1]:
        raise InputError(
            f"{records.file}: the coordinates at {records.time[k]:.3f} s are outside the area of EPSG:{frame.code}; "
            "correct them or the code"
        )
    return position


def trajectory_in(
    records: Records, frame: Frame, sigma_m: Float[np.ndarray, "records 3"], sigma_rad: Float[np.ndarray, "records 3"]
) -> Trajectory:
    """Transform a trajectory to the frame of a block, with the given standard deviations.

    Warns of columns rounded to a step whose error exceeds their standard deviation.
    """
    position = positions_in(records, frame)
    _warn_of_rounding(records, sigma_m, np.rad2deg(sigma_rad))
    axes = _frame_from_axes(records, frame, position)
    quaternion = _quaternions(axes, np.deg2rad(records.roll_pitch_yaw_deg))
    return Trajectory(*map(jnp.asarray, (records.time, position, quaternion, sigma_m, sigma_rad)))


def _warn_of_rounding(
    records: Records, sigma_m: Float[np.ndarray, "records 3"], sigma_deg: Float[np.ndarray, "records 3"]
) -> None:
    names = (*(_PLACE if records.geographic else _MAP), *_ANGLES)
    values = np.hstack([records.coordinates, records.roll_pitch_yaw_deg])
    for name, column, sigma in zip(names, values.T, np.hstack([sigma_m, sigma_deg]).T, strict=True):
        unit, limit = name.rsplit("_", 1)[1], float(np.median(sigma))
        if name in _PLACE[:2]:
            limit /= M_PER_DEGREE
        step = rounding_step(column, limit, unit)
        if rounding_error(step) > limit and not _is_smooth(records.time, column, step):
            warnings.warn(
                f"{records.file}, column {name}: all values are multiples of {step:.6g} {unit}, sigma is {limit:.2g} "
                f"{unit}; give them with all their digits, or a larger sigma",
                UserWarning,
                stacklevel=3,
            )


def _is_smooth(time: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], step: float) -> bool:
    """Return True if nearly all values are interpolated by a cubic through their four neighbours: exact tracks are
    multiples of their steps without being rounded.
    """
    k = np.arange(2, len(time) - 2)[:, None]
    j = k + np.array([-2, -1, 1, 2])
    x = time[j] - time[k]
    # Lagrange weights at the time between.
    others = [np.delete(x, m, axis=1) for m in range(4)]
    weights = np.stack([(o / (o - x[:, [m]])).prod(axis=1) for m, o in enumerate(others)], axis=1)
    off = np.abs(values[k[:, 0]] - (weights * values[j]).sum(axis=1))
    return bool((off > _OFF * step).sum() <= _UNEVEN * len(off))


def records_of(trajectory: Trajectory, file: str) -> Records:
    """Convert a trajectory to records in the object frame, without sigmas: the inverse of `trajectory_in`."""
    position = np.asarray(trajectory.position)
    axes = np.broadcast_to(np.eye(3), (len(position), 3, 3))
    angles = np.rad2deg(np.asarray(_roll_pitch_yaw(axes, np.asarray(trajectory.quaternion))))
    unknown = np.full(position.shape, np.nan)
    return Records(file, np.asarray(trajectory.time), position, False, angles, unknown, unknown)


def with_poses(records: Records, trajectory: Trajectory, frame: Frame) -> Records:
    """Replace positions and attitudes of records by `trajectory`, which is in the frame of a block."""
    position = np.asarray(trajectory.position)
    axes = np.swapaxes(_frame_from_axes(records, frame, position), 1, 2)
    angles = np.rad2deg(np.asarray(_roll_pitch_yaw(axes, np.asarray(trajectory.quaternion))))
    return with_positions(records, position, frame)._replace(roll_pitch_yaw_deg=angles)


def with_positions(records: Records, position: Float[np.ndarray, "records 3"], frame: Frame) -> Records:
    """Replace the positions of records by `position` (m), in the frame of a block."""
    if frame.kind != "epsg":
        return records._replace(coordinates=position)
    coordinates = frame.map.map(position)
    return records._replace(coordinates=frame.map.place(coordinates) if records.geographic else coordinates)


def _frame_from_axes(records: Records, frame: Frame, position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations from the reference axes of roll, pitch and yaw to the frame of the block."""
    if frame.kind != "epsg":
        return np.broadcast_to(np.eye(3), (len(position), 3, 3))
    true_north = records.geographic or frame.yaw == "true"
    return frame.map.local_from_level(position) if true_north else frame.map.local_from_grid(position)


@jit_quickly
@jax.vmap
def _roll_pitch_yaw(rotation, quaternion):
    return roll_pitch_yaw_from_matrix(rotation @ matrix_from_quaternion(quaternion))


@jit_quickly
@jax.vmap
def _quaternions(rotation, angles):
    return quaternion_from_matrix(rotation @ matrix_from_roll_pitch_yaw(angles))
