import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.least_squares import least_squares
from tests.derivatives import compiled


def rosenbrock(x, scale):
    return jnp.stack([scale * (x[1] - x[0] ** 2), 1 - x[0]])


def test_problems_side_by_side_have_the_solution_of_each():
    starts = np.array([[-1.2, 1.0], [3.0, -4.0], [1.0, 1.0]])
    fit = compiled(jax.vmap(lambda x: least_squares(rosenbrock, x, 10.0)))(starts)
    np.testing.assert_allclose(fit.unknowns, 1, atol=1e-9)
    assert np.all(fit.converged)
    assert fit.steps[2] == 2 and np.all(fit.steps[:2] < 50)
    np.testing.assert_allclose(fit.normal, np.tile([[401.0, -200], [-200, 100]], (3, 1, 1)), rtol=1e-6)


def test_units_of_unknowns_do_not_matter():
    t, unit = np.linspace(0, 1, 20), np.array([1e6, 1e-9])
    y = np.exp(-3 * t) + 1e-3 * np.random.default_rng(0).normal(size=20)
    model = lambda x, unit: x[0] * unit[0] * jnp.exp(x[1] * unit[1] * t) - y  # noqa: E731
    one = compiled(lambda: least_squares(model, jnp.array([2.0, 0.0]), np.ones(2)))()
    other = compiled(lambda: least_squares(model, jnp.array([2.0, 0.0]) / unit, unit))()
    np.testing.assert_allclose(other.unknowns * unit, one.unknowns, rtol=1e-7)
    residual = model(one.unknowns, np.ones(2))
    np.testing.assert_allclose(one.cost, residual @ residual, rtol=1e-9)
    jacobian = np.column_stack([np.exp(one.unknowns[1] * t), one.unknowns[0] * t * np.exp(one.unknowns[1] * t)])
    np.testing.assert_allclose(jacobian.T @ residual, 0, atol=1e-8)


def test_unknowns_that_the_residuals_do_not_see_stay():
    fit = compiled(lambda: least_squares(lambda x, _: x[:1] + x[1:2] - 1, jnp.array([0.0, 0, 5])))()
    np.testing.assert_allclose(fit.unknowns, [0.5, 0.5, 5], atol=1e-9)


def test_too_few_steps_are_reported():
    assert not compiled(lambda: least_squares(rosenbrock, jnp.array([-1.2, 1]), 10.0, max_steps=3))().converged
