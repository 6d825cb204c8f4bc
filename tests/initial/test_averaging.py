"""The two steps of one more image and the triplet to begin with, against the truth and scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from jaxphoto.initial.intersection import intersect_with_covariance
from jaxphoto.initial.quaternions import average_rotation, rotated
from jaxphoto.rotation import small_rotation
from tests.formulas import random_rotations, turns
from tests.initial.image_pairs import normalised, rays_of


def test_average_of_rotations():
    rng = np.random.default_rng(0)
    middle = random_rotations(rng, 1)[0]
    weights = rng.uniform(1, 5, 7)
    rotations = turns(0.3 * rng.normal(size=(7, 3))) @ middle
    average, spread = average_rotation(rotations, weights)
    np.testing.assert_allclose(average, Rotation.from_matrix(rotations).mean(weights).as_matrix(), rtol=0, atol=1e-12)
    angles = (Rotation.from_matrix(rotations) * Rotation.from_matrix(average).inv()).magnitude()
    assert spread == pytest.approx(np.sqrt(np.sum(weights * angles**2) / weights.sum()), rel=1e-9)
    assert average_rotation(rotations[:1])[1] < 1e-12


def test_small_turns_are_those_of_the_adjustment():
    for theta in ([0.0, 0, 0], [1e-9, 0, 2e-9], [0.3, -0.2, 0.9]):
        np.testing.assert_allclose(rotated(np.eye(3), np.array(theta)), small_rotation(np.array(theta)), atol=1e-14)


def test_intersected_points_have_the_errors_that_their_covariance_says():
    rng, sigma, n = np.random.default_rng(5), 2e-4, 1000
    positions = np.array([[0.0, 0, 100], [60, 0, 105], [20, 50, 95]])
    matrices = turns(0.1 * rng.normal(size=(3, 3)))
    points = rng.uniform(-30, 30, (n, 3)) * [1, 1, 0.3] + [20, 20, 0]
    image, point = np.repeat(np.arange(3), n), np.tile(np.arange(n), 3)
    in_camera = np.einsum("nij,nj->ni", matrices[image], points[point] - positions[image])
    xy = in_camera[:, :2] / -in_camera[:, 2:]
    exact = intersect_with_covariance(positions, matrices, image, rays_of(xy), point, n, sigma)
    np.testing.assert_allclose(exact.points, points, rtol=0, atol=1e-9)
    noisy = rays_of(xy + sigma * rng.normal(size=xy.shape))
    found = intersect_with_covariance(positions, matrices, image, noisy, point, n, sigma)
    assert found.determined.all()
    squares = [normalised(e, q) for e, q in zip(found.points - points, found.covariance, strict=True)]
    assert kstest(squares, "chi2", (3,)).pvalue > 1e-3
    assert abs(np.mean(squares) - 3) < 4 * np.sqrt(6 / n)


def test_parallel_rays_and_points_behind_are_not_determined():
    positions, matrices = np.array([[0.0, 0, 0], [1, 0, 0]]), np.tile(np.eye(3), (2, 1, 1))
    rays = rays_of(np.array([[0.0, 0], [0, 0], [0.1, 0], [-0.1, 0], [-0.1, 0], [0.1, 0]]))
    image, point = np.array([0, 1, 0, 1, 0, 1]), np.array([0, 0, 1, 1, 2, 2])
    found = intersect_with_covariance(positions, matrices, image, rays, point, 3, 1e-4)
    np.testing.assert_array_equal(found.determined, [False, True, False])
    np.testing.assert_allclose(found.points[1], [0.5, 0, -5], atol=1e-9)
    assert np.isnan(found.points[[0, 2]]).all()
    assert np.isnan(found.covariance[[0, 2]]).all()
