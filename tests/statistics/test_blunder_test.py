"""Critical values by simulation, errors estimated and detectable, and the blocks of redundancy numbers."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from jaxphoto import adjust, covariance
from jaxphoto.statistics import (
    DELTA0,
    blunder_test,
    critical_w,
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
    # Bonferroni's bound is close where w are hardly correlated; the normal distribution would give far too few.
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
    spoilt = dataclasses.replace(block, control=dataclasses.replace(rows, value=value))
    a = adjust(spoilt)
    found = blunder_test(a, redundancy_numbers(a, covariance(a)))
    worst = found.suspects[0]
    assert (worst.group, worst.row, worst.unit) == ("control_points", row, "m")
    assert worst.words == f"control point {block.points[rows.who[row]]} in X"
    assert abs(worst.error - error) < 4 * worst.sigma / float(a.sigma0)
    assert worst.w == pytest.approx(worst.error / worst.sigma)
    assert abs(worst.w) > found.limit
    # Sound, it is not suspected.
    clean = adjusted("cross")
    assert not blunder_test(clean, redundancy_numbers(clean, covariance_of("cross"))).suspects


def test_detectable_errors_are_those_of_the_redundancy_numbers():
    a = adjusted("cross")
    numbers = redundancy_numbers(a, covariance_of("cross"))
    r, sigma = np.asarray(numbers.image), np.asarray(a.block.image_points.sigma).T
    np.testing.assert_allclose(minimal_detectable_biases(a, numbers)["image_points"], DELTA0 * sigma / np.sqrt(r))
    for hidden in largest_mdbs(a, numbers):
        largest = (minimal_detectable_biases(a, numbers)[hidden.group] / np.asarray(hidden.sigma)).max()
        assert hidden.mdb / hidden.sigma == pytest.approx(largest, rel=1e-9)


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
    whole = global_test(a)
    q, f = float(a.square_sum), a.redundancy
    assert whole.p_value == pytest.approx(2 * min(stats.chi2.cdf(q, f), stats.chi2.sf(q, f)), rel=1e-9)
    numbers = redundancy_numbers(a, covariance_of("cross"))
    groups = {g.group: g for g in group_factors(a, numbers)}
    assert sum(g.redundancy for g in groups.values()) <= f + 1e-6
    v = np.asarray(a.residuals["image_points"])
    assert groups["image_points"].factor == pytest.approx((v**2).sum() / float(np.sum(numbers.image)))
