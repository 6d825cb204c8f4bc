"""Files of positions beside photographs: DJI's time marks, RTKLIB's .pos, SBET and tables (docs/exposures.md).

A time mark (`..._Timestamp.MRK`) is

    12  268619.354051  [2129]  24,N  9,E  193,V  22.97273819,Lat  113.93433129,Lon  91.071,Ellh  1.05, 1.08, 3.24  16,Q

number, seconds of the GPS week, week, from the antenna's phase centre to the centre of the sensor in north, east and
down (mm), latitude, longitude and ellipsoidal height of the camera, standard deviations north, east, up (m) and kind of
solution (DJI, user manual of the Matrice 4 series, "Image Log File": "after compensation"; Phantom 4 RTK,
"Timestamp.MRK Information").

A .pos file has positions of the antenna, a trajectory or events. The last line of its header names the clock: GPST, UTC
or JST, as date and time or as week and seconds; then latitude, longitude, height, quality Q (1 fixed, 2 float, 3 SBAS,
4 differential, 5 single, 6 precise point), satellites, and standard deviations north, east, up (RTKLIB ver. 2.4.2,
Manual, B.1 "Positioning Solution File").
"""

import re
from datetime import datetime
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.georeferencing.exposure_times import LEAP_SECONDS, WEEK_S, gps_seconds
from jaxphoto.georeferencing.gps import Fix, Heights
from jaxphoto.io.control_table import separator_of
from jaxphoto.io.exposures.records import Exposures, Lines
from jaxphoto.io.exposures.tables import read_table
from jaxphoto.io.photograph_metadata import fix_of
from jaxphoto.io.text_files import read_text
from jaxphoto.io.text_tables import finite
from jaxphoto.io.trajectory import read_sbet, sbet_records

SUFFIXES = (".mrk", ".pos", ".sbet")
"""Extensions of files of exposures."""
NAMES = ("exposures.csv", "geo.txt")
"""Names of tables of exposures."""
_N = r"([-+]?\d{1,12}(?:\.\d{1,15})?)"
_MARK = re.compile(
    rf"\s*(\d{{1,9}})\s+{_N}\s+\[\s*(\d{{1,5}})\s*\]\s+{_N},N\s+{_N},E\s+{_N},V\s+{_N},Lat\s+{_N},Lon\s+{_N},Ellh"
    rf"\s+{_N},\s*{_N},\s*{_N}\s+(\d{{1,3}}),Q\s*",
    re.ASCII,
)
# Seconds that a clock is behind GPS time.
_BEHIND_S = {"GPST": 0.0, "UTC": LEAP_SECONDS, "JST": LEAP_SECONDS - 9 * 3600}
_FIX: dict[float, Fix] = {1: "fixed", 2: "float", 3: "single", 4: "single", 5: "single", 6: "float"}


def exposure_files(folder: Path) -> list[Path]:
    """The files of a folder with positions of its photographs, by `SUFFIXES` and `NAMES`; hidden ones are skipped."""
    matching = (f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES or f.name.lower() in NAMES)
    return sorted(f for f in matching if f.is_file() and not f.name.startswith("."))


def read_exposures(path: Path, code: int | None = None, heights: Heights = "unknown") -> Exposures:
    """Read the exposures or the trajectory of a file: .MRK, .pos, .sbet or .out, else a table.

    `code` is the EPSG system of map coordinates in a table, `heights` the reference of its heights. Invalid rows are
    skipped (`Exposures.without`, `why`). Raises InputError, with file and row, if half of the rows are invalid.
    """
    suffix = path.suffix.lower()
    if suffix in (".sbet", ".out"):
        return _read_sbet(path)
    content = read_text(path)
    lines = [(row, line) for row, line in enumerate(content.split("\n"), 1) if line.strip()]
    errors: dict[int, str] = {}
    # Half a number reads as well as a whole one: only missing cells show that the last row is cut off.
    if len(lines) > 2 and not content.endswith("\n"):
        separator = separator_of(lines[-2][1])
        before, last = (len(line.split(None if separator == " " else separator)) for _, line in lines[-2:])
        if last < before:
            errors[lines.pop()[0]] = "the file ends within the row; copy it again, or complete it"
    if suffix == ".mrk":
        exposures = _read_marks(path.name, lines, errors)
    elif suffix == ".pos":
        exposures = _read_pos(path.name, lines, errors)
    else:
        exposures = read_table(path.name, lines, errors, code, heights)
    return _without_errors(exposures, errors)


def _without_errors(exposures: Exposures, errors: dict[int, str]) -> Exposures:
    """The exposures without invalid rows. Raises InputError if half of the rows are invalid, or there is none."""
    for k, axis in np.argwhere(np.abs(exposures.place[:, :2]) > [360.0, 90.0]):
        name, value = ("longitude", "latitude")[axis], exposures.place[k, axis]
        errors.setdefault(int(exposures.rows[k]), f"the {name} {value:g} degrees is impossible; exchange the columns?")
    total = len(set(exposures.rows.tolist()) | set(errors))
    if not total:
        raise InputError(f"{exposures.file}: the file has no positions; omit it, or copy it again")
    if not errors:
        return exposures
    first, rows = min(errors), sorted(errors)
    if 2 * len(errors) >= total:
        raise InputError(f"{exposures.file}, row {first}: {errors[first]}")
    kept = ~np.isin(exposures.rows, rows)
    are = "is" if len(rows) == 1 else "are"
    why = f"{len(rows)} of {total} rows {are} left out ({few(list(map(str, rows)))}); row {first}: {errors[first]}"
    return exposures.take(kept)._replace(without=tuple(rows), why=why)


def _read_marks(file: str, lines: Lines, errors: dict[int, str]) -> Exposures:
    values = {}
    for row, line in lines:
        if line.lstrip().startswith("#"):
            continue
        if match := _MARK.fullmatch(line):
            values[row] = list(map(float, match.groups()))
        else:
            errors[row] = (
                f"{quoted(line.strip())} is not a time mark, such as 12 268619.354 [2129] 24,N 9,E 193,V 22.97,Lat "
                "113.93,Lon 91.07,Ellh 0.01, 0.01, 0.02 50,Q; delete or complete it"
            )
    columns = np.array(list(values.values())).reshape(-1, 13).T
    number, second, week, north, east, down, latitude, longitude, height, s_north, s_east, s_up, flag = columns
    place, sigma = np.stack([longitude, latitude, height], axis=1), np.stack([s_east, s_north, s_up], axis=1)
    # A receiver without a position writes zeros.
    place[(flag == 0) | ((longitude == 0) & (latitude == 0))] = np.nan
    sigma[(sigma <= 0).any(axis=1)] = np.nan
    return Exposures(
        file,
        np.array(list(values), int),
        week * WEEK_S + second,
        place,
        sigma,
        tuple(map(fix_of, flag.tolist())),
        "ellipsoid",
        sequence=number.astype(int),
        camera_from_antenna_m=np.stack([east, north, -down], axis=1) / 1000,
    )


def _read_pos(file: str, lines: Lines, errors: dict[int, str]) -> Exposures:
    clock, heights, values = "GPST", "unknown", dict[int, list[float]]()
    for row, line in lines:
        if line.lstrip().startswith("%"):
            words = line.strip(" %\r").split()
            clock = words[0] if words and words[0] in _BEHIND_S else clock
            if "ecef" in line or "baseline" in line or "(d'\")" in line:
                raise InputError(
                    f"{file}: its positions are not latitudes and longitudes in degrees; write the solution again with "
                    "the format Lat/Lon/Height, ddd.ddddddd"
                )
            if "lat/lon/height=" in line:
                heights = "ellipsoid" if "ellipsoidal" in line else "geoid"
            continue
        cells = line.replace(",", " ").split()
        numbers = [finite(cell) for cell in cells[2:10]]
        time = _time(*cells[:2]) if len(cells) > 1 else None
        if time is None or len(numbers) < 4 or None in numbers or numbers[3] not in range(10):
            errors[row] = (
                f"{quoted(line.strip())} is not a record such as 2024/05/01 10:00:00.000 48.1 11.5 560.2 1 12 0.01 "
                "0.01 0.02; delete or complete it"
            )
        else:
            known = [v for v in numbers if v is not None]
            values[row] = [time, *known[:4], *(known[5:8] if len(known) == 8 else [np.nan] * 3)]
    time_s, latitude, longitude, height, q, north, east, up = np.array(list(values.values())).reshape(-1, 8).T
    sigma = np.stack([east, north, up], axis=1)
    sigma[~(sigma > 0).all(axis=1)] = np.nan
    return Exposures(
        file,
        np.array(list(values), int),
        time_s + _BEHIND_S[clock],
        np.stack([longitude, latitude, height], axis=1),
        sigma,
        tuple(_FIX.get(v, "unknown") for v in q.tolist()),
        heights,  # type: ignore[arg-type]
        of_antenna=True,
    )


def _time(first: str, second: str) -> float | None:
    """GPS seconds of a date and time, or of a week and its seconds; None for anything else."""
    if "/" in first:
        clock, _, digits = second.partition(".")
        try:
            whole = gps_seconds(datetime.strptime(f"{first} {clock}", "%Y/%m/%d %H:%M:%S"))
            return whole + float(f"0.{digits or 0}")
        except ValueError:
            return None
    week, seconds = finite(first), finite(second)
    valid = week is not None and seconds is not None and 0 <= week < 10_000 and 0 <= seconds <= WEEK_S
    return week * WEEK_S + seconds if valid else None  # type: ignore[operator]


def _read_sbet(path: Path) -> Exposures:
    """The records of an SBET, positions and attitudes of the IMU, at seconds of the GPS week."""
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
