"""Variances from few values, drawn towards what all have in common."""

import numpy as np
import pytest

from jaxphoto.lidar.strip_planes import moderated_variances


@pytest.mark.parametrize(("prior", "off"), [(1e9, 0.01), (30.0, 0.05), (8.0, 0.1)])
def test_the_expected_variance_given_what_was_measured(prior, off):
    """Of true variances drawn from the model: right on average for those that look small as for those that do not."""
    rng, n = np.random.default_rng(0), 20_000
    freedom = rng.integers(7, 15, n)
    true = 9e-4 * prior / rng.chisquare(prior, n)
    measured = true * rng.chisquare(freedom) / freedom
    found = moderated_variances(measured, freedom)
    order = np.argsort(found)
    for part in np.array_split(order, 4):
        # 1 / true is what weights should be; its expectation given the measurement is that of a chi squared one.
        assert np.mean(found[part] / true[part]) == pytest.approx(1.0, abs=off)
    assert np.mean(measured / true) == pytest.approx(1.0, abs=0.02)
    assert np.mean((found - true) ** 2) < np.mean((measured - true) ** 2)


def test_variances_that_scatter_by_chance_alone_become_one():
    rng, freedom = np.random.default_rng(2), np.full(500, 10)
    found = moderated_variances(4.0 * rng.chisquare(50.0, 500) / 50.0, freedom)
    assert np.ptp(found) == 0.0 and found[0] == pytest.approx(4.0, rel=0.1)


def test_one_alone_stays():
    np.testing.assert_array_equal(moderated_variances(np.array([2.0]), np.array([7])), [2.0])
