"""Tests of sigma naught and of single residuals against SciPy's distributions."""

import pytest
from scipy import stats

from jaxphoto.statistics import chi_square_p, critical_value


@pytest.mark.parametrize(("square_sum", "redundancy"), [(3.0, 3), (16.3, 3), (300.0, 248), (102_000.0, 100_000)])
def test_chi_square(square_sum, redundancy):
    assert chi_square_p(square_sum, redundancy) == pytest.approx(stats.chi2.sf(square_sum, redundancy), rel=1e-6)


def test_nothing_is_tested_without_redundancy():
    assert chi_square_p(5.0, 0) == 1.0


@pytest.mark.parametrize("level", [0.05, 1e-3, 1e-8])
def test_critical_value(level):
    assert 2 * stats.norm.sf(critical_value(level)) == pytest.approx(level, rel=1e-6)
