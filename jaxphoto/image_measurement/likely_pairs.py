"""Which photographs look alike: those whose few largest features match, which takes a thousandth of matching all.

Large features are few and seen from everywhere (Wu 2013, Towards linear-time incremental structure from motion). Of two
photographs that overlap several of the largest hundreds match; of others hardly any passes the ratio test.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int, UInt8

from jaxphoto.image_measurement.descriptors import RATIO
from jaxphoto.image_measurement.features import SiftFeatures

LARGEST = 300
"""Features of a photograph that are compared, those of the largest width."""
# Photographs whose products with one are in memory at a time.
_AT_ONCE = 32
# Fewer matches among the largest come by chance.
_LEAST = 2


def largest_of(features: SiftFeatures) -> UInt8[np.ndarray, "_ 128"]:
    """The descriptors of the `LARGEST` widest features."""
    width = features.sigma_mm[features.feature]
    return features.descriptors[np.sort(np.argsort(-width, kind="stable")[:LARGEST])]


def most_alike(
    largest: Sequence[UInt8[np.ndarray, "_ 128"]], count: int, progress: Callable[[int, int], None]
) -> list[tuple[int, int]]:
    """The pairs (first < second) in which one is among the `count` photographs that the other matches most.

    `largest` are descriptors of each photograph, `LARGEST` or fewer of its widest features.
    """
    n = len(largest)
    votes = np.zeros((n, n), int)
    for a in range(n):
        for begin in range(a + 1, n, _AT_ONCE):
            part = slice(begin, min(n, begin + _AT_ONCE))
            votes[a, part] = _votes(largest[a], largest[part])
        progress(a + 1, n)
    votes += votes.T
    order = np.argsort(-votes, axis=1, kind="stable")[:, :count]
    return sorted({(min(a, b), max(a, b)) for a in range(n) for b in order[a].tolist() if votes[a, b] >= _LEAST})


def _votes(one: UInt8[np.ndarray, "_ 128"], others: Sequence[UInt8[np.ndarray, "_ 128"]]) -> Int[np.ndarray, "others"]:
    """How many of `one` have in each of `others` a nearest descriptor that is clearly nearer than the second."""
    if len(one) == 0:
        return np.zeros(len(others), int)
    # What is missing to LARGEST is as far as can be.
    b = np.zeros((len(others), LARGEST, 128), np.float32)
    square = np.full((len(others), LARGEST), np.inf, np.float32)
    for k, other in enumerate(others):
        b[k, : len(other)] = other
        square[k, : len(other)] = np.square(other.astype(np.float32)).sum(axis=1)
    a = one.astype(np.float32)
    apart = square.reshape(-1) - 2 * (a @ b.reshape(-1, 128).T)
    apart += np.square(a).sum(axis=1)[:, None]
    apart = apart.reshape(len(a), len(others), LARGEST)
    nearest = apart.argmin(axis=2)
    first = np.take_along_axis(apart, nearest[:, :, None], axis=2)
    np.put_along_axis(apart, nearest[:, :, None], np.inf, axis=2)
    second = apart.min(axis=2)
    return ((first[:, :, 0] < RATIO**2 * second) & np.isfinite(second)).sum(axis=0)
