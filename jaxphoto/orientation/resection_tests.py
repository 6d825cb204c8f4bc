"""What the known points of an image do not tell: tests of a resection, each with its message."""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError
from jaxphoto.orientation.bending import bends, typical_errors
from jaxphoto.orientation.resection_steps import NO_LIMIT, RefinedResections, cost_at, moved

_AS_GOOD = 9.0  # squared residuals by which another orientation may be worse: three standard deviations


def check_determined(found: RefinedResections, best: int, sigma: float, image: str, limit: float) -> None:
    """Raises BlockError where the normal matrix leaves a direction of the six unknowns open.

    `sigma` is the standard deviation of image coordinates as a fraction of c; open is what has a standard deviation
    beyond `limit`, as a fraction of the distance or in rad.
    """
    values = np.linalg.eigvalsh(found.normals[best])
    weakest = sigma / np.sqrt(values[0]) if values[0] > 1e-13 * values[-1] else np.inf
    if not weakest < limit:
        raise BlockError(_open(image))


def check_unique(found: RefinedResections, best: int, sigma: float, image: str) -> None:
    """Raises BlockError where another orientation fits as well as the best."""
    near = found.costs - found.costs[best] < _AS_GOOD * sigma**2
    apart = np.linalg.norm(found.matrices - found.matrices[best], axis=(1, 2))
    # Of the same minimum: closer than its own standard deviations allow it to be told apart.
    same = np.sqrt(np.max(np.diagonal(np.linalg.inv(found.normals[best]))[3:])) * sigma
    if np.any(near & (apart > np.maximum(5 * same, 1e-6))):
        turn = np.rad2deg(2 * np.arcsin(min(float(np.max(apart[near])) / np.sqrt(8), 1.0)))
        raise BlockError(
            f"two orientations of image {image}, turned by {turn:.3g} deg, fit its known points equally well, as few "
            "points and flat figures seen from afar do: measure points off the plane or over more of the "
            "image, or give omega_deg, phi_deg, kappa_deg in images.csv"
        )


def check_linear(
    c_mm: float,
    ideal: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    found: RefinedResections,
    best: int,
    sigma: float,
    image: str,
) -> None:
    """Raises BlockError where the steps came to no end, or the covariance does not tell the errors (`bending`)."""
    steps = typical_errors(found.normals[best], sigma)
    one = slice(best, best + 1)
    places = moved(found.positions[one], found.matrices[one], found.distances[one], steps)
    growth = cost_at(c_mm, ideal, points, *places, NO_LIMIT) - found.costs[best]
    if not found.settled[best] or bends(growth, steps.shape[1], sigma):
        raise BlockError(_open(image))


def _open(image: str) -> str:
    return (
        f"the known points of image {image} leave its orientation open, as points close to a line do, few points "
        "in a small part of the image, or points on a dangerous cylinder or curve through the projection centre: "
        "measure known points elsewhere in it"
    )
