"""Cholesky factorisation of a block tridiagonal matrix with a dense border: the reduced normal matrix.

    A = [A11 A21'             S1']     images: k column blocks of m unknowns; only adjacent ones are coupled,
        [A21 A22 A32'         S2']     Aij = 0 for |i - j| > 1
        [    A32 A33 ...      S3']     shared: q unknowns coupled to everything (border S, corner C)
        [S1  S2  S3  ...      C  ]

Its factor L (A = L L') has the same block pattern. Column blocks j are processed in order, with P the rows of A below
the diagonal block and W the Schur complement after elimination of columns 1..j-1:

    Ljj Ljj' = Wjj,   LPj = WPj Ljj'^-1,   WPP -= LPj LPj'                                   10 m^3 / 3 operations

The inverse Z of A satisfies Z L = L'^-1. Backwards, from the blocks ZPP below (Takahashi, Fagan and Chin):

    G = LPj Ljj^-1,   ZPj = -ZPP G,   Zjj = Ljj'^-1 Ljj^-1 + G' ZPP G

requires only the blocks of Z in the band and the border; columns of the full inverse follow by ZRj = -[ZR,j+1 ZR,q] G.
The last column block and the shared unknowns form one dense block, the end; for k = 1 there is no other block.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.linear_algebra import cholesky, solve_lower, solve_lower_right, solve_lower_transposed, unit_like

# Maximum size of a triangle inverted directly. Larger ones are assembled from halves: a matrix product is five times as
# fast as trsm of BLAS.
_LEAF = 32


class Band(NamedTuple):
    """Symmetric matrix of images, ordered so that only adjacent column blocks are coupled, and shared unknowns."""

    columns: Float[Array, "inner 2m m"]
    """All column blocks j but the last: rows 0..m-1 are A[j, j] (lower triangle), rows m..2m-1 are A[j+1, j]."""
    border: Float[Array, "q inner*m"]
    """A[shared, images of these blocks]."""
    end: Float[Array, "m+q m+q"]
    """The last column block and the shared unknowns; lower triangle."""


class BandFactor(NamedTuple):
    """Lower Cholesky factor of a `Band`, in the same storage; zero above the diagonal."""

    columns: Float[Array, "inner 2m m"]
    border: Float[Array, "q inner*m"]
    end: Float[Array, "m+q m+q"]


class SelectedInverse(NamedTuple):
    """Blocks of the inverse inside band and border, stored like a `Band` but with both triangles of the diagonal."""

    columns: Float[Array, "inner 2m m"]
    border: Float[Array, "q inner*m"]
    end: Float[Array, "m+q m+q"]


def factor_band(band: Band) -> BandFactor:
    """Return L of A = L L'; NaN from the first column block that is not positive definite (the last includes the shared
    unknowns).
    """
    inner, _, m = band.columns.shape
    if not inner:
        return BandFactor(band.columns, band.border, cholesky(band.end))
    border = _split_border(band.border, inner)

    def eliminate(left, at):
        diagonal, shared, corner = left
        j, next_shared = at
        column = jax.lax.dynamic_index_in_dim(band.columns, j, keepdims=False)
        # The end follows the inner blocks.
        following = jax.lax.dynamic_index_in_dim(band.columns, jnp.minimum(j + 1, inner - 1), keepdims=False)
        following = jnp.where(j + 1 < inner, following[:m], band.end[:m, :m])
        lower = cholesky(diagonal)
        panel = solve_lower_right(lower, jnp.concatenate([column[m:], shared]))
        product = panel @ panel.T
        left = (following - product[:m, :m], next_shared - product[m:, :m], corner - product[m:, m:])
        return left, (jnp.concatenate([lower, panel[:m]]), panel[m:])

    following = jnp.concatenate([border[1:], band.end[None, m:, :m]])
    left = (band.columns[0, :m], border[0], band.end[m:, m:])
    (diagonal, shared, corner), (columns, borders) = jax.lax.scan(eliminate, left, (np.arange(inner), following))
    end = cholesky(_with_border(diagonal, shared, corner))
    return BandFactor(columns, _join_border(borders), end)


def solve_band(factor: BandFactor, right: Float[Array, "unknowns *c"]) -> Float[Array, "unknowns *c"]:
    """Solve A x = b for one right-hand side or for columns; the n + q unknowns are images, then shared.

    L y = b forwards, L' x = y backwards.
    """
    columns, border, end = factor
    inner, _, m = columns.shape
    b = right.reshape(len(right), -1)
    if not inner:
        return solve_lower_transposed(end, solve_lower(end, b)).reshape(right.shape)
    n = (inner + 1) * m
    images, shared = b[:n].reshape(inner + 1, m, -1), b[n:]

    # Read columns in place: as scanned arguments they would be copied, which takes as long as the solution.
    def down(left, at):
        j, following = at
        column = jax.lax.dynamic_index_in_dim(columns, j, keepdims=False)
        y = solve_lower(column[:m], left)
        return following - column[m:] @ y, y

    left, y = jax.lax.scan(down, images[0], (np.arange(inner), images[1:]))
    shared = shared - border @ y.reshape(n - m, -1)
    last = solve_lower_transposed(end, solve_lower(end, jnp.concatenate([left, shared])))

    def back(after, at):
        j, y = at
        column = jax.lax.dynamic_index_in_dim(columns, j, keepdims=False)
        x = solve_lower_transposed(column[:m], y - column[m:].T @ after)
        return x, x

    y = y - (border.T @ last[m:]).reshape(y.shape)
    _, x = jax.lax.scan(back, last[:m], (np.arange(inner), y), reverse=True)
    return jnp.concatenate([x.reshape(n - m, -1), last]).reshape(right.shape)


def selected_inverse(factor: BandFactor) -> SelectedInverse:
    """Return the blocks of A^-1 inside band and border by Takahashi's recursion (see the module docstring)."""
    return _invert_inside(factor)[0]


def invert_band(factor: BandFactor) -> Float[Array, "unknowns unknowns"]:
    """Return the full A^-1, symmetric, images first; 2 n^2 m operations in addition to `selected_inverse`."""
    inside, gains = _invert_inside(factor)
    inner, _, m = inside.columns.shape
    if not inner:
        return inside.end
    n, q = (inner + 1) * m, len(inside.border)
    border = jnp.concatenate([inside.border, inside.end[m:, :m]], axis=1)
    inverse = jnp.zeros((n + q, n + q)).at[n:, : n - m].set(inside.border).at[n - m :, n - m :].set(inside.end)

    # Column block j is valid from row block j on; rows above are not used.
    def fill(k, inverse):
        j = inner - 1 - k
        after = jax.lax.dynamic_slice(inverse, (0, (j + 1) * m), (n, m))
        column = -jnp.concatenate([after, border.T], axis=1) @ gains[j].T
        column = jax.lax.dynamic_update_slice(column, inside.columns[j, :m], (j * m, 0))
        return jax.lax.dynamic_update_slice(inverse, column, (0, j * m))

    return _symmetric(jax.lax.fori_loop(0, inner, fill, inverse))


def dense(band: Band) -> Float[Array, "unknowns unknowns"]:
    """Return the full symmetric A: for small blocks and tests."""
    inner, _, m = band.columns.shape
    n, each = (inner + 1) * m, np.arange(inner)
    images = jnp.zeros((inner + 1, m, inner + 1, m)).at[each, :, each, :].set(band.columns[:, :m])
    images = images.at[each + 1, :, each, :].set(band.columns[:, m:]).at[inner, :, inner, :].set(band.end[:m, :m])
    border = jnp.concatenate([band.border, band.end[m:, :m]], axis=1)
    return _with_border(_symmetric(images.reshape(n, n)), border, _symmetric(band.end[m:, m:]))


def diagonal_of(stored: Band | BandFactor) -> Float[Array, " unknowns"]:
    """Return the diagonal, images first."""
    m = stored.columns.shape[2]
    images = jnp.diagonal(stored.columns[:, :m], axis1=1, axis2=2).reshape(-1)
    return jnp.concatenate([images, jnp.diagonal(stored.end)])


def pivots(diagonal: Float[Array, " unknowns"], factor: BandFactor) -> Float[Array, " unknowns"]:
    """Return the squared diagonal of L over the diagonal of A (over 1 if that is not positive), images first.

    This is the information of an unknown that remains after elimination of the preceding unknowns: near zero at a rank
    defect.
    """
    return diagonal_of(factor) ** 2 / jnp.where(diagonal > 0, diagonal, 1.0)


def _invert_inside(factor: BandFactor) -> tuple[SelectedInverse, Float[Array, "inner m p"]]:
    """Return the selected inverse, and G' of all columns but the last."""
    inner, _, m = factor.columns.shape
    end = _invert_dense(factor.end)
    if not inner:
        return SelectedInverse(factor.columns, factor.border, end), jnp.zeros((0, m, len(end)))
    corner = end[m:, m:]

    def invert(after, at):
        # Use only products A B': XLA takes twice as long for A' B.
        column, shared = at
        own = _invert_triangle(column[:m])
        gain = own @ jnp.concatenate([column[m:], shared]).T
        panel = gain @ after
        diagonal = jnp.concatenate([own, gain], axis=1) @ jnp.concatenate([own, panel], axis=1).T
        diagonal, below, shared = _mean(diagonal), -panel[:, :m].T, -panel[:, m:].T
        return _with_border(diagonal, shared, corner), (gain, jnp.concatenate([diagonal, below]), shared)

    at = (factor.columns, _split_border(factor.border, inner))
    _, (gains, columns, borders) = jax.lax.scan(invert, end, at, reverse=True)
    return SelectedInverse(columns, _join_border(borders), end), gains


def _invert_dense(lower: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return (L L')^-1 from products of halves, which skip the zeros of the triangle."""
    first, across, second = _invert_halves(lower)
    corner = across @ second.T
    images = _mean(first @ first.T + across @ across.T)
    return jnp.block([[images, corner], [corner.T, _mean(second @ second.T)]])


def _invert_halves(lower: Float[Array, "m m"]) -> tuple[Array, Array, Array]:
    h = len(lower) // 2
    first, second = _invert_triangle(lower[:h, :h]), _invert_triangle(lower[h:, h:])
    return first, -(first @ lower[h:, :h].T) @ second, second


def _invert_triangle(lower: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return the transposed inverse of a lower triangle."""
    m = len(lower)
    if m <= _LEAF:
        return solve_lower_transposed(lower, unit_like(lower))
    first, across, second = _invert_halves(lower)
    return jnp.block([[first, across], [jnp.zeros((m - len(first), len(first))), second]])


def _symmetric(lower: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Complete a symmetric matrix from its lower triangle."""
    return jnp.tril(lower) + jnp.tril(lower, -1).T


def _mean(a: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return the exactly symmetric mean of a matrix and its transpose: floating-point products may differ in the last
    bit.
    """
    return 0.5 * (a + a.T)


def _with_border(
    images: Float[Array, "n n"], border: Float[Array, "q n"], corner: Float[Array, "q q"]
) -> Float[Array, "n+q n+q"]:
    return jnp.block([[images, border.T], [border, corner]])


def _split_border(border: Float[Array, "q n"], k: int) -> Float[Array, "k q m"]:
    return border.reshape(len(border), k, border.shape[1] // k).transpose(1, 0, 2)


def _join_border(border: Float[Array, "k q m"]) -> Float[Array, "q n"]:
    k, q, m = border.shape
    return border.transpose(1, 0, 2).reshape(q, k * m)
