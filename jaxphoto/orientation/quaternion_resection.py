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

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.orientation.quaternions import best_rotations, turned
from jaxphoto.orientation.rays import ideal_coordinates, unit_rays
from jaxphoto.orientation.resection import checked_points
from jaxphoto.orientation.resection_steps import (
    NO_LIMIT,
    STARTS,
    RefinedResections,
    both,
    moved,
    refined,
    reprojection_errors,
)
from jaxphoto.orientation.resection_tests import check_determined, check_linear, check_unique

_TURNS = 50
_SETTLED = 1e-3  # change of the rotations after which no more turns are taken
_POINTS = 60  # at most that are paired
_INCLINED = np.deg2rad(40.0)
_FEW = 8  # so many points may be far from a plane: cameras turned by quarters about its normal, too
_APART = 0.05  # chord of rotations that lead to different results
_ASIDE = np.array([-0.3, -0.03, 0.03, 0.3])  # of the distance and in rad together
# A standard deviation, of the distance or in rad, beyond which an orientation is no start for anything.
_OPEN = 0.1
_HOPELESS = 0.05  # root mean square residual as a fraction of c


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
    settled: bool
    """Whether they ended because the rotation no longer changed (by 1e-3), rather than at the fiftieth."""
    steps: int
    """Gauss-Newton steps after them, at most 40."""


class _Turned(NamedTuple):
    """Orientations that the quaternion solution ends with, how many turns it took, and whether it settled."""

    positions: Float[np.ndarray, "starts 3"]
    matrices: Float[np.ndarray, "starts 3 3"]
    turns: int
    settled: bool


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

    Raises BlockError where there are fewer than four distinct points (three leave up to four solutions), a coordinate
    is no number, the points lie on a line or in a plane with the projection centre, the orientation is left open by
    more than 0.1 of the distance or 0.1 rad or by more than a covariance can tell, because the projection centre lies
    with the points on a dangerous curve or cylinder, two orientations fit equally well (small flat figures seen from
    afar), or none fits. ValueError where `sigma_mm` is not positive or there are not as many points as coordinates.
    """
    c, ideal = float(interior.c), ideal_coordinates(interior, np.asarray(xy_mm, float))
    if not sigma_mm > 0:
        raise ValueError(f"the standard deviation of image coordinates is positive, but sigma_mm is {sigma_mm}")
    local, origin = checked_points(ideal, points, image)
    start = _starts(c, ideal, local)
    found = refined(c, ideal, local, start.positions, start.matrices, NO_LIMIT)
    positions, matrices = _alike(c, ideal, local, found)
    found = both(found, refined(c, ideal, local, positions, matrices, NO_LIMIT))
    best = found.best(len(local))
    cost, redundancy = float(found.costs[best]), 2 * len(local) - 6
    if not cost < 2 * len(local) * _HOPELESS**2:
        raise BlockError(
            f"no position and attitude of image {image} brings its known points near their images: check their ids, "
            "the units and axes of the image coordinates, and c_mm; resect can leave wrong points aside"
        )
    sigma = sigma_mm / c
    sigma0 = float(np.sqrt(cost / redundancy)) / sigma
    noise = sigma * max(1.0, sigma0)
    check_determined(found, best, noise, image, _OPEN)
    check_unique(found, best, noise, image)
    check_linear(c, ideal, local, found, best, noise, image)
    scale = np.repeat([found.distances[best], 1.0], 3)
    position, matrix = found.positions[best], found.matrices[best]
    in_camera = (local - position) @ matrix.T
    return Resection(
        origin + position,
        matrix,
        sigma**2 * scale[:, None] * np.linalg.inv(found.normals[best]) * scale,
        sigma0,
        ideal + c * in_camera[:, :2] / in_camera[:, 2:],
        start.turns,
        start.settled,
        found.steps,
    )


def _starts(c, ideal, points) -> _Turned:
    """Up to `STARTS` orientations from the quaternion solution, best first."""
    matrices = _from_plane(ideal, points)
    product = _condition(unit_rays(c, ideal), points)
    turns, change = 0, np.inf
    while turns < _TURNS and change > _SETTLED:
        new = best_rotations((matrices.reshape(-1, 9) @ product).reshape(-1, 3, 3))
        change, matrices, turns = np.max(np.abs(new - matrices)), new, turns + 1
    # The rays turned round, from the points: sum (I - d d') (S - X) = 0.
    directions = unit_rays(c, ideal) @ matrices
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    right = np.einsum("snij,nj->si", across, points)
    positions = np.linalg.solve(across.sum(axis=1), right[..., None])[..., 0]
    errors = np.sum(reprojection_errors(c, ideal, points, positions, matrices) ** 2, axis=1)
    chosen: list[int] = []
    for k in np.argsort(errors, kind="stable"):
        if all(np.linalg.norm(matrices[k] - matrices[i]) > _APART for i in chosen):
            chosen.append(int(k))
    return _Turned(positions[chosen[:STARTS]], matrices[chosen[:STARTS]], turns, bool(change <= _SETTLED))


def _condition(rays, points) -> Float[np.ndarray, "9 9"]:
    """What takes M, row by row, to the sum of n (|V|^2 M' n - V V' M' n)', of which the next M is the best rotation."""
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(int))
    j, k = some[np.stack(np.triu_indices(len(some), 1))]
    normals, sides = np.cross(rays[j], rays[k]), points[k] - points[j]
    sides = sides / np.sqrt(np.mean(np.sum(sides**2, axis=1)))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    useful = length[:, 0] > 1e-9
    normals, sides = (normals / np.maximum(length, 1e-300))[useful], sides[useful]
    twice = (normals[:, :, None] * normals[:, None]).reshape(-1, 9)
    across = np.sum(sides**2, axis=1)[:, None, None] * np.eye(3) - sides[:, :, None] * sides[:, None]
    result = (twice.T @ across.reshape(-1, 9)).reshape(3, 3, 3, 3)  # (row, row, column, column)
    return result.transpose(0, 2, 1, 3).reshape(9, 9)


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


def _alike(c, ideal, points, found: RefinedResections):
    """Where else the points may look as they do from the best place: positions and matrices.

    To both sides along the direction that is least determined, which leads over a dangerous cylinder to the orientation
    beyond it. And of a distant flat figure half a turn about its normal, and another about the sight line.
    """
    best = found.best(len(points))
    position, matrix, distance = found.positions[best], found.matrices[best], found.distances[best : best + 1]
    weakest = np.linalg.eigh(found.normals[best])[1][:, 0]
    steps = np.outer(_ASIDE, weakest)
    positions, matrices = moved(position[None], matrix[None], distance, steps)
    normal = np.linalg.svd(points, full_matrices=False)[2][2]
    sight = -position / np.linalg.norm(position)
    half_turn = lambda axis: 2 * np.outer(axis, axis) - np.eye(3)  # noqa: E731
    mirrored = matrix @ half_turn(sight) @ half_turn(normal)
    beyond = mirrored.T @ (matrix @ position)
    error = reprojection_errors(c, ideal, points, beyond[None], mirrored[None])
    if np.sqrt(np.mean(error**2)) < _HOPELESS * c:
        positions, matrices = np.concatenate([positions, beyond[None]]), np.concatenate([matrices, mirrored[None]])
    return positions, matrices
