"""Applanix SBET (smoothed best estimate of trajectory): 17 little-endian doubles a record, no header.

Angles are radians, the altitude is above the ellipsoid. Platform heading and horizontal velocities refer to axes that
are turned by the wander angle: true heading = platform heading - wander angle (the note beside the record's layout in
FilePOSOutput.h of the US Naval Oceanographic Office's CHARTS library). The file has no standard deviations.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.io.text_files import read_bytes
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.io.trajectory.records import Records, check_records

FIELDS = (
    "time", "latitude", "longitude", "altitude", "x_velocity", "y_velocity", "z_velocity", "roll", "pitch",
    "platform_heading", "wander_angle", "x_acceleration", "y_acceleration", "z_acceleration", "x_rate", "y_rate",
    "z_rate",
)  # fmt: skip
"""The numbers of a record in their order: s, rad, m, m/s, m/s^2, rad/s."""
_TYPE = np.dtype("<f8")
_RECORD = len(FIELDS) * _TYPE.itemsize


def read_sbet(path: Path) -> Float[np.ndarray, "records 17"]:
    """The records as they stand, columns `FIELDS`. Raises InputError for a file that cannot be an SBET."""
    data = read_bytes(path)
    if len(data) % _RECORD:
        raise InputError(
            f"{path.name}: {len(data)} bytes are no whole number of SBET records of {_RECORD} bytes; the file is cut "
            "off or of another format, so export it again"
        )
    values = np.frombuffer(data, _TYPE).reshape(-1, len(FIELDS)).astype(float)
    for k, _ in np.argwhere(~(np.abs(values) <= LARGEST))[:1]:
        raise InputError(
            f"{path.name}, record {k + 1}: a number is not finite, or impossibly large; export the file again as SBET"
        )
    angles = values[:, [FIELDS.index("latitude"), FIELDS.index("longitude"), FIELDS.index("roll")]]
    for k, axis in np.argwhere(np.abs(angles) > [np.pi / 2, 2 * np.pi, np.pi])[:1]:
        name = ("latitude", "longitude", "roll")[axis]
        raise InputError(
            f"{path.name}, record {k + 1}: a {name} of {angles[k, axis]:g} rad cannot be; the file gives degrees, or "
            "is of another format, so export it again as SBET in radians"
        )
    return values


def write_sbet(values: Float[np.ndarray, "records 17"], path: Path) -> None:
    """Write records, columns `FIELDS`, so that `read_sbet` reads the same numbers."""
    path.write_bytes(np.ascontiguousarray(values, _TYPE).tobytes())


def sbet_records(values: Float[np.ndarray, "records 17"], file: str) -> Records:
    """The trajectory in SBET records, yaw from true north. Raises InputError, calling them `file`."""
    column = dict(zip(FIELDS, values.T, strict=True))
    heading = np.mod(column["platform_heading"] - column["wander_angle"], 2 * np.pi)
    unknown = np.full((len(values), 3), np.nan)
    records = Records(
        file,
        column["time"],
        np.stack([*np.rad2deg([column["longitude"], column["latitude"]]), column["altitude"]], axis=1),
        True,
        np.rad2deg(np.stack([column["roll"], column["pitch"], heading], axis=1)),
        unknown,
        unknown,
    )
    return check_records(records, np.arange(1, len(values) + 1), "record")


def with_records(values: Float[np.ndarray, "records 17"], records: Records) -> Float[np.ndarray, "records 17"]:
    """SBET records with the places and attitudes of `records`, of which `sbet_records` makes the same again.

    Velocities, accelerations, rates and the wander angle stay as they were.
    """
    old = dict(zip(FIELDS, values.T, strict=True))
    longitude, latitude = np.deg2rad(records.coordinates[:, :2].T)
    roll, pitch, yaw = np.deg2rad(records.roll_pitch_yaw_deg.T)
    new = {
        "latitude": latitude, "longitude": _near(longitude, old["longitude"]), "altitude": records.coordinates[:, 2],
        "roll": roll, "pitch": pitch,
        "platform_heading": _near(yaw + old["wander_angle"], old["platform_heading"]),
    }  # fmt: skip
    changed = values.copy()
    for name, column in new.items():
        changed[:, FIELDS.index(name)] = column
    return changed


def _near(angle: Float[np.ndarray, "records"], old: Float[np.ndarray, "records"]) -> Float[np.ndarray, "records"]:
    """The same angles by whole turns nearest to those of the file, whichever turn that counts from."""
    return old + np.mod(angle - old + np.pi, 2 * np.pi) - np.pi
