"""Initial relative orientations from random samples of five points, scored by the other points.

The samples depend only on the number of points, so results are reproducible. A few hundred points score each
orientation by their squared misclosures, limited to the square of `_LIMIT` for gross errors.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from jaxphoto.initial.coplanarity import RayPairs, behind, essential, misclosures
from jaxphoto.initial.five_point import five_point_essentials, orientations
from jaxphoto.initial.homography import homographies, homography_orientations, transfer_errors

_FIVES = 60  # samples of five points per batch
_BATCHES = 40  # maximum number of batches: with 75 % false matches they still contain two samples without any
_GOOD_FIVES = 12.0  # expected number of samples without false matches; more than one, as close points give poor results
_JUDGES = 300
_LIMIT = 6.0  # standard deviations; larger than for blunders, because a sample of five has errors of its own
_FEW, _NEARLY = 8, 0.1  # for up to `_FEW` points, accept essential matrices with imaginary parts up to `_NEARLY`
_FOURS = 20  # number of samples whose first four points define a homography
_OFF_PLANE = 8.0  # standard deviations; larger than `_LIMIT`, as a homography of four points has larger errors
_PLANE, _LEAST_PLANE = 0.2, 6  # minimum fraction and number of points in a plane
_BEST = 16  # maximum number of essential matrices to decompose
_STARTS, _STARTS_OF_FEW = 8, 40
_APART = np.deg2rad(3.0)  # minimum difference in rotation and base of two starts


def candidates(pairs: RayPairs) -> tuple[Float[np.ndarray, "starts 3 3"], Float[np.ndarray, "starts 3"]]:
    """Return rotations `camera_2_from_camera_1` and bases (unit vectors) to adjust; may be empty."""
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
    # Always adjust both orientations of a plane, whatever their cost.
    costs[: len(of_plane)] = -1
    chosen: list[int] = []
    angles = 0.5 * (rotations.reshape(-1, 9) @ rotations.reshape(-1, 9).T - 1)
    far = np.minimum(angles, bases @ bases.T) < np.cos(_APART)
    for k in np.argsort(costs, kind="stable"):
        if far[k, chosen].all() and len(chosen) < (_STARTS if n > _FEW else _STARTS_OF_FEW):
            chosen.append(int(k))
    return rotations[chosen], bases[chosen]


def _of_plane(plane, pairs: RayPairs):
    """Return the orientations of the homography estimated from its inliers; empty if these are few."""
    for _ in range(3):
        agrees = transfer_errors(plane, pairs)[0] < _OFF_PLANE
        if agrees.sum() < max(_LEAST_PLANE, _PLANE * len(agrees)):
            return []
        plane = homographies(pairs.rays_1[agrees][None], pairs.rays_2[agrees][None])
    return homography_orientations(plane[0], pairs.rays_1[agrees])


def _fives(rng: np.random.Generator, n: int):
    """Return indices (samples, 5) of distinct points; all combinations if there are few points."""
    if n <= _FEW:
        return np.array(list(combinations(range(n), 5)))
    if n < 50:
        return np.argsort(rng.random((_FIVES, n)), axis=1)[:, :5]
    drawn = np.sort(rng.integers(n, size=(2 * _FIVES, 5)), axis=1)
    return drawn[np.all(np.diff(drawn, axis=1) > 0, axis=1)][:_FIVES]
