"""Resection of one image from known points, without approximate values.

1. Three-point resections of some thirty triangles, the largest in the image and some at random (so that a few wrong
   points do not spoil all).
2. The few solutions with the smallest robust reprojection error over all points.
3. Levenberg-Marquardt steps on (position, small rotation in the camera frame) over all points from each of them, with
   Cauchy's weights, in the domain of ideal image coordinates; the best is the result.
"""

from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project_ideal
from jaxphoto.compiling import QUICK_TO_COMPILE
from jaxphoto.errors import BlockError
from jaxphoto.orientation.rays import ideal_coordinates, padded_length, unit_rays
from jaxphoto.orientation.three_points import three_point_resections
from jaxphoto.rotation import small_rotation

_TRIANGLES = 16  # largest, and as many at random
_JUDGES = 60  # points at most that choose among the solutions
_STARTS = 4
_STEPS = 40
# Ideal image errors, as fractions of c: those that count as small when solutions are compared, and the typical one
# beyond which a resection is no solution. Lenient, because the distortion may still be unknown.
_SMALL, _HOPELESS = 2e-3, 0.2


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
    lie on a line, or no orientation brings the points near their images.
    """
    return resect_ideal(float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float)), points, image)


def resect_ideal(
    c_mm: float, ideal: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], image: str
) -> ExteriorOrientation:
    """`resect` from ideal image coordinates (mm, from the principal point)."""
    points = np.asarray(points, float)
    distinct = len(np.unique(points, axis=0))
    if distinct < 4:
        raise BlockError(
            f"image {image} sees {distinct} known points, and a resection needs 4: measure more known points in it or "
            "give its approximate X_m, Y_m, Z_m, omega_deg, phi_deg, kappa_deg in images.csv"
        )
    origin = points.mean(axis=0)
    local = points - origin
    if _on_a_line(local) or _on_a_line(ideal - ideal.mean(axis=0)):
        raise BlockError(
            f"the known points of image {image} lie on a line, which leaves its orientation open: measure a known "
            "point off the line or give its approximate X_m .. kappa_deg in images.csv"
        )
    positions, matrices = _candidates(c_mm, ideal, local)
    position, matrix, error = _best_refined(c_mm, ideal, local, positions, matrices)
    if not error < _HOPELESS * c_mm:
        raise BlockError(
            f"no position and attitude of image {image} brings its known points near their images: check their ids, "
            "the units and axes of the image coordinates, and c_mm"
        )
    return ExteriorOrientation(jnp.asarray(position + origin), jnp.asarray(matrix))


def _on_a_line(centred: Float[np.ndarray, "n axes"]) -> bool:
    across = np.linalg.svd(centred, compute_uv=False)
    return bool(across[1] < 1e-4 * across[0])


def _candidates(c_mm, ideal, points):
    """The solutions of the triangles with the smallest robust reprojection error, best first, `_STARTS` at most."""
    triples = _triples(ideal, points)
    positions, matrices = three_point_resections(unit_rays(c_mm, ideal)[triples], points[triples])
    some = np.linspace(0, len(ideal) - 1, min(len(ideal), _JUDGES)).astype(int)
    errors = _reprojection_errors(c_mm, ideal[some], points[some], positions, matrices)
    order = np.argsort(np.sum(np.log1p((errors / (_SMALL * c_mm)) ** 2), axis=1))[:_STARTS]
    return positions[order], matrices[order]


def _triples(ideal, points):
    """Indices (triples, 3) of the largest triangles in the image and of some random ones; no lines in the object."""
    angles = np.arange(12) * np.pi / 6
    extreme = np.unique(np.argmax(ideal @ np.stack([np.cos(angles), np.sin(angles)]), axis=0))
    among = np.arange(len(ideal)) if len(ideal) <= 12 else extreme
    large = np.array(list(combinations(among, 3)))
    random = np.random.default_rng(0).integers(len(ideal), size=(200, 3))
    area = _area(ideal, points, large)
    large = large[np.argsort(-area)[:_TRIANGLES]]
    random = random[_area(ideal, points, random) > 0.1 * area.max()][:_TRIANGLES]
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


def _reprojection_errors(c_mm, ideal, points, positions, matrices):
    """Errors (mm) of every point in every solution; a point behind the camera counts as c."""
    camera = (matrices.reshape(-1, 3) @ points.T).reshape(-1, 3, len(points)) - matrices @ positions[:, :, None]
    in_front = camera[:, 2] < 0
    error = ideal.T + c_mm * camera[:, :2] / np.where(in_front, camera[:, 2], -1.0)[:, None]
    return np.where(in_front, np.minimum(np.hypot(error[:, 0], error[:, 1]), c_mm), c_mm)


def _best_refined(c_mm, ideal, points, positions, matrices):
    """Position, matrix and median error (mm) of the best refined candidate; error infinite where there is none.

    The steps are taken here and only the linearised projection is compiled: a whole loop compiles four times longer.
    """
    if not len(positions):
        return np.zeros(3), np.eye(3), np.inf
    errors = _reprojection_errors(c_mm, ideal, points, positions, matrices)
    # Of a few points the triangle fits three exactly, so the others are no blunders for being worse.
    typical = np.median(errors[0]) if len(points) >= 8 else np.max(errors[0])
    limit = max(3 * 1.4826 * float(typical), 0.5 * _SMALL * c_mm)
    start = np.arange(_STARTS) % len(positions)
    distance = np.linalg.norm(positions[start], axis=1)  # the points are about the origin
    steps, damping = np.zeros((_STARTS, 6)), np.full(_STARTS, 1e-6)
    state = _normal_equations(c_mm, ideal, points, limit, distance, positions[start], matrices[start], steps)
    for _ in range(_STEPS):
        positions, matrices, cost, normal, right = state
        scaled = damping[:, None] * (np.einsum("skk->sk", normal) + 1e-15)
        steps = np.linalg.solve(normal + scaled[:, :, None] * np.eye(6), right[..., None])[..., 0]
        trial = _normal_equations(c_mm, ideal, points, limit, distance, positions, matrices, steps)
        better = trial[2] < cost
        state = tuple(
            np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(trial, state, strict=True)
        )
        damping *= np.where(better, 0.1, 10.0)
        if np.max(np.abs(steps)) < 1e-10:
            break
    positions, matrices, cost, _, _ = state
    best = int(np.argmin(cost))
    final = _reprojection_errors(c_mm, ideal, points, positions[best : best + 1], matrices[best : best + 1])
    return positions[best], matrices[best], float(np.median(final))


def _normal_equations(c_mm, ideal, points, limit, distance, positions, matrices, steps):
    """Per candidate, moved by its step: position, matrix, robust cost, normal matrix (6, 6) and right side (6)."""
    n = len(points)
    some = np.arange(padded_length(n)) % n  # padding repeats points; their rows are dropped again
    args = (positions, matrices, distance, steps, np.float64(c_mm), points[some])
    positions, matrices, projected, slope = (np.asarray(v) for v in _linearised(*args))
    residual, slope = (ideal.T - projected[:, :, :n]) / c_mm, slope[:, :, :n] / c_mm
    size, limit = np.hypot(residual[:, 0], residual[:, 1]), limit / c_mm
    weight, robust = 1 / (1 + (size / limit) ** 2), limit**2 * np.log1p((size / limit) ** 2).sum(axis=1)
    # A blunder may lie behind the best candidate, but no step may take more points there.
    behind = matrices[:, 2] @ points.T >= np.sum(matrices[:, 2] * positions, axis=1)[:, None]
    cost = np.where(np.isfinite(robust), robust, np.inf) + behind.sum(axis=1) * n
    rows = slope.reshape(_STARTS, 2 * n, 6)
    weighted = (slope * weight[:, None, :, None]).reshape(_STARTS, 2 * n, 6).transpose(0, 2, 1)
    return positions, matrices, cost, weighted @ rows, (weighted @ residual.reshape(_STARTS, 2 * n, 1))[..., 0]


@partial(jax.jit, compiler_options=QUICK_TO_COMPILE)
def _linearised(positions, matrices, distances, steps, c, points):
    """Orientations moved by `steps`, projections (2, n) from there, and their derivatives (2, n, 6), per candidate.

    A step is the shift as a fraction of the distance, and the small rotation in the camera frame (rad).
    """

    def moved(step, exterior, distance):
        turned = small_rotation(step[3:]) @ exterior.camera_from_object
        return ExteriorOrientation(exterior.position + distance * step[:3], turned)

    def projected(step, exterior, distance):
        project = jax.vmap(project_ideal, in_axes=(None, None, 1), out_axes=1)
        xy = project(c, moved(step, exterior, distance), points.T)
        return xy, xy

    def one(position, matrix, distance, step):
        exterior = moved(step, ExteriorOrientation(position, matrix), distance)
        slope, xy = jax.jacfwd(projected, has_aux=True)(jnp.zeros(6), exterior, distance)
        return exterior.position, exterior.camera_from_object, xy, slope

    return jax.vmap(one)(positions, matrices, distances, steps)
