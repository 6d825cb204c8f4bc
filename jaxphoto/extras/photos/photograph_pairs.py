"""Selection of photograph pairs to match: all, neighbours in sequence or position, or the most similar ones.

Similarity is the number of matches of the few widest features. It costs a thousandth of matching all features; wide
features are visible at all image scales (Wu 2013, Towards linear-time incremental structure from motion).
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int, UInt8

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import FEATURES, OF_FEW, SiftFeatures
from jaxphoto.io.photographs import Photograph

_EARTH_M = 6_371_000.0
# Default number of neighbours: contains all overlapping photographs at 80 % end and side overlap.
_NEAREST = 20
FEW = 2 * _NEAREST
"""Maximum number of photographs for which all pairs are matched (with more features each)."""

LARGEST = 300
"""Number of widest features compared."""
# Maximum ratio of the nearest to the second nearest distance (Lowe).
_RATIO = 0.8
# Number of photographs compared with one photograph in a batch; limits memory.
_AT_ONCE = 32
# Minimum number of matches of the widest features; fewer may match by chance.
_MIN_VOTES = 2


class MostSimilar(NamedTuple):
    """Request for the pairs of each photograph with its `number` most similar photographs."""

    number: int


def usual_choice(photographs: Sequence[Photograph]) -> str:
    """Return the default choice of pairs: all for few photographs, otherwise neighbours by position if known, otherwise
    similar ones.
    """
    if len(photographs) <= FEW:
        return "exhaustive"
    return f"{'position' if all(p.gps for p in photographs) else 'similar'}:{_NEAREST}"


def usual_count(photographs: int) -> int:
    """Return the default maximum number of features per photograph for N photographs."""
    return OF_FEW if photographs <= FEW else FEATURES


def photograph_pairs(
    photographs: Sequence[Photograph], choice: str = "exhaustive"
) -> list[tuple[int, int]] | MostSimilar:
    """Return index pairs (first < second) selected by `choice`.

    `exhaustive`: all pairs. `sequence:K`: each photograph with the next K in the given order. `position:K`: each with
    the K nearest by horizontal EXIF GPS position. `similar:K`: each with the K most similar (selected by
    `match_photographs`).

    Raises InputError for an invalid choice, and for `position` if a photograph has no position.
    """
    name, _, number = choice.partition(":")
    if name == "exhaustive" and not number:
        return list(itertools.combinations(range(len(photographs)), 2))
    if name not in ("sequence", "position", "similar") or not number.isdecimal() or int(number) < 1:
        raise InputError(
            f"unknown choice of pairs {choice!r}; give exhaustive, sequence:K, position:K or similar:K with a "
            "whole number K, for example sequence:10"
        )
    if name == "similar":
        return MostSimilar(int(number))
    if name == "sequence":
        n = len(photographs)
        return [(k, other) for k in range(n) for other in range(k + 1, min(n, k + 1 + int(number)))]
    without = [p.path.name for p in photographs if p.gps is None]
    if without:
        raise InputError(
            f"{len(without)} photograph(s) have no GPS position in their EXIF ({', '.join(without[:5])}); choose the "
            "pairs by similar:K, sequence:K or exhaustive"
        )
    places = np.deg2rad([(p.gps.longitude_deg, p.gps.latitude_deg) for p in photographs if p.gps])
    longitude, latitude = places.reshape(-1, 2).T
    level = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    return nearest_pairs(_EARTH_M * level.T, int(number))


def nearest_pairs(positions_m: Float[np.ndarray, "n axes"], count: int) -> list[tuple[int, int]]:
    """Return index pairs (first < second) in which one is among the `count` nearest of the other."""
    n = len(positions_m)
    _, near = scipy.spatial.cKDTree(positions_m).query(positions_m, k=range(1, min(count + 1, n) + 1))
    return sorted({(min(k, j), max(k, j)) for k in range(n) for j in near[k].tolist() if j != k})


def largest_of(features: SiftFeatures) -> UInt8[np.ndarray, "_ 128"]:
    """Return the descriptors of the `LARGEST` widest features."""
    width = features.sigma_mm[features.feature]
    return features.descriptors[np.sort(np.argsort(-width, kind="stable")[:LARGEST])]


def most_similar(
    largest: Sequence[UInt8[np.ndarray, "_ 128"]], count: int, progress: Callable[[int, int], None]
) -> list[tuple[int, int]]:
    """Return index pairs (first < second) in which one is among the `count` photographs most similar to the other.

    `largest`: descriptors of up to `LARGEST` widest features per photograph.
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
    return sorted({(min(a, b), max(a, b)) for a in range(n) for b in order[a].tolist() if votes[a, b] >= _MIN_VOTES})


def _votes(one: UInt8[np.ndarray, "_ 128"], others: Sequence[UInt8[np.ndarray, "_ 128"]]) -> Int[np.ndarray, "others"]:
    """Count the descriptors of `one` that pass the ratio test in each of `others`."""
    if len(one) == 0:
        return np.zeros(len(others), int)
    # Pad up to LARGEST descriptors at infinite distance.
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
    return ((first[:, :, 0] < _RATIO**2 * second) & np.isfinite(second)).sum(axis=0)
