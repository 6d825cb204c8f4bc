"""Matching of photographs and recorded exposures by the times of two clocks that differ by a constant.

The clock of a camera is set to some time zone, with or without leap seconds, and is off by seconds; a receiver uses GPS
time. The clock difference is the difference between times of photographs and exposures that most photographs share: a
gap, a missing or an additional exposure shifts no other. If exposures follow at equal intervals, a shift by one fits
nearly as well: then the positions recorded by the photographs decide; without these the result is ambiguous.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

GPS_EPOCH_UNIX_S = 315_964_800.0
"""Midnight of 6 January 1980 UTC, the origin of GPS weeks."""
LEAP_SECONDS = 18.0
"""GPS time minus UTC since 2017."""
WEEK_S = 604_800.0
_HOUR_S, DAY_S = 3600.0, 86_400.0
ZONES_S = 15 * _HOUR_S
"""Largest difference of a clock from UTC or GPS time: the farthest time zone is 14 hours ahead."""
# A camera's clock is set by hand, or by the receiver: remaining error besides time zone and leap seconds.
_NEAR_ZONE_S = 300.0
# Time zones are multiples of a quarter of an hour.
_ZONE_S = 900.0
# Maximum number of differences; of more photographs every second one suffices.
_MOST_PAIRS = 2_000_000
WORSE = 1.5
"""Ratio of position misfits above which an assignment is rejected."""


class Taken(NamedTuple):
    """Exposure time of a photograph, from its file."""

    clock_s: float
    """Seconds since 1980-01-06 of the camera's own clock, in its time zone."""
    resolution_s: float
    """1 if the file has whole seconds."""
    ahead_of_utc_s: float | None = None
    """Offset of that clock from UTC, if the file has it."""


class Matched(NamedTuple):
    """Exposure of every photograph, and the clock difference."""

    exposure: Int[np.ndarray, "photographs"]
    """Index of the exposure; -1 if there is none."""
    offset_s: float
    """Clock of the photographs minus that of the exposures; NaN if matched without times."""


class Ambiguous(NamedTuple):
    """Two clock differences that fit equally many photographs."""

    offsets_s: tuple[float, float]
    fitted: int


def match_times(
    photographs_s: Float[np.ndarray, "photographs"],
    exposures_s: Float[np.ndarray, "exposures"],
    tolerance_s: float,
    photographs_at: Float[np.ndarray, "photographs 3"] | None = None,
    exposures_at: Float[np.ndarray, "exposures 3"] | None = None,
) -> Matched | Ambiguous | None:
    """Match photographs and exposures by times that differ by a constant; NaN for a photograph without time.

    `tolerance_s` applies to a single difference. `photographs_at` and `exposures_at` (m, NaN if unknown) decide between
    constants that fit equally many. None if no two photographs share a constant.
    """
    known = np.flatnonzero(np.isfinite(photographs_s))
    order = known[np.argsort(photographs_s[known], kind="stable")]
    rank = np.argsort(exposures_s, kind="stable")
    if min(len(order), len(rank)) < 2:
        return None
    times, events = photographs_s[order], exposures_s[rank]
    tried = [_joined(times, events, offset, tolerance_s) for offset in _offsets(times, events, tolerance_s)]
    most = max(int((found >= 0).sum()) for found, _ in tried)
    if most < 2:
        return None
    # One photograph fewer may be the end of a shifted row.
    near = [(found, offset) for found, offset in tried if (found >= 0).sum() >= most]
    if photographs_at is not None and exposures_at is not None:
        off = [_apart(photographs_at[order], exposures_at[rank], found) for found, _ in tried]
        if np.isfinite(off).any():
            # Positions reveal a shifted row, even one that fits more times.
            enough = [k for k, (found, _) in enumerate(tried) if (found >= 0).sum() >= 0.8 * most]
            best = min(enough, key=lambda k: off[k])
            near = [tried[k] for k in enough if off[k] <= WORSE * off[best]]
            near.sort(key=lambda t: -int((t[0] >= 0).sum()))
            near = [t for t in near if (t[0] >= 0).sum() == (near[0][0] >= 0).sum()]
    distinct = [t for t in near if abs(t[1] - near[0][1]) > tolerance_s]
    if distinct:
        return Ambiguous((near[0][1], distinct[0][1]), most)
    found, offset = near[0]
    exposure = np.full(len(photographs_s), -1)
    exposure[order[found >= 0]] = rank[found[found >= 0]]
    return Matched(exposure, offset)


def _offsets(times: np.ndarray, events: np.ndarray, tolerance_s: float, most: int = 12) -> list[float]:
    """Return constants shared by many pairs, the most frequent first: centres of windows, as seconds are truncated
    evenly.
    """
    times = times[:: 1 + len(times) * len(events) // _MOST_PAIRS]
    every = np.sort((times[:, None] - events[None, :]).ravel())
    count = np.searchsorted(every, every + 2 * tolerance_s, side="right") - np.arange(len(every))
    offsets: list[float] = []
    for k in np.argsort(-count, kind="stable"):
        middle = float(every[k] + every[k + count[k] - 1]) / 2
        if all(abs(middle - other) > 2 * tolerance_s for other in offsets):
            offsets.append(middle)
        if len(offsets) == most or count[k] < 0.3 * count.max():
            break
    return offsets


def _joined(times: np.ndarray, events: np.ndarray, offset: float, tolerance_s: float) -> tuple[np.ndarray, float]:
    """Match each time to an exposure, each once and in order, and return the constant of those matched."""
    best, left = _in_order(times, events, offset, tolerance_s)
    # The window may be off centre: the mean of fine times, and the mid-range of truncated seconds, are better.
    for _ in range(2):
        for middle in (np.mean, lambda v: (np.min(v) + np.max(v)) / 2):
            if not len(left):
                return best, offset
            tried = offset + float(middle(left))
            found, apart = _in_order(times, events, tried, tolerance_s)
            if len(apart) >= len(left):
                best, left, offset = found, apart, tried
    return best, offset + float(np.mean(left))


def _in_order(
    times: np.ndarray, events: np.ndarray, offset: float, tolerance_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """For windows of equal width, the first free exposure gives the most pairs."""
    found, k = np.full(len(times), -1), 0
    for i, time in enumerate(times):
        while k < len(events) and time - events[k] - offset > tolerance_s:
            k += 1
        if k < len(events) and abs(time - events[k] - offset) <= tolerance_s:
            found[i] = k
            k += 1
    return found, (times - events[found] - offset)[found >= 0]


def _apart(at: np.ndarray, there: np.ndarray, found: np.ndarray) -> float:
    """Return the median distance of the positions of matched pairs; infinite if none is known.

    A common shift is included: for a single strip it is all that a shift by one exposure changes.
    """
    d = (at - there[found])[found >= 0]
    d = d[np.isfinite(d).all(axis=1)]
    return float(np.median(np.linalg.norm(d, axis=1))) if len(d) >= 3 else np.inf


def clock_words(offset_s: float) -> str:
    """Describe a difference to GPS time: hours of a time zone, leap seconds, remainder."""
    best = min(
        ((zone, leap) for zone in _near_zones(offset_s) for leap in (-LEAP_SECONDS, 0.0, LEAP_SECONDS)),
        key=lambda parts: (round(abs(offset_s - sum(parts))), parts[1]),
    )
    zone, leap = best
    rest = offset_s - zone - leap
    if abs(offset_s) > ZONES_S:
        return f"{offset_s / DAY_S:+.2f} days, which no time zone explains"
    if abs(rest) > _NEAR_ZONE_S:
        return f"{offset_s:+.1f} s, which is no time zone: it is counted from somewhere else"
    parts = [f"{zone / _HOUR_S:+g} h (time zone)"] if zone else []
    parts += [f"{leap:+g} s (leap seconds: GPS time against UTC)"] if leap else []
    parts += [f"{rest:+.2f} s"] if abs(rest) >= 0.005 or not parts else []
    return ", ".join(parts)


def _near_zones(offset_s: float) -> tuple[float, ...]:
    middle = round(offset_s / _ZONE_S)
    return tuple(_ZONE_S * k for k in (middle - 1, middle, middle + 1) if abs(_ZONE_S * k) <= 14 * _HOUR_S) or (0.0,)
