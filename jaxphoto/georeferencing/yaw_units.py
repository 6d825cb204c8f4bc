"""Detection of yaw angles in radians that were read as degrees, by comparison with the direction of flight."""

import numpy as np
from jaxtyping import Float

# Minimum mean cosine between yaw and course for the correct unit (allows for the crab angle); maximum for the wrong
# unit.
_ALIKE, _UNLIKE = 0.8, 0.7
_FEWEST = 4


def counts_in_radians(yaw: Float[np.ndarray, "n"], course: Float[np.ndarray, "n"]) -> bool:
    """Return True if `yaw` agrees with the `course` (rad) when interpreted in radians, but not in degrees.

    Valid degrees are never misclassified: crab angles are far below 90 degrees in any wind.
    """
    if len(course) < _FEWEST or np.abs(yaw).max() > 2 * np.pi:
        return False
    as_radians, as_degrees = np.cos(yaw - course).mean(), np.cos(np.deg2rad(yaw) - course).mean()
    return bool(as_radians >= _ALIKE and as_degrees <= _UNLIKE)
