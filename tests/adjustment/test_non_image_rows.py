"""Of many rows, derivatives and their products are computed portion by portion, and are the same."""

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto.adjustment.model import row_functions
from jaxphoto.adjustment.model.numbers import zero_increments
from jaxphoto.adjustment.model.observed_groups import RowsAtPoints
from jaxphoto.adjustment.solver import inverse, non_image_rows
from jaxphoto.adjustment.solver.optimum import unit_scale
from jaxphoto.compiling.quickly import jit_quickly
from jaxphoto.statistics import covariance
from tests.blocks import adjusted
from tests.marks import slow_but


@pytest.mark.parametrize("at_once", [1, 16 * 7, 16 * 50, 1 << 24])
def test_products_in_portions_are_those_at_once(at_once, monkeypatch):
    rng = np.random.default_rng(3)
    # The last unknown is none: products with it are not asked for.
    column, shared = rng.integers(0, 10, (4, 50)), rng.normal(size=(2, 4, 50))
    asked = np.zeros((10, 10))
    for k in range(50):
        full = np.zeros((2, 10))
        np.add.at(full, (slice(None), column[:, k]), shared[:, :, k])
        asked += full.T @ full
    monkeypatch.setattr(row_functions, "_AT_ONCE", at_once)
    found = jax.jit(non_image_rows._add_products)(np.zeros((10, 10)), column, shared)
    np.testing.assert_allclose(found[:9, :9], asked[:9, :9], atol=1e-12)


@pytest.mark.parametrize("at_once", [1, 3000])
def test_derivatives_in_portions_are_those_at_once(at_once, monkeypatch):
    equations = adjusted("everything").equations
    values, s = equations.values, equations.structure
    at, scale = zero_increments(s), unit_scale(s)
    listed = [
        (g, numbers)
        for g, numbers in zip(s.observed, values.groups, strict=True)
        if not isinstance(g.rows, RowsAtPoints)
    ]

    def jacobians():
        # Traced anew: how many rows are in memory is decided then.
        return jit_quickly(lambda at: [row_functions.row_jacobian(*group, at, scale, values, s) for group in listed])(
            at
        )

    asked = jacobians()
    monkeypatch.setattr(row_functions, "_AT_ONCE", at_once)
    found = jacobians()
    assert len(found) > 2
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(asked), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


@pytest.mark.parametrize("at_once", [1, 3000])
def test_redundancy_numbers_in_portions_are_those_at_once(at_once, monkeypatch):
    result = adjusted("everything")
    equations, known = result.equations, covariance(result, rows=True)

    def found():
        # Traced anew: how many rows are in memory is decided then.
        return jax.jit(lambda q: inverse.row_variances(equations.at, q, known.rows, equations.factored)[1])(
            known.cofactors
        )

    asked = found()
    monkeypatch.setattr(row_functions, "_AT_ONCE", at_once)
    for one, other in zip(found(), asked, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


@pytest.mark.parametrize("portion", slow_but([5], [1, 5, 12]))
@pytest.mark.parametrize("name", slow_but(["everything"], ["everything", "inner"]))
def test_many_directions_in_portions_are_those_one_by_one(name, portion, monkeypatch):
    """J x of each of twelve, and J' of that again; one block has image rows and its datum only."""
    equations = adjusted(name).equations.on_one_device.weighed
    rng = np.random.default_rng(2)
    x = jax.tree.map(lambda v: rng.normal(size=(12, *v.shape)), equations.scale)
    at = equations.at
    residuals = lambda y: at._replace(increments=y).residuals()  # noqa: E731
    j_product = jit_quickly(lambda x: jax.jvp(residuals, (at.increments,), (x,))[1])
    jt_product = jit_quickly(lambda z: jax.vjp(residuals, at.increments)[1](z))
    numbers = sum(g.components * g.n_rows * len(g.parameter) for g in equations.structure.observed)
    monkeypatch.setattr(row_functions, "_AT_ONCE", portion * max(numbers, 1))
    assert row_functions.rows_at_once(numbers) == portion
    pushed = eqx.filter_jit(lambda equations, x: equations.j_product(x))(equations, x)
    pulled = eqx.filter_jit(lambda equations, z: equations.jt_product(z))(equations, pushed)
    for k in range(12):
        own = j_product(jax.tree.map(lambda v, k=k: v[k], x))
        for one, other in zip(jax.tree.leaves(pushed), jax.tree.leaves(own), strict=True):
            np.testing.assert_allclose(one[k], other, atol=1e-9 * max(1.0, np.abs(other).max(initial=0.0)))
        for one, other in zip(jax.tree.leaves(pulled), jax.tree.leaves(jt_product(own)[0]), strict=True):
            np.testing.assert_allclose(one[k], other, atol=1e-9 * max(1.0, np.abs(other).max(initial=0.0)))
