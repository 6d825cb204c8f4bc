"""Exposures of files assigned to photographs: by name, by number, or by times and positions."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.errors import few
from jaxphoto.georeferencing.exposure_times import (
    LEAP_SECONDS,
    WORSE,
    ZONES_S,
    Ambiguous,
    Matched,
    clock_words,
    match_times,
)
from jaxphoto.georeferencing.gps import Fix
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
    own, listed = _plane(photographs, file.place)
    return match_times(clock.time_s, file.time_s, clock.tolerance_s, own, listed)


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
    own, listed = _plane(photographs, file.place)
    d = np.linalg.norm(own - listed[exposure], axis=1)[exposure >= 0]
    return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else None


def _plane(photographs: Sequence[Photograph], place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """East and north (m), and 0 for the height, of photographs and of `place`: files have different height systems."""
    # (0, 0) is no position.
    known = [p.gps is not None and (p.gps.longitude_deg, p.gps.latitude_deg) != (0, 0) for p in photographs]
    own = np.array(
        [(p.gps.longitude_deg, p.gps.latitude_deg) if p.gps and k else (np.nan,) * 2
         for p, k in zip(photographs, known, strict=True)]
    ).reshape(-1, 2)  # fmt: skip
    finite = place[np.isfinite(place[:, :2]).all(axis=1), :2]
    middle = np.median(finite, axis=0) if len(finite) else np.zeros(2)
    scale = _DEGREE_M * np.array([np.cos(np.deg2rad(middle[1])), 1.0])
    own, listed = (np.pad((v - middle) * scale, ((0, 0), (0, 1))) for v in (own, place[:, :2]))
    return own, listed


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
