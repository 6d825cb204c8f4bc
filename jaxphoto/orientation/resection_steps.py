"""The last steps of a resection: Levenberg-Marquardt on position and rotation over all points, from several starts.

The unknowns are the shift as a fraction of the distance and a small rotation in the camera frame, the residuals those
of ideal image coordinates as fractions of c, weighted as Cauchy does. With V = M (X - S) the camera coordinates of a
point, u = (x, y) / c = -(V_x, V_y) / V_z, of which

    du / dV = -(I_xy + u e_z') / V_z,   dV = -M dS + V x theta

In NumPy, all starts at once: one image is too little work to compile anything for.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.orientation.quaternions import cross_matrices, turned

STARTS = 4
"""Orientations that are worth refining, at most."""
NO_LIMIT = 1e3
"""A limit, as a fraction of c, beyond all residuals: least squares."""
_STEPS = 40
_DONE, _ROUNDING = 1e-12, 1e-7  # steps (of the distance, rad) that end it, and those that do where they help no more
_GAIN, _NOTHING = 1e-10, 1e-28  # of the squared residuals, and the squared rounding error of one


class RefinedResections(NamedTuple):
    """Orientations, each where its steps ended."""

    positions: Float[np.ndarray, "starts 3"]
    matrices: Float[np.ndarray, "starts 3 3"]
    costs: Float[np.ndarray, " starts"]
    """Sum of (robust) squares of residuals as fractions of c; infinite with a point at the projection centre."""
    normals: Float[np.ndarray, "starts 6 6"]
    """Of the shift as a fraction of `distances` and the small rotation in the camera frame (rad)."""
    distances: Float[np.ndarray, " starts"]
    """In m, of each start from the middle of the points."""
    settled: Bool[np.ndarray, " starts"]
    """Whether the steps ended by themselves."""
    steps: int
    """How many there were, of all starts alike."""

    def best(self, n_points: int) -> int:
        """Return the index of the least cost; of costs that differ by rounding, one where the steps ended."""
        alike = self.costs <= (1 + _GAIN) * np.min(self.costs) + _NOTHING * n_points
        return int(np.lexsort((self.costs, ~self.settled, ~alike))[0])


class _ResectionState(NamedTuple):
    positions: Float[np.ndarray, "starts 3"]
    matrices: Float[np.ndarray, "starts 3 3"]
    costs: Float[np.ndarray, " starts"]
    normals: Float[np.ndarray, "starts 6 6"]
    right: Float[np.ndarray, "starts 6"]


def reprojection_errors(c_mm, ideal, points, positions, matrices) -> Float[np.ndarray, "orientations n"]:
    """Errors (mm) of every point in every solution; a point behind the camera counts as c."""
    camera = (matrices.reshape(-1, 3) @ points.T).reshape(-1, 3, len(points)) - matrices @ positions[:, :, None]
    in_front = camera[:, 2] < 0
    error = ideal.T + c_mm * camera[:, :2] / np.where(in_front, camera[:, 2], -1.0)[:, None]
    return np.where(in_front, np.minimum(np.hypot(error[:, 0], error[:, 1]), c_mm), c_mm)


def refined(c_mm: float, ideal, points, positions, matrices, limit: float) -> RefinedResections:
    """From one or more starts. `points` (m) are about the origin; residuals beyond `limit` (of c) count less."""
    distances = np.linalg.norm(positions, axis=1)
    damping, settled = np.full(len(positions), 1e-6), np.zeros(len(positions), bool)
    observed = ideal / c_mm
    state = _state(observed, points, limit, distances, positions, matrices)
    steps = 0
    while steps < _STEPS and not settled.all():
        steps += 1
        scaled = damping[:, None] * (np.einsum("skk->sk", state.normals) + 1e-15)
        step = np.linalg.solve(state.normals + scaled[:, :, None] * np.eye(6), state.right[..., None])[..., 0]
        trial = _state(observed, points, limit, distances, *moved(state.positions, state.matrices, distances, step))
        better = (trial.costs < state.costs) & ~settled
        much = state.costs - trial.costs > _GAIN * state.costs + _NOTHING * len(points)
        state = _ResectionState(*(_chosen(better, a, b) for a, b in zip(trial, state, strict=True)))
        damping *= np.where(better, 0.1, 10.0)
        # A small step that does not help: what is left is rounding.
        settled |= np.max(np.abs(step), axis=1) < np.where(much, _DONE, _ROUNDING)
    return RefinedResections(*state[:4], distances, settled, steps)


def both(one: RefinedResections, other: RefinedResections) -> RefinedResections:
    """The orientations of both, one after the other."""
    join = lambda name: np.concatenate([getattr(one, name), getattr(other, name)])  # noqa: E731
    return RefinedResections(
        join("positions"),
        join("matrices"),
        join("costs"),
        join("normals"),
        join("distances"),
        join("settled"),
        max(one.steps, other.steps),
    )


def moved(
    positions: Float[np.ndarray, "#starts 3"],
    matrices: Float[np.ndarray, "#starts 3 3"],
    distances: Float[np.ndarray, "#starts"],
    step: Float[np.ndarray, "#starts 6"],
) -> tuple[Float[np.ndarray, "#starts 3"], Float[np.ndarray, "#starts 3 3"]]:
    """Orientations moved by steps: shift as a fraction of the distance, small rotation in the camera frame (rad)."""
    return positions + distances[:, None] * step[:, :3], turned(matrices, step[:, 3:])


def linearised(
    points: Float[np.ndarray, "n 3"],
    positions: Float[np.ndarray, "starts 3"],
    matrices: Float[np.ndarray, "starts 3 3"],
    distances: Float[np.ndarray, " starts"],
) -> tuple[Float[np.ndarray, "starts n 2"], Float[np.ndarray, "starts n 2 6"], Bool[np.ndarray, "starts n"]]:
    """Image coordinates over c, their derivatives by the steps of `moved`, and which points are in front."""
    in_camera = (points - positions[:, None]) @ np.swapaxes(matrices, 1, 2)
    depth = -in_camera[..., 2]
    in_front = depth > 0
    depth = np.where(depth == 0, np.nan, depth)
    u = in_camera[..., :2] / depth[..., None]
    by_camera = np.zeros((*u.shape, 3))
    by_camera[..., 0, 0] = by_camera[..., 1, 1] = 1.0
    by_camera[..., 2] = u
    by_camera /= depth[..., None, None]
    shift = -by_camera @ (matrices * distances[:, None, None])[:, None]
    return u, np.concatenate([shift, by_camera @ cross_matrices(in_camera)], axis=3), in_front


def cost_at(c_mm: float, ideal, points, positions, matrices, limit: float) -> Float[np.ndarray, " starts"]:
    """Sum of robust squares of residuals as fractions of c, of orientations: as in `RefinedResections`."""
    ones = np.ones(len(positions))
    return _state(ideal / c_mm, points, limit, ones, positions, matrices).costs


def _chosen(better, new, old):
    return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _state(observed, points, limit, distances, positions, matrices) -> _ResectionState:
    """Orientations with their robust costs, normal matrices and right sides."""
    starts, n = len(positions), len(points)
    u, slope, in_front = linearised(points, positions, matrices, distances)
    residual = observed - u
    size = (np.sum(residual**2, axis=2)) / limit**2
    cost = limit**2 * np.log1p(size).sum(axis=1)
    # A blunder may lie behind the best candidate, but no step may take more points there.
    cost = np.where(np.isfinite(cost), cost, np.inf) + (~in_front).sum(axis=1) * n
    rows = slope.reshape(starts, 2 * n, 6)
    weighted = np.swapaxes((slope / (1 + size)[..., None, None]).reshape(starts, 2 * n, 6), 1, 2)
    right = (weighted @ residual.reshape(starts, 2 * n, 1))[..., 0]
    return _ResectionState(positions, matrices, cost, np.nan_to_num(weighted @ rows), np.nan_to_num(right))
