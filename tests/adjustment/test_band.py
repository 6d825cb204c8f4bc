"""The band with a border against dense linear algebra."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.sharding import Mesh, PartitionSpec

from jaxphoto.adjustment.layout.rays import column_blocks
from jaxphoto.adjustment.solver.band import (
    Band,
    BandFactor,
    dense,
    diagonal_of,
    factor_band,
    invert_band,
    pivots,
    selected_inverse,
    solve_band,
)

# Column blocks, unknowns of each, shared unknowns.
SHAPES = [(1, 1, 0), (1, 7, 0), (1, 7, 3), (2, 5, 2), (4, 6, 0), (5, 3, 4), (3, 1, 1), (2, 301, 2)]

factored = jax.jit(factor_band)


def whole(k: int, m: int, q: int, rng: np.random.Generator, padded: int = 0) -> np.ndarray:
    """A positive definite matrix of the form; the last `padded` images' unknowns have a unit diagonal and no more."""
    n = k * m
    lower = np.zeros((n + q, n + q))
    for j in range(k):
        rows = slice(j * m, (j + 2) * m)
        lower[:n][rows, j * m : (j + 1) * m] = rng.normal(size=lower[:n][rows, j * m : (j + 1) * m].shape)
    lower[n:] = rng.normal(size=(q, n + q))
    # The factor of a band is a band: A = L L' has the zeros wanted.
    lower = np.tril(lower, -1) + np.diag(rng.uniform(1, 3, size=n + q) * np.sqrt(n + q))
    a = lower @ lower.T
    held = slice(n - padded, n)
    a[held], a[:, held] = 0, 0
    a[held, held] = np.eye(padded)
    return a


def stored(a: np.ndarray, k: int, m: int, garbage: float = 77.0) -> Band:
    """The matrix as a band, with garbage wherever it may be anything."""
    n = k * m
    columns = np.full((k - 1, 2 * m, m), garbage)
    upper = np.triu_indices(m, 1)
    for j in range(k - 1):
        own = slice(j * m, (j + 1) * m)
        columns[j, :m] = a[own, own]
        columns[j, :m][upper] = garbage
        columns[j, m:] = a[(j + 1) * m : (j + 2) * m, own]
    end = a[n - m :, n - m :].copy()
    end[np.triu_indices(len(end), 1)] = garbage
    return Band(jnp.array(columns), jnp.array(a[n:, : n - m]), jnp.array(end))


@pytest.mark.parametrize(("k", "m", "q"), SHAPES)
def test_everything_is_as_dense(k, m, q):
    rng = np.random.default_rng(k + m + q)
    a = whole(k, m, q, rng, padded=m // 2)
    n = k * m
    b, several = rng.normal(size=n + q), rng.normal(size=(n + q, 3))
    band = stored(a, k, m)

    @jax.jit
    def everything(band, b, several):
        factor = factor_band(band)
        inverses = selected_inverse(factor), invert_band(factor)
        solutions = solve_band(factor, b), solve_band(factor, several)
        return factor, dense(band), solutions, inverses, pivots(diagonal_of(band), factor)

    factor, back, (x, xs), (inside, inverse), left = everything(band, b, several)
    np.testing.assert_array_equal(back, a)
    lower, z = np.linalg.cholesky(a), np.linalg.inv(a)
    assert_stored(factor, lower, k, m)
    np.testing.assert_allclose(x, z @ b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(xs, z @ several, rtol=0, atol=1e-12)
    np.testing.assert_allclose(inverse, z, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(inverse, inverse.T)
    assert_stored(inside, z, k, m)
    np.testing.assert_allclose(left, np.diag(lower) ** 2 / np.diag(a), rtol=1e-11)


def assert_stored(found, matrix: np.ndarray, k: int, m: int) -> None:
    """Blocks of what is stored are those of the dense matrix; diagonal blocks by both triangles."""
    n, atol = k * m, 1e-12 * np.abs(matrix).max()
    for j in range(k - 1):
        own, below = slice(j * m, (j + 1) * m), slice((j + 1) * m, (j + 2) * m)
        np.testing.assert_allclose(found.columns[j, :m], matrix[own, own], rtol=0, atol=atol)
        np.testing.assert_allclose(found.columns[j, m:], matrix[below, own], rtol=0, atol=atol)
    np.testing.assert_allclose(found.border, matrix[n:, : n - m], rtol=0, atol=atol)
    np.testing.assert_allclose(found.end, matrix[n - m :, n - m :], rtol=0, atol=atol)


@given(st.integers(0, 2**32 - 1), st.floats(-6, 6))
@settings(max_examples=20, deadline=None)
def test_solution_of_any_scale(seed, power):
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-abs(power), abs(power), size=17)
    a, x = whole(3, 5, 2, rng), rng.normal(size=17) / scale
    a = a * scale[:, None] * scale
    found = jax.jit(solve_band)(factored(stored(a, 3, 5)), a @ x)
    np.testing.assert_allclose(found * scale, x * scale, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("k", "m", "q"), [(1, 4, 2), (3, 4, 2), (3, 4, 0)])
def test_derivative_is_that_of_differences(k, m, q):
    """Of a change of what counts only: the upper triangles of the tangent are garbage as well."""
    rng = np.random.default_rng(5)
    a, change = whole(k, m, q, rng), whole(k, m, q, rng)
    b = rng.normal(size=k * m + q)

    @jax.jit
    def results(band):
        factor = factor_band(band)
        inside = selected_inverse(factor)
        diagonal = jnp.diagonal(inside.columns[:, :m], axis1=1, axis2=2)
        return solve_band(factor, b), inside.border, diagonal, invert_band(factor), pivots(diagonal_of(band), factor)

    _, forward = jax.jit(lambda x, dx: jax.jvp(results, (x,), (dx,)))(stored(a, k, m), stored(change, k, m))
    h = 1e-5
    ahead, behind = results(stored(a + h * change, k, m)), results(stored(a - h * change, k, m))
    for derivative, plus, minus in zip(forward, ahead, behind, strict=True):
        np.testing.assert_allclose(derivative, (plus - minus) / (2 * h), rtol=1e-6, atol=1e-8)


def test_reverse_derivative_is_the_forward_one():
    rng = np.random.default_rng(6)
    band, change = (stored(whole(3, 2, 1, rng), 3, 2) for _ in range(2))
    b = rng.normal(size=7)

    def f(band):
        return jnp.sum(solve_band(factor_band(band), b) ** 2)

    _, forward = jax.jit(lambda x, dx: jax.jvp(f, (x,), (dx,)))(band, change)
    gradient = jax.jit(jax.grad(f))(band)
    reverse = sum(jnp.vdot(g, c) for g, c in zip(gradient, change, strict=True))
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)


@pytest.mark.parametrize("at", [0, 4, 8, 9])
def test_indefinite_is_not_a_number(at):
    """Nothing raises; what was eliminated before is finite, what comes with it and after is not."""
    a = whole(3, 3, 2, np.random.default_rng(1))
    a[at, at] = -1.0
    band = stored(a, 3, 3)
    factor = factored(band)
    assert np.isnan(factor.end).any()
    assert np.isnan(pivots(diagonal_of(band), factor)[at:]).any()
    assert np.isfinite(factor.columns[: min(at // 3, 2)]).all()
    assert np.isnan(solve_band(factor, jnp.ones(11))).all()


def test_pivot_of_a_defect_is_small_and_of_no_information_finite():
    a = whole(2, 3, 1, np.random.default_rng(2))
    # The fifth unknown all but repeats the second.
    a[4] = a[1] * (1 + 1e-12)
    a[:, 4] = a[:, 1]
    a[4, 4] = a[1, 1] * (1 + 1e-9)
    band = stored(a, 2, 3)
    left = pivots(diagonal_of(band), factored(band))
    assert left[4] < 1e-8 < np.delete(left, 4).min()
    nothing = Band(jnp.zeros((0, 6, 3)), jnp.zeros((0, 0)), jnp.zeros((3, 3)))
    assert np.isfinite(pivots(diagonal_of(nothing), BandFactor(*nothing))).all()


def test_many_at_once_are_each_by_itself():
    """Under vmap, and under shard_map with its checks on."""
    bands = [stored(whole(3, 4, 2, np.random.default_rng(seed)), 3, 4) for seed in range(2)]
    stack = jax.tree.map(lambda *x: jnp.stack(x), *bands)
    rights = jnp.array(np.random.default_rng(9).normal(size=(2, 14)))

    def both(band, right):
        factor = factor_band(band)
        return solve_band(factor, right), invert_band(factor)

    mesh = Mesh(np.array(jax.devices()[:1]), ("some",))
    spec = PartitionSpec("some")
    sharded = partial(jax.shard_map, mesh=mesh, in_specs=spec, out_specs=spec)
    alone = [jax.jit(both)(band, right) for band, right in zip(bands, rights, strict=True)]
    together = jax.jit(jax.vmap(both))(stack, rights)
    apart = jax.jit(sharded(jax.vmap(both)))(stack, rights)
    for i, expected in enumerate(alone):
        for found in (together, apart):
            for x, y in zip(found, expected, strict=True):
                np.testing.assert_allclose(x[i], y, rtol=0, atol=1e-13)


@given(st.integers(1, 5000), st.integers(0, 6000))
def test_column_blocks_hold_all_images_and_all_that_meet(n_images, bandwidth):
    k, w = column_blocks(n_images, bandwidth)
    assert k * w >= n_images > (k - 1) * w
    assert w >= min(bandwidth, n_images)
    if k == 1:
        assert w == n_images


@pytest.mark.parametrize(
    ("n_images", "bandwidth", "banded"),
    [(10, 1, False), (100, 60, False), (100, 99, False), (220, 44, True), (1000, 120, True), (2000, 3, True)],
)
def test_column_blocks_are_for_long_blocks(n_images, bandwidth, banded):
    k, w = column_blocks(n_images, bandwidth)
    assert (k > 1) == banded
    if banded:
        assert w <= 1.3 * max(bandwidth, 8)
