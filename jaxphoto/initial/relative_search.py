"""Starts of a relative orientation from random fives of points, judged by most other points.

The fives depend on the number of points alone, so results are reproducible. A few hundred points are judges; an
orientation costs each judge its squared misclosure, a gross error no more than the limit.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from jaxphoto.initial.coplanarity import RayPairs, behind, essential, misclosures
from jaxphoto.initial.five_point import five_point_essentials, orientations
from jaxphoto.initial.homography import homographies, homography_orientations, transfer_errors

_FIVES = 60  # at a time
_BATCHES = 40  # at most: three in four false matches still leave two fives of true ones
_GOOD_FIVES = 12.0  # to be expected: one alone may be a poor one, of points close together
_JUDGES = 300
_LIMIT = 6.0  # standard deviations; wider than a blunder, because five points leave errors of their own
_FEW, _NEARLY = 8, 0.1  # of so few points, essential matrices with imaginary parts are starts, too
_FOURS = 20  # of the fives, of which four points make a homography
_OFF_PLANE = 8.0  # `_LIMIT` of points and a homography, which four have more errors of
_PLANE, _LEAST_PLANE = 0.2, 6  # least fraction and number of the points that make a plane
_BEST = 16  # essential matrices whose orientations are tested for the points in front
_STARTS, _STARTS_OF_FEW = 8, 40
_APART = np.deg2rad(3.0)  # starts closer to one another than this in rotation and base lead to the same result


def candidates(pairs: RayPairs) -> tuple[Float[np.ndarray, "starts 3 3"], Float[np.ndarray, "starts 3"]]:
    """Rotations `camera_2_from_camera_1` and bases (unit vectors) worth adjusting; possibly none."""
    n = len(pairs.rays_1)
    rng = np.random.default_rng(0)
    judges = pairs if n <= _JUDGES else pairs.take(np.sort(rng.choice(n, _JUDGES, replace=False)))
    best, costs = np.zeros((0, 3, 3)), np.zeros(0)
    plane, least = np.zeros((0, 3, 3)), np.inf
    for batch in range(1, _BATCHES + 1):
        fives = _fives(rng, n)
        new = five_point_essentials(pairs.rays_1[fives], pairs.rays_2[fives], 1e-9 if n > _FEW else _NEARLY)
        new_costs = np.minimum(misclosures(new, judges) ** 2, _LIMIT**2).sum(axis=1)
        best, costs = np.concatenate([best, new]), np.concatenate([costs, new_costs])
        order = np.argsort(costs, kind="stable")[: _BEST if n > _FEW else None]
        best, costs = best[order], costs[order]
        flat = homographies(pairs.rays_1[fives[:_FOURS, :4]], pairs.rays_2[fives[:_FOURS, :4]])
        misfits = np.minimum(transfer_errors(flat, judges) ** 2, _OFF_PLANE**2).sum(axis=1)
        if np.min(misfits) < least:
            plane, least = flat[np.argmin(misfits)][None], float(np.min(misfits))
        if len(costs):
            fraction = np.mean(np.abs(misclosures(best[:1], judges)) < _LIMIT)
            if n <= _FEW or batch * _FIVES * fraction**5 > _GOOD_FIVES:
                break
    if not len(costs):
        return best, np.zeros((0, 3))
    rotations, bases = (part.reshape(-1, *part.shape[2:]) for part in orientations(best))
    of_plane = _of_plane(plane, pairs)
    if of_plane:
        rotations = np.concatenate([[rotation for rotation, _ in of_plane], rotations])
        bases = np.concatenate([[base for _, base in of_plane], bases])
    # A point behind a camera costs as much as a gross error.
    squares = np.minimum(misclosures(essential(rotations, bases), judges) ** 2, _LIMIT**2)
    costs = np.where(behind(rotations, bases, judges, _LIMIT), _LIMIT**2, squares).sum(axis=1)
    # Both orientations of a plane are adjusted, whatever they cost before.
    costs[: len(of_plane)] = -1
    chosen: list[int] = []
    angles = 0.5 * (rotations.reshape(-1, 9) @ rotations.reshape(-1, 9).T - 1)
    far = np.minimum(angles, bases @ bases.T) < np.cos(_APART)
    for k in np.argsort(costs, kind="stable"):
        if far[k, chosen].all() and len(chosen) < (_STARTS if n > _FEW else _STARTS_OF_FEW):
            chosen.append(int(k))
    return rotations[chosen], bases[chosen]


def _of_plane(plane, pairs: RayPairs):
    """Return the orientations of the homography of the points that agree with it; none where these are few."""
    for _ in range(3):
        agrees = transfer_errors(plane, pairs)[0] < _OFF_PLANE
        if agrees.sum() < max(_LEAST_PLANE, _PLANE * len(agrees)):
            return []
        plane = homographies(pairs.rays_1[agrees][None], pairs.rays_2[agrees][None])
    return homography_orientations(plane[0], pairs.rays_1[agrees])


def _fives(rng: np.random.Generator, n: int):
    """Return indices (fives, 5) of different points: all, of a few points."""
    if n <= _FEW:
        return np.array(list(combinations(range(n), 5)))
    if n < 50:
        return np.argsort(rng.random((_FIVES, n)), axis=1)[:, :5]
    drawn = np.sort(rng.integers(n, size=(2 * _FIVES, 5)), axis=1)
    return drawn[np.all(np.diff(drawn, axis=1) > 0, axis=1)][:_FIVES]
