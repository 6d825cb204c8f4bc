"""Which photograph each exposure of a file is: by the number in its name, or by times and positions."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.georeferencing.exposure_times import LEAP_SECONDS, WORSE, Ambiguous, Matched, match_times
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.photographs import Photograph

# DJI_20240501123456_0012_V, DJI_0012, 100_0042_0012: the number within the flight.
_NUMBER = re.compile(r"_(\d{3,5})(?:_[A-Za-z]\w*)?$")
# Numbers fit where the times that they join differ by a constant, for so many of them.
_MOST = 0.8
# Of a time that is cut off at the second, or written when the file is stored; and of a finer one.
_COARSE_S, FINE_S = 0.6, 0.2
_DEGREE_M = 111_320.0


class Clock(NamedTuple):
    """Times of exposure by the files of photographs."""

    time_s: Float[np.ndarray, "n"]
    """NaN where a file has none."""
    gps: bool
    """Whether they are GPS time; else those of a clock in some zone."""
    tolerance_s: float


def clock_of(photographs: Sequence[Photograph]) -> Clock:
    """Their clock, in GPS time where every file that has a time says how far it is ahead of UTC."""
    known = [p.taken for p in photographs if p.taken]
    told = all(t.ahead_of_utc_s is not None for t in known)
    times = [
        np.nan if (t := p.taken) is None else t.clock_s + (LEAP_SECONDS - (t.ahead_of_utc_s or 0.0) if told else 0.0)
        for p in photographs
    ]
    coarse = any(t.resolution_s >= FINE_S for t in known)
    return Clock(np.array(times), told, _COARSE_S if coarse else FINE_S)


def by_name(photographs: Sequence[Photograph], file: Exposures) -> Int[np.ndarray, "n"]:
    """The exposure of the same name; small and capital letters are the same where that leaves all names different."""
    wanted, names = [p.name for p in photographs], list(file.names)
    folded = [name.lower() for name in wanted], [name.lower() for name in names]
    if all(len(set(several)) == len(several) for several in folded):
        wanted, names = folded
    place = {name: k for k, name in enumerate(names)}
    return np.array([place.get(name, -1) for name in wanted], int)


def by_marks(
    photographs: Sequence[Photograph], file: Exposures, clock: Clock
) -> tuple[Matched | Ambiguous | None, str]:
    """What numbers or times join, and "by number" or "by time".

    A file that was numbered anew after it lost an exposure gives the others those of their neighbours: numbers count
    where times do not bring the photographs' own positions nearer, and, where none are known, of a file that cannot
    be such a one.
    """
    numbered, timed = by_number(photographs, file, clock), by_time(photographs, file, clock)
    if numbered is None:
        return timed, "by time"
    off = distance(photographs, file, numbered.exposure)
    if off is None and _perhaps_anew(photographs, file):
        return timed, "by time"
    if off is not None and isinstance(timed, Matched):
        nearer = distance(photographs, file, timed.exposure)
        if nearer is not None and off > WORSE * nearer and not np.array_equal(numbered.exposure, timed.exposure):
            return timed, "by time"
    return numbered, "by number"


def _perhaps_anew(photographs: Sequence[Photograph], file: Exposures) -> bool:
    """Whether the numbers of a file run from 1 without a gap, and end before those of the photographs do.

    Any gap may be that of a row that was left out.
    """
    assert file.sequence is not None
    n = len(file.sequence) + len(file.without)
    numbers = [int(found[1]) for p in photographs if (found := _NUMBER.search(p.name))]
    first, last = int(file.sequence.min()), int(file.sequence.max())
    return first >= 1 and last <= n < max(numbers, default=0)


def by_number(photographs: Sequence[Photograph], file: Exposures, clock: Clock) -> Matched | None:
    """What the numbers in the names join; None where they are none, not single, or contradict the times.

    Files of several flights begin anew: times then tell which is which.
    """
    assert file.sequence is not None
    found = [_NUMBER.search(p.name) for p in photographs]
    numbers = [int(f[1]) if f else None for f in found]
    known, listed = [v for v in numbers if v is not None], file.sequence.tolist()
    if len(set(known)) < len(known) or len(set(listed)) < len(listed):
        return None
    place = {number: k for k, number in enumerate(listed)}
    exposure = np.array([-1 if v is None else place.get(v, -1) for v in numbers])
    if not (exposure >= 0).any():
        return None
    d = np.where(exposure >= 0, clock.time_s - file.time_s[exposure], np.nan)
    timed = np.isfinite(d)
    if not timed.any():
        return Matched(exposure, np.nan)
    offset = float(np.median(d[timed]))
    near = np.abs(d - offset) <= 2 * clock.tolerance_s
    return Matched(np.where(near | ~timed, exposure, -1), offset) if near.sum() >= _MOST * timed.sum() else None


def by_time(photographs: Sequence[Photograph], file: Exposures, clock: Clock) -> Matched | Ambiguous | None:
    """What times that differ by a constant join; positions of the photographs' own decide between constants."""
    at, there = _level(photographs, file.place)
    return match_times(clock.time_s, file.time_s, clock.tolerance_s, at, there)


def distance(photographs: Sequence[Photograph], file: Exposures, exposure: Int[np.ndarray, "n"]) -> float | None:
    """The median distance (m, in plan) of exposures to the photographs' own positions; None where none are known."""
    at, there = _level(photographs, file.place)
    d = np.linalg.norm(at - there[exposure], axis=1)[exposure >= 0]
    return float(np.median(d[np.isfinite(d)])) if np.isfinite(d).any() else None


def _level(photographs: Sequence[Photograph], place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of photographs and of `place`, east and north (m); not up: files count heights from different zeros."""
    own = [(p.gps.longitude_deg, p.gps.latitude_deg) if p.gps else (np.nan, np.nan) for p in photographs]
    plan = place[:, :2]
    known = plan[np.isfinite(plan).all(axis=1)]
    middle = np.median(known, axis=0) if len(known) else np.zeros(2)
    scale = _DEGREE_M * np.array([np.cos(np.deg2rad(middle[1])), 1.0])
    at, there = (np.pad((v - middle) * scale, ((0, 0), (0, 1))) for v in (np.array(own).reshape(-1, 2), plan))
    at[np.array([p.gps is not None and not any(o) for p, o in zip(photographs, own, strict=True)], bool)] = np.nan
    return at, there
