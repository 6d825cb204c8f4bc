"""Features of two photographs that look alike: each nearest to the other, and clearly nearer than a third."""

import numpy as np
from jaxtyping import Int

from jaxphoto.image_measurement.features import SiftFeatures

RATIO = 0.8
"""Lowe's: how much nearer the best match must be than the second best."""
# Rows of a table of all products that the cache of a processor holds.
_ROWS = 256


def match_descriptors(one: SiftFeatures, other: SiftFeatures) -> Int[np.ndarray, "matches 2"]:
    """Features of two photographs that look alike: indices in `one` and `other`, each feature once at most.

    The nearest descriptor must be below 0.8 of the distance of the second, and so must it be seen from the other side.
    """
    a, b = one.descriptors.astype(np.float32), other.descriptors.astype(np.float32)
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), int)
    rows = np.arange(len(a))
    best, clear = _nearest(a, b)
    rows, best = rows[clear], best[clear]
    # From the other side only where it matters.
    columns, where = np.unique(best, return_inverse=True)
    back, clear_back = _nearest(b[columns], a)
    mutual = (back[where] == rows) & clear_back[where]
    pairs = np.column_stack([one.feature[rows[mutual]], other.feature[best[mutual]]])
    # A place with several descriptors may match twice.
    pairs = np.unique(pairs, axis=0)
    once = np.ones(len(pairs), bool)
    for side in pairs.T:
        _, inverse, times = np.unique(side, return_inverse=True, return_counts=True)
        once &= times[inverse] == 1
    return pairs[once]


def _nearest(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each row of `a` the nearest of `b`, and whether it is clearly nearer than the second.

    |a - b|^2 = |a|^2 - (2 a.b - |b|^2). All are whole numbers below 2^24, which single precision holds exactly: no
    order of summation, and so no number of threads, changes a match.
    """
    turned = np.concatenate([2 * a, np.full((len(a), 1), -1, np.float32)], axis=1)
    upright = np.concatenate([b, np.square(b).sum(axis=1, keepdims=True)], axis=1).T
    best, clear = np.zeros(len(a), int), np.zeros(len(a), bool)
    for begin in range(0, len(a), _ROWS):
        part = slice(begin, begin + _ROWS)
        score = turned[part] @ upright
        rows = np.arange(len(score))
        nearest = score.argmax(axis=1)
        square = np.square(a[part]).sum(axis=1)
        first = square - score[rows, nearest]
        score[rows, nearest] = -np.inf
        second = square - score.max(axis=1)
        best[part], clear[part] = nearest, first < RATIO**2 * second
    return best, clear
