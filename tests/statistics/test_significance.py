"""Significance: chi-square by SciPy; changes of a camera in flight against the formulas, priors removed, messages."""

import functools

import numpy as np
import pytest
from scipy import stats

from jaxphoto import FIXED, FREE, Tables, Weighted, adjust, covariance
from jaxphoto.camera import CameraRates
from jaxphoto.report.results import table_names
from jaxphoto.report.verdict import drift_finding
from jaxphoto.statistics import CameraDrift, ZeroTest, camera_drifts, chi_square_p
from tests.camera.test_camera_rates import TRUE, changing_block, with_rates


@pytest.mark.parametrize(("sum_of_squares", "redundancy"), [(3.0, 3), (16.3, 3), (300.0, 248), (102_000.0, 100_000)])
def test_chi_square(sum_of_squares, redundancy):
    assert chi_square_p(sum_of_squares, redundancy) == pytest.approx(
        stats.chi2.sf(sum_of_squares, redundancy), rel=1e-6
    )


def test_nothing_is_tested_without_redundancy():
    assert chi_square_p(5.0, 0) == 1.0


@functools.cache
def zero_test_of(*priors, parameters=("c", "xp", "yp", "k1")):
    """The test of a changing camera, and the a posteriori covariance of its changes within an hour."""
    result = adjust(with_rates(changing_block(), CameraRates(*priors)))
    q = covariance(result)
    (drift,) = camera_drifts(result, q)
    assert drift.parameters == parameters
    places = [k for k, label in enumerate(q.labels) if label.startswith("camera_rates[")]
    assert (drift.camera, drift.span) == ("one", pytest.approx(1.0))
    return result, drift.change, np.asarray(q.matrix)[np.ix_(places, places)] * float(result.sigma0) ** 2


def test_the_test_of_all_rates_is_that_of_fisher():
    result, drift, q = zero_test_of(FREE, FREE, FREE, FREE)
    rates = result.unknowns.more["camera_rates"]["one"]
    np.testing.assert_allclose(drift.value, [rates.c_rate, rates.xp_rate, rates.yp_rate, rates.k1_rate], rtol=1e-12)
    np.testing.assert_allclose(drift.sigma, np.sqrt(np.diagonal(q)), rtol=1e-9)
    f = drift.value @ np.linalg.solve(q, drift.value) / 4
    assert drift.p_value == pytest.approx(stats.f.sf(f, 4, result.redundancy), rel=1e-6)
    assert drift.rejected
    each = 2 * stats.t.sf(np.abs(drift.value) / drift.sigma, result.redundancy)
    np.testing.assert_allclose(drift.p_values, each, rtol=1e-6)


def test_a_change_of_the_detectable_size_is_found_with_the_power():
    _, drift, q = zero_test_of(FREE, FREE, FREE, FREE)
    noncentrality = drift.detectable**2 * np.diagonal(np.linalg.inv(q))
    np.testing.assert_allclose(stats.ncx2.sf(stats.chi2.isf(0.05, 4), 4, noncentrality), 0.8, atol=1e-6)
    _, alone, _ = zero_test_of(FREE, FIXED, FIXED, FIXED, parameters=("c",))
    np.testing.assert_allclose(alone.detectable, (1.959964 + 0.841621) * alone.sigma, rtol=1e-4)


def test_what_is_known_beforehand_shows_nothing():
    """A prior of a rate, tight or loose, is removed: the same test as without."""
    _, free, _ = zero_test_of(FREE, FREE, FREE, FREE)
    reference = [Weighted(value + 0.5 * s, 0.7 * s) for value, s in zip(free.value, free.sigma, strict=True)]
    _, drift, _ = zero_test_of(*reference)
    assert (drift.sigma < 0.8 * free.sigma).all()
    np.testing.assert_allclose(drift.detectable, free.detectable, rtol=0.02)
    assert np.log10(drift.p_value) == pytest.approx(np.log10(free.p_value), rel=0.02)


def test_the_table_has_a_row_a_rate_where_cameras_change():
    result, drift, _ = zero_test_of(FREE, FREE, FREE, FREE)
    tables = Tables(result)
    assert "camera_drift" in table_names(tables)
    table = tables.camera_drift.set_index("parameter")
    assert list(table.unit) == ["mm", "mm", "mm", ""]
    assert table.change["c"] == pytest.approx(drift.value[0]) and abs(table.change["c"] - TRUE.c_rate) < 0.03


def words(parameters, change, sigma, p_values, detectable, p_value, hours=1.0):
    test = ZeroTest(*map(np.array, (change, sigma, p_values, detectable)), p_value)
    return drift_finding(CameraDrift("kodak", CameraRates, hours, parameters, test)).text


def test_what_changed_is_said_with_its_standard_deviation():
    moved = words(("c", "xp", "k1"), [4.8e-3, -3.1e-3, 2e-9], [1.9e-3, 1e-3, 3e-9], [0.011, 0.002, 0.5],
                  [5e-3, 3e-3, 9e-9], 0.003)  # fmt: skip
    assert moved == "camera kodak changed over 60 min (p = 0.003): c by 4.8 +- 1.9 um, x_p by -3.1 +- 1.0 um"
    assert "c by -4.8 +- 1.9 um" in words(("c",), [-4.8e-3], [1.9e-3], [0.01], [5e-3], 0.01)


def test_what_would_have_been_seen_is_said_where_nothing_is():
    still = words(("c", "xp", "yp"), [1e-3] * 3, [1.9e-3] * 3, [0.6] * 3, [5.3e-3, 2.1e-3, np.inf], 0.62, 2.0)
    assert still == (
        "camera kodak: no significant change over 2 h (p = 0.6); MDB of a change (power 80 %): c 5.3 um, x_p 2.1 um, "
        "y_p none"
    )
    hardly = words(("c", "xp"), [0.1] * 2, [0.4] * 2, [0.6] * 2, [8.2, 0.0994], 0.62, 2.0)
    assert hardly.endswith(": c 8.2 mm, x_p 99 um")
    assert "c by 1.20 +- 0.38 mm" in words(("c",), [1.2], [0.38], [0.01], [1.1], 0.01)
