"""Covariance of a planned layout compared with that of an adjustment, and its gradient with finite differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxphoto
from jaxphoto import BlockError, DatumError, Equidistant, InputError
from jaxphoto.camera import get_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.sensitivity.network import covariance as criteria
from jaxphoto.sensitivity.network.covariance import design_covariance
from jaxphoto.sensitivity.network.layout import block_from_layout, check_layout
from jaxphoto.sensitivity.network.search import evaluate_designs
from jaxphoto.simulation import remeasure
from tests.blocks import observed
from tests.sensitivity.network import FREE, PLAN, USUAL


@pytest.fixture(scope="module")
def layout():
    """Stations, attitudes and a control point observed; no point in the edge of the format."""
    made = eqx.filter_jit(PLAN)(USUAL)
    attitude = np.tile([1e6, 2e6, 5e5], (8, 1))
    attitude[3] = 0.0
    return dataclasses.replace(made, attitude_weight=attitude, edge_mm=1e-9)


@pytest.fixture(scope="module")
def measured(layout):
    return block_from_layout(layout)


@pytest.fixture(scope="module")
def adjusted(measured):
    return jaxphoto.adjust(measured.block, measured.truth)


def test_it_is_the_covariance_of_an_adjustment(layout, measured, adjusted):
    planned, result = design_covariance(layout), jaxphoto.covariance(adjusted)
    assert float(adjusted.sigma0) < 1e-9
    assert adjusted.n_observations["attitudes"] == 21
    sigma = np.sqrt(np.diagonal(result.matrix))
    assert [label.split(".")[-1] for label in result.labels[-len(FREE) :]] == list(FREE)
    np.testing.assert_allclose(np.asarray(planned.sigma), sigma, rtol=1e-6)
    np.testing.assert_allclose(
        np.asarray(planned.matrix) / np.outer(sigma, sigma), result.matrix / np.outer(sigma, sigma), atol=1e-6
    )
    points = np.asarray(planned.points)[measured.point]
    np.testing.assert_allclose(points, result.points, rtol=1e-5, atol=1e-5 * np.abs(result.points).max())
    rays = np.bincount(measured.block.image_points.point)
    np.testing.assert_allclose(np.asarray(planned.rays)[measured.point], rays)


def test_noisy_measurements_scatter_by_it(layout, measured):
    """Forty adjustments: a sigma wrong by half fails, a correct one fails once in thousands."""
    block, truth, _ = measured
    numbers = jax.jit(lambda key: observed(remeasure(block, truth, key)))
    errors = []
    for k in range(40):
        noisy = eqx.tree_at(observed, block, jax.tree.map(np.asarray, numbers(jax.random.key(k))))
        again = jaxphoto.adjust(noisy, truth).unknowns.interior["camera"]
        errors.append([get_parameter(again, n) - get_parameter(truth.interior["camera"], n) for n in FREE])
    sigma = np.sqrt(np.diagonal(np.asarray(design_covariance(layout).interior)))
    ratio = np.sqrt(np.mean(np.square(np.array(errors, float)), axis=0)) / sigma
    assert (ratio > 0.62).all() and (ratio < 1.45).all(), ratio


ALL = {
    "a": lambda c: criteria.a_criterion(c.interior_at_corner),
    "d": lambda c: criteria.d_criterion(c.interior),
    "e": lambda c: criteria.e_criterion(c.interior_at_corner),
    "smooth e": lambda c: criteria.e_criterion(c.interior_at_corner, power=6.0),
    "sigma": eqx.Partial(criteria.sigma_of, name="yp_mm"),
    "rmse": eqx.Partial(criteria.point_rmse, points=tuple(range(12, 24))),
    "largest": eqx.Partial(criteria.largest_correlation, exterior=("omega", "phi"), interior=("xp_mm", "yp_mm")),
    "smooth": eqx.Partial(criteria.largest_correlation, exterior=("omega",), interior=("yp_mm",), power=12.0),
    "mean": eqx.Partial(criteria.mean_correlation, exterior=("Z",), interior=("c_mm", "k1")),
}


def all_of(covariance):
    """Sum of ln of all criteria with incommensurable weights."""
    logs = jnp.log(jnp.stack([criterion(covariance) for criterion in ALL.values()]))
    return logs @ jnp.sqrt(1.0 + jnp.arange(len(ALL)))


# Steps of the differences, in thousandths of these.
UNIT = {"heading": 0.1, "height": 30.0, "across": 30.0, "along": 30.0, "roll": 0.03, "pitch": 0.03, "control": 30.0}


def test_gradient_is_that_of_finite_differences():
    places = {name: np.full(np.shape(getattr(USUAL, name)), unit) for name, unit in UNIT.items()}
    unit, _ = ravel_pytree(dataclasses.replace(USUAL, **places))
    vector, back = ravel_pytree(USUAL)
    of = lambda v: all_of(design_covariance(PLAN(back(v))))  # noqa: E731
    exact = np.asarray(call_compiled(eqx.filter_jit(jax.grad(of)), vector) * unit)
    step = 1e-3
    moved = np.asarray(vector) + step * np.array([-2, -1, 1, 2])[:, None, None] * np.diag(unit)
    values = evaluate_designs(all_of, PLAN, jax.vmap(back)(moved.reshape(-1, len(unit)))).reshape(4, -1)
    numerical = np.array([1, -8, 8, -1]) @ values / (12 * step)
    assert np.abs(numerical).min() > 1e-5 * np.abs(numerical).max()
    np.testing.assert_allclose(exact, numerical, rtol=0, atol=1e-6 * np.abs(numerical).max())


def test_points_lie_in_the_edge_of_the_usual_layout():
    """Otherwise the test of the gradient would not cover the window."""
    rays = np.asarray(design_covariance(eqx.filter_jit(PLAN)(USUAL)).rays)
    assert (np.abs(rays - np.round(rays)) > 1e-3).sum() >= 4


def test_largest_is_the_limit_of_its_norm():
    covariance = design_covariance(eqx.filter_jit(PLAN)(USUAL))
    of = lambda power: float(criteria.largest_correlation(covariance, ("omega", "phi"), ("yp_mm",), power))  # noqa: E731
    assert of(None) == pytest.approx(np.abs(np.asarray(covariance.correlation)[:, 3:5, 2]).max())
    assert of(None) < of(20.0) < of(10.0)
    assert of(1000.0) == pytest.approx(of(None), rel=5e-3)
    e = float(criteria.e_criterion(covariance.interior_at_corner))
    assert e == pytest.approx(np.linalg.eigvalsh(np.asarray(covariance.interior_at_corner)).max())
    d = float(criteria.d_criterion(covariance.interior))
    assert d == pytest.approx(
        np.linalg.det(
            np.asarray(covariance.interior_at_corner)
            / np.asarray(covariance.corner)[:, None]
            / np.asarray(covariance.corner)
        )
        ** 0.25
    )


def test_what_a_layout_cannot_be_is_said_in_a_sentence(layout):
    with pytest.raises(InputError, match=r"k2, which is fixed: .* \(c_mm, xp_mm, yp_mm, k1\)"):
        criteria.sigma_of(design_covariance(layout), "k2")
    with pytest.raises(InputError, match=r"unknown exterior parameter roll .* X, Y"):
        criteria.mean_correlation(design_covariance(layout), ("roll",), ("k1",))
    with pytest.raises(InputError, match="unknown parameter k9 of this camera: choose among c_mm"):
        dataclasses.replace(layout, free=("k9",))
    with pytest.raises(InputError, match="edge_mm, the width"):
        dataclasses.replace(layout, edge_mm=0.0)
    nothing = dataclasses.replace(layout, station_weight=0.0, attitude_weight=0.0)
    with pytest.raises(DatumError, match="rotation about X"):
        check_layout(nothing)
    fisheye = dataclasses.replace(layout.interior, projection=Equidistant())
    with pytest.raises(BlockError, match="this one is equidistant"):
        check_layout(dataclasses.replace(layout, interior=fisheye))
    check_layout(layout)
