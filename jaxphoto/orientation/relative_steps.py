"""Relative orientations by least squares from several starts, all at once, with gross errors tested until none changes.

Every start has its own set of points that agree. Starts that come to the same, or to no good, are dropped on the way.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.orientation.coplanarity import (
    RayPairs,
    RelativeFits,
    behind,
    error_directions,
    essential,
    fitted,
    linearised,
    misclosures,
    tangent_plane,
)

BLUNDER = 3.3
"""Misclosures beyond so many standard deviations are gross errors."""
_FIRST = 10.0  # the same while the orientation is still that of five points
_ROUNDS = 20
_ROUGHLY = 0.03  # standard deviations, to test blunders with
_LIKE = 0.1  # starts no further apart than so many standard deviations are on the same way
# Of so many points, none need have a leverage beyond `_TAKING` over their number, within these limits.
_MANY, _TAKING, _UNCHECKED = 12, 25.0, (0.3, 0.9)
_AS_GOOD = 9.0  # squared misclosures by which another orientation may be worse: three standard deviations
_APART = 5.0  # standard deviations between orientations that are not the same one


class RelativeOrientation(NamedTuple):
    """Where image 2 is, seen from image 1; the length of the base is unknown."""

    camera_2_from_camera_1: Float[np.ndarray, "3 3"]
    base: Float[np.ndarray, "3"]
    """Unit vector from projection centre 1 to 2 in the frame of camera 1."""
    covariance: Float[np.ndarray, "5 5"]
    """A priori (rad^2), of a small rotation in the frame of camera 2 and a shift of the base along the two columns of
    `tangent_plane(base)`; times `sigma0`^2 it is a posteriori."""
    sigma0: float
    """Square root of the squared misclosures over the redundancy; NaN without redundancy."""
    agrees: Bool[np.ndarray, " n"]
    """The points that took part: in front of both cameras, with a misclosure below `BLUNDER` sigmas, which the other
    points can check."""
    parallactic_angle: float
    """Median angle (rad) between the rays of the points that agree."""
    described: bool = True
    """Whether typical errors, drawn from the covariance, cost what it says."""


def adjusted(
    rotations: Float[np.ndarray, "m 3 3"], bases: Float[np.ndarray, "m 3"], pairs: RayPairs, robust: bool
) -> list[RelativeOrientation]:
    """The orientations that the starts lead to, best first, and but for the best those only that fit as well.

    With `robust`, gross errors take no part. Starts with less than five points that agree lead to none.
    """
    agrees = np.ones((len(rotations), len(pairs.rays_1)), bool)
    if robust:
        agrees = _agreeing(rotations, bases, pairs, _FIRST)
        for round_ in range(_ROUNDS):
            enough = np.flatnonzero(agrees.sum(axis=1) >= 5)
            if not len(enough):
                return []
            fits = fitted(rotations[enough], bases[enough], pairs, agrees[enough], _ROUGHLY)
            again = _retested(fits, pairs, agrees[enough])
            same = np.array_equal(again, agrees[enough])
            rotations, bases, agrees = fits.rotations, fits.bases, again
            if same:
                break
            if round_ == 1:
                rest = _worthwhile(fits, again, pairs)
                rotations, bases, agrees = rotations[rest], bases[rest], agrees[rest]
    enough = agrees.sum(axis=1) >= 5
    fits = fitted(rotations[enough], bases[enough], pairs, agrees[enough])
    ends = _ends(fits, pairs, agrees[enough], robust)
    return _as_good(ends, pairs)


def _worthwhile(fits: RelativeFits, agrees, pairs: RayPairs):
    """The starts, one of each group on its way to the same orientation, that may still become as good as the best."""
    value = misclosures(essential(fits.rotations, fits.bases), pairs) ** 2
    costs = np.where(agrees, value, BLUNDER**2).sum(axis=1)
    best = int(np.argmin(costs))
    redundancy = max(int(agrees[best].sum()) - 5, 1)
    scale = max(1.0, value[best][agrees[best]].sum() / redundancy)
    # A limit of `_allowance`; and as much again, for the gross errors that are still to be found.
    near = costs - costs[best] < 2 * scale * (_AS_GOOD + 6 * np.sqrt(len(pairs.rays_1)))
    places = np.concatenate([fits.rotations.reshape(-1, 9), fits.bases], axis=1)
    limits = _LIKE * np.sqrt(np.trace(inverses(fits.normals), axis1=1, axis2=2)) + 1e-9
    chosen: list[int] = []
    for k in np.argsort(costs, kind="stable"):
        alike = any(np.linalg.norm(places[k] - places[i]) < min(limits[k], limits[i], 1.0) for i in chosen)
        if near[k] and not alike:
            chosen.append(int(k))
    return chosen


def _ends(fits: RelativeFits, pairs: RayPairs, agrees, robust: bool) -> list[tuple[float, RelativeOrientation]]:
    """Costs and orientations that differ from one another, best first."""
    value = misclosures(essential(fits.rotations, fits.bases), pairs)
    wrong = np.any(behind(fits.rotations, fits.bases, pairs, BLUNDER) & agrees, axis=1)
    # Squared misclosures, those of gross errors the square of the limit.
    costs = np.where(agrees, value**2, BLUNDER**2 if robust else value**2).sum(axis=1)
    ends: list[tuple[float, RelativeOrientation]] = []
    for k in np.argsort(costs, kind="stable"):
        x_1, x_2 = pairs.rays_1[agrees[k]], pairs.rays_2[agrees[k]] @ fits.rotations[k]
        angle = np.arctan2(np.linalg.norm(np.cross(x_1, x_2), axis=1), np.sum(x_1 * x_2, axis=1))
        redundancy = len(x_1) - 5
        one = RelativeOrientation(
            fits.rotations[k],
            fits.bases[k],
            inverses(fits.normals[k : k + 1])[0],
            float(np.sqrt(np.sum(value[k][agrees[k]] ** 2) / redundancy)) if redundancy else np.nan,
            agrees[k],
            float(np.median(angle)),
        )
        if not wrong[k] and not any(_same(one, other) for _, other in ends):
            ends.append((float(costs[k]), one))
    return ends


def _as_good(ends: list[tuple[float, RelativeOrientation]], pairs: RayPairs) -> list[RelativeOrientation]:
    """The best, and those whose squared misclosures are no larger than noise may make them.

    Where the best has few points, an orientation that fits five of them and calls the others gross errors is none.
    """
    if not ends:
        return []
    cost, best = ends[0]
    few = best.agrees.sum() < _MANY
    used = pairs.take(best.agrees)
    scale = np.nanmax([1.0, best.sigma0]) ** 2
    found = [best]
    for value, one in ends[1:]:
        more = value - cost
        if few:
            missed = misclosures(essential(one.camera_2_from_camera_1, one.base)[None], used)
            more = float(np.sum(missed**2)) - (cost - BLUNDER**2 * np.sum(~best.agrees))
        if more < scale * _allowance(best, one, pairs):
            found.append(one)
    return found


def inverses(normals: Float[np.ndarray, "m 5 5"]) -> Float[np.ndarray, "m 5 5"]:
    """Covariances from normal matrices; infinite where one is singular."""
    values, vectors = np.linalg.eigh(normals)
    result = vectors / np.maximum(values, 1e-300)[:, None] @ np.swapaxes(vectors, 1, 2)
    return np.where((values[:, 0] > 1e-13 * values[:, -1])[:, None, None], result, np.inf)


def _agreeing(rotations, bases, pairs: RayPairs, sigmas: float) -> Bool[np.ndarray, "m n"]:
    """The points in front of both cameras with a misclosure below so many standard deviations."""
    value = misclosures(essential(rotations, bases), pairs)
    return (np.abs(value) < sigmas) & ~behind(rotations, bases, pairs, sigmas)


def _retested(fits: RelativeFits, pairs: RayPairs, agrees) -> Bool[np.ndarray, "m n"]:
    """The points that agree, each misclosure over its own standard deviation after the adjustment.

    That of a point that took part is sqrt(1 - h) with its leverage h, so that one that drew the orientation to itself
    is found out (Baarda's test). One that all others together could not find out, the usual end of a false match with
    an odd parallax, does not agree either.
    """
    covariances = inverses(fits.normals)
    determined = np.isfinite(covariances).all(axis=(1, 2))
    value, slope = linearised(fits.rotations, fits.bases, pairs)
    leverage = np.sum(slope @ np.where(determined[:, None, None], covariances, 0.0) * slope, axis=2)
    # Of a point that took no part: what it would have.
    as_part = np.where(agrees, leverage, leverage / (1 + leverage))
    variance = np.where(agrees, 1 - leverage, 1 + leverage)
    good = np.abs(value) < BLUNDER * np.sqrt(np.maximum(variance, 1e-6))
    count = agrees.sum(axis=1, keepdims=True)
    checked = as_part < np.clip(_TAKING / count, *_UNCHECKED)
    good = np.where(count >= _MANY, good & checked, good | (as_part > 1 - 1e-6))
    good &= ~behind(fits.rotations, fits.bases, pairs, BLUNDER)
    return np.where(determined[:, None], good, agrees)


def _allowance(best: RelativeOrientation, other: RelativeOrientation, pairs: RayPairs) -> float:
    """By how much the squared misclosures of an orientation as true as the best may be larger.

    Of two orientations that both fit but for noise, such as of a flat scene, each point's squared misclosures differ
    with the variance 4 (1 - r^2), where r is their correlation.
    """
    rows = pairs.take(best.agrees & other.agrees)
    one, two = (error_directions(o.camera_2_from_camera_1, o.base, rows) for o in (best, other))
    return _AS_GOOD + 3 * float(np.sqrt(np.sum(4 * (1 - np.minimum(np.sum(one * two, axis=1) ** 2, 1)))))


def _same(one: RelativeOrientation, other: RelativeOrientation) -> bool:
    """Whether two orientations differ by no more than a few standard deviations, or than rounding."""
    rotation = one.camera_2_from_camera_1 @ other.camera_2_from_camera_1.T
    turn = np.array([rotation[1, 2] - rotation[2, 1], rotation[2, 0] - rotation[0, 2], rotation[0, 1] - rotation[1, 0]])
    apart = np.concatenate([0.5 * turn, tangent_plane(other.base).T @ one.base])
    near = np.trace(rotation) > 0 and one.base @ other.base > 0
    limit = _APART * np.sqrt(np.diagonal(other.covariance)) * max(1.0, np.nan_to_num(other.sigma0)) + 1e-6
    return bool(near and np.all(np.abs(apart) < limit))
