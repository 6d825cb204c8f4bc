"""Discrepancies, differences of adjustments, rotations of covariances, and positional accuracy by hand."""

import dataclasses
import math

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import Tables, angle_differences, covariance, point_differences
from jaxphoto.observations import ControlCoordinates
from jaxphoto.report.results import accuracy_sentences
from jaxphoto.report.tables import accuracy_table
from jaxphoto.statistics import (
    ComponentAccuracy,
    check_discrepancies,
    positional_accuracy,
    residual_spread,
    significance,
)
from tests.blocks import adjusted, simulated


def test_rotations_differ_by_the_matrices_that_join_them():
    """Object-frame rotations are R' times camera-frame ones; omega, phi, kappa transform by their derivative."""
    result = adjusted("cross")
    camera, world, angles = (
        np.asarray(covariance(result, kind).matrix) for kind in ("camera", "object", "omega_phi_kappa")
    )
    rotation = np.asarray(result.unknowns.exterior.camera_from_object)
    omega, phi, kappa = np.asarray(result.unknowns.exterior.omega_phi_kappa).T
    for i, r in enumerate(rotation):
        block = slice(6 * i + 3, 6 * i + 6)
        np.testing.assert_allclose(world[block, block], r.T @ camera[block, block] @ r, rtol=1e-9, atol=0)
        sp, cp, sk, ck = np.sin(phi[i]), np.cos(phi[i]), np.sin(kappa[i]), np.cos(kappa[i])
        # Camera-frame rotation of d(omega), d(phi), d(kappa): the axes of R1 and R2 in the camera frame, and its z.
        join = np.array([[cp * ck, sk, 0], [-cp * sk, ck, 0], [sp, 0, 1]])
        np.testing.assert_allclose(join @ angles[block, block] @ join.T, camera[block, block], rtol=1e-8, atol=1e-18)
    assert omega.shape == (len(rotation),)


def test_spread_and_check_points_are_plain_means():
    result = adjusted("cross")
    spread = {(s.group, s.axis): s for s in residual_spread(result)}
    v = np.asarray(result.residuals.image[0]) * np.asarray(result.values.sigma_xy[0])
    assert spread["image_points", "x"].rmse == pytest.approx(np.sqrt(np.mean(v**2)), rel=1e-12)
    assert spread["image_points", "x"].n == len(v)
    rows = check_discrepancies(result)
    surveyed = np.asarray(result.block.check.value)
    computed = np.asarray(result.unknowns.points)[rows.who, rows.axis]
    assert len(rows.value)
    np.testing.assert_array_equal(rows.value, surveyed - computed)
    table = Tables(result).check_points
    assert len(table) == len(set(rows.who.tolist()))


def test_differences_of_two_adjustments_meet_by_name_and_wrap():
    one = adjusted("cross")
    exterior = one.unknowns.exterior
    angles = np.asarray(exterior.omega_phi_kappa)
    turned = type(exterior).from_angles(exterior.position, angles + np.array([0.0, 0.0, 2 * np.pi - 0.01]))
    leaves = lambda a: (a.unknowns.points, a.unknowns.exterior)  # noqa: E731
    two = eqx.tree_at(leaves, one, (np.asarray(one.unknowns.points)[::-1] + 1.0, turned))
    renamed = dataclasses.replace(one.block, points=one.block.points[::-1])
    two = dataclasses.replace(two, block=renamed)
    names, points = point_differences(one, two)
    assert names == one.block.points
    np.testing.assert_allclose(points, -1.0, rtol=0, atol=1e-9)
    images, difference = angle_differences(one, two)
    assert images == one.block.images
    np.testing.assert_allclose(difference, np.tile([0, 0, 0.01], (len(images), 1)), rtol=0, atol=1e-12)


def test_truth_is_recovered_within_its_sigmas():
    result, (_, truth) = adjusted("cross"), simulated("cross")
    for s in significance(result, covariance(result)):
        interior = truth.interior["one"]
        place = {"c_mm": interior.c, "xp_mm": interior.x_p, "yp_mm": interior.y_p}
        true = place.get(s.parameter, getattr(interior.distortion, s.parameter, None))
        assert abs(s.value - float(true)) < 4 * s.sigma, s.parameter


def check_rows(error, sigma):
    """Rows of discrepancies (n, 3) with sigmas of the same shape; NaN for an axis without survey."""
    who, axis = np.nonzero(np.isfinite(error))
    return ControlCoordinates(who, axis, error[who, axis], np.broadcast_to(sigma, error.shape)[who, axis])


def thirty(z=0.03):
    """Errors of 0.03 m in X, 0.04 m in Y and `z` in Z with alternating signs at thirty points: 0.05 m in plan."""
    signs = np.resize([1.0, -1.0], 30)[:, None]
    return signs * [0.03, 0.04, z]


def test_survey_errors_are_added_in_square():
    # By hand: 5 cm in plan, survey sqrt(2 * 0.5 * 144) = 12 cm: 13 cm. In height sqrt(3^2 + 4^2) = 5 cm.
    sigma = [0.12 / math.sqrt(2), 0.12 / math.sqrt(2), 0.04]
    plan, height, space = positional_accuracy(check_rows(thirty(), sigma)).tested
    assert (plan.n, height.n, space.n) == (30, 30, 30)
    assert plan.fit_m == pytest.approx(0.05, rel=1e-12) and plan.survey_m == pytest.approx(0.12, rel=1e-12)
    assert plan.rmse_m == pytest.approx(0.13, rel=1e-12) and plan.class_cm == 13
    assert height.rmse_m == pytest.approx(0.05, rel=1e-12) and height.class_cm == 5
    assert space.rmse_m == pytest.approx(math.sqrt(0.13**2 + 0.05**2), rel=1e-12)
    assert plan.claimed and height.claimed and space.claimed


def test_unlike_points_and_sigmas_by_hand():
    # Two points in plan: squares 0.0025 and 0.0169 m2, mean 0.0097; sigmas 2 * 0.01^2 and 2 * 0.03^2, mean 0.001.
    error = np.array([[0.03, -0.04, np.nan], [0.05, 0.12, np.nan], [np.nan, np.nan, -0.02]])
    sigma = np.array([[0.01] * 3, [0.03] * 3, [0.02] * 3])
    result = positional_accuracy(check_rows(error, sigma))
    plan, height, space = result.tested
    assert plan.n == 2 and plan.fit_m == pytest.approx(0.0097**0.5) and plan.survey_m == pytest.approx(0.001**0.5)
    assert plan.rmse_m == pytest.approx(0.0107**0.5) and plan.class_cm == 11
    assert height.n == 1 and height.rmse_m == pytest.approx(0.0008**0.5) and height.class_cm == 2.9
    assert space.n == 1 and space.rmse_m == pytest.approx((0.0107 + 0.0008) ** 0.5)
    assert [(a.axis, a.n) for a in result.axes] == [("X", 2), ("Y", 2), ("Z", 1)]
    assert result.axes[0].mean_m == pytest.approx(0.04) and result.axes[0].rmse_m == pytest.approx(0.0017**0.5)


def test_the_class_is_the_next_number_of_two_digits():
    for rmse, expected in ((0.0321, 3.3), (0.0320, 3.2), (0.0991, 10.0), (1.234, 130.0), (0.0, 0.0), (0.05, 5.0)):
        assert ComponentAccuracy("vertical", "RMSE_V", 30, rmse, 0.0).class_cm == expected


def test_fewer_than_thirty_check_points_claim_nothing():
    result = positional_accuracy(check_rows(thirty()[:29], 0.001))
    assert not accuracy_table(result)["claimed"].any()
    messages = accuracy_sentences(result)
    assert (
        len([s for s in messages if s.startswith("Cannot be claimed") and "tested with 29 check points only" in s]) == 3
    )
    assert not any("to meet" in s for s in messages)
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
    messages = " ".join(accuracy_sentences(positional_accuracy(check_rows(thirty(), sigma))))
    assert "survey unknown" in messages and "vertical, three-dimensional" in messages


def test_a_shift_and_a_poor_survey_are_named():
    biased = np.add(thirty(), [0.0, 0.0, 0.05])
    messages = accuracy_sentences(positional_accuracy(check_rows(biased, 0.01)))
    assert [s for s in messages if "mean error" in s and "in Z" in s] and not [s for s in messages if "error in X" in s]
    # Means of half and of nearly all of the RMSE: t = 0.87 and 16, limit 4.30; none without redundancy.
    few = positional_accuracy(check_rows(np.array([[0.0, 0.05, 0.01], [0.0, 0.05, 0.03], [0.0, 0.06, -0.01]]), 0.01))
    assert [axis.biased for axis in few.axes] == [False, True, False]
    assert not any(axis.biased for axis in positional_accuracy(check_rows(np.full((1, 3), 0.05), 0.01)).axes)
    poor = accuracy_sentences(positional_accuracy(check_rows(thirty(), [0.1, 0.1, 0.001])))
    assert "not twice as accurate as the tested product (horizontal)" in poor[-1]


def test_no_check_points_say_nothing():
    result = positional_accuracy(ControlCoordinates.none())
    assert result.tested == () and accuracy_sentences(result) == [] and len(accuracy_table(result)) == 0
