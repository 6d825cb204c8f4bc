"""What the common points of two images do not tell: tests of a relative orientation, each with its message."""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError
from jaxphoto.orientation.bending import bends, typical_errors
from jaxphoto.orientation.coplanarity import RayPairs, essential, misclosures, moved
from jaxphoto.orientation.quaternions import best_rotations
from jaxphoto.orientation.relative_steps import RelativeOrientation

_OPEN = 0.1  # rad: a standard deviation beyond which an orientation is no start for anything
_SAME_PLACE = 3.0  # parallaxes below so many times their noise are none
_QUANTILE = 0.8  # of the points; their parallax counts, so that a few near ones suffice and a few false ones do not
_FALSE_ALARM = np.log(1e-2)


def check_determined(one: RelativeOrientation, images: str) -> None:
    """Raises BlockError where a direction of the five unknowns is open."""
    if not _sigma(one) < _OPEN:
        raise _open(one, images)


def check_described(one: RelativeOrientation, images: str) -> None:
    """Raises BlockError where the covariance does not tell the errors."""
    if not one.described:
        raise _open(one, images)


def is_described(one: RelativeOrientation, pairs: RayPairs) -> bool:
    """Whether errors are as the covariance says (see `bending`); of `pairs`, all points, those that agree count."""
    pairs = pairs.take(one.agrees)
    noise = max(1.0, np.nan_to_num(one.sigma0))
    steps = typical_errors(np.linalg.inv(one.covariance), noise)
    places = moved(one.camera_2_from_camera_1[None], one.base[None], steps)
    costs = np.sum(misclosures(essential(*places), pairs) ** 2, axis=1)
    least = np.sum(misclosures(essential(one.camera_2_from_camera_1, one.base)[None], pairs) ** 2)
    return not bends(costs - least, 5, noise)


def _sigma(one: RelativeOrientation) -> float:
    """Of the direction that is told worst (rad)."""
    return float(np.sqrt(np.linalg.eigvalsh(one.covariance)[-1])) if np.isfinite(one.covariance).all() else np.inf


def _open(one: RelativeOrientation, images: str) -> BlockError:
    sigma = _sigma(one)
    known = f"to {np.rad2deg(sigma):.2g} deg only" if sigma < 3 else "not at all"
    return BlockError(
        f"the common points of {images} determine their relative orientation {known}, as few points, points on a "
        "line, close together or on a critical surface do: measure points that spread over both images, near and "
        "far"
    )


def check_not_a_line(pairs: RayPairs, images: str) -> None:
    """Raises BlockError where the rays of an image lie in one plane, but for noise: its points are on a line."""
    for rays, noise in ((pairs.rays_1, pairs.noise_1), (pairs.rays_2, pairs.noise_2)):
        across = np.linalg.svd(rays, compute_uv=False)[2] / np.sqrt(len(rays))
        if across < _SAME_PLACE * np.sqrt(0.5 * np.mean(np.sum(noise**2, axis=(1, 2)))):
            raise BlockError(
                f"the common points of {images} lie on a line, which leaves their relative orientation open: measure "
                "points that spread over both images"
            )


def check_parallax(pairs: RayPairs, sigma0: float, images: str) -> None:
    """Raises BlockError where a rotation alone explains the rays, as of images from one place or far scenes.

    `pairs` are the points that agree, `sigma0` their noise in units of the given.
    """
    weights = np.ones(len(pairs.rays_1))
    for _ in range(10):
        rotation = best_rotations(np.einsum("n,ni,nj->ij", weights, pairs.rays_2, pairs.rays_1))
        parallax = np.linalg.norm(pairs.rays_2 - pairs.rays_1 @ rotation.T, axis=1)
        weights = 1 / np.maximum(parallax, 1e-3 * np.median(parallax) + 1e-15)
    # Noise in two axes from two images: Rayleigh's distribution.
    variance = 0.5 * (np.sum(pairs.noise_1**2, axis=(1, 2)) + np.sum(pairs.noise_2**2, axis=(1, 2)))
    noise = np.sqrt(np.median(variance) * -2 * np.log(1 - _QUANTILE)) * (sigma0 if np.isfinite(sigma0) else 1.0)
    size = np.quantile(parallax, _QUANTILE)
    if size < max(_SAME_PLACE * noise, 1e-12):
        raise BlockError(
            f"{images} were taken from one place, as far as their common points tell (parallaxes {size:.1e} rad, of "
            f"which {noise:.1e} rad are noise): use a pair with a longer base"
        )


def check_not_chance(matrix: Float[np.ndarray, "3 3"], pairs: RayPairs, agrees: int, limit: float, images: str):
    """Raises BlockError where as many points would agree with the best of all orientations if all were false.

    The share of false matches that agree is that of wrong partners, each point with those of others. Of the n points,
    five fix an orientation; more than chance is what the binomial distribution, times the number of fives, makes less
    probable than 1 % (a contrario: Moisan and Stival 2004, Int. J. Computer Vision 57(3)).
    """
    n = len(pairs.rays_1)
    if n <= 5:
        return
    shifts = np.unique(np.linspace(1, n - 1, min(10, n - 1)).astype(int))
    false = [pairs._replace(rays_2=np.roll(pairs.rays_2, s, 0), noise_2=np.roll(pairs.noise_2, s, 0)) for s in shifts]
    value = np.concatenate([np.abs(misclosures(matrix[None], wrong)[0]) for wrong in false])
    hits = np.sum(value < limit)
    # Of few points no wrong partner may agree: then half of the median misclosure counts as evenly spread.
    chance = (hits + 1) / (len(value) + 2) if hits else min(0.5, 0.5 * limit / np.median(value))
    chance = np.clip(chance, 1e-6, 0.999)
    share = min((agrees - 5) / (n - 5), 1 - 1e-12)
    # Chernoff's bound of the binomial tail, and the logarithm of the number of fives.
    tail = 0.0
    if share > chance:
        tail = -(n - 5) * (share * np.log(share / chance) + (1 - share) * np.log((1 - share) / (1 - chance)))
    fives = np.sum(np.log(n - np.arange(5))) - np.log(120)
    if tail + fives > _FALSE_ALARM:
        raise BlockError(
            f"{agrees} of {n} common points of {images} agree with the best relative orientation, and as many would if "
            "all were false: match them with a stricter ratio, or leave the pair out"
        )
