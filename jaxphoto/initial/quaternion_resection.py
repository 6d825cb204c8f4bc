"""Single photo resection by quaternions, without approximate values, with the covariance of its result.

1. The rays of two points j, k and the line between the points are coplanar: `V . M' n = 0`, with the normal n = x_j x
   x_k of the two rays in the camera frame, V = X_k - X_j and M = `camera_from_object`. Alternate: project each M' n
   onto the plane perpendicular to its V; estimate M as the rotation (Horn's unit quaternion) that best maps the
   projections to their n. Start from cameras above and below the best-fitting plane of the points, vertical and
   inclined; stop after 50 iterations, because near-vertical photographs of flat ground take thousands to converge.
2. Intersect the rays from the points back to the camera for the position (linear).
3. Refine the best few by least squares (`resection.refine`), and test for other solutions.

All points have equal weights; no minimal solution is needed. Suitable for targets and surveyed points without gross
errors. For points with gross errors use `resect`, which starts from samples of three points.

Source: Mazaheri and Habib (2015), "Quaternion-based solutions for the single photo resection problem", PE&RS 81(3).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.quaternions import best_rotations, rotated
from jaxphoto.initial.rays import ideal_coordinates, unit_rays
from jaxphoto.initial.resection import (
    STARTS,
    RefinedResections,
    check_determined,
    checked_points,
    no_orientation,
    open_orientation,
    refine,
    reprojection_errors,
)

_ITERATIONS = 50
_CONVERGED = 1e-3  # maximum change of the rotations at convergence
_POINTS = 60  # maximum number of points to pair
_INCLINED = np.deg2rad(40.0)
_FEW = 8  # maximum number of points for starts rotated by quarter turns: few points may be far from a plane
_APART = 0.05  # minimum chord between rotations with different results
_ASIDE = np.array([-0.3, -0.03, 0.03, 0.3])  # fractions of the distance, and rad
# Maximum standard deviation, as a fraction of the distance or in rad, of a usable orientation.
_OPEN = 0.1
_HOPELESS = 0.05  # maximum root mean square residual as a fraction of c
# Errors x of u unknowns with the normal matrix N increase the squared residuals by x' N x = u sigma^2 on average. If
# they increase far more or hardly at all, no covariance describes the errors: near a dangerous surface.
_SAMPLES, _QUANTILES = 16, (0.1, 0.9)
_FACTOR = 3.0  # maximum ratio of the increase to the expected one, and of its inverse
_AS_GOOD = 9.0  # maximum difference of squared residuals (sigma^2) of equally good solutions: three sigmas


class Resection(NamedTuple):
    """Exterior orientation from known points, with quality measures."""

    position: Float[np.ndarray, "3"]
    """Projection centre (m)."""
    camera_from_object: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    """A priori covariance of the position (m) and a small rotation in the camera frame (rad); multiply by `sigma0`^2
    for the a posteriori one.
    """
    sigma0: float
    """Square root of the weighted sum of squared residuals over the redundancy 2 n - 6."""
    residuals: Float[np.ndarray, "n 2"]
    """Measured minus computed ideal image coordinates (mm)."""
    iterations: int
    """Number of iterations of the quaternion solution, at most 50."""
    converged: bool
    """True if the rotation changed by less than 1e-3 before the 50th iteration."""
    steps: int
    """Number of least-squares steps, at most 50."""


def resect_by_quaternions(
    interior: InteriorOrientation,
    xy_mm: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    sigma_mm: float,
    image: str = "(unnamed)",
) -> Resection:
    """Estimate the exterior orientation of one image by least squares from four or more known points, planar or not.

    `xy_mm` are measured coordinates from the image centre with the standard deviation `sigma_mm`, `points` (m) the
    error-free known points in the same order; `image` is the name for messages.

    Raises BlockError for: fewer than four distinct points (three have up to four solutions); a coordinate that is not a
    number; points on a line or in a plane with the projection centre; a standard deviation above 0.1 of the distance or
    0.1 rad; errors not described by a covariance (projection centre and points on a critical curve or danger cylinder);
    two orientations that fit equally well (small planar figures at a large distance); points that no orientation fits.
    Raises ValueError if `sigma_mm` is not positive or the numbers of points and coordinates differ.
    """
    c, ideal = float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float))
    if not sigma_mm > 0:
        raise ValueError(f"sigma_mm, the standard deviation of image coordinates, must be positive, got {sigma_mm}")
    local, origin = checked_points(ideal, points, image)
    positions, matrices, iterations, converged = _starts(c, ideal, local)
    refined = refine(c, ideal, local, positions, matrices)
    others = refine(c, ideal, local, *_alternatives(c, ideal, local, refined))
    refined = RefinedResections(*(np.concatenate(both) for both in zip(refined, others, strict=True)))
    best = refined.best(len(local))
    cost, redundancy = float(refined.costs[best]), 2 * len(local) - 6
    if not cost < 2 * len(local) * _HOPELESS**2:
        raise no_orientation(image)
    sigma = sigma_mm / c
    sigma0 = float(np.sqrt(cost / redundancy)) / sigma
    noise = sigma * max(1.0, sigma0)
    check_determined(refined.normals[best], noise, image, _OPEN)
    _check_unique(refined, best, noise, image)
    steps = typical_errors(refined.normals[best], noise)
    errors = reprojection_errors(c, ideal, local, *_moved(refined, best, steps)) / c
    growth = np.sum(errors**2, axis=1) - cost
    if not refined.converged[best] or is_nonlinear(growth, 6, noise):
        raise open_orientation(image)
    scale = np.repeat([refined.distances[best], 1.0], 3)
    position, matrix = refined.positions[best], refined.matrices[best]
    in_camera = (local - position) @ matrix.T
    return Resection(
        origin + position,
        matrix,
        sigma**2 * scale[:, None] * np.linalg.inv(refined.normals[best]) * scale,
        sigma0,
        ideal + c * in_camera[:, :2] / in_camera[:, 2:],
        iterations,
        converged,
        int(refined.steps.max()),
    )


def _check_unique(refined: RefinedResections, best: int, sigma: float, image: str) -> None:
    """Raise BlockError if another orientation fits as well as the best."""
    near = refined.costs - refined.costs[best] < _AS_GOOD * sigma**2
    apart = np.linalg.norm(refined.matrices - refined.matrices[best], axis=(1, 2))
    # Solutions closer than their own standard deviations are the same minimum.
    same = np.sqrt(np.max(np.diagonal(np.linalg.inv(refined.normals[best]))[3:])) * sigma
    if np.any(near & (apart > np.maximum(5 * same, 1e-6))):
        angle = np.rad2deg(2 * np.arcsin(min(float(np.max(apart[near])) / np.sqrt(8), 1.0)))
        raise BlockError(
            f"two orientations of image {image}, {angle:.3g} deg apart, fit its known points equally well (typical of "
            "few points and of distant planes): measure points off the plane or over more of the "
            "image, or give omega_deg, phi_deg, kappa_deg in images.csv"
        )


def _starts(c, ideal, points):
    """Return up to `STARTS` positions and matrices, best first, the number of iterations, and True if converged."""
    matrices = _from_plane(ideal, points)
    product = _condition(unit_rays(c, ideal), points)
    iterations, change = 0, np.inf
    while iterations < _ITERATIONS and change > _CONVERGED:
        new = best_rotations((matrices.reshape(-1, 9) @ product).reshape(-1, 3, 3))
        change, matrices, iterations = np.max(np.abs(new - matrices)), new, iterations + 1
    # Intersect the rays from the points back to the camera: sum (I - d d') (S - X) = 0.
    directions = unit_rays(c, ideal) @ matrices
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    right = np.einsum("snij,nj->si", across, points)
    positions = np.linalg.solve(across.sum(axis=1), right[..., None])[..., 0]
    errors = np.sum(reprojection_errors(c, ideal, points, positions, matrices) ** 2, axis=1)
    chosen: list[int] = []
    for k in np.argsort(errors, kind="stable"):
        if all(np.linalg.norm(matrices[k] - matrices[i]) > _APART for i in chosen):
            chosen.append(int(k))
    return positions[chosen[:STARTS]], matrices[chosen[:STARTS]], iterations, bool(change <= _CONVERGED)


def _condition(rays, points) -> Float[np.ndarray, "9 9"]:
    """Return the linear map from M (row by row) to the sum of n (|V|^2 M' n - V V' M' n)', whose best rotation is the
    next M.
    """
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int))
    j, k = some[np.stack(np.triu_indices(len(some), 1))]
    normals, sides = np.cross(rays[j], rays[k]), points[k] - points[j]
    sides = sides / np.sqrt(np.mean(np.sum(sides**2, axis=1)))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    useful = length[:, 0] > 1e-9
    normals, sides = (normals / np.maximum(length, 1e-300))[useful], sides[useful]
    twice = (normals[:, :, None] * normals[:, None]).reshape(-1, 9)
    across = np.sum(sides**2, axis=1)[:, None, None] * np.eye(3) - sides[:, :, None] * sides[:, None]
    result = (twice.T @ across.reshape(-1, 9)).reshape(3, 3, 3, 3)  # axes: (row, row, column, column)
    return result.transpose(0, 2, 1, 3).reshape(9, 9)


def _from_plane(ideal, points) -> Float[np.ndarray, "starts 3 3"]:
    """Return rotations of cameras above and below the best-fitting plane: vertical, and inclined to four sides."""
    axes = np.linalg.svd(points, full_matrices=False)[2]
    axes[2] *= np.linalg.det(axes)
    quarters = np.arange(4 if len(points) <= _FEW else 1) * np.pi / 2
    image = ideal - ideal.mean(axis=0)
    starts = []
    for side in (1.0, -1.0):
        upright = axes * np.array([1.0, side, side])[:, None]
        in_plane = points @ upright[:2].T
        # Rotation about the normal that best aligns the figure with its image.
        kappa = np.arctan2(
            np.sum(in_plane[:, 0] * image[:, 1] - in_plane[:, 1] * image[:, 0]), np.sum(in_plane * image)
        )
        tilts = _INCLINED * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        for quarter in quarters:
            starts.append(rotated(rotated(upright, np.array([0.0, 0.0, -kappa - quarter])), tilts))
    return np.concatenate(starts)


def _moved(refined: RefinedResections, k: int, steps: Float[np.ndarray, "steps 6"]):
    """Return positions and matrices after steps from orientation `k`: shifts over the distance, rotations (rad)."""
    return refined.positions[k] + refined.distances[k] * steps[:, :3], rotated(refined.matrices[k], steps[:, 3:])


def _alternatives(c, ideal, points, refined: RefinedResections):
    """Return positions and matrices of other orientations in which the points may appear the same.

    Steps to both sides along the weakest direction reach the second orientation across a danger cylinder. For a
    distant flat figure: a rotation by 180 degrees about its normal, or about the line of sight.
    """
    best = refined.best(len(points))
    position, matrix = refined.positions[best], refined.matrices[best]
    weakest = np.linalg.eigh(refined.normals[best])[1][:, 0]
    positions, matrices = _moved(refined, best, np.outer(_ASIDE, weakest))
    normal = np.linalg.svd(points, full_matrices=False)[2][2]
    sight = -position / np.linalg.norm(position)
    half_turn = lambda axis: 2 * np.outer(axis, axis) - np.eye(3)  # noqa: E731
    mirrored = matrix @ half_turn(sight) @ half_turn(normal)
    beyond = mirrored.T @ (matrix @ position)
    error = reprojection_errors(c, ideal, points, beyond[None], mirrored[None])
    if np.sqrt(np.mean(error**2)) < _HOPELESS * c:
        positions, matrices = np.concatenate([positions, beyond[None]]), np.concatenate([matrices, mirrored[None]])
    return positions, matrices


def typical_errors(normal: Float[np.ndarray, "u u"], sigma: float) -> Float[np.ndarray, "steps u"]:
    """Draw errors of one-sigma size in random directions and their opposites, for a normal matrix and observation
    sigma.
    """
    values, vectors = np.linalg.eigh(normal)
    drawn = np.random.default_rng(0).normal(size=(_SAMPLES, len(normal)))
    drawn *= np.sqrt(len(normal)) / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.concatenate([drawn, -drawn]) * sigma / np.sqrt(np.maximum(values, 1e-300)) @ vectors.T


def is_nonlinear(growth: Float[np.ndarray, " steps"], unknowns: int, sigma: float) -> bool:
    """Return True if the increase of the squared residuals at `typical_errors` deviates from a linear adjustment."""
    least, most = np.quantile(growth / (unknowns * sigma**2), _QUANTILES)
    return not (least > 1 / _FACTOR and most < _FACTOR)
