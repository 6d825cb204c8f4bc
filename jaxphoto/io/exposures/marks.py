"""DJI's time marks (`..._Timestamp.MRK`): one line a photograph.

    12  268619.354051  [2129]  24,N  9,E  193,V  22.97273819,Lat  113.93433129,Lon  91.071,Ellh  1.05, 1.08, 3.24  16,Q

are number, seconds of the GPS week, week, from the antenna's phase centre to the centre of the sensor in north, east
and down (mm), latitude, longitude and height above the ellipsoid of the camera, standard deviations north, east, up (m)
and the kind of solution (DJI, user manual of the Matrice 4 series, "Image Log File": "after compensation"; Phantom 4
RTK, "Timestamp.MRK Information").
"""

import re
from collections.abc import Container
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.georeferencing.exposure_times import WEEK_S
from jaxphoto.io.exposures.records import Exposures, check_places
from jaxphoto.io.photograph_metadata import fix_of
from jaxphoto.io.text_tables import content_lines, each_row

_NUMBER = r"([-+]?\d{1,12}(?:\.\d{1,15})?)"
_LINE = re.compile(
    rf"\s*(\d{{1,9}})\s+{_NUMBER}\s+\[\s*(\d{{1,5}})\s*\]\s+{_NUMBER},N\s+{_NUMBER},E\s+{_NUMBER},V\s+{_NUMBER},Lat"
    rf"\s+{_NUMBER},Lon\s+{_NUMBER},Ellh\s+{_NUMBER},\s*{_NUMBER},\s*{_NUMBER}\s+(\d{{1,3}}),Q\s*",
    re.ASCII,
)


def read_marks(path: Path, without: Container[int] = ()) -> Exposures:
    """The exposures of a MRK file, but for the rows `without`. Raises InputError, naming file and row."""
    lines, rows = content_lines(path, without)

    def numbers_of(row: int, line: str) -> list[float]:
        found = _LINE.fullmatch(line) if len(line) < 1000 else None
        if found is None:
            raise RowError(
                f"{path.name}, row {row}: {quoted(line.strip())} is no line of time marks, as 12 268619.354 [2129] "
                "24,N 9,E 193,V 22.97,Lat 113.93,Lon 91.07,Ellh 0.01, 0.01, 0.02 50,Q; delete or complete it",
                [row],
            )
        return [float(cell) for cell in found.groups()]

    values = np.array(each_row(numbers_of, zip(rows, lines, strict=True)))
    if not len(values):
        raise InputError(f"{path.name}: the file has no time marks; leave it out, or copy it anew")
    number, second, week, north, east, down, latitude, longitude, height, s_north, s_east, s_up, flag = values.T
    numbers = np.array(rows)
    place, sigma = np.stack([longitude, latitude, height], axis=1), np.stack([s_east, s_north, s_up], axis=1)
    check_places(path.name, numbers, place)
    # A receiver without a position writes zeros.
    place[(flag == 0) | ((longitude == 0) & (latitude == 0))] = np.nan
    sigma[(sigma <= 0).any(axis=1)] = np.nan
    return Exposures(
        path.name,
        numbers,
        week * WEEK_S + second,
        place,
        sigma,
        tuple(fix_of(f) for f in flag),
        "ellipsoid",
        sequence=number.astype(int),
        camera_from_antenna_m=np.stack([east, north, -down], axis=1) / 1000,
    )
