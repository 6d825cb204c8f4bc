"""Which photographs to compare: each with each, with neighbours in the row or in space, or with what looks alike."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.image_measurement.features import FEATURES, OF_FEW
from jaxphoto.io.photographs import Photograph

_EARTH_M = 6_371_000.0
# So many of each are compared where photographs are many: as far as those of four fifths overlap still show the same,
# in all directions.
_NEAREST = 20
FEW = 2 * _NEAREST
"""Photographs of which each is compared with each, and many features of each are found."""


class MostAlike(NamedTuple):
    """Each photograph with the `number` that look most like it, which their features tell."""

    number: int


def usual_choice(photographs: Sequence[Photograph]) -> str:
    """The choice of pairs where nobody makes one: all of few, else neighbours, else those that look alike."""
    if len(photographs) <= FEW:
        return "exhaustive"
    return f"{'position' if all(p.gps for p in photographs) else 'similar'}:{_NEAREST}"


def usual_count(photographs: int) -> int:
    """Features of each of so many photographs, at most, where nobody says how many."""
    return OF_FEW if photographs <= FEW else FEATURES


def photograph_pairs(
    photographs: Sequence[Photograph], choice: str = "exhaustive"
) -> list[tuple[int, int]] | MostAlike:
    """The pairs (first < second) of indices of photographs that `choice` names.

    `exhaustive`: all; for many photographs they are too many. `sequence:K`: each with the K that follow it in the order
    given. `position:K`: each with the K nearest by the GPS positions of EXIF, heights left out.
    `similar:K`: each with the K that look most like it, for `match_photographs` to find.

    Raises InputError for another choice, and for `position` where a photograph has no position.
    """
    name, _, number = choice.partition(":")
    if name == "exhaustive" and not number:
        return list(itertools.combinations(range(len(photographs)), 2))
    if name not in ("sequence", "position", "similar") or not number.isdecimal() or int(number) < 1:
        raise InputError(
            f"the choice of pairs is {choice!r}; give exhaustive, sequence:K, position:K or similar:K with a "
            "whole number K, for example sequence:10"
        )
    if name == "similar":
        return MostAlike(int(number))
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
    """The pairs (first < second) in which one is among the `count` nearest of the other."""
    n = len(positions_m)
    _, near = scipy.spatial.cKDTree(positions_m).query(positions_m, k=range(1, min(count + 1, n) + 1))
    return sorted({(min(k, j), max(k, j)) for k in range(n) for j in near[k].tolist() if j != k})
