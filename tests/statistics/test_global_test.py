"""What is expected of sigma naught where residuals are of an image that the distortion has stretched."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto.statistics import expected_residual_scale, global_test, redundancy_numbers
from tests.blocks import adjusted, covariance_of


def test_noise_is_stretched_with_the_image_as_said():
    a = adjusted("cross")
    interior, rng = a.unknowns.interior["one"], np.random.default_rng(1)
    xy, sigma = np.asarray(a.values.xy).T, np.asarray(a.values.sigma_xy).T
    model = interior.distortion

    def corrected(xy):
        x, y = (xy - np.asarray(interior.principal_point)).T
        r2 = x * x + y * y
        return np.stack([x, y], axis=1) * (1 - model.k1 * r2 - model.k2 * r2 * r2)[:, None]

    shifted = np.array([corrected(xy + sigma * rng.normal(size=xy.shape)) for _ in range(400)])
    residual = (shifted - corrected(xy)) / sigma
    assert expected_residual_scale(a)["one"] == pytest.approx(np.sqrt((residual**2).mean()), abs=0.004)
    assert expected_residual_scale(a)["one"] > 1.01


def test_it_is_counted_in_the_test_of_sigma_naught():
    a = adjusted("cross")
    numbers = redundancy_numbers(a, covariance_of("cross"))
    counted, usual = global_test(a, numbers), global_test(a)
    assert counted.factor == usual.factor
    assert counted.sigma == pytest.approx(usual.sigma / counted.expected**0.5) and usual.expected == 1
    # One-sided probabilities of a square sum that is a few per cent smaller.
    expected = 1 + float(np.sum(numbers.image)) / a.redundancy * (expected_residual_scale(a)["one"] ** 2 - 1)
    scaled = eqx.tree_at(lambda adjusted: adjusted.residuals, a, jax.tree.map(lambda v: v / expected**0.5, a.residuals))
    assert counted.p_value == pytest.approx(global_test(scaled).p_value, rel=0.02)


def test_residuals_of_measured_coordinates_are_not_stretched():
    a = adjusted("cross")
    interior = dataclasses.replace(a.unknowns.interior["one"], residuals="measured")
    measured = eqx.tree_at(lambda adjusted: adjusted.unknowns.interior["one"], a, interior)
    assert expected_residual_scale(measured) == {"one": 1.0}
