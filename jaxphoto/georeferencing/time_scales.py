"""Recognition of time scales, and the offset between two time scales."""

import math
from itertools import product

import numpy as np
from jaxtyping import Float

DAY, WEEK = 86_400, 604_800
# GPS minus UTC (s), newest first: 13 s since 1999, 18 s since 2017.
LEAP_SECONDS = (18, 17, 16, 15, 14, 13)
LAS_OFFSET = 1e9
"""Offset (s) subtracted from full GPS time in LAS files."""
_OF_LAS = "full GPS time minus 1e9 s, as in LAS files"


def looks_like(times: Float[np.ndarray, "n"], origin: str = "the first exposure") -> str:
    """Describe the probable origin of the times by their magnitude; small times may refer to `origin`."""
    first, last = float(np.min(times)), float(np.max(times))
    return f"{first:.3f} to {last:.3f} s ({_kind(first, last, origin)})"


def shift_that_fits(times: Float[np.ndarray, "n"], start: float, end: float) -> float | None:
    """Return the offset between two time scales (s) that moves all `times` into [start, end]; None if there is none.

    Candidates are whole days (seconds of day, of week, full GPS time), the 1e9 s of LAS, and leap seconds; otherwise
    the integer-second offset, if exactly one fits.
    """
    first, last = float(np.min(times)), float(np.max(times))
    middle = (start + end) / 2 - (first + last) / 2
    # Test the apparent time scale first, because other offsets also fit a long flight.
    likely = LAS_OFFSET * ((_kind(first, last) == _OF_LAS) - (_kind(start, end) == _OF_LAS))
    bases = dict.fromkeys((likely, 0.0, LAS_OFFSET, -LAS_OFFSET))
    for base, leap in product(bases, (0, *LEAP_SECONDS, *(-s for s in LEAP_SECONDS))):
        offset = base + leap
        shift = offset + DAY * round((middle - offset) / DAY)
        if shift and start <= first + shift and last + shift <= end:
            return float(shift)
    least, most = start - first, end - last
    whole = math.ceil(least)
    return float(whole) if whole and whole <= most < whole + 1 and least > whole - 1 else None


def _kind(first: float, last: float, origin: str = "") -> str:
    if first >= 0 and last <= DAY:
        return f"seconds of a day, or from {origin}" if first < 600 else "seconds of a day"
    if first >= 0 and last <= 2 * WEEK:
        return "seconds of a GPS week"
    if first >= 6e8:
        return "full GPS or Unix time"
    # Negative before September 2011.
    return _OF_LAS if abs(first) > 2 * WEEK else "seconds from an unknown epoch"
