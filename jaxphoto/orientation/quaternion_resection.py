"""Single photo resection by quaternions, without approximate values, with the covariance of its result.

1. The rays of two points j, k and the line between the points lie in one plane: `V . M' n = 0`, with the plane's normal
   n = x_j x x_k in the camera frame, V = X_k - X_j and M = `camera_from_object`. In turn each M' n is projected on the
   plane across its V, and M is the rotation, by Horn's unit quaternion, that takes the projections nearest to their n.
   It starts with the camera above and below the plane nearest to the points, upright and inclined; at most 50 turns,
   because near-vertical photographs of flat ground take thousands to converge.
2. The position is that nearest to the rays back from the points: linear.
3. Gauss-Newton steps on both, of the best few (`resection_steps`). What else fits as well, or is left open, is told.

It uses all points alike and needs no minimal solution: for targets and surveyed points, where all are to be trusted.
`resect` finds its start from three points at a time, and is the one for points with gross errors among them.

Source: Mazaheri and Habib (2015), "Quaternion-based solutions for the single photo resection problem", PE&RS 81(3).
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.orientation.quaternions import best_rotations, turned
from jaxphoto.orientation.rays import ideal_coordinates, unit_rays
from jaxphoto.orientation.resection import checked_points
from jaxphoto.orientation.resection_steps import NO_LIMIT, STARTS, RefinedResections, refined, reprojection_errors

_TURNS = 50
_POINTS = 30  # at most that are paired
_INCLINED = np.deg2rad(40.0)
_FEW = 8  # so many points may be far from a plane: cameras turned by quarters about its normal, too
_APART = 0.05  # chord of rotations that lead to different results
# A standard deviation, as a fraction of the distance or in rad, beyond which an orientation is no start for anything.
_OPEN = 0.1
_HOPELESS = 0.05  # root mean square residual as a fraction of c
_AS_GOOD = 9.0  # squared residuals by which another orientation may be worse: three standard deviations


class Resection(NamedTuple):
    """An exterior orientation from known points."""

    position: Float[np.ndarray, "3"]
    """Projection centre, m."""
    camera_from_object: Float[np.ndarray, "3 3"]
    covariance: Float[np.ndarray, "6 6"]
    """A priori, of the position (m) and a small rotation in the camera frame (rad); times `sigma0`^2 a posteriori."""
    sigma0: float
    """Square root of the weighted squares of residuals over the redundancy 2 n - 6."""
    residuals: Float[np.ndarray, "n 2"]
    """Measured minus computed ideal image coordinates, mm."""
    iterations: int
    """Turns of the quaternion solution, at most 50."""


def resect_by_quaternions(
    interior: InteriorOrientation,
    xy_mm: Float[np.ndarray, "n 2"],
    points: Float[np.ndarray, "n 3"],
    sigma_mm: float,
    image: str = "(unnamed)",
) -> Resection:
    """Exterior orientation of one image by least squares from four or more known points, planar or not.

    `xy_mm` are measured coordinates from the image centre with the standard deviation `sigma_mm`, `points` (m) the
    known points in the same order, without errors; `image` the name for messages.

    Raises BlockError where there are fewer than four distinct points (three leave up to four solutions), they lie on a
    line, the orientation is left open because the projection centre lies with the points on a dangerous curve or
    cylinder, two orientations fit equally well (small flat figures seen from afar), or none fits.
    """
    c, ideal = float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float))
    local, origin = checked_points(ideal, points, image)
    positions, matrices, turns = _starts(c, ideal, local)
    found = refined(c, ideal, local, positions, matrices, NO_LIMIT)
    best = int(np.argmin(found.costs))
    position, matrix = _mirrored(found.positions[best], found.matrices[best], local)
    other = refined(c, ideal, local, position, matrix, NO_LIMIT)
    found = RefinedResections(*(np.concatenate(both) for both in zip(found, other, strict=True)))
    best = int(np.argmin(found.costs))
    cost, redundancy = float(found.costs[best]), 2 * len(local) - 6
    if not cost < 2 * len(local) * _HOPELESS**2:
        raise BlockError(
            f"no position and attitude of image {image} brings its known points near their images: check their ids, "
            "the units and axes of the image coordinates, and c_mm; resect can leave wrong points aside"
        )
    sigma = sigma_mm / c
    sigma0 = float(np.sqrt(cost / redundancy)) / sigma
    noise = sigma * max(1.0, sigma0)
    _check_determined(found.normals[best], noise, image)
    _check_unique(found, best, noise, image)
    scale = np.repeat([found.distances[best], 1.0], 3)
    position, matrix = found.positions[best], found.matrices[best]
    in_camera = (local - position) @ matrix.T
    return Resection(
        origin + position,
        matrix,
        sigma**2 * scale[:, None] * np.linalg.inv(found.normals[best]) * scale,
        sigma0,
        ideal + c * in_camera[:, :2] / in_camera[:, 2:],
        turns,
    )


def _starts(c, ideal, points):
    """Positions and matrices, up to `STARTS`, from the quaternion solution, best first; and the turns it took."""
    rays = unit_rays(c, ideal)
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int))
    j, k = some[np.array(list(combinations(range(len(some)), 2)))].T
    normals, sides = np.cross(rays[j], rays[k]), points[k] - points[j]
    sides = sides / np.sqrt(np.mean(np.sum(sides**2, axis=1)))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    useful = length[:, 0] > 1e-9
    normals, sides = (normals / np.maximum(length, 1e-300))[useful], sides[useful]
    matrices, turns = _from_plane(ideal, points), 0
    for _ in range(_TURNS):
        across = normals @ matrices  # M' n
        along = np.einsum("ni,sni->sn", sides, across)[..., None] * sides
        targets = np.sum(sides**2, axis=1)[:, None] * across - along
        new = best_rotations(np.einsum("ni,snj->sij", normals, targets))
        change, matrices, turns = np.max(np.abs(new - matrices)), new, turns + 1
        if change < 1e-12:
            break
    # The rays turned round, from the points: sum (I - d d') (S - X) = 0.
    directions = rays @ matrices
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    right = np.einsum("snij,nj->si", across, points)
    positions = np.linalg.solve(across.sum(axis=1), right[..., None])[..., 0]
    errors = np.sum(reprojection_errors(c, ideal, points, positions, matrices) ** 2, axis=1)
    chosen: list[int] = []
    for k in np.argsort(errors, kind="stable"):
        if all(np.linalg.norm(matrices[k] - matrices[i]) > _APART for i in chosen):
            chosen.append(int(k))
    return positions[chosen[:STARTS]], matrices[chosen[:STARTS]], turns


def _from_plane(ideal, points) -> Float[np.ndarray, "starts 3 3"]:
    """Rotations of cameras above and below the plane nearest to the points, upright and inclined to four sides."""
    axes = np.linalg.svd(points, full_matrices=False)[2]
    axes[2] *= np.linalg.det(axes)
    quarters = np.arange(4 if len(points) <= _FEW else 1) * np.pi / 2
    image = ideal - ideal.mean(axis=0)
    starts = []
    for side in (1.0, -1.0):
        upright = axes * np.array([1.0, side, side])[:, None]
        in_plane = points @ upright[:2].T
        # The turn about the normal that brings the figure nearest to its image.
        turn = np.arctan2(np.sum(in_plane[:, 0] * image[:, 1] - in_plane[:, 1] * image[:, 0]), np.sum(in_plane * image))
        tilts = _INCLINED * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        for quarter in quarters:
            upright_there = turned(upright, np.array([0.0, 0.0, -turn - quarter]))
            starts += [turned(upright_there, tilt) for tilt in tilts]
    return np.array(starts)


def _mirrored(position, matrix, points):
    """Where a distant flat figure looks alike from: half a turn about its normal, and another about the sight line."""
    normal = np.linalg.svd(points, full_matrices=False)[2][2]
    sight = -position / np.linalg.norm(position)
    half_turn = lambda axis: 2 * np.outer(axis, axis) - np.eye(3)  # noqa: E731
    other = matrix @ half_turn(sight) @ half_turn(normal)
    return (other.T @ (matrix @ position))[None], other[None]


def _check_determined(normal, sigma: float, image: str) -> None:
    values = np.linalg.eigvalsh(normal)
    weakest = sigma / np.sqrt(values[0]) if values[0] > 1e-13 * values[-1] else np.inf
    if not weakest < _OPEN:
        raise BlockError(
            f"the known points of image {image} leave its orientation open, as points close to a line do, or points "
            "on a dangerous cylinder or curve through the projection centre: measure known points elsewhere in it"
        )


def _check_unique(found: RefinedResections, best: int, sigma: float, image: str) -> None:
    near = found.costs - found.costs[best] < _AS_GOOD * sigma**2
    apart = np.linalg.norm(found.matrices - found.matrices[best], axis=(1, 2))
    # Of the same minimum: closer than its own standard deviations allow it to be told apart.
    same = np.sqrt(np.max(np.diagonal(np.linalg.inv(found.normals[best]))[3:])) * sigma
    if np.any(near & (apart > np.maximum(5 * same, 1e-6))):
        turn = np.rad2deg(2 * np.arcsin(min(float(np.max(apart[near])) / np.sqrt(8), 1.0)))
        raise BlockError(
            f"two orientations of image {image}, turned by {turn:.1f} deg, fit its known points equally well, as few "
            "points and flat figures seen from afar do: measure points off the plane or over more of the "
            "image, or give omega_deg, phi_deg, kappa_deg in images.csv"
        )
