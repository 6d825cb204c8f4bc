"""Positions and attitudes of photographs from their own files and from files of exposures.

Exposures are assigned to photographs by name, by number, or by times and positions.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.errors import InputError, few, shown
from jaxphoto.georeferencing.camera_attitude import CameraAttitude, level_from_body
from jaxphoto.georeferencing.exposure_times import (
    DAY_S,
    LEAP_SECONDS,
    WEEK_S,
    WORSE,
    ZONES_S,
    Ambiguous,
    Matched,
    clock_words,
    match_times,
)
from jaxphoto.georeferencing.gps import Fix, Heights, moved
from jaxphoto.georeferencing.recorded_positions import one_height, plausible_positions
from jaxphoto.io.exposures.files import exposure_files, read_exposures
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.photographs import Photograph

# DJI_20240501123456_0012_V, DJI_0012, 100_0042_0012: the number within the flight.
_NUMBER = re.compile(r"_(\d{3,5})(?:_[A-Za-z]\w*)?$")
# Numbers are valid if the times of this fraction of the photographs differ by a constant.
_CONSISTENT = 0.8
# Tolerance of times in whole seconds, and of finer ones.
_COARSE_S, FINE_S = 0.6, 0.2
# Differences of clocks that are not reported: EXIF counts seconds.
_SMALL_S = 1.5
_DEGREE_M = 111_320.0
# A longer interval between records than this multiple of the median is a gap.
_GAP = 2.5


class Clock(NamedTuple):
    """Times of exposure by the files of photographs."""

    time_s: Float[np.ndarray, "n"]
    """NaN if unknown."""
    gps: bool
    """True if they are GPS times."""
    tolerance_s: float


def clock_of(photographs: Sequence[Photograph]) -> Clock:
    """The clock of photographs, in GPS time if all known times have an offset to UTC."""
    known = [p.taken for p in photographs if p.taken]
    gps = all(t.ahead_of_utc_s is not None for t in known)
    times = [
        t.clock_s + (LEAP_SECONDS - (t.ahead_of_utc_s or 0.0) if gps else 0.0) if (t := p.taken) else np.nan
        for p in photographs
    ]
    coarse = any(t.resolution_s >= FINE_S for t in known)
    return Clock(np.array(times), gps, _COARSE_S if coarse else FINE_S)


def by_name(photographs: Sequence[Photograph], file: Exposures) -> Int[np.ndarray, "n"]:
    """The exposure of the same name (case is ignored if the names stay different), -1 for none."""
    wanted, names = [p.name for p in photographs], list(file.names)
    folded = [name.lower() for name in wanted], [name.lower() for name in names]
    if all(len(set(several)) == len(several) for several in folded):
        wanted, names = folded
    index = {name: k for k, name in enumerate(names)}
    return np.array([index.get(name, -1) for name in wanted], int)


def by_time(photographs: Sequence[Photograph], file: Exposures, clock: Clock) -> Matched | Ambiguous | None:
    """Matches of times that differ by a constant; the photographs' own positions decide between constants."""
    positions, listed = _plane(photographs, file.place)
    return match_times(clock.time_s, file.time_s, clock.tolerance_s, positions, listed)


def by_number_or_time(
    photographs: Sequence[Photograph], file: Exposures, clock: Clock
) -> tuple[Matched | Ambiguous | None, str]:
    """Matches of numbers or times, and "by number" or "by time".

    A file that was renumbered after it lost an exposure has the numbers of their neighbours: times count if they bring
    the photographs' own positions nearer. Without positions, numbers that run from 1 without a gap and end before those
    of the photographs may have been renumbered.
    """
    assert file.sequence is not None
    numbered, timed = _by_number(photographs, file, clock), by_time(photographs, file, clock)
    if numbered is None:
        return timed, "by time"
    off = distance(photographs, file, numbered.exposure)
    if off is None:
        last = max((int(match[1]) for p in photographs if (match := _NUMBER.search(p.name))), default=0)
        n = len(file.sequence) + len(file.without)
        renumbered = file.sequence.min() >= 1 and file.sequence.max() <= n < last
        return (timed, "by time") if renumbered else (numbered, "by number")
    if isinstance(timed, Matched) and not np.array_equal(numbered.exposure, timed.exposure):
        nearer = distance(photographs, file, timed.exposure)
        if nearer is not None and off > WORSE * nearer:
            return timed, "by time"
    return numbered, "by number"


def _by_number(photographs: Sequence[Photograph], file: Exposures, clock: Clock) -> Matched | None:
    """Matches of the numbers in the names; None if they are missing, not unique, or contradict the times.

    Times tell the files of several flights that count from 1.
    """
    assert file.sequence is not None
    numbers = [int(match[1]) if (match := _NUMBER.search(p.name)) else None for p in photographs]
    known, listed = [v for v in numbers if v is not None], file.sequence.tolist()
    if len(set(known)) < len(known) or len(set(listed)) < len(listed):
        return None
    index = {number: k for k, number in enumerate(listed)}
    exposure = np.array([-1 if v is None else index.get(v, -1) for v in numbers])
    if not (exposure >= 0).any():
        return None
    difference = np.where(exposure >= 0, clock.time_s - file.time_s[exposure], np.nan)
    timed = np.isfinite(difference)
    if not timed.any():
        return Matched(exposure, np.nan)
    offset = float(np.median(difference[timed]))
    near = np.abs(difference - offset) <= 2 * clock.tolerance_s
    consistent = near.sum() >= _CONSISTENT * timed.sum()
    return Matched(np.where(near | ~timed, exposure, -1), offset) if consistent else None


def distance(photographs: Sequence[Photograph], file: Exposures, exposure: Int[np.ndarray, "n"]) -> float | None:
    """Median horizontal distance (m) of exposures to the photographs' own positions; None if none are known."""
    positions, listed = _plane(photographs, file.place)
    d = np.linalg.norm(positions - listed[exposure], axis=1)[exposure >= 0]
    return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else None


def _plane(photographs: Sequence[Photograph], place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """East and north (m), and 0 for the height, of photographs and of `place`: files have different height systems."""
    # (0, 0) is no position.
    known = [p.gps is not None and (p.gps.longitude_deg, p.gps.latitude_deg) != (0, 0) for p in photographs]
    positions = np.array(
        [(p.gps.longitude_deg, p.gps.latitude_deg) if p.gps and k else (np.nan,) * 2
         for p, k in zip(photographs, known, strict=True)]
    ).reshape(-1, 2)  # fmt: skip
    finite = place[np.isfinite(place[:, :2]).all(axis=1), :2]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(2)
    scale = _DEGREE_M * np.array([np.cos(np.deg2rad(middle[1])), 1.0])
    positions, listed = (np.pad((v - middle) * scale, ((0, 0), (0, 1))) for v in (positions, place[:, :2]))
    return positions, listed


def interpolated(track: Exposures, times_s: Float[np.ndarray, "n"]) -> Exposures:
    """A trajectory at `times_s` by a cubic spline; positions before, after and in gaps of it are NaN.

    Standard deviations are interpolated linearly, rotations at constant angular velocity, the kind of solution is that
    of the nearest record.
    """
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
    return track._replace(
        rows=track.rows[nearest], time_s=times_s, place=place, sigma_m=sigma, fix=fix, aircraft_deg=aircraft
    )


def match_message(
    photographs: Sequence[Photograph], file: Exposures, match: Matched, clock: Clock, how: str = "by time"
) -> str:
    """Numbers of matched, missing and surplus exposures, and the difference of the clocks."""
    message = f"positions of {count_message(photographs, file, match.exposure)} {how}{fix_counts(file, match.exposure)}"
    small = _SMALL_S if clock.tolerance_s > FINE_S else FINE_S
    if not np.isfinite(match.offset_s) or (clock.gps and abs(match.offset_s) <= small):
        return message
    message += f"; the clocks of photographs and file differ by {clock_words(match.offset_s)}"
    if abs(match.offset_s) > ZONES_S:
        near = distance(photographs, file, match.exposure)
        return f"{message}; positions agree to {near:.1f} m: omit the file if it is of another day"
    return f"{message}, which is corrected"


def no_match_message(result: Ambiguous | None) -> str:
    """The reason why times match no photographs."""
    if result is None:
        return "no two photographs have times that differ from its times by one constant; not used"
    one, other = map(clock_words, result.offsets_s)
    return (
        f"{result.fitted} photographs fit its times with clocks that differ by {one} or by {other}, and no position "
        "decides; not used (a table with names does: --exposures)"
    )


def count_message(photographs: Sequence[Photograph], file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
    """Number of photographs with an exposure, those without, and rows without a photograph."""
    used = set(exposure[exposure >= 0].tolist())
    without = [p.name for p, k in zip(photographs, exposure, strict=True) if k < 0]
    surplus = [str(row) for k, row in enumerate(file.rows.tolist()) if k not in used]
    parts = [f"none for {few(without)}"] if without else []
    if surplus:
        rows = "row" if len(surplus) == 1 else "rows"
        parts.append(f"{len(surplus)} of its exposures without a photograph, {rows} {few(surplus)}")
    return f"{len(used)} of {len(photographs)} photographs" + (f" ({'; '.join(parts)})" if parts else "")


def fix_counts(file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
    """Numbers of solutions of each kind, after a comma."""
    return _fix_counts([file.fix[k] for k in exposure if k >= 0])


def own_files_message(photographs: Sequence[Photograph]) -> list[str]:
    """A message about attitudes, heights, sigmas and solutions in the files of the photographs; none without them."""
    positions = [p.gps for p in photographs if p.gps]
    known = {
        "attitudes": [p.attitude is not None for p in photographs],
        "heights above take-off": [p.above_takeoff_m is not None for p in photographs],
        "standard deviations of positions": [g.sigma_m is not None for g in positions],
    }
    parts = [name if all(v) else f"{name} ({sum(v)} of {len(v)})" for name, v in known.items() if any(v)]
    if solutions := _fix_counts([g.fix for g in positions]):
        parts.append(f"solutions{solutions.replace(',', ':', 1)}")
    return [f"the photographs' own files have {', '.join(parts)}"] if parts else []


def _fix_counts(kinds: Sequence[Fix]) -> str:
    parts = [f"{kinds.count(kind)} {kind}" for kind in ("fixed", "float", "single", "integrated") if kind in kinds]
    return f", {', '.join(parts)}" if parts else ""


Arm = tuple[float, float, float]
"""Lever arm from the camera to the antenna, right, forward, up of the aircraft (m)."""

# A trajectory has more records per photograph than this; events are about as many as photographs.
_TRACK = 3
# Positions farther from the photographs' own are of another flight.
_FAR_M = 200.0
# Agreement of positions without and with corrections.
_SAME_M = 5.0
# Resolution of times for a trajectory: a centimetre at 10 m/s.
_EXACT_S = 1e-3


class Assigned(NamedTuple):
    """Photographs with the positions and attitudes of files, and a message per file."""

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
    """The photographs with positions of the files `given` and of those in `folders`, with heights of one kind.

    `code` is the EPSG system of map coordinates in tables, `arm` the lever arm, `heights` the reference of heights that
    do not have one; "take-off" selects those above it, an EPSG code of heights adds its geoid. Invalid files in folders
    are reported; those in `given` raise InputError, as does a geoid that is not installed.
    """
    kind: Heights = "geoid" if isinstance(heights, int) else heights or "unknown"
    files, messages = [read_exposures(path, code, kind) for path in given], []
    known = {path.resolve() for path in given}
    for path in (path for folder in folders if folder.is_dir() for path in exposure_files(folder)):
        if path.resolve() not in known:
            try:
                files.append(read_exposures(path, code, kind))
            except InputError as error:
                messages.append(f"{error}; the file is not used")
    assigned = with_exposures(photographs, files, arm)
    positions, corrections = plausible_positions({p.name: p.gps for p in assigned.photographs})
    above = {p.name: p.above_takeoff_m for p in assigned.photographs}
    positions, height_messages = one_height(positions, above, heights)
    messages += [*assigned.sentences, *corrections, *own_files_message(photographs), *height_messages]
    return Assigned([p._replace(gps=positions[p.name]) for p in assigned.photographs], list(map(shown, messages)))


def with_exposures(photographs: Sequence[Photograph], files: Sequence[Exposures], arm: Arm | None = None) -> Assigned:
    """The photographs with positions, sigmas and attitudes of the files; later kinds replace earlier ones.

    Time marks are first: their times and lever arms serve positions of the antenna, at events and along trajectories.
    Tables, by name, are last. `arm` is that of positions without a lever arm of a time mark, and, without such a file,
    of the photographs' own positions.
    """
    assignment = _Assignment(photographs, arm)
    track = lambda f: len(f.rows) > _TRACK * len(photographs) or f.aircraft_deg is not None  # noqa: E731
    messages = []
    for file in sorted(files, key=lambda f: 3 if f.names else 0 if f.sequence is not None else 1 + track(f)):
        if file.names:
            message = assignment.by_name(file)
        elif file.sequence is None and track(file):
            message = assignment.along(file)
        else:
            message = assignment.by_time(file)
        messages.append("; ".join(filter(None, (f"{file.file}: {message}", file.why))))
    if arm is not None and not any(f.of_antenna for f in files):
        if any(assignment.own):
            messages.append(assignment.move_own(arm))
        else:
            messages.append("the lever arm is not used: positions of time marks and tables are those of the camera")
    return Assigned(assignment.photographs, messages)


class _Assignment:
    """Photographs with what is known of each; every method takes one file and returns its message."""

    def __init__(self, photographs: Sequence[Photograph], arm: Arm | None):
        n = len(photographs)
        self.photographs, self.arm = list(photographs), arm
        # GPS times of time marks and of events.
        self.gps_s, self.event_s = np.full(n, np.nan), np.full(n, np.nan)
        self.camera_from_antenna_m = np.full((n, 3), np.nan)
        # True if the position is that of the photograph's own file.
        self.own = [True] * n

    def by_name(self, file: Exposures) -> str:
        """A table."""
        exposure = by_name(self.photographs, file)
        if not (exposure >= 0).any():
            return f"none of its {len(file.names)} names is that of a photograph ({few(list(file.names))}); not used"
        if problem := self._other_flight(file, exposure):
            return problem
        message = f"positions of {count_message(self.photographs, file, exposure)} by name{fix_counts(file, exposure)}"
        for i in np.flatnonzero(exposure >= 0):
            if (attitude := file.attitude[exposure[i]]) is not None:
                self.photographs[i] = self.photographs[i]._replace(attitude=attitude)
        self._set_camera(file, exposure)
        return message

    def by_time(self, file: Exposures) -> str:
        """Time marks of DJI, by number or time, or events of the antenna, by time."""
        clock = clock_of(self.photographs)
        match: Matched | Ambiguous | None
        if file.sequence is not None:
            match, how = by_number_or_time(self.photographs, file, clock)
        else:
            if np.isfinite(self.gps_s).sum() >= 2:
                clock = Clock(self.gps_s, True, FINE_S)
            match, how = by_time(self.photographs, file, clock), "by time"
        if not isinstance(match, Matched):
            return no_match_message(match)
        if problem := self._other_flight(file, match.exposure) or self._other_day(file, match):
            return problem
        message = match_message(self.photographs, file, match, clock, how)
        if file.sequence is not None:
            self._set_camera(file, match.exposure)
            return message
        self.event_s = np.where(match.exposure >= 0, file.time_s[match.exposure], self.event_s)
        return f"{message}; {self._set_antenna(file, match.exposure)}"

    def along(self, file: Exposures) -> str:
        """A trajectory, at times of marks or events, or of photographs to the millisecond."""
        times = np.where(np.isfinite(self.gps_s), self.gps_s, self.event_s)
        if not np.isfinite(times).any():
            clock = clock_of(self.photographs)
            exact = [clock.gps and bool(p.taken and p.taken.resolution_s <= _EXACT_S) for p in self.photographs]
            times = np.where(exact, clock.time_s, np.nan)
        if not np.isfinite(times).any():
            return (
                "a trajectory needs the time of every exposure to the millisecond, and neither time marks nor events "
                "nor photographs have it; not used"
            )
        if file.time_s.max() < 2 * WEEK_S:
            file = file._replace(time_s=file.time_s + WEEK_S * np.floor(np.nanmin(times) / WEEK_S))
        at = interpolated(file, times)
        exposure = np.where(np.isfinite(at.place).all(axis=1), np.arange(len(times)), -1)
        if not (exposure >= 0).any():
            apart = np.nanmedian(times) - np.median(file.time_s)
            return f"no photograph was taken while it lasts: it is {apart:+,.0f} s from them; not used"
        if problem := self._other_flight(at, exposure):
            return problem
        lost = [p.name for p, k in zip(self.photographs, exposure, strict=True) if k < 0]
        n = len(times) - len(lost)
        without = f" ({len(lost)} before, after or in a gap of it: {few(lost)})" if lost else ""
        message = f"positions of {n} photographs by interpolation{fix_counts(at, exposure)}{without}"
        return f"{message}; {self._set_antenna(at, exposure)}"

    def move_own(self, arm: Arm) -> str:
        """Reduce positions of the photographs' own files by the lever arm."""
        moved_count = left = 0
        for i, p in enumerate(self.photographs):
            if not self.own[i] or p.gps is None:
                continue
            if (rotation := _aircraft(p)) is None:
                left += 1
            else:
                self.photographs[i] = p._replace(gps=moved(p.gps, -rotation @ np.array(arm)))
                moved_count += 1
        without = f"; {left} have no attitude that turns it, and stay" if left else ""
        return f"the lever arm is taken off {moved_count} positions of the photographs' own files{without}"

    def _set_camera(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> None:
        """Take positions of the camera, times and lever arms."""
        for i in np.flatnonzero(exposure >= 0):
            k = int(exposure[i])
            if (gps := file.gps(k)) is not None:
                self.photographs[i], self.own[i] = self.photographs[i]._replace(gps=gps), False
            if np.isfinite(file.time_s[k]):
                self.gps_s[i] = file.time_s[k]
            if file.camera_from_antenna_m is not None:
                self.camera_from_antenna_m[i] = file.camera_from_antenna_m[k]

    def _set_antenna(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
        """Take positions of the antenna, reduced to the camera; return how."""
        marked = given = none = 0
        for i in np.flatnonzero(exposure >= 0):
            k = int(exposure[i])
            gps, photograph = file.gps(k), self.photographs[i]
            if gps is None:
                continue
            if file.aircraft_deg is not None and photograph.attitude is None:
                roll, pitch, yaw = file.aircraft_deg[k].tolist()
                fixed = CameraAttitude(level_from_body((roll, pitch, yaw)))
                photograph = photograph._replace(attitude=fixed, aircraft_deg=(roll, pitch, yaw))
            # Lever arms of time marks are those to the antenna; a trajectory with attitudes is that of the IMU.
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
            why = "--lever-arm gives it" if self.arm is None else "no attitude of the aircraft turns it"
            sensor = "antenna" if file.aircraft_deg is None else "IMU"
            parts.append(f"{none} are positions of the {sensor}, the lever arm is not known ({why})")
        return ", ".join(parts)

    def _other_flight(self, file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
        """The reason not to use a file far from the photographs' own positions; "" if it is near."""
        far = distance(self.photographs, file, exposure)
        if far is None or far <= _FAR_M:
            return ""
        back = distance(self.photographs, file._replace(place=file.place[:, [1, 0, 2]]), exposure)
        if back is not None and back <= _FAR_M:
            return (
                "its longitudes and latitudes have changed places, as the photographs' own positions show; not used: "
                "exchange the two in the file"
            )
        return f"its positions are {far:,.0f} m from those of the photographs, as of another flight; not used"

    def _other_day(self, file: Exposures, match: Matched) -> str:
        """The reason not to use a file of another day; "" if its positions prove that the clock is wrong."""
        if not abs(match.offset_s) > ZONES_S:
            return ""
        near = distance(self.photographs, file, match.exposure)
        if near is not None and near <= _SAME_M:
            return ""
        when = "before" if match.offset_s > 0 else "after"
        return (
            f"its times are {abs(match.offset_s) / DAY_S:.1f} days {when} those of the photographs, as of another day, "
            "and no positions prove that only the clock is wrong; not used"
        )


def _aircraft(photograph: Photograph) -> Float[np.ndarray, "3 3"] | None:
    """Rotation from the aircraft's axes right, forward, up to the level frame, by its attitude or the camera's."""
    if photograph.aircraft_deg is not None:
        return level_from_body(photograph.aircraft_deg)
    return None if photograph.attitude is None else photograph.attitude.level_from_camera
