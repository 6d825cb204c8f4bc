"""The turn of a single strip about its line, which positions leave open: its photographs look down on average."""

import numpy as np
from jaxtyping import Float

LEVEL_DEG = 5.0
"""By which a strip that is flown to look down may hang to one side."""
# Of its length: what is narrower is a line.
_NARROW = 0.1


def is_line(centres: Float[np.ndarray, "n 3"]) -> bool:
    """Whether projection centres are in one line, to a tenth of its length."""
    across = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)
    return bool(across[1] < _NARROW * across[0])


def level_turn(
    centres: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "n 3"],
    backwards: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "3 3"]:
    """The turn of a network to a level frame: its line to that of the `positions`, and on average as upright as can be.

    `backwards` are the axes of the network's cameras against their lines of sight.
    """
    one, other = _axes(_line(centres), backwards.mean(axis=0)), _axes(_line(positions), np.array([0.0, 0.0, 1.0]))
    return other @ one.T


def _line(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """The direction from the first places to the last, by medians: one that is wrong turns it by little."""
    half = len(places) // 2
    apart = places[half:] - places[: len(places) - half]
    return np.median(apart, axis=0)


def _axes(along: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Axes along, across and up as columns."""
    x = along / np.linalg.norm(along)
    y = np.cross(up, x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)
