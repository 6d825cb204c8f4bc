"""Matching of photographs with exposures of a receiver by the times of two clocks with a constant offset.

The clock of a camera runs in some time zone with an error of seconds; a receiver records GPS time. The clock offset
with the most matches is selected: gaps, missing and surplus exposures do not change it. At equal intervals a shift by
one exposure fits nearly as well; the positions of the photographs then resolve the ambiguity.
"""

from datetime import datetime
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

LEAP_SECONDS = 18.0
"""GPS time minus UTC since 2017 (s)."""
WEEK_S = 604_800.0
_HOUR_S, DAY_S = 3600.0, 86_400.0
ZONES_S = 15 * _HOUR_S
"""Maximum offset of a clock from UTC (s); time zones extend to UTC+14."""
# Maximum error (s) of a camera's clock apart from time zone and leap seconds.
_NEAR_ZONE_S = 300.0
# Step of time zones (s): a quarter of an hour.
_ZONE_S = 900.0
# Maximum number of time differences; with more photographs every n-th is used.
_MOST_PAIRS = 2_000_000
WORSE = 1.5
"""Maximum ratio of the median position difference of a clock offset to that of the best clock offset."""


def gps_seconds(at: datetime) -> float:
    """Return the seconds since 1980-01-06 in the time zone of `at`, without leap seconds."""
    return (at - datetime(1980, 1, 6)).total_seconds()


class Taken(NamedTuple):
    """Exposure time recorded in the file of a photograph."""

    clock_s: float
    """Time of the camera's clock in its time zone, in seconds since 1980-01-06."""
    resolution_s: float
    """Resolution of the time (s); 1 for whole seconds."""
    ahead_of_utc_s: float | None = None
    """Offset of the clock from UTC (s); None if unknown."""


class Matched(NamedTuple):
    """Exposure of every photograph, and offset between the clocks."""

    exposure: Int[np.ndarray, "photographs"]
    """Index of the exposure; -1 for none."""
    offset_s: float
    """Clock of the photographs minus clock of the exposures; NaN if matched without times."""


class Ambiguous(NamedTuple):
    """Two clock offsets that match equally many photographs."""

    offsets_s: tuple[float, float]
    fitted: int


def match_times(
    photographs_s: Float[np.ndarray, "photographs"],
    exposures_s: Float[np.ndarray, "exposures"],
    tolerance_s: float,
    photographs_at: Float[np.ndarray, "photographs 3"] | None = None,
    exposures_at: Float[np.ndarray, "exposures 3"] | None = None,
) -> Matched | Ambiguous | None:
    """Match photographs and exposures whose times (NaN: unknown) differ by a constant offset.

    `tolerance_s`: maximum deviation of a time difference from the offset. The positions `photographs_at` and
    `exposures_at` (m, NaN: unknown) select between similar offsets. Returns None if no offset matches two photographs.
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
    near = [(found, offset) for found, offset in tried if (found >= 0).sum() >= most]
    if photographs_at is not None and exposures_at is not None:
        off = [_apart(photographs_at[order], exposures_at[rank], found) for found, _ in tried]
        if np.isfinite(off).any():
            # Prefer the offset with the best positions, even if another offset matches more times.
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
    """Return candidate offsets (centres of windows), sorted by decreasing number of pairs within the tolerance."""
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
    """Return the exposure of each time (in order, each used at most once), and the refined offset."""
    best, left = _in_order(times, events, offset, tolerance_s)
    # Refine the offset: try the mean (precise times) and the midrange (truncated seconds) of the residuals.
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
    """Pair each time with the first unused exposure in its window; return pairs and their residuals."""
    found, k = np.full(len(times), -1), 0
    for i, time in enumerate(times):
        while k < len(events) and time - events[k] - offset > tolerance_s:
            k += 1
        if k < len(events) and abs(time - events[k] - offset) <= tolerance_s:
            found[i] = k
            k += 1
    return found, (times - events[found] - offset)[found >= 0]


def _apart(at: np.ndarray, there: np.ndarray, found: np.ndarray) -> float:
    """Return the median distance of matched positions, including a common shift; infinite if unknown."""
    d = (at - there[found])[found >= 0]
    d = d[np.isfinite(d).all(axis=1)]
    return float(np.median(np.linalg.norm(d, axis=1))) if len(d) >= 3 else np.inf


def clock_words(offset_s: float) -> str:
    """Describe an offset from GPS time: hours of a time zone, leap seconds, remainder."""
    best = min(
        ((zone, leap) for zone in _near_zones(offset_s) for leap in (-LEAP_SECONDS, 0.0, LEAP_SECONDS)),
        key=lambda parts: (round(abs(offset_s - sum(parts))), parts[1]),
    )
    zone, leap = best
    rest = offset_s - zone - leap
    if abs(offset_s) > ZONES_S:
        return f"{offset_s / DAY_S:+.2f} days, more than any time zone"
    if abs(rest) > _NEAR_ZONE_S:
        return f"{offset_s:+.1f} s, which is not a time zone: the epochs differ"
    parts = [f"{zone / _HOUR_S:+g} h (time zone)"] if zone else []
    parts += [f"{leap:+g} s (leap seconds: GPS time against UTC)"] if leap else []
    parts += [f"{rest:+.2f} s"] if abs(rest) >= 0.005 or not parts else []
    return ", ".join(parts)


def _near_zones(offset_s: float) -> tuple[float, ...]:
    middle = round(offset_s / _ZONE_S)
    return tuple(_ZONE_S * k for k in (middle - 1, middle, middle + 1) if abs(_ZONE_S * k) <= 14 * _HOUR_S) or (0.0,)
