"""A trajectory as a file gives it, in the file's system and units, checked record by record."""

from typing import NamedTuple

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.trajectory import SHORTEST


class Records(NamedTuple):
    """One entry per record. `geographic` says which of the two kinds of coordinates there is.

    `coordinates`: X, Y, Z (m) in the frame of the block, or longitude, latitude (degrees) and height above the
    ellipsoid (m); yaw is then from true north. Standard deviations are NaN where the file gives none.
    """

    file: str
    time: np.ndarray
    coordinates: np.ndarray
    geographic: bool
    roll_pitch_yaw_deg: np.ndarray
    sigma_m: np.ndarray
    sigma_deg: np.ndarray


def check_records(records: Records, rows: np.ndarray, row: str) -> Records:
    """`records` if they can be a trajectory. Raises InputError, naming the `row` (what a row is called) of `rows`."""
    file, time, coordinates = records.file, records.time, records.coordinates
    if len(time) < SHORTEST:
        raise InputError(
            f"{file}: there are {len(time)} records, but an interpolation that knows its uncertainty needs {SHORTEST}; "
            "give the trajectory with more of them"
        )
    for k in np.flatnonzero(np.diff(time) <= 0)[:1]:
        raise InputError(
            f"{file}, {row} {rows[k + 1]}: the time {time[k + 1]:.6f} s does not come after {time[k]:.6f} s before it; "
            "sort the records, delete doubles, and add 604800 s to the times after the end of a GPS week"
        )
    if records.geographic:
        limits = np.abs(coordinates[:, :2]) > [360.0, 90.0]
        for k, axis in np.argwhere(limits)[:1]:
            name = ("longitude", "latitude")[axis]
            raise InputError(
                f"{file}, {row} {rows[k]}: the {name} {coordinates[k, axis]:g} degrees cannot be; give longitude and "
                "latitude in this order, in the unit of the format"
            )
    for k, axis in np.argwhere(np.abs(records.roll_pitch_yaw_deg) > 360)[:1]:
        name = ("roll", "pitch", "yaw")[axis]
        raise InputError(
            f"{file}, {row} {rows[k]}: {name} = {records.roll_pitch_yaw_deg[k, axis]:g} degrees is more than a turn; "
            "give angles in the unit of the format"
        )
    return records
