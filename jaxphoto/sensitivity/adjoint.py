"""Adjoint vectors: H lambda = de/dx, points eliminated, for many estimates e at once.

With M, C and F of `hessian`, the gain K = -V^-1 [W; Ws; D]' = -L^-T F, b the derivative of an estimate by the unknowns
of M and b_p that by the points,

    lambda = M^-1 [b + K_x' b_p; C K_mu' b_p]       of images and shared unknowns, and of mu
    lambda_p = V^-1 b_p + K lambda

These are a few products of numbers that lie still, with a matrix K that is sparse.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.small_matrices import unwhiten


class Estimates(NamedTuple):
    """Of what adjoint vectors are wanted; steps are those of the scaled increments."""

    unknowns: Int[np.ndarray, "n"]
    """Place in M of exterior orientations and shared unknowns, in the block's order."""
    step: Float[np.ndarray, "n"]
    turns: Float[np.ndarray, "images 3 3"]
    """From the small rotation of an image (rad) to its angles as they are reported."""
    points: Int[np.ndarray, "asked"]
    """Points whose coordinates are wanted, in padded order."""
    point_step: Float[np.ndarray, "asked 3"]


def adjoint_vectors(h: Any, of: Estimates) -> Float[np.ndarray, "unknowns estimates"]:
    """lambda of each estimate: at exterior orientations and shared unknowns in the block's order, mu, all points.

    `h` is an `Eliminated` of numbers that lie still.
    """
    n, k, asked = len(of.unknowns), len(h.c), len(of.points)
    n_points = h.l.shape[1]
    own = np.append(of.unknowns, len(h.m) - k + np.arange(k))
    # What is no unknown of the block meets nothing: its F is zero.
    place = np.zeros(int(max(h.of_rays.max(initial=0), h.of_border.max(initial=0), len(h.m))) + 1, int)
    place[own] = np.arange(n + k)
    inverse = _inverse(h.m.take(own, axis=0).take(own, axis=1), positive=not k)
    found = np.empty((n + k + 3 * n_points, n + 3 * asked))
    reduced = found[: n + k]

    np.multiply(inverse[:, :n], of.step, out=reduced[:, :n])
    # By component: a batch of products of 3 x 3 matrices takes several times as long.
    images = 6 * len(of.turns)
    angles = [reduced[:, j:images:6] for j in (3, 4, 5)]
    turned = [sum(a * turn for a, turn in zip(angles, of.turns[:, i].T, strict=True)) for i in range(3)]
    for i in range(3):
        angles[i][:] = turned[i]
    gain = _gain(h, place, n + k)
    of_asked = gain[(3 * of.points[:, None] + np.arange(3)).ravel()].toarray()
    down = of_asked.T * of.point_step.reshape(-1)
    reduced[:, n:] = inverse @ np.concatenate([down[:n], h.c @ down[n:]])

    found[n + k :] = gain @ reduced
    at_points = found[n + k :].reshape(n_points, 3, -1)
    for j, own_part in enumerate(_inverses_of(h.l[:, of.points].T) * of.point_step[:, None]):
        at_points[of.points[j], :, n + 3 * j : n + 3 * j + 3] += own_part
    return found


def _gain(h: Any, place: Int[np.ndarray, "unknowns"], size: int) -> "scipy.sparse.csr_array":
    """K = -L^-T F, three rows a point."""
    rows, values, columns = [], [], []
    for point, f, of in ((h.point, h.rays, h.of_rays), (np.arange(h.l.shape[1]), h.border, h.of_border)):
        gain = -np.stack(unwhiten(np.moveaxis(f, 0, -1), h.l[:, point]))
        rows.append(np.broadcast_to((3 * point + np.arange(3)[:, None])[:, None], gain.shape).ravel())
        columns.append(np.broadcast_to(place[of].T, gain.shape).ravel())
        values.append(gain.ravel())
    data, at = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_array((data, at), shape=(3 * h.l.shape[1], size)).tocsr()


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
