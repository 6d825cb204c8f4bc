"""Initial image triplet and orientation of further images from relative orientations of pairs.

Rotation: each oriented image i that forms a pair with the new image k gives `R_ik M_i`; the unit quaternions are
averaged. Position: each such image gives a line through its projection centre; the lines are intersected.

Source: He and Habib (2014), "Linear approach for initial recovery of the exterior orientation parameters of randomly
captured images by low-cost mobile mapping systems", ISPRS Archives XL-1. The criteria for the triplet are ours.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.initial.quaternions import best_rotations

_PARALLEL = np.deg2rad(3.0)  # lines at a smaller angle are parallel
_CLOSED = np.deg2rad(2.0)  # maximum misclosure of the rotations of a triplet
_SPREAD = np.deg2rad(10.0)  # minimum angle between the bases of a triplet
_WIDE = np.deg2rad(5.0)  # median ray angle below which a pair's points are downweighted


class DirectedPoint(NamedTuple):
    """Projection centre intersected from directions."""

    position: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    """In squared units of the position if the weights are rad^-2."""


def average_rotation(
    rotations: Float[np.ndarray, "n 3 3"], weights: Float[np.ndarray, " n"] | None = None
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Return the average rotation, and the weighted root mean square (rad) of the angles to it.

    The average is the eigenvector of the largest eigenvalue of sum w q q', with unit quaternions q of any sign.
    """
    w = np.ones(len(rotations)) if weights is None else np.asarray(weights, float)
    average = best_rotations(np.einsum("n,nij->ij", w, rotations))
    # Compute angles from the chord: the arc cosine of the trace loses half of the digits.
    chord = np.linalg.norm(rotations - average, axis=(1, 2))
    angles = 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))
    return average, float(np.sqrt(np.sum(w * angles**2) / np.sum(w)))


def intersect_directions(
    positions: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"] | None = None,
) -> DirectedPoint | None:
    """Intersect the lines from known `positions` along unit `directions`; None if they are nearly parallel.

        sum w / D^2 (I - d d') (X - position) = 0,   D = |X - position|

    `weights` of the directions are the inverse of their variance (rad^-2) or proportional to it. The lines are parallel
    if X and all positions are collinear: then only the direction to X is determined. Returns None if X lies behind most
    of the positions.
    """
    w = np.ones(len(positions)) if weights is None else np.asarray(weights, float)
    sine = np.linalg.norm(np.cross(directions[:, None], directions[None]), axis=2)
    if len(positions) < 2 or sine.max() < np.sin(_PARALLEL):
        return None
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    origin, scale = positions.mean(axis=0), np.ones(len(positions))
    local = positions - origin
    for _ in range(5):
        normal = np.einsum("n,nij->ij", w * scale, across)
        point = np.linalg.solve(normal, np.einsum("n,nij,nj->i", w * scale, across, local))
        distance = np.linalg.norm(point - local, axis=1)
        # The error across a line grows in proportion to the distance along it.
        scale = 1 / np.maximum(distance, 1e-3 * distance.max()) ** 2
    ahead = np.sum(directions * (point - local), axis=1) > 0
    if w[ahead].sum() < 0.5 * w.sum():
        return None
    return DirectedPoint(origin + point, np.linalg.inv(np.einsum("n,nij->ij", w * scale, across)))


def best_triplet(pairs: Sequence[Any]) -> tuple[int, int, int] | None:
    """Return the best three images to start from; None if no three pairs have consistent rotations.

    A pair has the indices `first` and `second` of its images, the rotation `second_from_first` between the camera
    frames, the `base` (unit vector to the second centre in the first camera's frame), the number `n` of consistent
    points and the median `angle` (rad) between their rays. It may be given several times, with orientations that fit
    equally well.

    Three pairs are consistent if the rotation |R_ki R_jk R_ij - I| is small. The best triplet has the most points in
    its weakest pair; points with narrow ray angles are downweighted. Triplets with parallel bases are used only if
    there are no others.
    """
    by_ends: dict[tuple[int, int], list[Any]] = defaultdict(list)
    for pair in pairs:
        by_ends[min(pair.first, pair.second), max(pair.first, pair.second)].append(pair)
    worth = {ends: max(p.n * min(1.0, p.angle / _WIDE) for p in same) for ends, same in by_ends.items()}
    after: dict[int, set[int]] = defaultdict(set)
    for i, j in by_ends:
        after[i].add(j)
    triplets = [(i, j, k) for i, j in by_ends for k in after[i] & after.get(j, set())]
    sides = {t: ((t[0], t[1]), (t[1], t[2]), (t[0], t[2])) for t in triplets}
    flat: tuple[int, int, int] | None = None
    for triplet in sorted(triplets, key=lambda t: (-min(worth[s] for s in sides[t]), t)):
        closed = [trio for trio in product(*(by_ends[s] for s in sides[triplet])) if _closes(*trio)]
        if any(_spans(*trio) for trio in closed):
            return triplet
        if closed and flat is None:
            flat = triplet
    return flat


def _of(pair):
    """Return rotation and base of a pair from the lower index to the higher."""
    if pair.first < pair.second:
        return pair.second_from_first, pair.base
    return pair.second_from_first.T, -pair.second_from_first @ pair.base


def _closes(ij, jk, ik) -> bool:
    """Return True if the three rotations are consistent."""
    chord = np.linalg.norm(_of(jk)[0] @ _of(ij)[0] - _of(ik)[0])
    return bool(2 * np.arcsin(min(chord / np.sqrt(8), 1.0)) < _CLOSED)


def _spans(ij, jk, ik) -> bool:
    """Return True if the three bases, in the frame of image i, are coplanar and not parallel."""
    turn, first = _of(ij)
    second, third = turn.T @ _of(jk)[1], _of(ik)[1]
    products = [np.cross(first, second), np.cross(second, third), np.cross(first, third)]
    sines = np.linalg.norm(products, axis=1)
    if np.min(sines) < np.sin(_SPREAD):
        return False
    return bool(abs(first @ products[1]) < np.sin(_SPREAD) * np.min(sines))
