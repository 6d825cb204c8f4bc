"""Relative orientation of two images from their common points, with or without false matches.

1. Generate essential matrices from random samples of five points, and both orientations of the best homography
   (`relative_search`).
2. Adjust the coplanarity condition by least squares from all of these starts. After each adjustment repeat the test for
   gross errors, until the set of accepted points is constant. Each start has its own set; starts that converge to the
   same orientation are merged.
3. Return the best orientation and those that fit equally well.
4. Test for undetermined results: too few points, points on a line or a critical surface, errors not described by a
   covariance (`nonlinearity`), no base, agreement no better than chance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.errors import BlockError, counted
from jaxphoto.initial.coplanarity import (
    RayPairs,
    RelativeFits,
    behind,
    error_directions,
    essential,
    fit,
    misclosures,
    moved,
    tangent_plane,
)
from jaxphoto.initial.nonlinearity import is_nonlinear, typical_errors
from jaxphoto.initial.quaternions import best_rotations
from jaxphoto.initial.relative_search import candidates

BLUNDER = 3.3
"""Number of standard deviations above which a misclosure is a gross error."""
_SAMPLE = 400  # number of points for comparing starts
_FIRST = 10.0  # limit of gross errors (sigmas) while the orientation is from five points only
_ITERATIONS = 20
_ROUGHLY = 0.03  # convergence limit (sigmas) before a test for blunders
_SAME_WAY = 0.1  # maximum distance (sigmas) of starts that converge to the same orientation
# With at least `_MANY` points, the maximum leverage of a point is `_LEVERAGE` over their number, within these limits.
_MANY, _LEVERAGE, _UNCHECKED = 12, 25.0, (0.3, 0.9)
_AS_GOOD = 9.0  # maximum difference of squared misclosures of equally good orientations: three standard deviations
_APART = 5.0  # minimum difference (sigmas) of distinct orientations
_OPEN = 0.1  # maximum standard deviation (rad) of a usable orientation
_SAME_PLACE = 3.0  # minimum ratio of parallax to its noise
_QUANTILE = 0.8  # quantile of the parallaxes to test: robust to a few near points and a few false ones
_FALSE_ALARM = np.log(1e-2)


class RelativeOrientation(NamedTuple):
    """Orientation of image 2 relative to image 1; the length of the base is unknown."""

    camera_2_from_camera_1: Float[np.ndarray, "3 3"]
    base: Float[np.ndarray, "3"]
    """Unit vector from projection centre 1 to 2, in the frame of camera 1."""
    covariance: Float[np.ndarray, "5 5"]
    """A priori covariance (rad^2) of a small rotation in the frame of camera 2 and a shift of the base along the
    columns of `tangent_plane(base)`; multiply by `sigma0`^2 for the a posteriori one.
    """
    sigma0: float
    """Square root of the sum of squared misclosures over the redundancy; NaN without redundancy."""
    agrees: Bool[np.ndarray, " n"]
    """True for the points used: in front of both cameras, misclosure below `BLUNDER` sigmas, checked by others."""
    parallactic_angle: float
    """Median angle (rad) between the rays of the points used."""
    described: bool = True
    """True if the covariance describes the errors (see `nonlinearity`)."""


def relative_orientation(
    rays_1: Float[np.ndarray, "n 3"],
    rays_2: Float[np.ndarray, "n 3"],
    sigma_rad: float,
    robust: bool = True,
    images: str = "the two images",
) -> RelativeOrientation:
    """Estimate the relative orientation of two images from unit rays of their common points, in the camera frames.

        x_2' R (B x x_1) = 0,   R = camera_2_from_camera_1,   |B| = 1

    Rows of `rays_1` and `rays_2` correspond. `sigma_rad` is the standard deviation of an image coordinate as a fraction
    of c (the angle at the principal point; see `ray_noise`). With `robust`, half of the pairs and more may be false;
    otherwise all are used. `images` names the two for messages.

    Raises BlockError for: fewer than five points; a ray that is not a number; points on a line; a standard deviation
    above 0.1 rad, or errors not described by a covariance; no significant base; no more consistent points than by
    chance; two orientations that fit equally well, as for a flat scene (see `relative_orientations`). Raises ValueError
    if `sigma_rad` is not positive or the numbers of rays differ.

    Sources: docs/photographs.md; Mikhail, Bethel and McGlone (2001), "Introduction to Modern Photogrammetry".
    """
    all_that_fit = relative_orientations(rays_1, rays_2, sigma_rad, robust, images)
    for one in all_that_fit:
        check_described(one, images)
    if len(all_that_fit) > 1:
        trace = np.sum(all_that_fit[0].camera_2_from_camera_1 * all_that_fit[1].camera_2_from_camera_1)
        angle = np.rad2deg(np.arccos(np.clip(0.5 * (trace - 1), -1, 1)))
        raise BlockError(
            f"{len(all_that_fit)} relative orientations of {images} fit their {len(rays_1)} common points equally well "
            f"(the first two differ by {angle:.1f} deg), typical of a flat scene or few points: measure points "
            "off the plane, or decide with a third image (relative_orientations gives them all)"
        )
    return all_that_fit[0]


def relative_orientations(
    rays_1: Float[np.ndarray, "n 3"],
    rays_2: Float[np.ndarray, "n 3"],
    sigma_rad: float,
    robust: bool = True,
    images: str = "the two images",
) -> list[RelativeOrientation]:
    """Return the relative orientation, best first, and all others that fit equally well.

    An orientation that is not `described` is suitable as approximate value, but its covariance is unreliable. For
    arguments and other errors see `relative_orientation`.
    """
    rays_1, rays_2 = np.asarray(rays_1, float), np.asarray(rays_2, float)
    if len(rays_1) != len(rays_2):
        raise ValueError(f"rays must be pairs, got {len(rays_1)} and {len(rays_2)}")
    finite = np.isfinite(rays_1).all(axis=1) & np.isfinite(rays_2).all(axis=1)
    if not finite.all():
        raise BlockError(f"{np.sum(~finite)} of the {len(finite)} rays of {images} are NaN or infinite: remove them")
    if not sigma_rad > 0:
        raise ValueError(f"sigma_rad, the standard deviation of image coordinates, must be positive, got {sigma_rad}")
    n = len(np.unique(np.column_stack([rays_1, rays_2]), axis=0)) if len(rays_1) < 50 else len(rays_1)
    if n < 5:
        raise BlockError(
            f"{images} have {counted(n, 'point')} in common, a relative orientation needs 5: match or measure more"
        )
    pairs = RayPairs.of(rays_1, rays_2, sigma_rad)
    rotations, bases = candidates(pairs)
    if n > _SAMPLE and len(rotations):
        sample = np.sort(np.random.default_rng(1).choice(n, _SAMPLE, False))
        of_sample = _adjusted(rotations, bases, pairs.take(sample), robust)
        rotations = np.array([one.camera_2_from_camera_1 for one in of_sample]).reshape(-1, 3, 3)
        bases = np.array([one.base for one in of_sample]).reshape(-1, 3)
    orientations = _adjusted(rotations, bases, pairs, robust) if len(rotations) else []
    if not orientations:
        raise BlockError(
            f"relative orientation of {images} failed: no five of {n} common points are in front of both cameras. "
            "Check for false matches, collinear points, image axes and c_mm; measure well-distributed points"
        )
    best = orientations[0]
    used = pairs.take(best.agrees)
    _check_not_a_line(used, images)
    if robust:
        _check_not_chance(best, pairs, images)
    _check_parallax(used, best.sigma0, images)
    for one in orientations:
        if not _sigma(one) < _OPEN:
            raise _open(one, images)
    return [one._replace(described=_is_described(one, pairs)) for one in orientations]


def _adjusted(rotations, bases, pairs: RayPairs, robust: bool) -> list[RelativeOrientation]:
    """Return the distinct orientations adjusted from the starts, best first, without significantly worse ones.

    With `robust`, gross errors are rejected. Starts with fewer than five accepted points are discarded.
    """
    agrees = np.ones((len(rotations), len(pairs.rays_1)), bool)
    if robust:
        value = misclosures(essential(rotations, bases), pairs)
        agrees = (np.abs(value) < _FIRST) & ~behind(rotations, bases, pairs, _FIRST)
        for iteration in range(_ITERATIONS):
            enough = agrees.sum(axis=1) >= 5
            if not enough.any():
                return []
            fits = fit(rotations[enough], bases[enough], pairs, agrees[enough], _ROUGHLY)
            retested = _retested(fits, pairs, agrees[enough])
            converged = np.array_equal(retested, agrees[enough])
            rotations, bases, agrees = fits.rotations, fits.bases, retested
            if converged:
                break
            if iteration == 1:
                rest = _worthwhile(fits, retested, pairs)
                rotations, bases, agrees = rotations[rest], bases[rest], agrees[rest]
    enough = agrees.sum(axis=1) >= 5
    if not enough.any():
        return []
    fits = fit(rotations[enough], bases[enough], pairs, agrees[enough])
    return _as_good(_distinct(fits, pairs, agrees[enough], robust), pairs)


def _retested(fits: RelativeFits, pairs: RayPairs, agrees) -> Bool[np.ndarray, "m n"]:
    """Return the accepted points: each misclosure is tested with its own standard deviation after adjustment (Baarda).

    For a point that was used this is sqrt(1 - h), with its leverage h: a point that dominates the orientation is
    detected. Points that all others cannot check, typically false matches with an exceptional parallax, are rejected.
    """
    covariances = _inverses(fits.normals)
    determined = np.isfinite(covariances).all(axis=(1, 2))
    leverage = np.sum(fits.slopes @ np.where(determined[:, None, None], covariances, 0.0) * fits.slopes, axis=2)
    # Leverage if the point were used.
    as_part = np.where(agrees, leverage, leverage / (1 + leverage))
    variance = np.where(agrees, 1 - leverage, 1 + leverage)
    good = np.abs(fits.values) < BLUNDER * np.sqrt(np.maximum(variance, 1e-6))
    count = agrees.sum(axis=1, keepdims=True)
    checked = as_part < np.clip(_LEVERAGE / count, *_UNCHECKED)
    good = np.where(count >= _MANY, good & checked, good | (as_part > 1 - 1e-6))
    good &= ~behind(fits.rotations, fits.bases, pairs, BLUNDER)
    return np.where(determined[:, None], good, agrees)


def _worthwhile(fits: RelativeFits, agrees, pairs: RayPairs) -> list[int]:
    """Select starts that may still become the best, one per group that converges to one orientation."""
    squares = fits.values**2
    costs = np.where(agrees, squares, BLUNDER**2).sum(axis=1)
    best = int(np.argmin(costs))
    scale = max(1.0, squares[best][agrees[best]].sum() / max(int(agrees[best].sum()) - 5, 1))
    # The limit of `_allowance`, doubled for gross errors not yet found.
    near = costs - costs[best] < 2 * scale * (_AS_GOOD + 6 * np.sqrt(len(pairs.rays_1)))
    places = np.concatenate([fits.rotations.reshape(-1, 9), fits.bases], axis=1)
    limits = _SAME_WAY * np.sqrt(np.trace(_inverses(fits.normals), axis1=1, axis2=2)) + 1e-9
    chosen: list[int] = []
    for k in np.argsort(costs, kind="stable"):
        same = any(np.linalg.norm(places[k] - places[i]) < min(limits[k], limits[i], 1.0) for i in chosen)
        if near[k] and not same:
            chosen.append(int(k))
    return chosen


def _distinct(fits: RelativeFits, pairs: RayPairs, agrees, robust: bool) -> list[tuple[float, RelativeOrientation]]:
    """Return costs and distinct orientations, best first."""
    wrong = np.any(behind(fits.rotations, fits.bases, pairs, BLUNDER) & agrees, axis=1)
    # Sum of squared misclosures; gross errors contribute the square of the limit.
    squares = fits.values**2
    costs = np.where(agrees, squares, BLUNDER**2 if robust else squares).sum(axis=1)
    covariances = _inverses(fits.normals)
    ends: list[tuple[float, RelativeOrientation]] = []
    for k in np.argsort(costs, kind="stable"):
        x_1, x_2 = pairs.rays_1[agrees[k]], pairs.rays_2[agrees[k]] @ fits.rotations[k]
        angle = np.arctan2(np.linalg.norm(np.cross(x_1, x_2), axis=1), np.sum(x_1 * x_2, axis=1))
        sigma0 = float(np.sqrt(squares[k][agrees[k]].sum() / (len(x_1) - 5))) if len(x_1) > 5 else np.nan
        one = RelativeOrientation(
            fits.rotations[k], fits.bases[k], covariances[k], sigma0, agrees[k], float(np.median(angle))
        )
        if not wrong[k] and not any(_same(one, other) for _, other in ends):
            ends.append((float(costs[k]), one))
    return ends


def _same(one: RelativeOrientation, other: RelativeOrientation) -> bool:
    """Return True if two orientations differ by no more than a few standard deviations, or by rounding."""
    rotation = one.camera_2_from_camera_1 @ other.camera_2_from_camera_1.T
    theta = np.array(
        [rotation[1, 2] - rotation[2, 1], rotation[2, 0] - rotation[0, 2], rotation[0, 1] - rotation[1, 0]]
    )
    apart = np.concatenate([0.5 * theta, tangent_plane(other.base).T @ one.base])
    near = np.trace(rotation) > 0 and one.base @ other.base > 0
    limit = _APART * np.sqrt(np.diagonal(other.covariance)) * max(1.0, np.nan_to_num(other.sigma0)) + 1e-6
    return bool(near and np.all(np.abs(apart) < limit))


def _as_good(ends: list[tuple[float, RelativeOrientation]], pairs: RayPairs) -> list[RelativeOrientation]:
    """Return the best orientation, and those whose squared misclosures exceed its own only by noise.

    If the best has few points, discard orientations that fit five of them and reject the others as gross errors.
    """
    if not ends:
        return []
    cost, best = ends[0]
    few = best.agrees.sum() < _MANY
    used = pairs.take(best.agrees)
    scale = np.nanmax([1.0, best.sigma0]) ** 2
    as_good = [best]
    for value, one in ends[1:]:
        more = value - cost
        if few:
            missed = misclosures(essential(one.camera_2_from_camera_1, one.base)[None], used)
            more = float(np.sum(missed**2)) - (cost - BLUNDER**2 * np.sum(~best.agrees))
        if more < scale * _allowance(best, one, pairs):
            as_good.append(one)
    return as_good


def _allowance(best: RelativeOrientation, other: RelativeOrientation, pairs: RayPairs) -> float:
    """Return the maximum difference of squared misclosures between the best and an equally likely orientation.

    If both orientations fit except for noise, as for a flat scene, the difference of a point's squared misclosures has
    the variance 4 (1 - r^2), where r is the correlation of both misclosures.
    """
    rows = pairs.take(best.agrees & other.agrees)
    one, two = (error_directions(o.camera_2_from_camera_1, o.base, rows) for o in (best, other))
    return _AS_GOOD + 3 * float(np.sqrt(np.sum(4 * (1 - np.minimum(np.sum(one * two, axis=1) ** 2, 1)))))


def _inverses(normals: Float[np.ndarray, "m 5 5"]) -> Float[np.ndarray, "m 5 5"]:
    """Invert normal matrices; infinite where one is singular."""
    values, vectors = np.linalg.eigh(normals)
    result = vectors / np.maximum(values, 1e-300)[:, None] @ np.swapaxes(vectors, 1, 2)
    return np.where((values[:, 0] > 1e-13 * values[:, -1])[:, None, None], result, np.inf)


def _is_described(one: RelativeOrientation, pairs: RayPairs) -> bool:
    """Return True if the covariance describes the errors (see `nonlinearity`); uses the accepted points of `pairs`."""
    pairs = pairs.take(one.agrees)
    noise = max(1.0, np.nan_to_num(one.sigma0))
    steps = typical_errors(np.linalg.inv(one.covariance), noise)
    cost = lambda *place: np.sum(misclosures(essential(*place), pairs) ** 2, axis=1)  # noqa: E731
    place = one.camera_2_from_camera_1[None], one.base[None]
    return not is_nonlinear(cost(*moved(*place, steps)) - cost(*place), 5, noise)


def check_described(one: RelativeOrientation, images: str) -> None:
    """Raise BlockError if the covariance does not describe the errors."""
    if not one.described:
        raise _open(one, images)


def _sigma(one: RelativeOrientation) -> float:
    """Return the standard deviation (rad) of the weakest direction."""
    return float(np.sqrt(np.linalg.eigvalsh(one.covariance)[-1])) if np.isfinite(one.covariance).all() else np.inf


def _open(one: RelativeOrientation, images: str) -> BlockError:
    sigma = _sigma(one)
    known = f"to {np.rad2deg(sigma):.2g} deg only" if sigma < 3 else "not at all"
    return BlockError(
        f"the common points of {images} determine their relative orientation {known} (few points, or points on a "
        "line, close together or on a critical surface): measure points that spread over both images, near and far"
    )


def _check_not_a_line(pairs: RayPairs, images: str) -> None:
    """Raise BlockError if the rays of an image are coplanar except for noise: its points are on a line."""
    for rays, noise in ((pairs.rays_1, pairs.noise_1), (pairs.rays_2, pairs.noise_2)):
        across = np.linalg.svd(rays, compute_uv=False)[2] / np.sqrt(len(rays))
        if across < _SAME_PLACE * np.sqrt(0.5 * np.mean(np.sum(noise**2, axis=(1, 2)))):
            raise BlockError(
                f"the common points of {images} lie on a line, their relative orientation is undetermined: measure "
                "points that spread over both images"
            )


def _check_parallax(pairs: RayPairs, sigma0: float, images: str) -> None:
    """Raise BlockError if a rotation alone explains the rays: images from one position, or distant scenes.

    `pairs` are the accepted points, `sigma0` is the ratio of their noise to the a priori one.
    """
    weights = np.ones(len(pairs.rays_1))
    for _ in range(10):
        rotation = best_rotations(np.einsum("n,ni,nj->ij", weights, pairs.rays_2, pairs.rays_1))
        parallax = np.linalg.norm(pairs.rays_2 - pairs.rays_1 @ rotation.T, axis=1)
        weights = 1 / np.maximum(parallax, 1e-3 * np.median(parallax) + 1e-15)
    # Noise in two axes from two images has a Rayleigh distribution.
    variance = 0.5 * (np.sum(pairs.noise_1**2, axis=(1, 2)) + np.sum(pairs.noise_2**2, axis=(1, 2)))
    noise = np.sqrt(np.median(variance) * -2 * np.log(1 - _QUANTILE)) * (sigma0 if np.isfinite(sigma0) else 1.0)
    size = np.quantile(parallax, _QUANTILE)
    if size < max(_SAME_PLACE * noise, 1e-12):
        raise BlockError(
            f"the base of {images} is zero within the noise of their common points (parallaxes {size:.1e} rad, "
            f"noise {noise:.1e} rad): use a pair with a longer base"
        )


def _check_not_chance(best: RelativeOrientation, pairs: RayPairs, images: str) -> None:
    """Raise BlockError if equally many points would be accepted if all matches were false.

    The probability that a false match is accepted is estimated by pairing each point with wrong partners. Five of the n
    points determine an orientation. The result is better than chance if the binomial probability, multiplied by the
    number of samples of five, is below 1 % (a contrario: Moisan and Stival 2004, Int. J. Computer Vision 57(3)).
    """
    n, agrees = len(pairs.rays_1), int(best.agrees.sum())
    if n <= 5:
        return
    matrix = essential(best.camera_2_from_camera_1, best.base)[None]
    shifts = np.unique(np.linspace(1, n - 1, min(10, n - 1)).astype(int))
    false = [pairs._replace(rays_2=np.roll(pairs.rays_2, s, 0), noise_2=np.roll(pairs.noise_2, s, 0)) for s in shifts]
    value = np.concatenate([np.abs(misclosures(matrix, wrong)[0]) for wrong in false])
    hits = np.sum(value < BLUNDER)
    # If no wrong partner is accepted (few points), assume a uniform distribution up to twice the median misclosure.
    chance = (hits + 1) / (len(value) + 2) if hits else min(0.5, 0.5 * BLUNDER / np.median(value))
    chance = np.clip(chance, 1e-6, 0.999)
    fraction = min((agrees - 5) / (n - 5), 1 - 1e-12)
    # Chernoff bound of the binomial tail, and the logarithm of the number of samples of five.
    tail = 0.0
    if fraction > chance:
        tail = fraction * np.log(fraction / chance) + (1 - fraction) * np.log((1 - fraction) / (1 - chance))
    fives = np.sum(np.log(n - np.arange(5))) - np.log(120)
    if fives - (n - 5) * tail > _FALSE_ALARM:
        raise BlockError(
            f"{agrees} of {n} common points of {images} agree with the best relative orientation, no more than "
            "random matches would: match them with a stricter ratio, or skip the pair"
        )
