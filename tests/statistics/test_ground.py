"""Correlation of the camera with the ground: linear forms by the covariance, correlations by Monte Carlo."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import covariance, monte_carlo
from jaxphoto.procedures.adjust import adjust
from jaxphoto.sensitivity.perturbation import noise
from jaxphoto.statistics.correlation import FORMS, _weights, ground_correlations, linear_forms
from tests.blocks import adjusted, simulated


def test_of_one_coordinate_it_is_what_the_covariance_says():
    result = adjusted("cross")
    reference, n = covariance(result), len(result.block.images)
    points, exterior = np.zeros((2, len(result.block.points), 3)), np.zeros((2, n, 6))
    points[0, 7, 2], exterior[1, 3, 0] = 1.0, 2.0
    forms = linear_forms(result, 2, points=points, exterior=exterior)
    assert forms.variance[0, 0] == pytest.approx(float(reference.point_sigma[7, 2]) ** 2, rel=1e-6)
    matrix = np.asarray(reference.matrix) * float(reference.variance_factor)
    assert forms.variance[1, 1] == pytest.approx(4 * matrix[18, 18], rel=1e-6)
    np.testing.assert_allclose(forms.with_shared[1], 2 * matrix[18, 6 * n :], rtol=1e-5, atol=1e-12)
    assert forms.variance[0, 1] == pytest.approx(forms.variance[1, 0], rel=1e-6)


def test_forms_are_height_and_dome():
    rng = np.random.default_rng(2)
    xyz = np.column_stack([rng.uniform(-300, 300, (200, 2)), np.zeros(200)])
    points, positions = _weights(xyz, np.ones(200, bool), 5)
    square = ((xyz[:, :2] - xyz[:, :2].mean(axis=0)) ** 2).sum(axis=1)
    ground = 7.0 + 0.01 * xyz[:, 0] - 3.0 * square / square.max()
    assert points[2, :, 2] @ ground == pytest.approx(3.0)
    assert points[0, :, 2] @ ground == pytest.approx(ground.mean())
    assert points[1, :, 2] @ ground + positions[1, :, 2].sum() * 100 == pytest.approx(100 - ground.mean())


def test_a_block_that_does_not_look_down_has_no_ground():
    result = adjusted("cross")
    assert set(ground_correlations(result, covariance(result))) == {"one"}
    turned = np.asarray(result.unknowns.exterior.camera_from_object)[:, [0, 2, 1]]
    exterior = dataclasses.replace(result.unknowns.exterior, camera_from_object=turned)
    wall = dataclasses.replace(result, unknowns=dataclasses.replace(result.unknowns, exterior=exterior))
    assert ground_correlations(wall, covariance(result)) == {}


@pytest.mark.slow
def test_correlations_are_those_of_many_adjustments():
    block, truth = simulated("cross")
    result = adjust(block, truth)
    (g,) = ground_correlations(result, covariance(result)).values()
    draws = monte_carlo(result, noise(result.block), 1500, exterior=True, points=True)
    rays = np.bincount(result.structure.point, minlength=len(block.points))
    points, positions = _weights(np.asarray(result.unknowns.points), rays >= 3, len(block.images))
    forms = np.einsum("fpa,dpa->df", points, draws.points)
    forms += np.einsum("fia,dia->df", positions, draws.exterior[..., :3])
    columns = [draws.labels.index(f"interior[one].{p}") for p in g.parameters]
    shared = draws.shared[:, columns]
    sample = np.corrcoef(np.hstack([forms, shared]).T)
    z = np.arctanh(sample[:3, 3:]) - np.arctanh(np.clip(g.rho, -0.9999, 0.9999))
    assert np.abs(z).max() * np.sqrt(len(shared)) < 4.5
    np.testing.assert_allclose(forms.std(axis=0) * float(result.sigma0), g.sigma_m, rtol=0.1)
    dome = FORMS.index("dome")
    fit = np.linalg.lstsq(shared - shared.mean(axis=0), forms[:, dome] - forms[:, dome].mean(), rcond=None)
    explained = 1 - fit[1][0] / np.sum((forms[:, dome] - forms[:, dome].mean()) ** 2)
    assert np.sqrt(explained) == pytest.approx(g.together[dome], abs=0.05)
