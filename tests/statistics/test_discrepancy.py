"""Correlations, significance, discrepancies and differences against their definitions."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from scipy import stats

from jaxphoto import Brown, Tables, angle_differences, covariance, point_differences
from jaxphoto.statistics import check_discrepancies, correlation_matrix, correlations, residual_spread, significance
from jaxphoto.statistics.significance import student_p
from tests.blocks import adjusted, simulated


def test_p_value_is_students():
    for t, dof in ((0.0, 5), (0.7, 1), (2.5, 30), (12.0, 275)):
        assert student_p(t, dof) == pytest.approx(2 * stats.t.sf(t, dof), rel=1e-9)
    assert student_p(3.0, 0) == 1.0


def test_significance_is_the_ratio_to_the_a_posteriori_sigma():
    result = adjusted("cross")
    c = covariance(result)
    tests = {s.parameter: s for s in significance(result, c)}
    assert list(tests) == ["c_mm", "xp_mm", "yp_mm", "k1", "k2"]
    sigma = np.sqrt(np.diagonal(np.asarray(c.matrix))[-5:]) * float(result.sigma0)
    interior = result.unknowns.interior["one"]
    assert isinstance(interior.distortion, Brown)
    values = [interior.c, interior.x_p, interior.y_p, interior.distortion.k1, interior.distortion.k2]
    for test, value, s in zip(tests.values(), values, sigma, strict=True):
        assert test.ratio == pytest.approx(abs(float(value)) / s, rel=1e-12)
        assert test.significant == (abs(float(value)) >= stats.t.ppf(0.975, result.redundancy) * s)


def test_correlations_are_scaled_covariances_of_the_named_unknowns():
    result = adjusted("cross")
    c = covariance(result)
    rho = correlation_matrix(c)
    ours = correlations(result, c)["one"]
    place = {label: k for k, label in enumerate(c.labels)}
    q = np.asarray(c.matrix)
    for i, image in enumerate(ours.images):
        for j, eop in enumerate(ours.eop_names):
            for k, iop in enumerate(ours.parameters):
                a, b = place[f"exterior[{image}].{eop}"], place[f"interior[one].{iop}"]
                expected = q[a, b] / np.sqrt(q[a, a] * q[b, b])
                assert ours.exterior[i, j, k] == pytest.approx(expected, abs=1e-12)
                assert rho[a, b] == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(ours.mean_abs, np.abs(ours.exterior).mean(0), rtol=0, atol=1e-15)
    assert (ours.max_abs >= ours.mean_abs).all()
    np.testing.assert_allclose(np.diagonal(ours.interior), 1.0, rtol=0, atol=1e-12)


def test_rotations_differ_by_the_matrices_that_join_them():
    """Object-frame rotations are R' times camera-frame ones; omega, phi, kappa follow by their own derivative."""
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
        # Camera-frame rotation of d(omega), d(phi), d(kappa): the axes of R1 and R2 seen from the camera, and its z.
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
    where = lambda a: (a.unknowns.points, a.unknowns.exterior)  # noqa: E731
    two = eqx.tree_at(where, one, (np.asarray(one.unknowns.points)[::-1] + 1.0, turned))
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
