"""The last steps of a resection: Levenberg-Marquardt on position and rotation over all points, from several starts.

The unknowns are the shift as a fraction of the distance and a small rotation in the camera frame, the residuals those
of ideal image coordinates as fractions of c, weighted as Cauchy does. The steps are taken here and only the linearised
projection is compiled: a whole loop compiles four times longer.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.collinearity import ExteriorOrientation, project_ideal
from jaxphoto.compiling import QUICK_TO_COMPILE
from jaxphoto.orientation.rays import padded_length
from jaxphoto.rotation import small_rotation

STARTS = 4
"""Orientations that are refined at a time."""
NO_LIMIT = 1e3
"""A limit, as a fraction of c, beyond all residuals: least squares."""
_STEPS = 40


class RefinedResections(NamedTuple):
    """`STARTS` orientations, each where its steps ended."""

    positions: Float[np.ndarray, "starts 3"]
    matrices: Float[np.ndarray, "starts 3 3"]
    costs: Float[np.ndarray, " starts"]
    """Sum of (robust) squares of residuals as fractions of c."""
    normals: Float[np.ndarray, "starts 6 6"]
    """Of the shift as a fraction of `distances` and the small rotation in the camera frame (rad)."""
    distances: Float[np.ndarray, " starts"]
    """In m, of each start from the middle of the points."""


def reprojection_errors(c_mm, ideal, points, positions, matrices) -> Float[np.ndarray, "orientations n"]:
    """Errors (mm) of every point in every solution; a point behind the camera counts as c."""
    camera = (matrices.reshape(-1, 3) @ points.T).reshape(-1, 3, len(points)) - matrices @ positions[:, :, None]
    in_front = camera[:, 2] < 0
    error = ideal.T + c_mm * camera[:, :2] / np.where(in_front, camera[:, 2], -1.0)[:, None]
    return np.where(in_front, np.minimum(np.hypot(error[:, 0], error[:, 1]), c_mm), c_mm)


def refined(c_mm: float, ideal, points, positions, matrices, limit: float) -> RefinedResections:
    """From one to `STARTS` starts. `points` (m) are about the origin; residuals beyond `limit` (of c) count less."""
    start = np.arange(STARTS) % len(positions)
    distance = np.linalg.norm(positions[start], axis=1)
    steps, damping = np.zeros((STARTS, 6)), np.full(STARTS, 1e-6)
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
    positions, matrices, cost, normal, _ = state
    return RefinedResections(positions, matrices, cost, normal, distance)


def _normal_equations(c_mm, ideal, points, limit, distance, positions, matrices, steps):
    """Per candidate, moved by its step: position, matrix, robust cost, normal matrix (6, 6) and right side (6)."""
    n = len(points)
    some = np.arange(padded_length(n)) % n  # padding repeats points; their rows are dropped again
    args = (positions, matrices, distance, steps, np.float64(c_mm), points[some])
    positions, matrices, projected, slope = (np.asarray(v) for v in _linearised(*args))
    residual, slope = (ideal.T - projected[:, :, :n]) / c_mm, slope[:, :, :n] / c_mm
    size = np.hypot(residual[:, 0], residual[:, 1])
    weight, robust = 1 / (1 + (size / limit) ** 2), limit**2 * np.log1p((size / limit) ** 2).sum(axis=1)
    # A blunder may lie behind the best candidate, but no step may take more points there.
    behind = matrices[:, 2] @ points.T >= np.sum(matrices[:, 2] * positions, axis=1)[:, None]
    cost = np.where(np.isfinite(robust), robust, np.inf) + behind.sum(axis=1) * n
    rows = slope.reshape(STARTS, 2 * n, 6)
    weighted = (slope * weight[:, None, :, None]).reshape(STARTS, 2 * n, 6).transpose(0, 2, 1)
    return positions, matrices, cost, weighted @ rows, (weighted @ residual.reshape(STARTS, 2 * n, 1))[..., 0]


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
