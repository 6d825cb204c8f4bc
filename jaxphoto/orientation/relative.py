"""Relative orientation of two images from their common points, false matches among them or not.

1. Essential matrices of random fives of points (`five_point`), always the same fives; of each the truncated squared
   misclosures of a few hundred points. Of fours of them homographies, and both orientations of the best: a flat scene
   has two.
2. The best few that differ, as rotation and base with the points in front of both cameras.
3. From all of them least squares with the coplanarity condition (`relative_steps`), blunders tested anew until none
   changes. The best is the result; another one that fits as well is not hidden.
4. What the rays do not determine is told: too few points, points on a line or on a critical surface, errors that no
   covariance describes (`bending`), images from one place, agreement no better than chance.
"""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError, counted
from jaxphoto.orientation.coplanarity import RayPairs, essential
from jaxphoto.orientation.relative_search import candidates
from jaxphoto.orientation.relative_steps import BLUNDER, RelativeOrientation, adjusted
from jaxphoto.orientation.relative_tests import (
    check_described,
    check_determined,
    check_not_a_line,
    check_not_chance,
    check_parallax,
    is_described,
)

_SOME = 400  # points that choose among starts


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

    Raises BlockError where there are fewer than five points, a ray is no number, they lie on a line or leave the
    orientation open by more than 0.1 rad or by more than a covariance can tell, the images were taken from one place as
    far as the points tell, no more points agree than by chance, and where two orientations fit equally well, such as
    of a flat scene (see `relative_orientations`). ValueError where `sigma_rad` is not positive or there are not as
    many rays of the one as of the other.

    Sources: docs/orientation.md; Mikhail, Bethel and McGlone (2001), "Introduction to Modern Photogrammetry".
    """
    found = relative_orientations(rays_1, rays_2, sigma_rad, robust, images)
    for one in found:
        check_described(one, images)
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

    Where one is not `described`, it is a start of an adjustment, but its covariance says little. Arguments and errors
    are those of `relative_orientation`, but for that and the last.
    """
    rays_1, rays_2 = np.asarray(rays_1, float), np.asarray(rays_2, float)
    if len(rays_1) != len(rays_2):
        raise ValueError(f"rays belong together in pairs, but there are {len(rays_1)} and {len(rays_2)}")
    finite = np.isfinite(rays_1).all(axis=1) & np.isfinite(rays_2).all(axis=1)
    if not finite.all():
        raise BlockError(f"{np.sum(~finite)} of the {len(finite)} rays of {images} are no numbers: leave them out")
    if not sigma_rad > 0:
        raise ValueError(f"the standard deviation of image coordinates is positive, but sigma_rad is {sigma_rad}")
    n = len(np.unique(np.column_stack([rays_1, rays_2]), axis=0)) if len(rays_1) < 50 else len(rays_1)
    if n < 5:
        raise BlockError(
            f"{images} have {counted(n, 'point')} in common and a relative orientation needs 5: match or measure more"
        )
    pairs = RayPairs.of(rays_1, rays_2, sigma_rad)
    rotations, bases = candidates(pairs)
    if n > _SOME:
        some = adjusted(rotations, bases, pairs.take(np.sort(np.random.default_rng(1).choice(n, _SOME, False))), robust)
        rotations = np.array([one.camera_2_from_camera_1 for one in some]).reshape(-1, 3, 3)
        bases = np.array([one.base for one in some]).reshape(-1, 3)
    if not len(rotations):
        raise BlockError(
            f"no five of the {n} points that {images} have in common give a relative orientation, as points on a line "
            "and false matches do not: measure points that spread over the images"
        )
    found = adjusted(rotations, bases, pairs, robust)
    if not found:
        raise BlockError(
            f"no relative orientation has five points of {images} in front of both cameras: check the matches, the "
            "axes of the image coordinates and c_mm"
        )
    best = found[0]
    used = pairs.take(best.agrees)
    check_not_a_line(used, images)
    if robust:
        check_not_chance(
            essential(best.camera_2_from_camera_1, best.base), pairs, int(best.agrees.sum()), BLUNDER, images
        )
    check_parallax(used, best.sigma0, images)
    for one in found:
        check_determined(one, images)
    return [one._replace(described=is_described(one, pairs)) for one in found]


def _angle(one: RelativeOrientation, other: RelativeOrientation) -> float:
    """Angle (rad) between the rotations."""
    trace = np.sum(one.camera_2_from_camera_1 * other.camera_2_from_camera_1)
    return float(np.arccos(np.clip(0.5 * (trace - 1), -1, 1)))
