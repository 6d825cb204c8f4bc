"""Adjoint vectors: H lambda = de/dx, points eliminated, for many estimates e at once.

With M, C and the gain K = -V^-1 [W; Ws; D]' of `hessian`, b the derivative of an estimate by the unknowns of M and b_p
that by the points,

    lambda = M^-1 [b + K_x' b_p; C K_mu' b_p]       of images and shared unknowns, and of mu
    lambda_p = V^-1 b_p + K lambda

These are a few dense products of numbers that lie still, which BLAS does best.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int


class Estimates(NamedTuple):
    """Of what adjoint vectors are wanted; steps are those of the scaled increments."""

    unknowns: Int[np.ndarray, "n"]
    """Place in M of exterior orientations and shared unknowns, in the block's order."""
    step: Float[np.ndarray, "n"]
    turns: Float[np.ndarray, "images 3 3"]
    """From the small rotation of an image (rad) to its angles as they are reported."""
    points: Int[np.ndarray, "asked"]
    """Points whose coordinates are wanted, in the order of the tiles."""
    point_step: Float[np.ndarray, "asked 3"]


def adjoint_vectors(h: Any, of: Estimates) -> Float[np.ndarray, "unknowns estimates"]:
    """lambda of each estimate: at exterior orientations and shared unknowns in the block's order, mu, all points.

    `h` is an `Eliminated` of numbers that lie still.
    """
    n, k, asked = len(of.unknowns), len(h.c), len(of.points)
    tiles, p, _, f = h.gain.shape
    own = np.append(of.unknowns, len(h.m) - k + np.arange(k))
    # Images that are padding meet nothing: their gain is zero.
    place = np.zeros(len(h.m), int)
    place[own] = np.arange(n + k)
    touched = place[h.touched]
    inverse = _inverse(h.m.take(own, axis=0).take(own, axis=1), positive=not k)
    found = np.empty((n + k + 3 * p * tiles, n + 3 * asked))
    reduced = found[: n + k]

    np.multiply(inverse[:, :n], of.step, out=reduced[:, :n])
    # By component: a batch of products of 3 x 3 matrices takes several times as long.
    images = 6 * len(of.turns)
    angles = [reduced[:, j:images:6] for j in (3, 4, 5)]
    turned = [sum(a * turn for a, turn in zip(angles, of.turns[:, i].T, strict=True)) for i in range(3)]
    for i in range(3):
        angles[i][:] = turned[i]
    tile, slot = np.divmod(of.points, p)
    right = np.zeros((asked, 3, n + k))
    met = h.gain[tile, slot] * of.point_step[:, :, None]
    np.add.at(right, (np.arange(asked)[:, None, None], np.arange(3)[:, None], touched[tile][:, None]), met)
    down = right.reshape(3 * asked, n + k).T
    reduced[:, n:] = inverse @ np.concatenate([down[:n], h.c @ down[n:]])

    of_points = found[n + k :].reshape(tiles, 3 * p, -1)
    for gain, unknowns, result in zip(h.gain.reshape(tiles, 3 * p, f), touched, of_points, strict=True):
        np.matmul(gain, reduced[unknowns], out=result)
    at_points = of_points.reshape(tiles, p, 3, -1)
    for j, own_part in enumerate(_inverses_of(h.l[tile, :, slot]) * of.point_step[:, None]):
        at_points[tile[j], slot[j], :, n + 3 * j : n + 3 * j + 3] += own_part
    return found


def _inverse(m: Float[np.ndarray, "n n"], positive: bool) -> Float[np.ndarray, "n n"]:
    """Of a matrix that may be symmetric and positive definite: half of it, then, by Cholesky."""
    lower, failed = scipy.linalg.lapack.dpotrf(m.T, lower=True) if positive else (m, True)
    if failed:
        return np.linalg.inv(m)
    # What lies above the diagonal is zero.
    half = scipy.linalg.lapack.dpotri(lower, lower=True, overwrite_c=True)[0]
    inverse = half + half.T
    np.fill_diagonal(inverse, half.diagonal())
    return inverse


def _inverses_of(l: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 3 3"]:  # noqa: E741
    """V^-1 of V = L L'."""
    lower = np.zeros((len(l), 3, 3))
    lower[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = l
    inverse = np.linalg.inv(lower)
    return inverse.swapaxes(1, 2) @ inverse
