"""Covariances in each kind of rotation, correlations, and significance."""

import jax
import numpy as np
import pytest
from scipy import stats

from jaxphoto import covariance
from jaxphoto.camera import get_parameter
from jaxphoto.rotation import omega_phi_kappa_from_matrix, small_rotation
from jaxphoto.statistics import EOP_NAMES, correlation_matrix, correlations, significance
from jaxphoto.statistics.significance import student_p
from tests.blocks import adjusted, covariance_of
from tests.checked_types import unchecked


@pytest.fixture(scope="module")
def by_rotation():
    return {kind: covariance(adjusted("two_cameras"), kind) for kind in EOP_NAMES}


@pytest.mark.parametrize("kind", ["omega_phi_kappa", "object"])
def test_kinds_of_rotation_are_one_covariance(by_rotation, kind):
    """Camera-frame rotations transformed by a numerical derivative, or by the rotation matrix."""
    exterior = adjusted("two_cameras").unknowns.exterior
    n = by_rotation[kind].n_images
    transport = np.eye(len(by_rotation[kind].labels))
    angles = jax.jit(jax.vmap(lambda m, t: omega_phi_kappa_from_matrix(small_rotation(t) @ m), in_axes=(None, 0)))
    for i in range(n):
        matrix = np.asarray(exterior.camera_from_object)[i]
        if kind == "object":
            factor = matrix.T
        else:
            step = 1e-5 * np.eye(3)
            factor = np.asarray(angles(matrix, step) - angles(matrix, -step)).T / 2e-5
        transport[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = factor
    expected = transport @ np.asarray(by_rotation["camera"].matrix) @ transport.T
    sigma = np.sqrt(np.diag(expected))
    result = np.asarray(by_rotation[kind].matrix)
    np.testing.assert_allclose(result / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-8)
    # Positions and interior orientation are invariant; rotations are not.
    others = np.r_[0:3, 6 * n : len(sigma)]
    np.testing.assert_allclose(result[np.ix_(others, others)], expected[np.ix_(others, others)], rtol=1e-12)
    assert np.abs(result / np.asarray(by_rotation["camera"].matrix) - 1).max() > 0.1


def test_labels_and_a_posteriori_sigmas(by_rotation):
    cov, a = by_rotation["omega_phi_kappa"], adjusted("two_cameras")
    assert cov.labels[:6] == tuple(f"exterior[i0].{n}" for n in ("X", "Y", "Z", "omega", "phi", "kappa"))
    assert cov.labels[6 * cov.n_images :] == a.structure.labels
    sigma = float(a.sigma0) * np.sqrt(np.diag(np.asarray(cov.matrix)))
    np.testing.assert_allclose(cov.exterior_sigma, sigma[: 6 * cov.n_images].reshape(-1, 6))
    np.testing.assert_allclose(cov.shared_sigma, sigma[6 * cov.n_images :])
    np.testing.assert_allclose(
        cov.point_sigma, float(a.sigma0) * np.sqrt(np.diagonal(np.asarray(cov.points), axis1=1, axis2=2))
    )


def test_unknown_rotations_are_refused():
    with unchecked(), pytest.raises(ValueError, match="omega_phi_kappa, object, camera"):
        covariance(adjusted("cross"), "quaternion")


def test_fixed_coordinates_have_no_variance():
    """Fixed control of `everything`: X and Y of one point."""
    block, cov = adjusted("everything").block, covariance_of("everything")
    sigma = np.asarray(cov.point_sigma)
    fixed = np.zeros_like(sigma, bool)
    fixed[block.fixed.who, block.fixed.axis] = True
    assert fixed.sum() == 2
    assert (sigma[fixed] == 0).all()
    assert (sigma[~fixed] > 0).all()


def test_correlations_by_camera(by_rotation):
    cov, a = by_rotation["omega_phi_kappa"], adjusted("two_cameras")
    rho = np.asarray(cov.matrix) / np.sqrt(np.outer(np.diag(cov.matrix), np.diag(cov.matrix)))
    np.testing.assert_allclose(correlation_matrix(cov), rho, atol=1e-12)
    labels = list(cov.labels)
    result = correlations(a, cov)
    assert set(result) == {"one", "two"}
    assert result["one"].parameters == ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
    assert result["two"].parameters == ("c_mm", "xp_mm", "yp_mm", "k1", "p1")
    for name, c in result.items():
        assert c.images == tuple(i for i, n in zip(a.block.images, a.block.image_camera, strict=True) if n == name)
        assert len(c.images) in (4, 6)
        for j, parameter in enumerate(c.parameters):
            column = labels.index(f"interior[{name}].{parameter}")
            for k, other in enumerate(c.parameters):
                assert c.interior[k, j] == pytest.approx(rho[labels.index(f"interior[{name}].{other}"), column])
            for i, image in enumerate(c.images):
                for e, eop in enumerate(c.eop_names):
                    assert c.exterior[i, e, j] == pytest.approx(rho[labels.index(f"exterior[{image}].{eop}"), column])
        for i, image in enumerate(c.images):
            rows = [labels.index(f"exterior[{image}].{eop}") for eop in c.eop_names]
            np.testing.assert_allclose(c.within_image[i], rho[np.ix_(rows, rows)], atol=1e-12)
        np.testing.assert_allclose(c.mean_abs, np.abs(c.exterior).sum(axis=0) / len(c.images))
        np.testing.assert_allclose(c.max_abs, np.abs(c.exterior).max(axis=0))
        assert (c.max_abs > c.mean_abs).all()


def test_correlation_of_what_is_fixed_is_zero():
    rho = correlation_matrix(covariance_of("cross"))
    assert np.isfinite(rho).all()
    np.testing.assert_allclose(np.diag(rho), 1.0)
    a = adjusted("fixed_interior")
    c = correlations(a, covariance_of("fixed_interior"))["one"]
    assert c.parameters == ()
    assert c.exterior.shape == (10, 6, 0)


def test_significance():
    a, cov = adjusted("two_cameras"), covariance_of("two_cameras")
    tests = significance(a, cov)
    assert [f"interior[{t.camera}].{t.parameter}" for t in tests] == list(a.structure.labels)
    for t, sigma in zip(tests, np.asarray(cov.shared_sigma), strict=True):
        value = float(get_parameter(a.unknowns.interior[t.camera], t.parameter))
        assert (t.value, t.sigma) == (value, sigma)
        assert t.ratio == pytest.approx(abs(value) / sigma)
        p = 2 * stats.t.sf(abs(value) / sigma, a.redundancy)
        assert t.p_value == pytest.approx(p, rel=1e-9, abs=1e-300)
        assert t.significant == (p < 0.05)
    assert {t.significant for t in tests} == {True, False}


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0, 2.5, 8.0, 40.0])
@pytest.mark.parametrize("degrees", [1, 2, 5, 30, 1000, 20000])
def test_students_p_is_scipys(t, degrees):
    assert student_p(t, degrees) == pytest.approx(2 * stats.t.sf(t, degrees), rel=1e-8, abs=1e-300)


def test_students_p_at_the_ends():
    assert student_p(3.0, 0) == 1.0
    assert student_p(np.inf, 10) == 0.0
