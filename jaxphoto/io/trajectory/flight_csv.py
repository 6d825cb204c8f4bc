"""A trajectory as CSV: one record a row, degrees and metres."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.trajectory.records import Records, check_records

_MAP = ("X_m", "Y_m", "Z_m")
_PLACE = ("longitude_deg", "latitude_deg", "height_m")
_ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
_SIGMA_M = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
_SIGMA_DEG = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")


def read_flight_csv(path: Path) -> Records:
    """The records of a CSV with time_s, X_m, Y_m, Z_m (or longitude_deg, latitude_deg, height_m), roll_deg, ...

    Standard deviations (sigma_X_m ... sigma_yaw_deg) are optional. Raises InputError, naming file and row.
    """
    table = read_csv(path, ("time_s", *_ANGLES), (*_MAP, *_PLACE, *_SIGMA_M, *_SIGMA_DEG))
    pairs = [names for names in (_MAP, _PLACE) if any(name in table for name in names)]
    if len(pairs) != 1 or not all(name in table for name in pairs[0]):
        raise InputError(
            f"{path.name}: the positions are not given by one set of columns; use either {', '.join(_MAP)} or "
            f"{', '.join(_PLACE)}"
        )

    def columns(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([table.numbers(name) for name in names], axis=1)

    sigma_m, sigma_deg = (np.stack([table.sigmas(n) for n in names], axis=1) for names in (_SIGMA_M, _SIGMA_DEG))
    geographic = pairs[0] is _PLACE
    records = Records(
        path.name, table.numbers("time_s"), columns(pairs[0]), geographic, columns(_ANGLES), sigma_m, sigma_deg
    )
    return check_records(records, table.rows, "row")


def write_flight_csv(records: Records, path: Path) -> None:
    """Write `records` so that `read_flight_csv` reads the same numbers; sigmas that are unknown are left out."""
    columns = {"time_s": records.time}
    groups = (
        (_PLACE if records.geographic else _MAP, records.coordinates),
        (_ANGLES, records.roll_pitch_yaw_deg),
        (_SIGMA_M, records.sigma_m),
        (_SIGMA_DEG, records.sigma_deg),
    )
    for names, values in groups:
        for name, column in zip(names, values.T, strict=True):
            if not np.isnan(column).all():
                columns[name] = column
    pd.DataFrame(columns).to_csv(path, index=False)
