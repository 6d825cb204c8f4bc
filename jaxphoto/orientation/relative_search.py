"""Starts of a relative orientation: what random fives of points say that most other points agree with.

The fives are always the same ones for as many points, so a result can be had again. A few hundred points judge; an
orientation costs each judge its squared misclosure, a gross error no more than the limit.
"""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError
from jaxphoto.orientation.coplanarity import RayPairs, behind, essential, misclosures
from jaxphoto.orientation.essential import linear_essential, orientations
from jaxphoto.orientation.five_point import five_point_essentials

_FIVES = 60  # at a time
_BATCHES = 40  # at most: three in four false matches still leave two fives of true ones
_GOOD_FIVES = 12.0  # to be expected: one alone may be a poor one, of points close together
_JUDGES = 300
_LIMIT = 6.0  # standard deviations; wider than a blunder, because five points leave errors of their own
_BEST = 16  # essential matrices that are looked at for the points in front
_STARTS = 6
_APART = np.deg2rad(3.0)  # starts closer to one another than this in rotation and base lead to the same result


def candidates(pairs: RayPairs) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """Rotations `camera_2_from_camera_1` and bases (unit vectors) worth adjusting, best first; none may be found."""
    n = len(pairs.rays_1)
    rng = np.random.default_rng(0)
    judges = pairs if n <= _JUDGES else pairs.take(np.sort(rng.choice(n, _JUDGES, replace=False)))
    best, costs = np.zeros((0, 3, 3)), np.zeros(0)
    for batch in range(1, _BATCHES + 1):
        fives = _fives(rng, n)
        found = five_point_essentials(pairs.rays_1[fives], pairs.rays_2[fives])
        best, costs = _kept(np.concatenate([best, found]), np.concatenate([costs, _costs(found, judges)]))
        if len(costs):
            share = np.mean(np.abs(misclosures(best[:1], judges)) < _LIMIT)
            if batch * _FIVES * share**5 > _GOOD_FIVES:
                break
    if not len(costs):
        return []
    best = np.concatenate([best, _linear(best[:1], pairs)])
    rotations, bases = (part.reshape(-1, *part.shape[2:]) for part in orientations(best))
    # A point behind a camera costs as much as a gross error.
    squares = np.minimum(misclosures(essential(rotations, bases), judges) ** 2, _LIMIT**2)
    costs = np.where(behind(rotations, bases, judges, _LIMIT), _LIMIT**2, squares).sum(axis=1)
    return _distinct(rotations, bases, np.argsort(costs, kind="stable"))


def _fives(rng: np.random.Generator, n: int):
    """Indices (fives, 5) of different points."""
    if n < 50:
        return np.argsort(rng.random((_FIVES, n)), axis=1)[:, :5]
    drawn = np.sort(rng.integers(n, size=(2 * _FIVES, 5)), axis=1)
    return drawn[np.all(np.diff(drawn, axis=1) > 0, axis=1)][:_FIVES]


def _costs(essentials, judges: RayPairs):
    return np.minimum(misclosures(essentials, judges) ** 2, _LIMIT**2).sum(axis=1)


def _kept(essentials, costs):
    order = np.argsort(costs, kind="stable")[:_BEST]
    return essentials[order], costs[order]


def _linear(best, pairs: RayPairs):
    """The linear solution of all points that agree with the best five, which has less noise; none of a flat scene."""
    agrees = np.abs(misclosures(best, pairs)[0]) < _LIMIT
    try:
        return linear_essential(pairs.rays_1[agrees], pairs.rays_2[agrees])[None]
    except BlockError:
        return np.zeros((0, 3, 3))


def _distinct(rotations, bases, order):
    """The first of every group of like orientations, `_STARTS` at most."""
    chosen: list[int] = []
    for k in order:
        if all(_angle(rotations[k], bases[k], rotations[i], bases[i]) > _APART for i in chosen):
            chosen.append(k)
        if len(chosen) == _STARTS:
            break
    return [(rotations[k], bases[k]) for k in chosen]


def _angle(rotation, base, other_rotation, other_base) -> float:
    """The larger of the angles (rad) between two rotations and two bases."""
    turn = np.arccos(np.clip(0.5 * (np.sum(rotation * other_rotation) - 1), -1, 1))
    return max(turn, np.arccos(np.clip(base @ other_base, -1, 1)))
