"""Relative orientation of two images from their common points, false matches among them or not.

1. Essential matrices of random fives of points (`five_point`), always the same fives; of each the truncated squared
   misclosures of a few hundred points.
2. The best few that differ, as rotation and base with the points in front of both cameras.
3. From each of them least squares with the coplanarity condition (`coplanarity`), blunders tested anew until none
   changes. The best is the result; another one that fits as well is not hidden.
4. What the rays do not determine is told: too few points, points on a line or on a critical surface, images from one
   place, agreement no better than chance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.errors import BlockError
from jaxphoto.orientation.coplanarity import (
    RayPairs,
    behind,
    error_directions,
    essential,
    fitted,
    linearised,
    misclosures,
    tangent_plane,
)
from jaxphoto.orientation.relative_search import candidates
from jaxphoto.orientation.relative_tests import check_determined, check_not_a_line, check_not_chance, check_parallax

BLUNDER = 3.3
"""Misclosures beyond so many standard deviations are gross errors."""
_FIRST = 10.0  # the same while the orientation is still that of five points
_ROUNDS = 20
_ROUGHLY = 0.03  # standard deviations, to test blunders with
_SOME = 400  # points that choose among starts
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


def relative_orientation(
    rays_1: Float[np.ndarray, "n 3"],
    rays_2: Float[np.ndarray, "n 3"],
    sigma_rad: float,
    robust: bool = True,
    images: str = "the two images",
) -> RelativeOrientation:
    """Relative orientation of two images from the unit rays of their common points, in the camera frames.

        x_2' R (B x x_1) = 0,   R = camera_2_from_camera_1,   |B| = 1

    Rows of `rays_1` and `rays_2` belong together. `sigma_rad` is the standard deviation of an image coordinate as a
    fraction of c (the angle at the principal point; see `ray_noise`). With `robust`, up to half of the pairs and more
    may be false; without, all count. `images` names the two for messages.

    Raises BlockError where there are fewer than five points, they lie on a line or leave the orientation open by more
    than 0.1 rad, the images were taken from one place as far as the points tell, no more points agree than by chance,
    and where two orientations fit equally well, such as of a flat scene (see `relative_orientations`).

    Sources: docs/orientation.md; Mikhail, Bethel and McGlone (2001), "Introduction to Modern Photogrammetry".
    """
    found = relative_orientations(rays_1, rays_2, sigma_rad, robust, images)
    if len(found) > 1:
        apart = np.rad2deg(_angle(found[0], found[1]))
        raise BlockError(
            f"{len(found)} relative orientations of {images} fit their {len(rays_1)} common points equally well (the "
            f"first two turned by {apart:.1f} deg), as points of a flat scene and few points may: measure points off "
            "the plane, or decide with a third image (relative_orientations gives them all)"
        )
    return found[0]


def relative_orientations(
    rays_1: Float[np.ndarray, "n 3"],
    rays_2: Float[np.ndarray, "n 3"],
    sigma_rad: float,
    robust: bool = True,
    images: str = "the two images",
) -> list[RelativeOrientation]:
    """The relative orientation, best first, and those that fit as well as the best: `relative_orientation`, undecided.

    Arguments and errors are those of `relative_orientation`, but for the last.
    """
    rays_1, rays_2 = np.asarray(rays_1, float), np.asarray(rays_2, float)
    if len(rays_1) != len(rays_2):
        raise ValueError(f"rays belong together in pairs, but there are {len(rays_1)} and {len(rays_2)}")
    n = len(np.unique(np.column_stack([rays_1, rays_2]), axis=0)) if len(rays_1) < 50 else len(rays_1)
    if n < 5:
        raise BlockError(
            f"{images} have {n} points in common and a relative orientation needs 5: match or measure more"
        )
    pairs = RayPairs.of(rays_1, rays_2, sigma_rad)
    starts = _worthwhile(candidates(pairs), pairs, robust)
    if not starts:
        raise BlockError(
            f"no five of the {n} points that {images} have in common give a relative orientation, as points on a line "
            "and false matches do not: measure points that spread over the images"
        )
    found = _as_good(_judged(starts, pairs, robust), pairs)
    if not found:
        raise BlockError(
            f"no relative orientation has five points of {images} in front of both cameras: check the matches, the "
            "axes of the image coordinates and c_mm"
        )
    best = found[0]
    used = pairs.take(best.agrees)
    rotation = best.camera_2_from_camera_1
    if robust:
        check_not_chance(essential(rotation, best.base), pairs, int(best.agrees.sum()), BLUNDER, images)
    check_not_a_line(used, images)
    check_parallax(used, best.sigma0, images)
    check_determined(fitted(rotation, best.base, used).normal, images)
    return found


def _worthwhile(starts, pairs: RayPairs, robust: bool):
    """The starts that some of the points, adjusted, do not tell to be worse than the best, or the same as a better."""
    n = len(pairs.rays_1)
    if n <= _SOME:
        return starts
    some = pairs.take(np.sort(np.random.default_rng(1).choice(n, _SOME, replace=False)))
    judged = _judged(starts, some, robust)
    return [(one.camera_2_from_camera_1, one.base) for one in _as_good(judged, some)]


def _judged(starts, pairs: RayPairs, robust: bool) -> list[tuple[float, RelativeOrientation]]:
    """Costs and orientations, adjusted, that differ from one another; best first."""
    judged: list[tuple[float, RelativeOrientation]] = []
    for rotation, base in starts:
        one = _adjusted(rotation, base, pairs, robust)
        if one is not None and not any(_same(one, other) for _, other in judged):
            judged.append((_cost(one, pairs, robust), one))
    return sorted(judged, key=lambda pair: pair[0])


def _as_good(judged: list[tuple[float, RelativeOrientation]], pairs: RayPairs) -> list[RelativeOrientation]:
    """The best, and those whose squared misclosures are no larger than noise may make them."""
    if not judged:
        return []
    cost, best = judged[0]
    scale = np.nanmax([1.0, best.sigma0]) ** 2
    return [best, *(one for value, one in judged[1:] if value - cost < scale * _allowance(best, one, pairs))]


def _adjusted(rotation, base, pairs: RayPairs, robust: bool) -> RelativeOrientation | None:
    """Least squares from a start, gross errors tested anew until none changes; None where less than five agree."""
    agrees = np.ones(len(pairs.rays_1), bool)
    if robust:
        agrees = _agreeing(rotation, base, pairs, _FIRST)
        for _ in range(_ROUNDS):
            if agrees.sum() < 5:
                return None
            rotation, base, normal = fitted(rotation, base, pairs.take(agrees), _ROUGHLY)
            again = _retested(rotation, base, normal, pairs, agrees)
            same, agrees = np.array_equal(again, agrees), again
            if same:
                break
    if agrees.sum() < 5:
        return None
    rotation, base, normal = fitted(rotation, base, pairs.take(agrees))
    if np.count_nonzero(behind(rotation[None], base[None], pairs.take(agrees), BLUNDER)):
        return None
    used = pairs.take(agrees)
    value = misclosures(essential(rotation, base)[None], used)[0]
    redundancy = len(value) - 5
    x_1, x_2 = used.rays_1, used.rays_2 @ rotation
    angle = np.arctan2(np.linalg.norm(np.cross(x_1, x_2), axis=1), np.sum(x_1 * x_2, axis=1))
    return RelativeOrientation(
        rotation,
        base,
        _inverse(normal),
        float(np.sqrt(value @ value / redundancy)) if redundancy else np.nan,
        agrees,
        float(np.median(angle)),
    )


def _inverse(normal):
    """Covariance from the normal matrix; infinite where that is singular."""
    values, vectors = np.linalg.eigh(normal)
    return (
        vectors / np.maximum(values, 1e-300) @ vectors.T if values[0] > 1e-13 * values[-1] else np.full((5, 5), np.inf)
    )


def _agreeing(rotation, base, pairs: RayPairs, sigmas: float) -> Bool[np.ndarray, " n"]:
    """The points in front of both cameras with a misclosure below so many standard deviations."""
    value = misclosures(essential(rotation, base)[None], pairs)[0]
    return (np.abs(value) < sigmas) & ~behind(rotation[None], base[None], pairs, sigmas)[0]


def _retested(rotation, base, normal, pairs: RayPairs, agrees) -> Bool[np.ndarray, " n"]:
    """The points that agree, each misclosure over its own standard deviation after the adjustment.

    That of a point that took part is sqrt(1 - h) with its leverage h, so that one that drew the orientation to itself
    is found out (Baarda's test). One that all others together could not find out, the usual end of a false match with
    an odd parallax, does not agree either.
    """
    covariance = _inverse(normal)
    if not np.isfinite(covariance).all():
        return agrees
    value, slope = linearised(rotation, base, pairs)
    leverage = np.sum(slope @ covariance * slope, axis=1)
    # Of a point that took no part: what it would have.
    as_part = np.where(agrees, leverage, leverage / (1 + leverage))
    variance = np.where(agrees, 1 - leverage, 1 + leverage)
    good = np.abs(value) < BLUNDER * np.sqrt(np.maximum(variance, 1e-6))
    if agrees.sum() >= _MANY:
        good &= as_part < np.clip(_TAKING / agrees.sum(), *_UNCHECKED)
    else:
        good |= as_part > 1 - 1e-6
    return good & ~behind(rotation[None], base[None], pairs, BLUNDER)[0]


def _cost(one: RelativeOrientation, pairs: RayPairs, robust: bool) -> float:
    """Squared misclosures, those of gross errors the square of the limit."""
    value = misclosures(essential(one.camera_2_from_camera_1, one.base)[None], pairs)[0] ** 2
    return float(np.where(one.agrees, value, BLUNDER**2).sum() if robust else value.sum())


def _allowance(best: RelativeOrientation, other: RelativeOrientation, pairs: RayPairs) -> float:
    """By how much the squared misclosures of an orientation as true as the best may be larger.

    Of two orientations that both fit but for noise, such as of a flat scene, each point's squared misclosures differ
    with the variance 4 (1 - r^2), where r is their correlation.
    """
    rows = pairs.take(best.agrees & other.agrees)
    one, two = (error_directions(o.camera_2_from_camera_1, o.base, rows) for o in (best, other))
    return _AS_GOOD + 3 * float(np.sqrt(np.sum(4 * (1 - np.minimum(np.sum(one * two, axis=1) ** 2, 1)))))


def _angle(one: RelativeOrientation, other: RelativeOrientation) -> float:
    """Angle (rad) between the rotations."""
    trace = np.sum(one.camera_2_from_camera_1 * other.camera_2_from_camera_1)
    return float(np.arccos(np.clip(0.5 * (trace - 1), -1, 1)))


def _same(one: RelativeOrientation, other: RelativeOrientation) -> bool:
    """Whether two orientations differ by no more than a few standard deviations, or than rounding."""
    rotation = one.camera_2_from_camera_1 @ other.camera_2_from_camera_1.T
    turn = np.array([rotation[1, 2] - rotation[2, 1], rotation[2, 0] - rotation[0, 2], rotation[0, 1] - rotation[1, 0]])
    apart = np.concatenate([0.5 * turn, tangent_plane(other.base).T @ one.base])
    near = np.trace(rotation) > 0 and one.base @ other.base > 0
    limit = _APART * np.sqrt(np.diagonal(other.covariance)) * max(1.0, np.nan_to_num(other.sigma0)) + 1e-6
    return bool(near and np.all(np.abs(apart) < limit))
