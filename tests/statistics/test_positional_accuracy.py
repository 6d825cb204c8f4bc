"""Positional accuracy of ASPRS Edition 2 by numbers that were computed by hand."""

import math

import numpy as np
import pytest

from jaxphoto.observations import ControlRows
from jaxphoto.report.results import accuracy_sentences
from jaxphoto.report.tables import accuracy_table
from jaxphoto.statistics import ComponentAccuracy, positional_accuracy


def check_rows(off, sigma):
    """Rows of discrepancies (n, 3) with sigmas of the same shape; NaN stands for an axis that was not surveyed."""
    who, axis = np.nonzero(np.isfinite(off))
    return ControlRows(who, axis, off[who, axis], np.broadcast_to(sigma, off.shape)[who, axis])


def thirty(z=0.03):
    """X 0.03 and Y 0.04 m off by turns either way, Z `z`: 0.05 m in plan at each of thirty points."""
    signs = np.resize([1.0, -1.0], 30)[:, None]
    return signs * [0.03, 0.04, z]


def test_survey_errors_are_added_in_square():
    # By hand: fit 5 cm in plan, survey sqrt(2 * 0.5 * 144) = 12 cm: 13 cm. In height sqrt(3^2 + 4^2) = 5 cm.
    sigma = [0.12 / math.sqrt(2), 0.12 / math.sqrt(2), 0.04]
    plan, height, space = positional_accuracy(check_rows(thirty(), sigma)).tested
    assert (plan.n, height.n, space.n) == (30, 30, 30)
    assert plan.fit_m == pytest.approx(0.05, rel=1e-12) and plan.survey_m == pytest.approx(0.12, rel=1e-12)
    assert plan.rmse_m == pytest.approx(0.13, rel=1e-12) and plan.class_cm == 13
    assert height.rmse_m == pytest.approx(0.05, rel=1e-12) and height.class_cm == 5
    assert space.rmse_m == pytest.approx(math.sqrt(0.13**2 + 0.05**2), rel=1e-12)
    assert plan.claimed and height.claimed and space.claimed


def test_unlike_points_and_sigmas_by_hand():
    # Plan of two points: squares 0.0025 and 0.0169 m2, mean 0.0097; sigmas 2 * 0.01^2 and 2 * 0.03^2, mean 0.001.
    off = np.array([[0.03, -0.04, np.nan], [0.05, 0.12, np.nan], [np.nan, np.nan, -0.02]])
    sigma = np.array([[0.01] * 3, [0.03] * 3, [0.02] * 3])
    found = positional_accuracy(check_rows(off, sigma))
    plan, height, space = found.tested
    assert plan.n == 2 and plan.fit_m == pytest.approx(0.0097**0.5) and plan.survey_m == pytest.approx(0.001**0.5)
    assert plan.rmse_m == pytest.approx(0.0107**0.5) and plan.class_cm == 11
    assert height.n == 1 and height.rmse_m == pytest.approx(0.0008**0.5) and height.class_cm == 2.9
    assert space.n == 1 and space.rmse_m == pytest.approx((0.0107 + 0.0008) ** 0.5)
    assert [(a.axis, a.n) for a in found.axes] == [("X", 2), ("Y", 2), ("Z", 1)]
    assert found.axes[0].mean_m == pytest.approx(0.04) and found.axes[0].rmse_m == pytest.approx(0.0017**0.5)


def test_the_class_is_the_next_number_of_two_digits():
    for rmse, expected in ((0.0321, 3.3), (0.0320, 3.2), (0.0991, 10.0), (1.234, 130.0), (0.0, 0.0), (0.05, 5.0)):
        assert ComponentAccuracy("vertical", "RMSE_V", 30, rmse, 0.0).class_cm == expected


def test_fewer_than_thirty_check_points_claim_nothing():
    found = positional_accuracy(check_rows(thirty()[:29], 0.001))
    assert not accuracy_table(found)["claimed"].any()
    said = accuracy_sentences(found)
    assert len([s for s in said if s.startswith("Cannot be claimed") and "tested with 29 check points only" in s]) == 3
    assert not any("to meet" in s for s in said)
    claimed = accuracy_sentences(positional_accuracy(check_rows(thirty(), 0.001)))
    met = "Tested with 30 check points to meet the 3.1-cm RMSE_V vertical positional accuracy class: RMSE_V = 3 cm"
    assert f"{met} (block to check points 3 cm, survey 0.1 cm)." == claimed[2] and not any(
        "Cannot" in s for s in claimed
    )


def test_a_survey_whose_errors_nobody_told_claims_nothing():
    sigma = np.full((30, 3), 0.001)
    sigma[7, 2] = 0.0
    plan, height, space = positional_accuracy(check_rows(thirty(), sigma)).tested
    assert plan.claimed and not height.claimed and not space.claimed
    assert height.rmse_m == pytest.approx(0.03)
    said = " ".join(accuracy_sentences(positional_accuracy(check_rows(thirty(), sigma))))
    assert "survey unknown" in said and "vertical, three-dimensional" in said


def test_a_shift_and_a_poor_survey_are_named():
    biased = np.add(thirty(), [0.0, 0.0, 0.05])
    said = accuracy_sentences(positional_accuracy(check_rows(biased, 0.01)))
    assert [s for s in said if "mean error" in s and "in Z" in s] and not [s for s in said if "error in X" in s]
    # Means of half and of nearly all of the RMSE, t = 0.87 and 16 of 4.30, without freedom none.
    few = positional_accuracy(check_rows(np.array([[0.0, 0.05, 0.01], [0.0, 0.05, 0.03], [0.0, 0.06, -0.01]]), 0.01))
    assert [axis.biased for axis in few.axes] == [False, True, False]
    assert not any(axis.biased for axis in positional_accuracy(check_rows(np.full((1, 3), 0.05), 0.01)).axes)
    poor = accuracy_sentences(positional_accuracy(check_rows(thirty(), [0.1, 0.1, 0.001])))
    assert "not twice as accurate as the tested product (horizontal)" in poor[-1]


def test_no_check_points_say_nothing():
    found = positional_accuracy(ControlRows.none())
    assert found.tested == () and accuracy_sentences(found) == [] and len(accuracy_table(found)) == 0
