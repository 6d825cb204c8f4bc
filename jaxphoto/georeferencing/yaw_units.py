"""Detection of angles in radians read as degrees, by the direction of flight."""

import numpy as np
from jaxtyping import Float

# Mean cosine between yaw and course: the crab angle leaves more than the first; the readings differ below the second.
_ALIKE, _UNLIKE = 0.8, 0.7
_FEWEST = 4


def counts_in_radians(yaw: Float[np.ndarray, "n"], course: Float[np.ndarray, "n"]) -> bool:
    """Return True if the numbers `yaw` follow the `course` (rad) when read as radians, but not when read as degrees.

    Valid degrees are never misjudged: they follow the flight, whatever the wind, because no aircraft flies sideways.
    """
    if len(course) < _FEWEST or np.abs(yaw).max() > 2 * np.pi:
        return False
    as_radians, as_degrees = np.cos(yaw - course).mean(), np.cos(np.deg2rad(yaw) - course).mean()
    return bool(as_radians >= _ALIKE and as_degrees <= _UNLIKE)
