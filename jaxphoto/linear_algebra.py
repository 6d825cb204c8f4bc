"""Factorisation and solution of one matrix, safe and fast under `jax.vmap`.

jaxlib distributes a batched LAPACK call over a small thread pool, and two such calls in one program can deadlock
(docs/solver.md has an example of ten lines). Here `jax.vmap` never makes a batched call: right-hand sides of one matrix
become its columns, small systems are eliminated without LAPACK, and all others run one matrix at a time.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Maximum size of systems that are eliminated without LAPACK if there are many.
_SMALL = 7


def one_at_a_time(function: Callable) -> Callable:
    """Evaluate `function` in a loop under `jax.vmap`. The caller provides derivatives."""
    return jax.custom_batching.sequential_vmap(function)


def _solver(function: Callable, small: Callable | None = None) -> Callable:
    """Return `function(matrix, right)` with a batching rule; `small` solves many small systems without LAPACK."""
    solve = jax.custom_batching.custom_vmap(function)

    @solve.def_vmap
    def rule(size: int, batched: list, matrix: Array, right: Array) -> tuple[Array, bool]:
        of_matrix, of_right = batched
        if not of_matrix:
            columns = jnp.moveaxis(right, 0, -1)
            x = solve(matrix, columns.reshape(len(columns), -1))
            return jnp.moveaxis(x.reshape(columns.shape), -1, 0), True
        if small is not None and right.shape[-2] <= _SMALL:
            return jax.vmap(small, (0, 0 if of_right else None))(matrix, right), True
        if of_right:
            return jax.lax.map(lambda one: solve(*one), (matrix, right)), True
        return jax.lax.map(lambda one: solve(one, right), matrix), True

    return solve


def _eliminated(a: Float[Array, "n n"], b: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """Solve by unrolled Gauss-Jordan elimination with partial pivoting."""
    n = len(a)
    rows, at = jnp.concatenate([a, b], axis=1), jnp.arange(n)[:, None]
    for k in range(n):
        pivot = k + jnp.argmax(jnp.abs(rows[k:, k]))
        chosen = rows[pivot]
        rows = jnp.where(at == pivot, rows[k], rows)
        chosen = chosen / chosen[k]
        rows = jnp.where(at == k, chosen, rows - rows[:, k : k + 1] * chosen)
    return rows[:, n:]


_lu = _solver(jnp.linalg.solve, _eliminated)
_lu_transposed = _solver(lambda a, b: jnp.linalg.solve(a.T, b), lambda a, b: _eliminated(a.T, b))
# LAPACK stores by column: the transpose of a JAX array needs no copy. Therefore solve x' L' = b' and x' L = b'.
_down = _solver(lambda lower, b: jax.lax.linalg.triangular_solve(lower.T, b.T, left_side=False, lower=False).T)
_up = _solver(
    lambda lower, b: jax.lax.linalg.triangular_solve(lower.T, b.T, left_side=False, lower=False, transpose_a=True).T
)
_band = _solver(lambda bands, b: jax.lax.linalg.tridiagonal_solve(bands[0], bands[1], bands[2], b))
_band_transposed = _solver(lambda bands, b: _band(_transposed_bands(bands), b))
_eigh = one_at_a_time(lambda a: tuple(jnp.linalg.eigh(a)))
_factor = one_at_a_time(lambda a: jax.lax.linalg.cholesky(a, symmetrize_input=False))


def solve(a: Float[Array, "n n"], b: Float[Array, "n *c"]) -> Float[Array, "n *c"]:
    """Solve A x = b for a vector or for the columns of a matrix."""
    columns = b.reshape(len(b), -1)
    return _linear(lambda x: a @ x, columns, lambda b: _lu(a, b), lambda b: _lu_transposed(a, b)).reshape(b.shape)


def inverse(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return A^-1."""
    return solve(a, unit_like(a))


def unit_like(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the unit matrix, sharded over the devices of a mesh like `a`, as required of a right-hand side."""
    unit = jnp.eye(len(a))
    return jnp.where(a == a, unit, unit)


def solve_lower(lower: Float[Array, "n n"], b: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """Return L^-1 b for a lower triangle."""
    return _linear(lambda x: jnp.tril(lower) @ x, b, lambda b: _down(lower, b), lambda b: _up(lower, b))


def solve_lower_transposed(lower: Float[Array, "n n"], b: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """Return L'^-1 b for a lower triangle."""
    return _linear(lambda x: jnp.tril(lower).T @ x, b, lambda b: _up(lower, b), lambda b: _down(lower, b))


def solve_lower_right(lower: Float[Array, "n n"], b: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Return b L'^-1 for a lower triangle."""
    return solve_lower(lower, b.T).T


def solve_tridiagonal(
    lower: Float[Array, "n"], diagonal: Float[Array, "n"], upper: Float[Array, "n"], b: Float[Array, "n c"]
) -> Float[Array, "n c"]:
    """Solve A x = b for A with the diagonals `lower` (from its second element on), `diagonal` and `upper`."""
    bands = jnp.stack([lower, diagonal, upper])

    def product(x):
        below, above = jnp.roll(x, 1, axis=0).at[0].set(0.0), jnp.roll(x, -1, axis=0).at[-1].set(0.0)
        return lower[:, None] * below + diagonal[:, None] * x + upper[:, None] * above

    return _linear(product, b, lambda b: _band(bands, b), lambda b: _band_transposed(bands, b))


@jax.custom_jvp
def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the lower Cholesky factor of a matrix given by its lower triangle; NaN if not positive definite."""
    return _factor(a)


@cholesky.defjvp
def _cholesky_jvp(primals, tangents):
    """Differentiate: dL = L Phi(L^-1 dA L'^-1), with Phi the lower triangle and half the diagonal."""
    (a,), (change,) = primals, tangents
    lower = cholesky(a)
    change = jnp.tril(change) + jnp.tril(change, -1).T
    white = solve_lower(lower, solve_lower(lower, change).T)
    return lower, lower @ (jnp.tril(white, -1) + 0.5 * jnp.diag(jnp.diagonal(white)))


@jax.custom_jvp
def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Return eigenvalues of a symmetric matrix, ascending, and eigenvectors by column."""
    values, vectors = _eigh(a)
    return values, vectors


@eigh.defjvp
def _eigh_jvp(primals, tangents):
    """Differentiate: dw = diag(V' dA V), dV = V (F * V' dA V) with F[i, j] = 1 / (w[j] - w[i])."""
    w, v = eigh(*primals)
    change = v.T @ (0.5 * (tangents[0] + tangents[0].T)) @ v
    apart = w - w[:, None] + jnp.eye(len(w))
    return (w, v), (jnp.diagonal(change), v @ (change / apart * (1 - jnp.eye(len(w)))))


def _linear(product: Callable, b: Array, solve: Callable, transposed: Callable) -> Array:
    """Solve product(x) = b, differentiable with respect to b and all inputs of the product."""
    return jax.lax.custom_linear_solve(product, b, lambda _, b: solve(b), lambda _, b: transposed(b))


def _transposed_bands(bands: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    lower, diagonal, upper = bands
    return jnp.stack([jnp.roll(upper, 1), diagonal, jnp.roll(lower, -1)])
