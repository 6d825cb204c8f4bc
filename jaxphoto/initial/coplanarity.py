"""Coplanarity condition of two images, and its least-squares solution.

    e = x_2' R (B x x_1) = det[B, x_1, R' x_2] = 0

x_1 and x_2 are unit rays in the camera frames, R = `camera_2_from_camera_1`, and the base B is a unit vector in the
frame of camera 1. E = R [B]x is the essential matrix. The five unknowns are a small rotation in the frame of camera 2
and a shift of B in its tangent plane. Each condition has one residual: its misclosure e divided by the standard
deviation of e, propagated from both rays (Gauss-Helmert: `de = (E' x_2)' dx_1 + (E x_1)' dx_2`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.compiling import call_compiled
from jaxphoto.initial.quaternions import cayley, cross_matrices, rotated
from jaxphoto.initial.rays import padded, padded_length, ray_noise
from jaxphoto.least_squares import least_squares
from jaxphoto.rotation import CROSS

# Initial lambda. With smaller values, few points of a flat scene overshoot the nearest orientation.
_DAMPING = 1e-2
# Factor of the second-order variance. Within a few sigmas of the epipole the condition is pure noise, which the
# first-order variance ignores: the adjustment would move the epipole towards the point.
_EPIPOLE = 50.0
# Batch sizes of orientations for which programs are compiled; the first only for more than `_MANY_POINTS` points.
_STARTS, _MANY_POINTS = (2, 8, 40), 512


class RayPairs(NamedTuple):
    """Rays of corresponding points in two images, one row per point."""

    rays_1: Float[np.ndarray, "n 3"]
    rays_2: Float[np.ndarray, "n 3"]
    noise_1: Float[np.ndarray, "n 3 2"]
    """See `ray_noise`."""
    noise_2: Float[np.ndarray, "n 3 2"]
    floor: Float[np.ndarray, " n"]
    """Minimum variance of the condition (rad^2)."""

    @staticmethod
    def of(rays_1: Float[np.ndarray, "n 3"], rays_2: Float[np.ndarray, "n 3"], sigma_rad: float) -> "RayPairs":
        """Create from unit rays in the camera frames and the sigma of image coordinates as a fraction of c."""
        noise = ray_noise(rays_1, sigma_rad), ray_noise(rays_2, sigma_rad)
        square_1, square_2 = (np.sum(one**2, axis=(1, 2)) for one in noise)
        return RayPairs(rays_1, rays_2, *noise, 0.5 * _EPIPOLE * square_1 * square_2)

    def take(self, which) -> "RayPairs":
        """Select rows."""
        return RayPairs(*(part[which] for part in self))


class RelativeFits(NamedTuple):
    """Relative orientations, their misclosures and normal equations."""

    rotations: Float[np.ndarray, "m 3 3"]
    bases: Float[np.ndarray, "m 3"]
    values: Float[np.ndarray, "m n"]
    """Misclosures of all points divided by their standard deviations."""
    slopes: Float[np.ndarray, "m n 5"]
    """Derivatives of `values` with respect to the small rotation in camera 2 and the shift of the base in its tangent
    plane.
    """
    normals: Float[np.ndarray, "m 5 5"]
    """J'J of the points used."""


def tangent_plane(base: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m 3 2"]:
    """Return two orthogonal unit vectors, as columns, perpendicular to a unit vector: the axes of small shifts of a
    base.
    """
    across = cross_matrices(base)
    least = np.argmin(np.abs(base), axis=-1)[..., None, None]
    first = np.take_along_axis(across, least, axis=-1)
    first = first / np.linalg.norm(first, axis=-2, keepdims=True)
    return np.concatenate([first, across @ first], axis=-1)


def moved(
    rotations: Float[np.ndarray, "#m 3 3"], bases: Float[np.ndarray, "#m 3"], step: Float[np.ndarray, "#m 5"]
) -> tuple[Float[np.ndarray, "#m 3 3"], Float[np.ndarray, "#m 3"]]:
    """Apply a small rotation in camera 2 and a shift of the base in its tangent plane (rad) to orientations."""
    there = bases + (tangent_plane(bases) @ step[:, 3:, None])[..., 0]
    return rotated(rotations, step[:, :3]), there / np.linalg.norm(there, axis=1, keepdims=True)


def essential(rotation: Float[np.ndarray, "*n 3 3"], base: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the essential matrix `E = R [B]x`, with `x_2' E x_1 = 0`."""
    return rotation @ cross_matrices(base)


def misclosures(essentials: Float[np.ndarray, "m 3 3"], pairs: RayPairs) -> Float[np.ndarray, "m n"]:
    """Return the standardised coplanarity misclosures of many essential matrices."""
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
    """Return True for points behind a camera by more than `sigmas` standard deviations of their parallax."""
    # The distances along the rays have the signs of (x_1 x x_2)'(B x x_2) and (x_1 x x_2)'(B x x_1).
    along_1, along_2 = bases @ pairs.rays_1.T, (rotations @ bases[:, :, None])[:, :, 0] @ pairs.rays_2.T
    cosine = np.sum((pairs.rays_2 @ rotations) * pairs.rays_1, axis=2)
    side_1, side_2 = (np.sqrt(np.maximum(1 - along**2, 1e-12)) for along in (along_1, along_2))
    angle = np.minimum((along_1 - cosine * along_2) / side_2, (cosine * along_1 - along_2) / side_1)
    sigma = np.sqrt(0.5 * (np.sum(pairs.noise_1**2, axis=(1, 2)) + np.sum(pairs.noise_2**2, axis=(1, 2))))
    return angle < -sigmas * sigma - 1e-12


def fit(
    rotations: Float[np.ndarray, "m 3 3"],
    bases: Float[np.ndarray, "m 3"],
    pairs: RayPairs,
    used: Bool[np.ndarray, "m n"],
    tolerance: float = 1e-9,
) -> RelativeFits:
    """Adjust the five unknowns of each approximate orientation by least squares, each with its own set of points.

    Iterates until a step is below `tolerance` standard deviations.
    """
    m, n = len(rotations), len(pairs.rays_1)
    rows = padded_length(n)
    starts = next(k for k in (*_STARTS[rows <= _MANY_POINTS :], m) if k >= m)
    rays = RayPairs(*(padded(part, rows) for part in pairs))
    used_rows = np.zeros((starts, rows), bool)
    used_rows[:m, :n] = used
    rotations, bases = padded(rotations, starts), padded(bases, starts)
    place = rotations, bases, tangent_plane(bases), rays
    rotations, bases = map(np.asarray, call_compiled(_fitted, *place, used_rows, np.asarray(tolerance, float)))
    linearised = call_compiled(_linearised, rotations, bases, tangent_plane(bases), rays)
    values, slopes = (np.asarray(v)[:m, :n] for v in linearised)
    normals = np.swapaxes(slopes * used[..., None], 1, 2) @ slopes
    return RelativeFits(rotations[:m], bases[:m], values, slopes, normals)


def _moved(step, rotation, base, tangent):
    base = base + tangent @ step[3:]
    return cayley(step[:3]) @ rotation, base / jnp.linalg.norm(base)


def _misclosures(step, rotation, base, tangent, pairs: RayPairs):
    """Return the standardised misclosures of one orientation after a step of the five unknowns."""
    rotation, base = _moved(step, rotation, base, tangent)
    matrix = rotation @ (CROSS @ base)
    by_1, by_2 = pairs.rays_2 @ matrix, pairs.rays_1 @ matrix.T
    along = [jnp.einsum("ni,nij->nj", by, noise) for by, noise in ((by_1, pairs.noise_1), (by_2, pairs.noise_2))]
    variance = jnp.sum(along[0] ** 2 + along[1] ** 2, axis=1) + pairs.floor
    return jnp.sum(pairs.rays_2 * by_2, axis=1) / jnp.sqrt(jnp.maximum(variance, 1e-300))


@eqx.filter_jit
def _fitted(rotations, bases, tangents, pairs, used, tolerance):
    def fitted(rotation, base, tangent, used):
        residuals = lambda x, _: used * _misclosures(x, rotation, base, tangent, pairs)  # noqa: E731
        step = least_squares(residuals, jnp.zeros(5), damping=_DAMPING, atol=tolerance).unknowns
        return _moved(step, rotation, base, tangent)

    return jax.vmap(fitted)(rotations, bases, tangents, used)


@eqx.filter_jit
def _linearised(rotations, bases, tangents, pairs):
    def one(rotation, base, tangent):
        misclosures = lambda step: _misclosures(step, rotation, base, tangent, pairs)  # noqa: E731
        return misclosures(jnp.zeros(5)), jax.jacfwd(misclosures)(jnp.zeros(5))

    return jax.vmap(one)(rotations, bases, tangents)


def error_directions(
    rotation: Float[np.ndarray, "3 3"], base: Float[np.ndarray, "3"], pairs: RayPairs
) -> Float[np.ndarray, "n 4"]:
    """Return the derivatives of the standardised misclosures with respect to the four image coordinates, in their
    sigmas.

    The product of two such rows is the correlation of one point's misclosures in two orientations.
    """
    matrix = essential(rotation, base)
    sides = ((pairs.rays_2 @ matrix, pairs.noise_1), (pairs.rays_1 @ matrix.T, pairs.noise_2))
    rows = np.concatenate([np.einsum("ni,nij->nj", by, noise) for by, noise in sides], axis=1)
    return rows / np.sqrt(np.sum(rows**2, axis=1) + np.maximum(pairs.floor, 1e-300))[:, None]
