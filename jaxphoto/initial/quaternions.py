"""Vectorised rotations in NumPy, and the best rotation for a sum of vector products."""

import numpy as np
from jaxtyping import Float

from jaxphoto.rotation import CROSS


def matrices_from_quaternions(quaternions: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the rotation matrices `(w^2 - v'v) I + 2 v v' + 2 w [v]x` of unit quaternions (w, v)."""
    w, v = quaternions[..., 0, None, None], quaternions[..., 1:]
    square = w**2 - np.sum(v**2, axis=-1)[..., None, None]
    return square * np.eye(3) + 2 * v[..., :, None] * v[..., None, :] + 2 * w * cross_matrices(v)


def cross_matrices(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the matrices `[v]x` of the cross products v x a."""
    return (vectors @ CROSS.reshape(9, 3).T).reshape(*vectors.shape, 3)


def rotated(matrix: Float[np.ndarray, "*#n 3 3"], theta: Float[np.ndarray, "*#n 3"]) -> Float[np.ndarray, "*#n 3 3"]:
    """Return `small_rotation(theta) @ matrix` (see `jaxphoto.rotation`), theta in rad."""
    half = 0.5 * np.linalg.norm(theta, axis=-1, keepdims=True)
    quaternion = np.concatenate([np.cos(half), -0.5 * np.sinc(half / np.pi) * theta], axis=-1)
    return matrices_from_quaternions(quaternion) @ matrix


def cayley(theta):
    """Return `small_rotation(theta)` to second order (rad) of one NumPy or JAX vector: the quaternion (1, -theta / 2).

    The result is a rotation for any theta, with half as many operations to compile.
    """
    v = -0.5 * theta
    return ((1 - v @ v) * np.eye(3) + 2 * v[:, None] * v + 2 * (CROSS @ v)) / (1 + v @ v)


def best_rotations(products: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the rotation R with the largest sum of b' R a, where `products` is the sum of b a'.

    R is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix that is linear in the products (Horn
    1987, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A 4(4)). To average
    rotations R_i with weights w_i, pass `products` = sum w_i R_i: the matrix is then 4 sum w_i q_i q_i' plus a multiple
    of the identity.
    """
    m = products
    trace = np.trace(m, axis1=-2, axis2=-1)
    n = np.empty((*m.shape[:-2], 4, 4))
    n[..., 0, 0] = trace
    n[..., 1:, 1:] = m + np.swapaxes(m, -1, -2) - trace[..., None, None] * np.eye(3)
    axis = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], axis=-1)
    n[..., 0, 1:] = n[..., 1:, 0] = axis
    return matrices_from_quaternions(np.linalg.eigh(n)[1][..., -1])


def average_rotation(
    rotations: Float[np.ndarray, "n 3 3"], weights: Float[np.ndarray, " n"] | None = None
) -> tuple[Float[np.ndarray, "3 3"], float]:
    """Return the average of rotations, and the weighted root mean square (rad) of the angles to it.

    The eigenvector of the largest eigenvalue of sum w q q', with the unit quaternions q: their signs do not count.
    """
    w = np.ones(len(rotations)) if weights is None else np.asarray(weights, float)
    average = best_rotations(np.einsum("n,nij->ij", w, rotations))
    # From the chord, which has all digits where the arc cosine of the trace has half of them.
    chord = np.linalg.norm(rotations - average, axis=(1, 2))
    angles = 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))
    return average, float(np.sqrt(np.sum(w * angles**2) / np.sum(w)))
