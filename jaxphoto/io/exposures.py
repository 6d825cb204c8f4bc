"""Positions of photographs in files: DJI's time marks, RTKLIB's .pos, SBET and CSV (docs/exposures.md).

A time mark (`..._Timestamp.MRK`) is

    12  268619.354051  [2129]  24,N  9,E  193,V  22.97273819,Lat  113.93433129,Lon  91.071,Ellh  1.05, 1.08, 3.24  16,Q

number, seconds of the GPS week, week, lever arm from the antenna's phase centre to the centre of the sensor (north,
east, down, mm), latitude, longitude and ellipsoidal height of the camera, standard deviations north, east, up (m) and
kind of solution (DJI, user manual of the Matrice 4 series, "Image Log File": "after compensation"; Phantom 4 RTK,
"Timestamp.MRK Information").

A .pos file has positions of the antenna, as a trajectory or at events. The last line of its header names the time
scale: GPST, UTC or JST, as date and time or as week and seconds; then latitude, longitude, height, quality Q (1 fixed,
2 float, 3 SBAS, 4 differential, 5 single, 6 precise point), number of satellites, and standard deviations north, east,
up (RTKLIB ver. 2.4.2, Manual, B.1 "Positioning Solution File").
"""

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path, PureWindowsPath
from typing import NamedTuple, get_args

import jax
import numpy as np
import pandas as pd
import scipy
from jaxtyping import Float, Int

from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import InputError, few, quoted, shown
from jaxphoto.georeferencing.camera_attitude import (
    USUAL_SIGMA_DEG,
    CameraAttitude,
    level_from_belly,
    level_from_body,
)
from jaxphoto.georeferencing.datum_change import wgs84_places
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.georeferencing.recorded_positions import (
    LEAP_SECONDS,
    WEEK_S,
    Fix,
    Gps,
    Heights,
    gps_seconds,
    moved,
    one_height,
    plausible_positions,
)
from jaxphoto.io.photographs import Photograph, fix_of
from jaxphoto.io.text_files import read_text
from jaxphoto.io.text_tables import finite, read_csv
from jaxphoto.io.trajectory import read_sbet, sbet_records
from jaxphoto.rotation import matrix_from_omega_phi_kappa

SUFFIXES = (".mrk", ".pos", ".sbet")
"""File name extensions of position files."""
NAMES = ("exposures.csv",)
"""File names of position tables."""
Arm = tuple[float, float, float]
"""Lever arm from the camera to the antenna, right, forward, up of the aircraft (m)."""
_N = r"([-+]?\d{1,12}(?:\.\d{1,15})?)"
_MARK = re.compile(
    rf"\s*(\d{{1,9}})\s+{_N}\s+\[\s*(\d{{1,5}})\s*\]\s+{_N},N\s+{_N},E\s+{_N},V\s+{_N},Lat\s+{_N},Lon\s+{_N},Ellh"
    rf"\s+{_N},\s*{_N},\s*{_N}\s+(\d{{1,3}}),Q\s*",
    re.ASCII,
)
# Number within the flight: DJI_20240501123456_0012_V, DJI_0012, 100_0042_0012.
_NUMBER = re.compile(r"_(\d{3,5})(?:_[A-Za-z]\w*)?$")
# GPS time minus time scale (s).
_BEHIND_S = {"GPST": 0.0, "UTC": LEAP_SECONDS, "JST": LEAP_SECONDS - 9 * 3600}
_FIX: dict[float, Fix] = {1: "fixed", 2: "float", 3: "single", 4: "single", 5: "single", 6: "float"}
_MAP, _PLACE = ("X_m", "Y_m", "Z_m"), ("longitude_deg", "latitude_deg", "height_m")
_OPK, _RPY = ("omega_deg", "phi_deg", "kappa_deg"), ("roll_deg", "pitch_deg", "yaw_deg")
_SIGMA = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
# Ratio of an interval between records to the median interval above which it is a gap.
_GAP = 2.5
# Minimum ratio of records to photographs of a trajectory; events have about one record per photograph.
_TRACK = 3
# Maximum median distance (m) of positions from the photographs' own; beyond it, they belong to another flight.
_FAR_M, _DEGREE_M = 200.0, 111_320.0
# Maximum resolution (s) of times for interpolation in a trajectory: 1 cm at 10 m/s; maximum difference of events.
_EXACT_S, _EVENT_S = 1e-3, 0.2


class Exposures(NamedTuple):
    """Exposures or trajectory, one entry per row of a file; NaN or None for unknown values."""

    file: str
    time_s: Float[np.ndarray, "n"]
    """GPS time: seconds since 1980-01-06; of an SBET, seconds of the week."""
    place: Float[np.ndarray, "n 3"]
    """Longitude, latitude (degrees) and height (m)."""
    sigma_m: Float[np.ndarray, "n 3"]
    """Standard deviations east, north, up (m)."""
    fix: tuple[Fix, ...]
    heights: Heights
    names: tuple[str, ...] = ()
    """Names of the photographs, without extension."""
    sequence: Int[np.ndarray, "n"] | None = None
    """Number of the photograph within its flight."""
    camera_from_antenna_m: Float[np.ndarray, "n 3"] | None = None
    """Lever arm from the antenna to the camera: east, north, up (m)."""
    of_antenna: bool = False
    """True if `place` is the position of the antenna or IMU."""
    aircraft_deg: Float[np.ndarray, "n 3"] | None = None
    """Roll, pitch, yaw of the aircraft (degrees)."""
    attitude: tuple[CameraAttitude | None, ...] = ()
    folder: Path | None = None
    """Folder whose photographs the file describes; None for any."""

    def gps(self, k: int) -> Gps | None:
        """Return the position of entry `k`; None if unknown."""
        longitude, latitude, height = self.place[k].tolist()
        if not np.isfinite([longitude, latitude]).all():
            return None
        east, north, up = self.sigma_m[k].tolist()
        return Gps(
            latitude,
            longitude,
            height if np.isfinite(height) else None,
            (east, north, up) if np.isfinite(self.sigma_m[k]).all() else None,
            self.heights,
            self.fix[k],
        )


def exposure_files(folder: Path) -> list[Path]:
    """List the position files in a folder, by `SUFFIXES` and `NAMES`; hidden files are skipped."""
    matching = (f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES or f.name.lower() in NAMES)
    return sorted(f for f in matching if f.is_file() and not f.name.startswith("."))


def read_exposures(path: Path, code: int | None = None, heights: Heights = "unknown") -> Exposures:
    """Read the exposures or the trajectory of a file: .MRK, .pos, .sbet or .out, else CSV.

    `code` is the EPSG system of map coordinates in a CSV file, `heights` the reference of its heights. Raises
    InputError, with file and row, for an invalid row.
    """
    suffix = path.suffix.lower()
    if suffix in (".sbet", ".out"):
        return _read_sbet(path)
    if suffix not in (".mrk", ".pos"):
        return _read_table(path, code, heights)
    lines = [(row, line) for row, line in enumerate(read_text(path).split("\n"), 1) if line.strip()]
    exposures = (_read_marks if suffix == ".mrk" else _read_pos)(path.name, lines)
    if not len(exposures.place):
        raise InputError(f"{path.name}: the file has no positions; omit it, or copy it again")
    for k, axis in np.argwhere(np.abs(exposures.place[:, :2]) > [360.0, 90.0])[:1]:
        name, value = ("longitude", "latitude")[axis], exposures.place[k, axis]
        raise InputError(f"{path.name}, record {k + 1}: the {name} {value:g} degrees is out of range; correct it")
    return exposures


def _read_marks(file: str, lines: list[tuple[int, str]]) -> Exposures:
    values = []
    for row, line in lines:
        if line.lstrip().startswith("#"):
            continue
        if not (match := _MARK.fullmatch(line)):
            raise InputError(
                f"{file}, row {row}: {quoted(line.strip())} is not a time mark, such as 12 268619.354 [2129] 24,N 9,E "
                "193,V 22.97,Lat 113.93,Lon 91.07,Ellh 0.01, 0.01, 0.02 50,Q; delete or complete it"
            )
        values.append(list(map(float, match.groups())))
    columns = np.array(values).reshape(-1, 13).T
    number, second, week, north, east, down, latitude, longitude, height, s_north, s_east, s_up, flag = columns
    place, sigma = np.stack([longitude, latitude, height], axis=1), np.stack([s_east, s_north, s_up], axis=1)
    # Receivers write zeros if they have no position.
    place[(flag == 0) | ((longitude == 0) & (latitude == 0))] = np.nan
    sigma[(sigma <= 0).any(axis=1)] = np.nan
    return Exposures(
        file,
        week * WEEK_S + second,
        place,
        sigma,
        tuple(map(fix_of, flag.tolist())),
        "ellipsoid",
        sequence=number.astype(int),
        camera_from_antenna_m=np.stack([east, north, -down], axis=1) / 1000,
    )


def _read_pos(file: str, lines: list[tuple[int, str]]) -> Exposures:
    clock, heights, values = "GPST", "unknown", []
    for row, line in lines:
        if line.lstrip().startswith("%"):
            words = line.strip(" %\r").split()
            clock = words[0] if words and words[0] in _BEHIND_S else clock
            if "ecef" in line or "baseline" in line or "(d'\")" in line:
                raise InputError(
                    f"{file}: positions are not latitudes and longitudes in degrees; re-export the solution with "
                    "the format Lat/Lon/Height, ddd.ddddddd"
                )
            if "lat/lon/height=" in line:
                heights = "ellipsoid" if "ellipsoidal" in line else "geoid"
            continue
        cells = line.replace(",", " ").split()
        numbers = [finite(cell) for cell in cells[2:10]]
        time = _time(*cells[:2]) if len(cells) > 1 else None
        if time is None or len(numbers) < 4 or None in numbers or numbers[3] not in range(10):
            raise InputError(
                f"{file}, row {row}: {quoted(line.strip())} is not a record such as 2024/05/01 10:00:00.000 48.1 11.5 "
                "560.2 1 12 0.01 0.01 0.02; delete or complete it"
            )
        values.append([time, *numbers[:4], *(numbers[5:8] if len(numbers) == 8 else [np.nan] * 3)])
    time_s, latitude, longitude, height, q, north, east, up = np.array(values, float).reshape(-1, 8).T
    sigma = np.stack([east, north, up], axis=1)
    sigma[~(sigma > 0).all(axis=1)] = np.nan
    return Exposures(
        file,
        time_s + _BEHIND_S[clock],
        np.stack([longitude, latitude, height], axis=1),
        sigma,
        tuple(_FIX.get(v, "unknown") for v in q.tolist()),
        heights,  # type: ignore[arg-type]
        of_antenna=True,
    )


def _time(first: str, second: str) -> float | None:
    """Convert date and time, or week and seconds, to GPS seconds; None for other text."""
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
    """Read an SBET: positions and attitudes of the IMU, times in seconds of the GPS week."""
    records = sbet_records(read_sbet(path), path.name)
    n = len(records.time)
    fix: Fix = "integrated"
    return Exposures(
        path.name,
        records.time,
        records.coordinates,
        np.full((n, 3), np.nan),
        (fix,) * n,
        "ellipsoid",
        of_antenna=True,
        aircraft_deg=records.roll_pitch_yaw_deg,
    )


def _read_table(path: Path, code: int | None, heights: Heights) -> Exposures:
    """Read a CSV file of positions of the camera.

    At yaw = pitch = roll = 0, the camera looks down and the top of its picture points to the north of the coordinates.
    """
    sigmas_deg = [f"sigma_{name}" for name in (*_OPK, *_RPY)]
    optional = (*_PLACE, *_MAP, *_SIGMA, *_OPK, *_RPY, *sigmas_deg, "fix")
    table = read_csv(path, (), ("image", *optional), text=("fix",))
    columns = next((names for names in (_PLACE, _MAP) if all(name in table for name in names)), None)
    if columns is None or "image" not in table:
        raise InputError(
            f"{table.file}: give the columns image and {', '.join(_PLACE)} (WGS 84), or {', '.join(_MAP)} with --epsg; "
            f"optional columns: {', '.join((*_SIGMA, *_OPK, *_RPY, *sigmas_deg, 'fix'))}"
        )
    if not len(table):
        raise InputError(f"{table.file}: the file has no positions; omit it, or copy it again")
    names = [PureWindowsPath(name).stem for name in table.ids("image")]
    table.check(pd.Series(names).duplicated().to_numpy(), lambda k: f"image {names[k]} is given twice; keep one row")
    kinds = table.text("fix")
    table.check(
        ~np.isin(kinds, ["", *get_args(Fix)]),
        lambda k: f"fix is {quoted(kinds[k])}; give one of {', '.join(get_args(Fix))}, or nothing",
    )
    place, level_from_axes = table.matrix(columns), np.broadcast_to(np.eye(3), (len(table), 3, 3))
    if columns is _MAP:
        if code is None:
            raise InputError(f"{table.file}: its positions are map coordinates; give the EPSG code (--epsg)")
        place, level_from_axes = _from_map(place, code, heights)
        outside = ~np.isfinite(place).all(axis=1)
        table.check(outside, lambda k: f"the coordinates are outside the area of EPSG:{code}; correct them")
    wrong = (np.abs(place[:, :2]) > [360.0, 90.0]).any(axis=1)
    table.check(wrong, lambda k: f"longitude {place[k, 0]:g}, latitude {place[k, 1]:g} is out of range; correct them")
    angles = next((names for names in (_OPK, _RPY) if all(name in table for name in names)), None)
    attitude: tuple[CameraAttitude | None, ...] = (None,) * len(table)
    if angles is not None:
        values = table.matrix(angles, empty=True)
        partial = np.isfinite(values).any(axis=1) & ~np.isfinite(values).all(axis=1)
        table.check(partial, lambda k: f"give all three angles {', '.join(angles)}, or none")
        sigma = np.stack([table.sigmas(f"sigma_{name}") for name in angles], axis=1)
        attitude = _attitudes(values, sigma, level_from_axes, angles is _OPK)
    return Exposures(
        table.file,
        np.full(len(table), np.nan),
        place,
        np.stack([table.sigmas(name) for name in _SIGMA], axis=1),
        tuple(kind or "unknown" for kind in kinds),
        heights,
        names=tuple(names),
        attitude=attitude,
    )


def _from_map(coordinates: np.ndarray, code: int, heights: Heights) -> tuple[np.ndarray, np.ndarray]:
    """Convert to longitude, latitude, height in WGS 84, and return the rotations from grid to true-north axes."""
    place = MapFrame(code, None, (0.0, 0.0, 0.0)).place(coordinates)
    if not np.isfinite(place).all():
        return place, np.zeros((len(place), 3, 3))
    frame = MapFrame(code, None, (*np.median(place[:, :2], axis=0).tolist(), 0.0))
    local = frame.local_from_place(place)
    rotation = np.swapaxes(frame.local_from_level(local), 1, 2) @ frame.local_from_grid(local)
    return wgs84_places(code, place, heights == "ellipsoid"), rotation


def _attitudes(
    angles: np.ndarray, sigma: np.ndarray, level_from_axes: np.ndarray, opk: bool
) -> tuple[CameraAttitude | None, ...]:
    if opk:
        # Near nadir, omega is about the x axis (right) like pitch, and phi about y like roll: exchange their sigmas.
        sigma = sigma[:, [1, 0, 2]]
        camera = np.swapaxes(np.asarray(_matrices(np.deg2rad(angles))), 1, 2)
    else:
        camera = np.array([level_from_belly(yaw, pitch, roll) for roll, pitch, yaw in np.nan_to_num(angles)])
    matrices, known = level_from_axes @ camera.reshape(-1, 3, 3), np.isfinite(angles).all(axis=1)
    sigmas: Sequence = [tuple(s) if np.isfinite(s).all() else USUAL_SIGMA_DEG for s in sigma.tolist()]
    return tuple(CameraAttitude(m, s) if k else None for m, s, k in zip(matrices, sigmas, known, strict=True))


_matrices = jit_quickly(jax.vmap(matrix_from_omega_phi_kappa))


class Assigned(NamedTuple):
    """Photographs with positions and attitudes from files, and a message per file."""

    photographs: list[Photograph]
    sentences: list[str]


def located(
    photographs: Sequence[Photograph],
    folders: Sequence[Path] = (),
    given: Sequence[Path] = (),
    *,
    code: int | None = None,
    arm: Arm | None = None,
    heights: Heights | int | None = None,
) -> Assigned:
    """Assign positions of the files `given`, and of the files in `folders`; convert heights to one reference.

    `code` is the EPSG system of map coordinates in tables, `arm` the lever arm. `heights` is the reference of heights
    whose reference is unknown. "take-off" selects heights above take-off; an EPSG code of a vertical system applies its
    geoid model. Invalid files in folders are reported. Invalid files in `given`, or a missing geoid model, raise
    InputError.
    """
    kind: Heights = "geoid" if isinstance(heights, int) else heights or "unknown"
    files, messages = [read_exposures(path, code, kind) for path in given], []
    known = {path.resolve() for path in given}
    for path in (path for folder in folders if folder.is_dir() for path in exposure_files(folder)):
        if path.resolve() not in known:
            try:
                files.append(read_exposures(path, code, kind)._replace(folder=path.parent))
            except InputError as error:
                messages.append(f"{error}; the file is not used")
    assigned = with_exposures(photographs, files, arm)
    positions, corrections = plausible_positions({p.name: p.gps for p in assigned.photographs})
    above = {p.name: p.above_takeoff_m for p in assigned.photographs}
    positions, height_messages = one_height(positions, above, heights)
    messages += [*assigned.sentences, *corrections, *height_messages]
    return Assigned([p._replace(gps=positions[p.name]) for p in assigned.photographs], list(map(shown, messages)))


def with_exposures(photographs: Sequence[Photograph], files: Sequence[Exposures], arm: Arm | None = None) -> Assigned:
    """Assign positions, sigmas and attitudes of the files to photographs; later files override earlier ones.

    Time marks are matched by the number in the name, first: their times and lever arms are used for antenna positions,
    at events and along trajectories. Tables are matched by name, last. `arm` is the lever arm of antenna positions that
    have none from a time mark. If no file has antenna positions, it applies to the photographs' own positions.
    """
    assignment = _Assignment(photographs, arm)
    order = lambda f: 3 if f.names else 0 if f.sequence is not None else 1 + assignment.is_track(f)  # noqa: E731
    messages = [f"{file.file}: {assignment.assign(file)}" for file in sorted(files, key=order)]
    if arm is not None and not any(f.of_antenna for f in files):
        if any(assignment.own):
            messages.append(assignment.move_own(arm))
        else:
            messages.append("the lever arm is not used: positions of time marks and tables are those of the camera")
    return Assigned(assignment.photographs, messages)


class _Assignment:
    """Assignment of files to photographs."""

    def __init__(self, photographs: Sequence[Photograph], arm: Arm | None):
        n = len(photographs)
        self.photographs, self.arm = list(photographs), arm
        # GPS times, from time marks or exact times in the photographs.
        self.gps_s = np.full(n, np.nan)
        for k, taken in enumerate(p.taken for p in photographs):
            if taken and taken.ahead_of_utc_s is not None and taken.resolution_s <= _EXACT_S:
                self.gps_s[k] = taken.clock_s - taken.ahead_of_utc_s + LEAP_SECONDS
        self.camera_from_antenna_m = np.full((n, 3), np.nan)
        # True if the position is from the photograph's own file.
        self.own = [True] * n

    def is_track(self, file: Exposures) -> bool:
        """Return True for a trajectory, False for exposures."""
        return file.aircraft_deg is not None or len(file.time_s) > _TRACK * len(self.photographs)

    def assign(self, file: Exposures) -> str:
        """Assign the exposures of one file; return a message."""
        n = len(self.photographs)
        if file.names:
            exposure, how = self._by_name(file), "by name"
        elif file.sequence is not None:
            exposure, how = self._by_number(file), "by number"
        elif self.is_track(file):
            if not np.isfinite(self.gps_s).any():
                return (
                    "a trajectory needs the GPS time of every exposure to the millisecond, from time marks or "
                    "UTCAtExposure; not used"
                )
            file, how = _interpolated(file, self.gps_s), "by interpolation"
            exposure = np.where(np.isfinite(file.place).all(axis=1), np.arange(n), -1)
        elif np.isfinite(self.gps_s).any():
            apart = np.nan_to_num(np.abs(self.gps_s[:, None] - file.time_s), nan=np.inf)
            exposure, how = np.where(apart.min(axis=1) <= _EVENT_S, apart.argmin(axis=1), -1), "by time"
        elif len(file.time_s) == n:
            clock = np.array([p.taken.clock_s if p.taken else np.nan for p in self.photographs])
            rank = np.argsort(np.argsort(clock, kind="stable"))
            exposure, how = np.argsort(file.time_s, kind="stable")[rank], "in order of time"
        else:
            return (
                f"{len(file.time_s)} events for {n} photographs, whose GPS times are unknown; not used: add the time "
                "marks, or give a table with names (--exposures)"
            )
        if file.folder is not None:
            exposure = np.where([p.path.parent == file.folder for p in self.photographs], exposure, -1)
        if not (exposure >= 0).any():
            return f"no photograph matches {how}; not used: correct the names, or give a table with names (--exposures)"
        far = self._distance(file, exposure)
        if far is not None and far > _FAR_M:
            return (
                f"its positions are {far:,.0f} m from those of the photographs (another flight, or longitude and "
                "latitude exchanged?); not used"
            )
        without = [p.name for p, k in zip(self.photographs, exposure, strict=True) if k < 0]
        matched = n - len(without)
        message = f"positions of {matched} of {n} photographs {how}"
        message += _fix_counts([file.fix[k] for k in exposure if k >= 0])
        message += f", {far:.2g} m from their own" if far is not None else ""
        message += f"; none for {few(without)}" if without else ""
        if how != "by interpolation" and (surplus := len(file.place) - len(set(exposure[exposure >= 0].tolist()))):
            message += f"; {surplus} of its exposures without a photograph"
        if file.of_antenna:
            return f"{message}; {self._set_antenna(file, exposure)}"
        self._set_camera(file, exposure)
        return message

    def _by_name(self, file: Exposures) -> Int[np.ndarray, "n"]:
        index = {name.lower(): k for k, name in enumerate(file.names)}
        return np.array([index.get(p.name.lower(), -1) for p in self.photographs], int)

    def _by_number(self, file: Exposures) -> Int[np.ndarray, "n"]:
        """Match by the number in the name; -1 for numbers that are missing or not unique."""
        assert file.sequence is not None
        inside = [file.folder is None or p.path.parent == file.folder for p in self.photographs]
        matches = [_NUMBER.search(p.name) for p in self.photographs]
        numbers = [int(match[1]) if match and able else -1 for match, able in zip(matches, inside, strict=True)]
        listed = file.sequence.tolist()
        return np.array(
            [listed.index(v) if numbers.count(v) == listed.count(v) == 1 and v >= 0 else -1 for v in numbers], int
        )

    def _distance(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> float | None:
        """Return the median horizontal distance (m) to the photographs' own positions; None if unknown."""
        own = np.full((len(exposure), 2), np.nan)
        for k, gps in enumerate(p.gps for p in self.photographs):
            # (0, 0) means no position.
            if gps is not None and exposure[k] >= 0 and (gps.longitude_deg, gps.latitude_deg) != (0, 0):
                own[k] = gps.longitude_deg, gps.latitude_deg
        d = (own - file.place[exposure, :2]) * _DEGREE_M
        d[:, 0] *= np.cos(np.deg2rad(own[:, 1]))
        length = np.hypot(*d.T)
        return float(np.nanmedian(length)) if np.isfinite(length).any() else None

    def move_own(self, arm: Arm) -> str:
        """Reduce the photographs' own positions from the antenna to the camera by the lever arm."""
        moved_count = left = 0
        for i, p in enumerate(self.photographs):
            if not self.own[i] or p.gps is None:
                continue
            if (rotation := _aircraft(p)) is None:
                left += 1
            else:
                self.photographs[i] = p._replace(gps=moved(p.gps, -rotation @ np.array(arm)))
                moved_count += 1
        without = f"; {left} have no attitude to rotate it and are unchanged" if left else ""
        return f"the lever arm is applied to {moved_count} positions of the photographs' own files{without}"

    def _set_camera(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> None:
        """Assign camera positions, attitudes, times and lever arms."""
        for i in np.flatnonzero(exposure >= 0):
            k = int(exposure[i])
            if (gps := file.gps(k)) is not None:
                self.photographs[i], self.own[i] = self.photographs[i]._replace(gps=gps), False
            if file.attitude and (attitude := file.attitude[k]) is not None:
                self.photographs[i] = self.photographs[i]._replace(attitude=attitude)
            if np.isfinite(file.time_s[k]):
                self.gps_s[i] = file.time_s[k]
            if file.camera_from_antenna_m is not None:
                self.camera_from_antenna_m[i] = file.camera_from_antenna_m[k]

    def _set_antenna(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
        """Assign antenna or IMU positions, reduced to the camera; report the lever arms used."""
        marked = given = none = 0
        for i in np.flatnonzero(exposure >= 0):
            k = int(exposure[i])
            gps, photograph = file.gps(k), self.photographs[i]
            if gps is None:
                continue
            if file.aircraft_deg is None:
                self.gps_s[i] = file.time_s[k]
            elif photograph.attitude is None:
                roll, pitch, yaw = file.aircraft_deg[k].tolist()
                fixed = CameraAttitude(level_from_body((roll, pitch, yaw)))
                photograph = photograph._replace(attitude=fixed, aircraft_deg=(roll, pitch, yaw))
            # Time marks have lever arms of the antenna, but a trajectory with attitudes has positions of the IMU.
            if file.aircraft_deg is None and np.isfinite(self.camera_from_antenna_m[i]).all():
                gps, marked = moved(gps, self.camera_from_antenna_m[i]), marked + 1
            elif self.arm is not None and (rotation := _aircraft(photograph)) is not None:
                gps, given = moved(gps, -rotation @ np.array(self.arm)), given + 1
            else:
                none += 1
            self.photographs[i], self.own[i] = photograph._replace(gps=gps), False
        instead = ", not the one given" if self.arm is not None else ""
        parts = [f"lever arms of {marked} are those of the time marks{instead}"] if marked else []
        parts += [f"the lever arm of {given} is as given"] if given else []
        if none:
            why = "give it by --lever-arm" if self.arm is None else "no aircraft attitude to rotate it"
            sensor = "antenna" if file.aircraft_deg is None else "IMU"
            parts.append(f"{none} are positions of the {sensor}, the lever arm is unknown ({why})")
        return ", ".join(parts)


def _interpolated(track: Exposures, times_s: Float[np.ndarray, "n"]) -> Exposures:
    """Interpolate a trajectory at `times_s` by a cubic spline; positions outside it and in its gaps are NaN.

    Standard deviations are interpolated linearly, rotations at constant angular velocity. The kind of solution is taken
    from the nearest record.
    """
    if track.time_s.max() < 2 * WEEK_S:
        track = track._replace(time_s=track.time_s + WEEK_S * np.floor(np.nanmin(times_s) / WEEK_S))
    time, first = np.unique(track.time_s, return_index=True)
    inside = np.isfinite(times_s) & (times_s >= time[0]) & (times_s <= time[-1])
    at = np.where(inside, times_s, time[0])
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    inside &= (time[after] - time[after - 1] <= _GAP * np.median(np.diff(time))) | np.isin(at, time)
    nearest = first[np.where(at - time[after - 1] < time[after] - at, after - 1, after)]
    middle = np.nanmedian(track.place, axis=0)
    place = middle + scipy.interpolate.CubicSpline(time - time[0], track.place[first] - middle)(at - time[0])
    sigma = np.stack([np.interp(at, time, track.sigma_m[first, k]) for k in range(3)], axis=1)
    aircraft = None
    if track.aircraft_deg is not None:
        rotations = scipy.spatial.transform.Rotation.from_euler("ZYX", track.aircraft_deg[first][:, ::-1], degrees=True)
        aircraft = scipy.spatial.transform.Slerp(time - time[0], rotations)(at - time[0]).as_euler("ZYX", degrees=True)
        aircraft = aircraft[:, ::-1]
    place[~inside], sigma[~inside] = np.nan, np.nan
    fix = tuple(track.fix[k] for k in nearest)
    return track._replace(time_s=times_s, place=place, sigma_m=sigma, fix=fix, aircraft_deg=aircraft)


def _fix_counts(kinds: Sequence[Fix]) -> str:
    """Return the counts of each kind of solution, after a comma."""
    parts = [f"{kinds.count(kind)} {kind}" for kind in ("fixed", "float", "single", "integrated") if kind in kinds]
    return f", {', '.join(parts)}" if parts else ""


def _aircraft(photograph: Photograph) -> Float[np.ndarray, "3 3"] | None:
    """Return the rotation from aircraft axes (right, forward, up) to the level frame; if unknown, the camera's."""
    if photograph.aircraft_deg is not None:
        return level_from_body(photograph.aircraft_deg)
    return None if photograph.attitude is None else photograph.attitude.level_from_camera
