"""Positions of the antenna as RTKLIB and programs made of it write them (`.pos`): a trajectory, or events.

The header's last line names the clock and the columns: GPST, UTC or JST, as date and time or as week and seconds;
latitude and longitude in degrees, height, quality Q (1 fixed, 2 float, 3 SBAS, 4 differential, 5 single, 6 precise
point), satellites, and standard deviations north, east, up (RTKLIB ver. 2.4.2, Manual, B.1 "Positioning Solution
File").
"""

from collections.abc import Container
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.georeferencing.exposure_times import LEAP_SECONDS, WEEK_S
from jaxphoto.georeferencing.gps import Fix, Heights
from jaxphoto.io.exposures.records import Exposures, check_places
from jaxphoto.io.text_tables import each_row, finite
from jaxphoto.io.whole_text import LARGE, read_text

# Seconds by which the clock is behind GPS time.
_BEHIND_S = {"GPST": 0.0, "UTC": LEAP_SECONDS, "JST": LEAP_SECONDS - 9 * 3600}
_FIX: dict[int, Fix] = {1: "fixed", 2: "float", 3: "single", 4: "single", 5: "single", 6: "float"}
_LONGEST = 1000


def read_pos(path: Path, without: Container[int] = ()) -> Exposures:
    """The records of a `.pos` file, times in GPS time, but for the rows `without`. Raises InputError, naming file
    and row."""
    clock, heights = "GPST", "unknown"
    records: list[tuple[int, str]] = []
    geodetic = True
    for row, line in enumerate(read_text(path, LARGE).split("\n"), 1):
        if line.lstrip().startswith("%"):
            words = line.strip(" %").split()
            clock = words[0] if words and words[0] in _BEHIND_S else clock
            if "ecef" in line or "baseline" in line or "(d'\")" in line:
                geodetic = False
            if "lat/lon/height=" in line:
                heights = "ellipsoid" if "ellipsoidal" in line else "geoid"
        elif line.strip() and row not in without:
            if not geodetic:
                raise InputError(
                    f"{path.name}: its positions are no latitudes and longitudes in degrees; write the solution again "
                    "with the format Lat/Lon/Height, ddd.ddddddd"
                )
            records.append((row, line[:_LONGEST]))
    if not records:
        raise InputError(f"{path.name}: the file has no positions; leave it out, or write the solution again")
    table = np.array(each_row(partial(_record, path.name), records))
    numbers = np.array([row for row, _ in records])
    time, latitude, longitude, height, q, north, east, up = table.T
    place, sigma = np.stack([longitude, latitude, height], axis=1), np.stack([east, north, up], axis=1)
    check_places(path.name, numbers, place)
    sigma[~(sigma > 0).all(axis=1)] = np.nan
    said: Heights = "ellipsoid" if heights == "ellipsoid" else "geoid" if heights == "geoid" else "unknown"
    fix = tuple(_FIX.get(int(v), "unknown") for v in q)
    return Exposures(path.name, numbers, time + _BEHIND_S[clock], place, sigma, fix, said, of_antenna=True)


def _record(file: str, row: int, line: str) -> list[float]:
    """Time, latitude, longitude, height, Q and three standard deviations, NaN where the line ends before them."""
    cells = line.replace(",", " ").split()
    time = _time(cells[:2])
    numbers = [finite(cell) for cell in cells[2:10]]
    q = numbers[3] if len(numbers) > 3 else None
    if time is None or None in numbers or q is None or not (q.is_integer() and 0 <= q <= 9):
        raise RowError(
            f"{file}, row {row}: {quoted(line.strip())} is no record such as 2024/05/01 10:00:00.000 48.1 11.5 560.2 1 "
            "12 0.01 0.01 0.02; delete or complete it",
            [row],
        )
    known = [v for v in numbers if v is not None]
    return [time, *known[:4], *(known[5:8] if len(known) == 8 else [np.nan] * 3)]


def _time(cells: list[str]) -> float | None:
    if len(cells) < 2:
        return None
    try:
        if "/" in cells[0]:
            clock, _, digits = cells[1].partition(".")
            part = finite(f"0.{digits[:15]}")
            if part is None or (digits and not digits.isdigit()):
                return None
            return seconds(datetime.strptime(f"{cells[0]} {clock}", "%Y/%m/%d %H:%M:%S")) + part
    except ValueError:
        return None
    week, second = finite(cells[0]), finite(cells[1])
    if week is None or second is None or not (0 <= week < 10_000 and 0 <= second <= WEEK_S):
        return None
    return week * WEEK_S + second
