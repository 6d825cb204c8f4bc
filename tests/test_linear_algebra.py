"""Solutions and factors against NumPy, their derivatives against differences, and no batched LAPACK under vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxphoto.compiling.quickly import jit_quickly
from jaxphoto.linear_algebra import (
    cholesky,
    eigh,
    inverse,
    solve,
    solve_lower,
    solve_lower_right,
    solve_lower_transposed,
    solve_tridiagonal,
)
from tests.marks import slow_but
from tests.programs import batched_lapack_calls


def _general(n, seed=0):
    return np.random.default_rng(seed).normal(size=(n, n)) + 0.1 * np.eye(n)


def _positive(n, seed=0):
    a = _general(n, seed)
    return a @ a.T + np.eye(n)


def _right(n, seed=1):
    return np.random.default_rng(seed).normal(size=(n, 2))


def _of_lower(function):
    """The same of any square matrix: its lower triangle."""
    return lambda a, b: function(jnp.tril(a), b)


def _tridiagonal(a, b):
    lower, upper = (jnp.zeros(len(a)).at[1:].set(jnp.diagonal(a, -1)), jnp.append(jnp.diagonal(a, 1), 0.0))
    return solve_tridiagonal(lower, jnp.diagonal(a) + 5.0, upper, b)


def _numpy_tridiagonal(a, b):
    full = np.diag(np.diag(a) + 5) + np.diag(np.diag(a, -1), -1) + np.diag(np.diag(a, 1), 1)
    return np.linalg.solve(full, b)


PAIRS = {
    "solve": (solve, np.linalg.solve),
    "inverse": (lambda a, b: inverse(a) @ b, np.linalg.solve),
    "lower": (_of_lower(solve_lower), lambda a, b: np.linalg.solve(np.tril(a), b)),
    "transposed": (_of_lower(solve_lower_transposed), lambda a, b: np.linalg.solve(np.tril(a).T, b)),
    "right": (_of_lower(lambda a, b: solve_lower_right(a, b.T)), lambda a, b: np.linalg.solve(np.tril(a), b).T),
    "tridiagonal": (_tridiagonal, _numpy_tridiagonal),
    "cholesky": (lambda a, b: cholesky(a) @ b, lambda a, b: np.linalg.cholesky(a) @ b),
    "eigenvalues": (lambda a, b: eigh(a)[0][:, None] * b, lambda a, b: np.linalg.eigvalsh(a)[:, None] * b),
    # Eigenvectors have no sign.
    "eigenvectors": (lambda a, b: eigh(a)[1] ** 2 @ b, lambda a, b: np.linalg.eigh(a)[1] ** 2 @ b),
}


@pytest.mark.parametrize("n", slow_but((3, 9), (3, 7, 9)))
@pytest.mark.parametrize("name", PAIRS)
def test_equals_numpy_one_at_a_time_and_many(name, n):
    ours, theirs = PAIRS[name]
    matrices, rights = (np.stack([of(n, k) for k in range(4)]) for of in (_positive, _right))
    expected = np.stack([theirs(a, b) for a, b in zip(matrices, rights, strict=True)])
    of_one = np.stack([theirs(matrices[0], b) for b in rights])

    @jit_quickly
    def ways(a, b):
        twice = jax.vmap(jax.vmap(ours, (0, None)), (None, 0))(a, b)
        return ours(a[0], b[0]), jax.vmap(ours)(a, b), jax.vmap(ours, (None, 0))(a[0], b), twice[1, 2]

    wanted = expected[0], expected, of_one, theirs(matrices[2], rights[1])
    for found, value in zip(ways(matrices, rights), wanted, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", PAIRS)
def test_derivatives_of_first_and_second_order(name):
    """Forward and reverse against differences, of one and under vmap."""
    ours = PAIRS[name][0]
    # A symmetric matrix stays one where differences are taken.
    symmetric = lambda a, b: ours(0.5 * (a + a.T), b)  # noqa: E731
    check_grads(symmetric, (_positive(3), _right(3)), order=2, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5)
    many = tuple(np.stack([of(3, k) for k in range(2)]) for of in (_positive, _right))
    check_grads(jax.vmap(symmetric), many, order=1, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", PAIRS)
def test_a_vmapped_program_has_no_batched_lapack_call(name):
    """Two of them in one program can wait for each other forever (jaxlib 0.10.2)."""
    ours = PAIRS[name][0]
    both = lambda a, b: (ours(a, b), jax.grad(lambda a: jnp.sum(ours(a, b)))(a))  # noqa: E731
    many = tuple(np.stack([of(9, k) for k in range(3)]) for of in (_positive, _right))
    assert not batched_lapack_calls(jax.vmap(both), *many)
    assert not batched_lapack_calls(jax.vmap(jax.vmap(both, (0, None)), (None, 0)), *many)


def test_the_search_for_batched_calls_finds_one():
    assert batched_lapack_calls(jax.vmap(jnp.linalg.cholesky), np.stack([_positive(9)] * 2))


def test_elimination_pivots():
    a = np.array([[0.0, 1.0, 2.0], [1.0, 0.0, 3.0], [4.0, -3.0, 8.0]])
    b = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(jax.vmap(solve)(a[None], b[None])[0], np.linalg.solve(a, b), rtol=1e-13)


def test_a_matrix_that_is_not_positive_definite_has_no_factor():
    assert np.isnan(np.asarray(cholesky(-np.eye(3)))).any()
    many = jax.vmap(cholesky)(np.stack([np.eye(3), -np.eye(3)]))
    assert np.isfinite(many[0]).all() and np.isnan(np.asarray(many[1])).any()
