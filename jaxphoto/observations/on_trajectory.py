"""Column names and validation of rows on a trajectory."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import ArrayLike

# Maximum deviation of the sum of weights, and of the length of a normal, from 1; allows for rounding in files.
_OFF = 1e-3


def knot_columns(side: str = "") -> dict[str, tuple[str, ...]]:
    """Return the column names of knots and their weights."""
    return {f"{name}s{side}": tuple(f"{name}{side}_{k}" for k in range(1, 5)) for name in ("knot", "weight")}


def pose_columns(place: str, side: str = "") -> dict[str, tuple[str, ...]]:
    """Return the column names of a measured point, and of pose and motion of the scanner."""
    return {
        **{f"{name}{side}": tuple(f"{name}{side}_{x}_m" for x in "XYZ") for name in (place, "scanner")},
        f"roll_pitch_yaw{side}": tuple(f"{angle}{side}_deg" for angle in ("roll", "pitch", "yaw")),
        f"velocity{side}": tuple(f"velocity{side}_{x}_m_per_s" for x in "XYZ"),
        f"rate{side}": tuple(f"rate{side}_{x}_deg_per_s" for x in ("right", "forward", "up")),
    }


NORMAL = {"normal": ("normal_X", "normal_Y", "normal_Z")}


def weight_flaws(weights: Float[ArrayLike, "n 4"]) -> Iterator[tuple[int, str]]:
    """Yield (row, message) for every row whose interpolation weights do not sum to 1."""
    total = np.asarray(weights).sum(axis=1)
    for row in np.flatnonzero(np.abs(total - 1) > _OFF):
        yield int(row), f"the weights of its knots add up to {total[row]:.4f}; give weights that add up to 1"


def normal_flaws(normal: Float[ArrayLike, "n 3"]) -> Iterator[tuple[int, str]]:
    """Yield (row, message) for every row whose normal is not a unit vector."""
    length = np.linalg.norm(np.asarray(normal), axis=1)
    for row in np.flatnonzero(np.abs(length - 1) > _OFF):
        yield int(row), f"the normal has the length {length[row]:.4f}; give a unit vector"
