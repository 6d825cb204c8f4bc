"""Angles in radians that are read as degrees, told by the direction of flight."""

import numpy as np
from jaxtyping import Float

# Means of the cosine between yaw and course: the crab angle leaves more than the first, and both readings are told
# apart below the second.
_ALIKE, _UNLIKE = 0.8, 0.7
_FEWEST = 4


def counts_in_radians(yaw: Float[np.ndarray, "n"], course: Float[np.ndarray, "n"]) -> bool:
    """Whether the numbers `yaw` follow the `course` (rad) when read as radians, and do not when read as degrees.

    Honest degrees are safe: read as degrees they follow the flight themselves, whatever the wind, because no aircraft
    flies sideways.
    """
    if len(course) < _FEWEST or np.abs(yaw).max() > 2 * np.pi:
        return False
    as_radians, as_degrees = np.cos(yaw - course).mean(), np.cos(np.deg2rad(yaw) - course).mean()
    return bool(as_radians >= _ALIKE and as_degrees <= _UNLIKE)
