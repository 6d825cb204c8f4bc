"""What robust losses cost and weigh: the constants of the textbooks, and one formula against another."""

import jax
import numpy as np
import pytest

from jaxphoto.losses import LOSSES, Huber, LinearisedLoss, Tukey
from jaxphoto.statistics.quantiles import student_freedom

V = np.array([0.0, 0.3, 1.0, 2.9, 7.0, 40.0])
BY_HAND = {
    "huber": lambda s, k: np.where(s > k, k / np.maximum(s, k), 1.0),
    "tukey": lambda s, k: np.where(s > k, 0.0, (1 - (s / k) ** 2) ** 2),
    "geman_mcclure": lambda s, k: 1 / (1 + (s / k) ** 2) ** 2,
    "student_t": lambda s, k: 1 / (1 + (s / k) ** 2),
}


@pytest.mark.parametrize("name", LOSSES)
def test_weights_are_those_of_the_textbooks(name):
    loss = LOSSES[name](threshold=2.5, scale=1.2)
    np.testing.assert_allclose(loss.weights(V**2, 1), BY_HAND[name](V, 2.5 * 1.2), rtol=1e-9, atol=1e-12)


def test_thresholds_of_huber_and_tukey_are_those_of_the_textbooks():
    assert float(Huber().for_rows_of(1).threshold) == pytest.approx(1.345, abs=5e-4)
    assert float(Tukey().for_rows_of(1).threshold) == pytest.approx(4.685, abs=5e-4)


@pytest.mark.parametrize("name", LOSSES)
def test_an_estimate_from_normal_errors_is_as_efficient_as_said(name):
    # Two numbers a row, one unknown mean: many times, by reweighting.
    x = np.random.default_rng(1).normal(size=(3000, 40, 2))
    loss, mean = LOSSES[name]().for_rows_of(2), np.zeros((3000, 1, 2))
    for _ in range(30):
        w = loss.weights(np.sum((x - mean) ** 2, axis=2).ravel(), 2).reshape(3000, 40, 1)
        mean = (w * x).sum(1, keepdims=True) / w.sum(1, keepdims=True)
    # Of 6,000 numbers, a variance has a standard deviation of 1.8 %.
    assert 1 / (40 * np.mean(mean**2)) == pytest.approx(0.95, abs=0.06)


@pytest.mark.parametrize("name", LOSSES)
def test_normal_equations_have_the_gradient_of_the_cost(name):
    loss = LOSSES[name](threshold=2.5).for_rows_of(2)
    for v in np.random.default_rng(2).normal(size=(20, 2)) * np.geomspace(0.1, 30, 20)[:, None]:
        cost = jax.grad(lambda v: sum(x**2 for x in loss.reduced(*v)) / 2)(v)
        r = LinearisedLoss(loss).reduced(*v)
        j = np.array(jax.jacfwd(lambda v: LinearisedLoss(loss).reduced(*v))(v))
        np.testing.assert_allclose(j.T @ np.array(r), cost, rtol=1e-8, atol=1e-10)


def test_degrees_of_freedom_are_found_again():
    rng = np.random.default_rng(3)
    found = [student_freedom(np.sum(rng.standard_t(4, size=(4000, 1)) ** 2, axis=1), 1) for _ in range(5)]
    np.testing.assert_allclose(np.mean(found), 4.0, rtol=0.1)
    assert student_freedom(rng.normal(size=4000) ** 2, 1) > 30
