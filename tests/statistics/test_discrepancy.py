"""Discrepancies, differences of adjustments, rotations of covariances, and positional accuracy by hand."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import Tables, angle_differences, covariance, point_differences
from jaxphoto.statistics import (
    AxisErrors,
    check_discrepancies,
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
        place = {"c_mm": interior.c, "xp_mm": interior.xp, "yp_mm": interior.yp}
        true = place.get(s.parameter, getattr(interior.distortion, s.parameter, None))
        assert abs(s.value - float(true)) < 4 * s.sigma, s.parameter


def test_a_shift_of_check_points_exceeds_chance():
    """Means of half and of nearly all of the RMSE: t = 0.87 and 16, limit 4.30; none without redundancy."""
    errors = np.array([[0.0, 0.05, 0.01], [0.0, 0.05, 0.03], [0.0, 0.06, -0.01]])
    axes = [AxisErrors(a, 3, d.mean(), np.sqrt((d**2).mean())) for a, d in zip("XYZ", errors.T, strict=True)]
    assert [axis.biased for axis in axes] == [False, True, False]
    assert not AxisErrors("X", 1, 0.05, 0.05).biased
