"""What the numbers of two clocks look like, and by how much one must be shifted to fit the other."""

import numpy as np
from jaxtyping import Float

DAY, WEEK = 86_400, 604_800
# GPS minus UTC since 1999; 18 s since 2017.
LEAP_SECONDS = (18, 17, 16, 15, 14, 13)


def looks_like(times: Float[np.ndarray, "n"]) -> str:
    """In words, what seconds of this size usually count from."""
    first, last = float(np.min(times)), float(np.max(times))
    if first >= 0 and last <= DAY:
        kind = "seconds of a day, or from the first exposure" if first < 600 else "seconds of a day"
    elif first >= 0 and last <= 2 * WEEK:
        kind = "seconds of a GPS week"
    elif first >= 6e8:
        kind = "full GPS or Unix time"
    elif first > 2 * WEEK:
        kind = "full GPS time less 1e9 s, as in LAS files"
    else:
        kind = "seconds from some event"
    return f"{first:.3f} to {last:.3f} s ({kind})"


def shift_that_fits(times: Float[np.ndarray, "n"], start: float, end: float) -> float | None:
    """The shift between two common clocks (s) that brings all `times` into [start, end], None if there is none.

    Tried are whole days (seconds of day, of week, full GPS time), the 1e9 s that LAS takes off, and leap seconds.
    """
    middle = (start + end) / 2 - (float(np.min(times)) + float(np.max(times))) / 2
    for offset in (0, *LEAP_SECONDS, *(-leap for leap in LEAP_SECONDS), 1e9, -1e9):
        shift = offset + DAY * round((middle - offset) / DAY)
        if shift and start <= np.min(times) + shift and np.max(times) + shift <= end:
            return float(shift)
    return None
