"""Resection of one image from known points, without approximate values.

1. Three-point resections of some thirty triangles, the largest in the image and some at random (so that a few wrong
   points do not spoil all).
2. The few solutions with the smallest robust reprojection error over all points.
3. Levenberg-Marquardt steps on (position, small rotation in the camera frame) over all points from each of them, with
   Cauchy's weights, in the domain of ideal image coordinates; the best is the result.
"""

from itertools import combinations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.orientation.rays import ideal_coordinates, unit_rays
from jaxphoto.orientation.resection_steps import STARTS, RefinedResections, refined, reprojection_errors
from jaxphoto.orientation.resection_tests import check_determined
from jaxphoto.orientation.three_points import three_point_resections

_TRIANGLES = 16  # largest, and as many at random
_JUDGES = 60  # points at most that choose among the solutions
# Ideal image errors, as fractions of c: those that count as small when solutions are compared, and the typical one
# beyond which a resection is no solution. Lenient, because the distortion may still be unknown.
_SMALL, _HOPELESS = 2e-3, 0.2
# A standard deviation, of the distance or in rad, that makes a resection useless; by noise of `_LEAST` of c at least.
_OPEN, _LEAST = 0.3, 1e-6


def resect(
    interior: InteriorOrientation,
    xy_mm: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    image: str = "(unnamed)",
) -> ExteriorOrientation:
    """Exterior orientation of one image from four or more known points, planar or not.

    `xy_mm` are measured coordinates from the image centre, `points` (m) the known points in the same order, `image`
    the name for the message. The interior orientation may be rough.

    Raises BlockError where there are fewer than four distinct points (three leave up to four solutions), the points
    lie on a line or in a plane with the projection centre, they leave the orientation open by more than 0.3 of the
    distance or 0.3 rad, a coordinate is no number, or no orientation brings the points near their images. It
    does not tell how good it is: `resect_by_quaternions` does.
    """
    return resect_ideal(float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float)), points, image)


def resect_ideal(
    c_mm: float, ideal: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], image: str
) -> ExteriorOrientation:
    """`resect` from ideal image coordinates (mm, from the principal point)."""
    local, origin = checked_points(ideal, points, image)
    positions, matrices = _candidates(c_mm, ideal, local)
    if not len(positions):
        raise BlockError(_nowhere(image))
    found, best = _best_refined(c_mm, ideal, local, positions, matrices)
    position, matrix = found.positions[best], found.matrices[best]
    error = float(np.median(reprojection_errors(c_mm, ideal, local, position[None], matrix[None])))
    if not error < _HOPELESS * c_mm:
        raise BlockError(_nowhere(image))
    # The noise that the points show, of which six unknowns have taken their part.
    noise = error / c_mm * np.sqrt(len(local) / (len(local) - 3))
    check_determined(found, best, max(noise, _LEAST), image, _OPEN)
    return ExteriorOrientation(jnp.asarray(position + origin), jnp.asarray(matrix))


def checked_points(
    ideal: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], image: str
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3"]]:
    """The points about their middle, and the middle (m), of an image that they can orient.

    Raises BlockError where a coordinate is no number, there are fewer than four distinct points, or they lie on a line
    on the ground or in the image; ValueError where there are not as many points as image coordinates.
    """
    points = np.asarray(points, float)
    if points.shape != (len(ideal), 3):
        raise ValueError(
            f"image coordinates and points belong together, but of image {image} there are {len(ideal)} coordinates "
            f"and points of shape {points.shape}"
        )
    finite = np.isfinite(points).all(axis=1) & np.isfinite(ideal).all(axis=1)
    if not finite.all():
        raise BlockError(
            f"{np.sum(~finite)} of the {len(points)} known points of image {image} have a coordinate that is no "
            "number (in the image, after the correction of its distortion, or on the ground): leave them out"
        )
    distinct = len(np.unique(points, axis=0))
    if distinct < 4:
        raise BlockError(
            f"image {image} sees {distinct} known points, and a resection needs 4: measure more known points in it or "
            "give its approximate X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv"
        )
    origin = points.mean(axis=0)
    local = points - origin
    if _on_a_line(local):
        raise BlockError(
            f"the known points of image {image} lie on a line, which leaves its orientation open: measure a known "
            "point off the line or give its approximate X_m .. kappa_deg in images.csv"
        )
    if _on_a_line(ideal - ideal.mean(axis=0)):
        raise BlockError(
            f"the known points of image {image} lie in one plane with its projection centre, so that they are on a "
            "line in the image, which leaves its orientation open: measure a known point off that line or give its "
            "approximate X_m .. kappa_deg in images.csv"
        )
    return local, origin


def _on_a_line(centred: Float[np.ndarray, "n axes"]) -> bool:
    across = np.linalg.svd(centred, compute_uv=False)
    return bool(across[1] < 1e-4 * across[0])


def _nowhere(image: str) -> str:
    return (
        f"no position and attitude of image {image} brings its known points near their images: check their ids, "
        "the units and axes of the image coordinates, and c_mm"
    )


def _candidates(c_mm, ideal, points):
    """The solutions of the triangles with the smallest robust reprojection error, best first, `STARTS` at most."""
    triples = _triples(ideal, points)
    positions, matrices = three_point_resections(unit_rays(c_mm, ideal)[triples], points[triples])
    some = np.linspace(0, len(ideal) - 1, min(len(ideal), _JUDGES)).astype(int)
    errors = reprojection_errors(c_mm, ideal[some], points[some], positions, matrices)
    order = np.argsort(np.sum(np.log1p((errors / (_SMALL * c_mm)) ** 2), axis=1))[:STARTS]
    return positions[order], matrices[order]


def _triples(ideal, points):
    """Indices (triples, 3) of the largest triangles in the image and of some random ones; no lines in the object."""
    angles = np.arange(12) * np.pi / 6
    extreme = np.unique(np.argmax(ideal @ np.stack([np.cos(angles), np.sin(angles)]), axis=0))
    among = np.arange(len(ideal)) if len(ideal) <= 12 else extreme
    large = np.array(list(combinations(among, 3)), int).reshape(-1, 3)
    random = np.random.default_rng(0).integers(len(ideal), size=(200, 3))
    area = _area(ideal, points, large)
    large = large[np.argsort(-area)[:_TRIANGLES]]
    random = random[_area(ideal, points, random) > 0.1 * area.max(initial=0.0)][:_TRIANGLES]
    triples = np.unique(np.sort(np.concatenate([large, random]), axis=1), axis=0)
    return triples[_area(ideal, points, triples) > 0]


def _area(ideal, points, triples):
    """Twice the area of triangles in the image; zero where they are lines in the object."""
    a, b, c = (ideal[triples[:, k]] for k in range(3))
    sides = points[triples[:, [1, 2, 0]]] - points[triples]
    longest = np.max(np.sum(sides**2, axis=2), axis=1)
    flat = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) <= 1e-3 * longest
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return np.where(flat, 0.0, area)


def _best_refined(c_mm, ideal, points, positions, matrices) -> tuple[RefinedResections, int]:
    """The refined candidates, and which of them is the best."""
    errors = reprojection_errors(c_mm, ideal, points, positions, matrices)
    # Of a few points the triangle fits three exactly, so the others are no blunders for being worse.
    typical = np.median(errors[0]) if len(points) >= 8 else np.max(errors[0])
    limit = max(3 * 1.4826 * float(typical) / c_mm, 0.5 * _SMALL)
    found = refined(c_mm, ideal, points, positions, matrices, limit)
    return found, int(np.argmin(found.costs))
