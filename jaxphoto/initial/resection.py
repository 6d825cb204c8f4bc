"""Resection of one image from known points, without approximate values.

1. Compute three-point resections of about thirty triangles: the largest in the image, and random ones in case the
   outermost points are wrong.
2. Select the solutions with the smallest robust reprojection error over all points.
3. Refine them by least squares in ideal image coordinates over c, with Cauchy's loss, and return the best.

Grunert's (1841) solution as written by Haralick, Lee, Ottenberg and Noelle (1994), "Review and analysis of solutions of
the three point perspective pose estimation problem", equations (2)-(9). Let a, b, c be the sides of the object triangle
opposite points 1, 2, 3. The distances are s1, u s1, v s1; v is a root of a quartic with coefficients from the sides and
the cosines of the angles between the rays. The published formula for u divides by zero for symmetric figures, such as a
vertical photograph of a square. Here u is a root of the quadratic of side c; the caller rejects its false root by the
reprojection error.
"""

from itertools import combinations
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.initial.quaternions import cayley
from jaxphoto.initial.rays import ideal_coordinates, padded, padded_length, unit_rays
from jaxphoto.least_squares import least_squares

# Maximum relative difference of the sides of a solution. False roots have large differences, but true double roots are
# only as accurate as the square root of the rounding and image errors.
_MISFIT = 0.3


def three_point_resections(
    rays: Float[np.ndarray, "triples 3 3"], points: Float[np.ndarray, "triples 3 3"]
) -> tuple[Float[np.ndarray, "solutions 3"], Float[np.ndarray, "solutions 3 3"]]:
    """Return positions (m) and `camera_from_object` of every solution of every triple.

    `rays` are unit directions in the camera frame, in the order of the points (triple, point, axis).
    """
    d12, d13, d23 = (np.linalg.norm(points[:, i] - points[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
    cos12, cos13, cos23 = (np.sum(rays[:, i] * rays[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
    v = _roots(_quartic(d23, d13, d12, cos23, cos13, cos12))
    triple = np.repeat(np.arange(len(rays)), 4)
    v = v.ravel()
    with np.errstate(all="ignore"):
        s1 = d13[triple] / np.sqrt(1 + v**2 - 2 * v * cos13[triple])
        discriminant = cos12[triple] ** 2 - 1 + (d12[triple] / s1) ** 2
        root = np.sqrt(np.maximum(discriminant, 0.0))
        u = np.concatenate([cos12[triple] + root, cos12[triple] - root])
    triple, v, s1 = np.tile(triple, 2), np.tile(v, 2), np.tile(s1, 2)
    distances = np.stack([s1, u * s1, v * s1], axis=1)
    in_camera = rays[triple] * distances[..., None]
    side = np.linalg.norm(in_camera[:, 1] - in_camera[:, 2], axis=1)
    with np.errstate(invalid="ignore"):
        good = np.all(np.isfinite(distances) & (distances > 0), axis=1) & (np.abs(side / d23[triple] - 1) < _MISFIT)
    in_camera, in_object = in_camera[good], points[triple[good]]
    matrices = np.einsum("nik,njk->nij", _triad(in_camera), _triad(in_object))
    positions = in_object.mean(axis=1) - np.einsum("nij,ni->nj", matrices, in_camera.mean(axis=1))
    return positions, matrices


def _quartic(a, b, c, cos_a, cos_b, cos_g):
    """Return the coefficients, highest power first, of Haralick et al. (1994), equation (9)."""
    a2, b2, c2 = a * a, b * b, c * c
    minus, plus = (a2 - c2) / b2, (a2 + c2) / b2
    return np.stack(
        [
            (minus - 1) ** 2 - 4 * c2 / b2 * cos_a**2,
            4 * (minus * (1 - minus) * cos_b - (1 - plus) * cos_a * cos_g + 2 * c2 / b2 * cos_a**2 * cos_b),
            2
            * (
                minus**2 - 1 + 2 * minus**2 * cos_b**2 + 2 * (b2 - c2) / b2 * cos_a**2
                - 4 * plus * cos_a * cos_b * cos_g + 2 * (b2 - a2) / b2 * cos_g**2
            ),
            4 * (-minus * (1 + minus) * cos_b + 2 * a2 / b2 * cos_g**2 * cos_b - (1 - plus) * cos_a * cos_g),
            (1 + minus) ** 2 - 4 * a2 / b2 * cos_g**2,
        ],
        axis=1,
    )  # fmt: skip


def _roots(coefficients):
    """Return the real roots (NaN for complex ones), as eigenvalues of the companion matrices."""
    leading = coefficients[:, :1]
    tiny = np.abs(leading) < 1e-12 * np.max(np.abs(coefficients), axis=1, keepdims=True)
    companion = np.zeros((len(coefficients), 4, 4))
    companion[:, 0, :] = -coefficients[:, 1:] / np.where(tiny, 1.0, leading)
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    roots = np.linalg.eigvals(companion)
    # Noise splits a double root into a complex pair; its imaginary part is of the order of the square root of the
    # noise.
    real = (np.abs(roots.imag) < 0.1 * (0.1 + np.abs(roots.real))) & ~tiny
    return np.where(real, roots.real, np.nan)


def _triad(triangles):
    """Return right-handed orthonormal axes of triangles, as columns."""
    first = triangles[:, 1] - triangles[:, 0]
    normal = np.cross(first, triangles[:, 2] - triangles[:, 0])
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=2)


STARTS = 4
"""Maximum number of orientations to refine."""
_STARTS = 8  # batch size of the refinement
_TRIANGLES = 16  # number of the largest triangles; maximum number of random ones
_JUDGES = 60  # maximum number of points for scoring the solutions
# Scale of small errors when solutions are compared, and maximum median error of a valid resection, as fractions of c.
# Lenient, because the distortion may still be unknown.
_SMALL, _HOPELESS = 2e-3, 0.2
# Maximum standard deviation, as a fraction of the distance or in rad; minimum noise as a fraction of c.
_OPEN, _LEAST = 0.3, 1e-6
# Relative and absolute difference of costs due to rounding.
_SAME_COST, _ROUNDING = 1e-10, 1e-28


class RefinedResections(NamedTuple):
    """Orientations refined from several starts."""

    positions: Float[np.ndarray, "starts 3"]
    matrices: Float[np.ndarray, "starts 3 3"]
    costs: Float[np.ndarray, " starts"]
    """Robust sums of squared residuals over c."""
    normals: Float[np.ndarray, "starts 6 6"]
    """Normal matrices of the shift over `distances` and the small rotation in the camera frame (rad)."""
    distances: Float[np.ndarray, " starts"]
    """Distance of each start from the origin (m)."""
    converged: Bool[np.ndarray, " starts"]
    steps: Int[np.ndarray, " starts"]

    def best(self, n_points: int) -> int:
        """Return the index of the minimum cost; among costs equal except for rounding, prefer a converged one."""
        equal = self.costs <= (1 + _SAME_COST) * np.min(self.costs) + _ROUNDING * n_points
        return int(np.lexsort((self.costs, ~self.converged, ~equal))[0])


def resect(
    interior: InteriorOrientation,
    xy_mm: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    image: str = "(unnamed)",
) -> ExteriorOrientation:
    """Estimate the exterior orientation of one image from four or more known points, planar or not.

    `xy_mm` are measured coordinates from the image centre, `points` (m) the known points in the same order, `image` is
    the name for messages. The interior orientation may be approximate.

    Raises BlockError for: fewer than four distinct points (three have up to four solutions); points on a line or in a
    plane with the projection centre; a standard deviation above 0.3 of the distance or 0.3 rad; a coordinate that is
    not a number; points that no orientation fits. For the accuracy of the result use `resect_by_quaternions`.
    """
    return resect_ideal(float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float)), points, image)


def resect_ideal(
    c_mm: float, ideal: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], image: str
) -> ExteriorOrientation:
    """Estimate the exterior orientation from ideal image coordinates (mm, from the principal point); see `resect`."""
    local, origin = checked_points(ideal, points, image)
    positions, matrices = _candidates(c_mm, ideal, local)
    if not len(positions):
        raise no_orientation(image)
    errors = reprojection_errors(c_mm, ideal, local, positions, matrices)
    # A triangle fits three points exactly: with few points, larger errors of the others do not indicate blunders.
    typical = np.median(errors[0]) if len(local) >= 8 else np.max(errors[0])
    refined = refine(c_mm, ideal, local, positions, matrices, max(3 * 1.4826 * float(typical) / c_mm, 0.5 * _SMALL))
    best = int(np.argmin(refined.costs))
    position, matrix = refined.positions[best], refined.matrices[best]
    error = float(np.median(reprojection_errors(c_mm, ideal, local, position[None], matrix[None])))
    if not error < _HOPELESS * c_mm:
        raise no_orientation(image)
    # Compensate for the noise absorbed by six unknowns.
    noise = error / c_mm * np.sqrt(len(local) / (len(local) - 3))
    check_determined(refined.normals[best], max(noise, _LEAST), image, _OPEN)
    return ExteriorOrientation(jnp.asarray(position + origin), jnp.asarray(matrix))


def refine(
    c_mm: float,
    ideal: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "starts 3"],
    matrices: Float[np.ndarray, "starts 3 3"],
    limit: float = np.inf,
) -> RefinedResections:
    """Refine orientations by least squares, with Cauchy's loss of scale `limit` (residuals over c).

    `points` (m) are relative to a local origin.
    """
    n, starts = padded_length(len(points)), _STARTS * -(-len(positions) // _STARTS)
    place = tuple(padded(v, starts) for v in (positions, matrices))
    rows = *(padded(v, n) for v in (ideal / c_mm, points)), np.arange(n) < len(points)
    # Repeat from the solution: normal matrices refer to small rotations from there.
    for _ in range(2):
        results = [np.asarray(v) for v in call_compiled(_refined, *place, *rows, np.asarray(limit, float))]
        place = results[0], results[1]
    return RefinedResections(*(v[: len(positions)] for v in results))


@eqx.filter_jit
def _refined(positions, matrices, observed, points, used, limit):
    def refined(position, matrix):
        distance = jnp.linalg.norm(position)

        def moved(step):
            return position + distance * step[:3], cayley(step[3:]) @ matrix

        def residuals(step, _):
            """Return robust residuals over c after a shift over `distance` and a small rotation in the camera frame."""
            position, matrix = moved(step)
            in_camera = (points - position) @ matrix.T
            depth = -in_camera[:, 2:]
            residual = observed - in_camera[:, :2] / jnp.where(depth == 0, 1e-100, depth)
            # The squares of r sqrt(log(1 + q) / q) are Cauchy's loss.
            q = jnp.sum(residual**2, axis=1, keepdims=True) / limit**2 + 1e-30
            # With the best candidate, blunders may lie behind the camera, but no step may increase the number of points
            # there.
            behind = jnp.sqrt(jnp.sum(used) * jnp.sum(used * (depth[:, 0] <= 0)))
            return jnp.append(residual * used[:, None] * jnp.sqrt(jnp.log1p(q) / q), behind)

        fit = least_squares(residuals, jnp.zeros(6), damping=1e-6)
        return *moved(fit.unknowns), fit.cost, fit.normal, distance, fit.converged, fit.steps

    return jax.vmap(refined)(positions, matrices)


def reprojection_errors(
    c_mm: float,
    ideal: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "orientations 3"],
    matrices: Float[np.ndarray, "orientations 3 3"],
) -> Float[np.ndarray, "orientations n"]:
    """Return the errors (mm) of every point in every orientation, at most c; c for a point behind the camera."""
    camera = (matrices.reshape(-1, 3) @ points.T).reshape(-1, 3, len(points)) - matrices @ positions[:, :, None]
    in_front = camera[:, 2] < 0
    error = ideal.T + c_mm * camera[:, :2] / np.where(in_front, camera[:, 2], -1.0)[:, None]
    return np.where(in_front, np.minimum(np.hypot(error[:, 0], error[:, 1]), c_mm), c_mm)


def checked_points(
    ideal: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], image: str
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3"]]:
    """Check the known points of an image; return them relative to their mean, and the mean (m).

    Raises BlockError for a coordinate that is not a number, fewer than four distinct points, and points collinear on
    the ground or in the image; ValueError if the numbers of points and image coordinates differ.
    """
    points = np.asarray(points, float)
    if points.shape != (len(ideal), 3):
        raise ValueError(
            f"image {image} has {len(ideal)} image coordinates, but points of shape {points.shape}; "
            "give one point for each"
        )
    finite = np.isfinite(points).all(axis=1) & np.isfinite(ideal).all(axis=1)
    if not finite.all():
        raise BlockError(
            f"{np.sum(~finite)} of the {len(points)} known points of image {image} have a coordinate that is "
            "NaN or infinite (in the image, after the correction of its distortion, or on the ground): remove them"
        )
    distinct = len(np.unique(points, axis=0))
    cure = "or give its approximate X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv"
    if distinct < 4:
        raise BlockError(
            f"image {image} sees {distinct} known points, and a resection needs 4: measure more known points in it "
            + cure
        )
    origin = points.mean(axis=0)
    for centred, where in (
        (points - origin, "on a line"),
        (ideal - ideal.mean(axis=0), "in one plane with its projection centre (a line in the image)"),
    ):
        across = np.linalg.svd(centred, compute_uv=False)
        if across[1] < 1e-4 * across[0]:
            raise BlockError(
                f"the known points of image {image} lie {where}, which leaves its orientation undetermined: measure "
                f"a known point off that line {cure}"
            )
    return points - origin, origin


def no_orientation(image: str) -> BlockError:
    """Return the error for points that match no orientation of the image."""
    return BlockError(
        f"resection of image {image} failed: no orientation fits its known points; check their ids, the units and axes "
        "of the image coordinates, and c_mm"
    )


def check_determined(normal: Float[np.ndarray, "6 6"], sigma: float, image: str, limit: float) -> None:
    """Raise BlockError if a standard deviation exceeds `limit`, as a fraction of the distance or in rad.

    `sigma` is the standard deviation of image coordinates as a fraction of c.
    """
    values = np.linalg.eigvalsh(normal)
    if not (values[0] > 1e-13 * values[-1] and sigma / np.sqrt(values[0]) < limit):
        raise open_orientation(image)


def open_orientation(image: str) -> BlockError:
    """Return the error for points that do not determine the orientation."""
    return BlockError(
        f"the known points of image {image} leave its orientation undetermined (near a line, few in a small "
        "part of the image, or on a danger cylinder or critical curve through the projection centre): "
        "measure known points elsewhere in it"
    )


def _candidates(c_mm, ideal, points):
    """Return the `STARTS` triangle solutions with the smallest robust reprojection error, best first."""
    triples = _triples(ideal, points)
    positions, matrices = three_point_resections(unit_rays(c_mm, ideal)[triples], points[triples])
    judges = np.linspace(0, len(ideal) - 1, min(len(ideal), _JUDGES)).astype(int)
    errors = reprojection_errors(c_mm, ideal[judges], points[judges], positions, matrices)
    order = np.argsort(np.sum(np.log1p((errors / (_SMALL * c_mm)) ** 2), axis=1))[:STARTS]
    return positions[order], matrices[order]


def _triples(ideal, points):
    """Choose indices (triples, 3) of the largest image triangles and of random ones; none collinear in the object."""
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
    """Return twice the area of triangles in the image; zero if they are collinear in the object."""
    a, b, c = (ideal[triples[:, k]] for k in range(3))
    sides = points[triples[:, [1, 2, 0]]] - points[triples]
    longest = np.max(np.sum(sides**2, axis=2), axis=1)
    flat = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) <= 1e-3 * longest
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return np.where(flat, 0.0, area)
