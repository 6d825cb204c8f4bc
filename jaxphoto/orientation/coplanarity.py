"""The coplanarity condition of two images, and the relative orientation that meets it best.

    e = x_2' R (B x x_1) = det[B, x_1, R' x_2] = 0

with unit rays x_1 and x_2 in the camera frames, R = `camera_2_from_camera_1` and the base B, a unit vector in the
frame of camera 1. E = R [B]x is the essential matrix. The five unknowns are a small rotation in the frame of camera 2
and a shift of B in its tangent plane. Every condition has one residual, its misclosure e over the standard deviation
of e by the errors of both rays (Gauss-Helmert: `de = (E' x_2)' dx_1 + (E x_1)' dx_2`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.orientation.quaternions import cross_matrices, turned
from jaxphoto.orientation.rays import ray_noise

_STEPS = 50
_DAMPING = 1e-2  # first, of the diagonal: with less, few points of a flat scene leap over the nearest orientation
# Within a few sigmas of the epipole the condition is all noise, and the first order says nothing of that: there the
# epipole would be drawn to the point. Its variance of second order counts so many times.
_EPIPOLE = 50.0


class RayPairs(NamedTuple):
    """Rays of the same points in two images, a row for each point."""

    rays_1: Float[np.ndarray, "n 3"]
    rays_2: Float[np.ndarray, "n 3"]
    noise_1: Float[np.ndarray, "n 3 2"]
    """See `ray_noise`."""
    noise_2: Float[np.ndarray, "n 3 2"]
    floor: Float[np.ndarray, " n"]
    """What a variance of the condition is at least (rad^2)."""

    @staticmethod
    def of(rays_1: Float[np.ndarray, "n 3"], rays_2: Float[np.ndarray, "n 3"], sigma_rad: float) -> "RayPairs":
        """From unit rays in the camera frames and the sigma of image coordinates as a fraction of c."""
        noise = ray_noise(rays_1, sigma_rad), ray_noise(rays_2, sigma_rad)
        square_1, square_2 = (np.sum(one**2, axis=(1, 2)) for one in noise)
        return RayPairs(rays_1, rays_2, *noise, 0.5 * _EPIPOLE * square_1 * square_2)

    def take(self, which) -> "RayPairs":
        """Some of the rows."""
        return RayPairs(*(part[which] for part in self))


class RelativeFits(NamedTuple):
    """Relative orientations found by least squares."""

    rotations: Float[np.ndarray, "m 3 3"]
    bases: Float[np.ndarray, "m 3"]
    normals: Float[np.ndarray, "m 5 5"]
    """Normal matrices (rad^-2) of the small rotation in camera 2 and the shift of the base in its tangent plane."""


def tangent_plane(base: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 3 2"]:
    """Two unit vectors, as columns, across a unit vector and each other: the axes of small shifts of a base."""
    across = cross_matrices(base)
    least = np.argmin(np.abs(base), axis=-1)[..., None, None]
    first = np.take_along_axis(across, least, axis=-1)
    first = first / np.linalg.norm(first, axis=-2, keepdims=True)
    return np.concatenate([first, across @ first], axis=-1)


def essential(rotation: Float[np.ndarray, "*n 3 3"], base: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """The essential matrix `E = R [B]x`, of which `x_2' E x_1 = 0`."""
    return rotation @ cross_matrices(base)


def misclosures(essentials: Float[np.ndarray, "m 3 3"], pairs: RayPairs) -> Float[np.ndarray, "m n"]:
    """The misclosures of the coplanarity condition in units of their standard deviation, of many essential matrices."""
    by_1 = np.swapaxes(essentials, 1, 2) @ pairs.rays_2.T  # (m, 3, n)
    by_2 = essentials @ pairs.rays_1.T
    variance = np.broadcast_to(pairs.floor, (len(essentials), len(pairs.floor))).copy()
    for by, noise in ((by_1, pairs.noise_1), (by_2, pairs.noise_2)):
        for axis in range(2):
            variance += np.einsum("min,ni->mn", by, noise[:, :, axis]) ** 2
    return np.einsum("min,ni->mn", by_1, pairs.rays_1) / np.sqrt(np.maximum(variance, 1e-300))


def behind(
    rotations: Float[np.ndarray, "m 3 3"], bases: Float[np.ndarray, "m 3"], pairs: RayPairs, sigmas: float
) -> Bool[np.ndarray, "m n"]:
    """Which points lie behind a camera by more than `sigmas` standard deviations of their parallax, of many bases."""
    # The distances along the rays have the signs of (x_1 x x_2)'(B x x_2) and (x_1 x x_2)'(B x x_1).
    along_1, along_2 = bases @ pairs.rays_1.T, (rotations @ bases[:, :, None])[:, :, 0] @ pairs.rays_2.T
    cosine = np.sum((pairs.rays_2 @ rotations) * pairs.rays_1, axis=2)
    side_1, side_2 = (np.sqrt(np.maximum(1 - along**2, 1e-12)) for along in (along_1, along_2))
    angle = np.minimum((along_1 - cosine * along_2) / side_2, (cosine * along_1 - along_2) / side_1)
    sigma = np.sqrt(0.5 * (np.sum(pairs.noise_1**2, axis=(1, 2)) + np.sum(pairs.noise_2**2, axis=(1, 2))))
    return angle < -sigmas * sigma - 1e-12


def fitted(
    rotations: Float[np.ndarray, "m 3 3"],
    bases: Float[np.ndarray, "m 3"],
    pairs: RayPairs,
    counts: Bool[np.ndarray, "m n"],
    tolerance: float = 0.0,
) -> RelativeFits:
    """Least squares in the five unknowns from approximate orientations, each of the points that `counts` says.

    By Levenberg-Marquardt steps, of all at once. They end where a step is less than `tolerance` standard deviations,
    and at the latest where it is rounding.
    """
    state = _state(rotations, bases, pairs, counts)
    damping, under_way = np.full(len(rotations), _DAMPING), np.ones(len(rotations), bool)
    for _ in range(_STEPS):
        diagonal = np.einsum("mkk->mk", state.normals)
        scaled = damping[:, None] * (diagonal + 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-300)
        step = -np.linalg.solve(state.normals + scaled[:, :, None] * np.eye(5), state.right[..., None])[..., 0]
        trial = _state(*moved(state.rotations, state.bases, step), pairs, counts)
        better = under_way & (trial.costs <= state.costs)
        gain = np.einsum("mi,mij,mj->m", step, state.normals, step)
        state = _RelativeState(
            *(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(trial, state, strict=True))
        )
        damping = np.where(better, 0.1 * damping, np.maximum(10 * damping, 1e-9))
        # A small step that does not help: what is left is rounding.
        size = np.max(np.abs(step), axis=1)
        under_way &= ~((size < np.where(better, 1e-12, 1e-8)) | (better & (gain < tolerance**2)))
        if not under_way.any():
            break
    return RelativeFits(state.rotations, state.bases, state.normals)


def moved(
    rotations: Float[np.ndarray, "#m 3 3"], bases: Float[np.ndarray, "#m 3"], step: Float[np.ndarray, "#m 5"]
) -> tuple[Float[np.ndarray, "#m 3 3"], Float[np.ndarray, "#m 3"]]:
    """Orientations moved by a small rotation in camera 2 and a shift of the base in its tangent plane (rad)."""
    there = bases + (tangent_plane(bases) @ step[:, 3:, None])[..., 0]
    return turned(rotations, step[:, :3]), there / np.linalg.norm(there, axis=1, keepdims=True)


class _RelativeState(NamedTuple):
    rotations: Float[np.ndarray, "m 3 3"]
    bases: Float[np.ndarray, "m 3"]
    costs: Float[np.ndarray, " m"]
    normals: Float[np.ndarray, "m 5 5"]
    right: Float[np.ndarray, "m 5"]


def _state(rotations, bases, pairs: RayPairs, counts) -> _RelativeState:
    """Orientations with their squared misclosures, normal matrices and right sides."""
    value, slope = linearised(rotations, bases, pairs)
    value, slope = value * counts, slope * counts[..., None]
    across = np.swapaxes(slope, 1, 2)
    return _RelativeState(
        rotations, bases, np.sum(value**2, axis=1), across @ slope, (across @ value[..., None])[..., 0]
    )


def linearised(
    rotations: Float[np.ndarray, "m 3 3"], bases: Float[np.ndarray, "m 3"], pairs: RayPairs
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n 5"]]:
    """Misclosures in units of sigma and their derivatives by the five unknowns, those of the sigmas included."""
    x_1, x_2, in_1 = pairs.rays_1, pairs.rays_2, pairs.rays_2 @ rotations
    matrices = essential(rotations, bases)
    by_1, by_2 = x_2 @ matrices, x_1 @ np.swapaxes(matrices, 1, 2)
    noise_1, noise_2 = _along(by_1, pairs.noise_1), _along(by_2, pairs.noise_2)
    variance = np.sum(noise_1**2, axis=-1) + np.sum(noise_2**2, axis=-1) + pairs.floor
    sigma = np.sqrt(np.maximum(variance, 1e-300))
    value = np.sum(x_2 * by_2, axis=-1) / sigma
    # d sigma = (of_1' d by_1 + of_2' d by_2) / sigma
    share = (value / sigma)[..., None]
    of_1 = share * (pairs.noise_1 @ noise_1[..., None])[..., 0]
    of_2 = share * (pairs.noise_2 @ noise_2[..., None])[..., 0]
    turn = _cross(x_2, by_2 - of_1 @ np.swapaxes(matrices, 1, 2)) - _cross(of_2, by_2)
    shift = _cross(x_1, in_1 - of_2 @ rotations) - _cross(of_1, in_1)
    return value, np.concatenate([turn, shift @ tangent_plane(bases)], axis=-1) / sigma[..., None]


def error_directions(
    rotation: Float[np.ndarray, "3 3"], base: Float[np.ndarray, "3"], pairs: RayPairs
) -> Float[np.ndarray, "n 4"]:
    """How the misclosures in units of sigma move with the four image coordinates, in theirs.

    The product of two such rows is the correlation of the misclosures of one point in two orientations.
    """
    matrix = essential(rotation, base)
    by_1, by_2 = pairs.rays_2 @ matrix, pairs.rays_1 @ matrix.T
    rows = np.column_stack([_along(by_1, pairs.noise_1), _along(by_2, pairs.noise_2)])
    return rows / np.sqrt(np.sum(rows**2, axis=1) + np.maximum(pairs.floor, 1e-300))[:, None]


def _along(by, noise):
    return (by[..., None, :] @ noise)[..., 0, :]


def _cross(a, b):
    """Products of the rows of two tables: numpy.cross takes five times as long."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return result
