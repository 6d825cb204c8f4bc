"""A trajectory of POSPac (SBET) as exposures: positions and attitudes of the IMU, to be interpolated."""

from pathlib import Path

import numpy as np

from jaxphoto.georeferencing.gps import Fix
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.trajectory import read_sbet, sbet_records


def read_sbet_exposures(path: Path) -> Exposures:
    """The records of an SBET, seconds of the GPS week as its times. Raises InputError as `read_sbet`."""
    records = sbet_records(read_sbet(path), path.name)
    n = len(records.time)
    fix: Fix = "integrated"
    return Exposures(
        path.name,
        np.arange(1, n + 1),
        records.time,
        records.coordinates,
        np.full((n, 3), np.nan),
        (fix,) * n,
        "ellipsoid",
        of_antenna=True,
        aircraft_deg=records.roll_pitch_yaw_deg,
    )
