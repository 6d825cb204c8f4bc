"""Blunder test and global test: critical values by simulation, MDBs, and expectations for distorted images."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

from jaxphoto import adjust, covariance
from jaxphoto.statistics import (
    DELTA0,
    blunder_test,
    critical_w,
    expected_residual_scale,
    global_test,
    group_factors,
    largest_mdbs,
    minimal_detectable_biases,
    redundancy_numbers,
)
from tests.blocks import adjusted, covariance_of, simulated


def test_the_largest_w_of_a_sound_adjustment_exceeds_its_critical_value_as_seldom_as_said():
    rng = np.random.default_rng(3)
    n, u, draws, level = 30, 22, 40_000, 0.05
    q, _ = np.linalg.qr(rng.normal(size=(n, u)))
    r = np.eye(n) - q @ q.T
    v = rng.normal(size=(draws, n)) @ r
    sigma0 = np.sqrt((v**2).sum(axis=1) / (n - u))
    largest = (np.abs(v) / np.sqrt(np.diagonal(r))).max(axis=1) / sigma0
    rate = (largest > critical_w(n, n - u, level)).mean()
    # Bonferroni's bound is close for weakly correlated w; the normal distribution would be far too strict.
    assert 0.6 * level < rate < level
    assert (largest > stats.norm.isf(level / 2 / n)).mean() < 0.1 * level


def test_the_critical_value_of_many_is_that_of_the_normal_distribution():
    assert critical_w(1000, 10**7) == pytest.approx(stats.norm.isf(1e-3 / 2000), abs=1e-5)
    assert critical_w(10, 1) == np.inf and critical_w(0, 50) == np.inf


def test_a_blunder_is_estimated_with_its_sigma():
    block, error = simulated("cross").block, 0.6
    rows = block.control
    value = np.array(rows.value)
    row = int(np.flatnonzero(rows.axis == 0)[1])
    value[row] += error
    with_blunder = dataclasses.replace(block, control=dataclasses.replace(rows, value=value))
    a = adjust(with_blunder)
    result = blunder_test(a, redundancy_numbers(a, covariance(a)))
    worst = result.suspects[0]
    assert (worst.group, worst.row, worst.unit) == ("control_points", row, "m")
    assert worst.words == f"control point {block.points[rows.who[row]]} in X"
    assert abs(worst.error - error) < 4 * worst.sigma / float(a.sigma0)
    assert worst.w == pytest.approx(worst.error / worst.sigma)
    assert abs(worst.w) > result.limit
    # Without the blunder there is no suspect.
    clean = adjusted("cross")
    assert not blunder_test(clean, redundancy_numbers(clean, covariance_of("cross"))).suspects


def test_detectable_errors_are_those_of_the_redundancy_numbers():
    a = adjusted("cross")
    numbers = redundancy_numbers(a, covariance_of("cross"))
    r, sigma = np.asarray(numbers.image), np.asarray(a.block.image_points.sigma).T
    np.testing.assert_allclose(minimal_detectable_biases(a, numbers)["image_points"], DELTA0 * sigma / np.sqrt(r))
    for largest_mdb in largest_mdbs(a, numbers):
        largest = (minimal_detectable_biases(a, numbers)[largest_mdb.group] / np.asarray(largest_mdb.sigma)).max()
        assert largest_mdb.mdb / largest_mdb.sigma == pytest.approx(largest, rel=1e-9)


def test_a_shift_of_delta0_is_found_with_a_probability_of_80_per_cent():
    limit = stats.norm.isf(1e-3 / 2)
    power = stats.norm.sf(limit - DELTA0) + stats.norm.cdf(-limit - DELTA0)
    assert power == pytest.approx(0.80, abs=0.003)


def test_the_blocks_of_a_row_hold_its_redundancy_numbers():
    a = adjusted("cross")
    numbers = redundancy_numbers(a, covariance_of("cross"))
    block = numbers.blocks["image_points"]
    np.testing.assert_allclose(np.diagonal(block, axis1=1, axis2=2).T, numbers.image, atol=1e-12)
    np.testing.assert_allclose(block, block.transpose(0, 2, 1))
    values = np.linalg.eigvalsh(block)
    assert values.min() > -1e-9 and values.max() < 1 + 1e-9
    assert np.abs(block[:, 0, 1]).max() > 1e-3


def test_sigma_naught_is_tested_on_both_sides():
    a = adjusted("cross")
    test = global_test(a)
    q, f = float(a.sum_of_squares), a.redundancy
    assert test.p_value == pytest.approx(2 * min(stats.chi2.cdf(q, f), stats.chi2.sf(q, f)), rel=1e-9)
    numbers = redundancy_numbers(a, covariance_of("cross"))
    groups = {g.group: g for g in group_factors(a, numbers)}
    assert sum(g.redundancy for g in groups.values()) <= f + 1e-6
    v = np.asarray(a.residuals["image_points"])
    assert groups["image_points"].factor == pytest.approx((v**2).sum() / float(np.sum(numbers.image)))


def corrected_coordinates(a):
    """The same adjustment with residuals of corrected coordinates."""
    interior = dataclasses.replace(a.unknowns.interior["one"], residuals="model")
    return eqx.tree_at(lambda adjusted: adjusted.unknowns.interior["one"], a, interior)


def test_noise_is_stretched_with_the_image_as_said():
    a = corrected_coordinates(adjusted("cross"))
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
    a = corrected_coordinates(adjusted("cross"))
    numbers = redundancy_numbers(a, covariance_of("cross"))
    test, without_numbers = global_test(a, numbers), global_test(a)
    assert test.factor == without_numbers.factor
    assert test.sigma == pytest.approx(without_numbers.sigma / test.expected**0.5) and without_numbers.expected == 1
    # One-sided probabilities of a square sum smaller by a few per cent.
    expected = 1 + float(np.sum(numbers.image)) / a.redundancy * (expected_residual_scale(a)["one"] ** 2 - 1)
    scaled = eqx.tree_at(lambda adjusted: adjusted.residuals, a, jax.tree.map(lambda v: v / expected**0.5, a.residuals))
    assert test.p_value == pytest.approx(global_test(scaled).p_value, rel=0.02)


def test_residuals_of_measured_coordinates_are_not_stretched():
    assert expected_residual_scale(adjusted("cross")) == {"one": 1.0}
