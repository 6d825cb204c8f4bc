"""The test of sigma naught against SciPy's distributions."""

import pytest
from scipy import stats

from jaxphoto.statistics import chi_square_p


@pytest.mark.parametrize(("square_sum", "redundancy"), [(3.0, 3), (16.3, 3), (300.0, 248), (102_000.0, 100_000)])
def test_chi_square(square_sum, redundancy):
    assert chi_square_p(square_sum, redundancy) == pytest.approx(stats.chi2.sf(square_sum, redundancy), rel=1e-6)


def test_nothing_is_tested_without_redundancy():
    assert chi_square_p(5.0, 0) == 1.0
