"""The two steps of one more image and the triplet to begin with, against the truth and scipy."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from jaxphoto.initial import average_rotation, best_triplet, intersect_directions, intersect_with_covariance
from jaxphoto.initial.quaternions import rotated
from jaxphoto.rotation import small_rotation
from tests.formulas import random_rotations, turns
from tests.initial.image_pairs import normalised, rays_of


class Pair(NamedTuple):
    first: int
    second: int
    second_from_first: np.ndarray
    base: np.ndarray
    n: int
    angle: float = 0.2


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


POSITIONS = np.array([[0.0, 0, 0], [4, 1, 0], [1, 5, 1], [-2, 2, 3]])
TARGET = np.array([2.0, 2.0, 9.0])


def directions(sigma=0.0, rng=None):
    lines = TARGET - POSITIONS
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    if sigma:
        lines += sigma * rng.normal(size=lines.shape)
    return lines / np.linalg.norm(lines, axis=1, keepdims=True)


def test_lines_meet_in_the_point_and_with_its_covariance():
    np.testing.assert_allclose(intersect_directions(POSITIONS, directions()).position, TARGET, atol=1e-9)
    rng, sigma = np.random.default_rng(1), 1e-3
    squares = []
    for _ in range(1000):
        found = intersect_directions(POSITIONS, directions(sigma, rng), np.full(4, sigma**-2))
        squares.append(normalised(found.position - TARGET, found.covariance))
    assert kstest(squares, "chi2", (3,)).pvalue > 1e-3
    assert abs(np.mean(squares) - 3) < 4 * np.sqrt(6 / 1000)


def test_collinear_centres_and_points_behind_have_no_intersection():
    line = np.outer([0.0, 1, 2], [1.0, 0, 0])
    assert intersect_directions(line, np.tile([1.0, 0, 0], (3, 1))) is None
    assert intersect_directions(POSITIONS[:1], directions()[:1]) is None
    assert intersect_directions(POSITIONS, -directions()) is None


def pair(i, j, positions, matrices, n, turn=0.0):
    base = matrices[i] @ (positions[j] - positions[i])
    relative = turns([[turn, 0, 0]])[0] @ matrices[j] @ matrices[i].T
    return Pair(i, j, relative, base / np.linalg.norm(base), n)


def test_the_triplet_with_the_most_points_that_closes():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0.01, 0], [1, 1, 0]])
    matrices = random_rotations(np.random.default_rng(3), 4)
    make = lambda i, j, n, turn=0.0: pair(i, j, positions, matrices, n, turn)  # noqa: E731
    pairs = [make(0, 1, 900), make(1, 2, 900), make(0, 2, 900), make(0, 3, 100), make(3, 1, 100)]
    # 0, 1, 2 have the most points, but lie on a line; 0, 1, 3 do not.
    assert best_triplet(pairs) == (0, 1, 3)
    assert best_triplet(pairs[:3]) == (0, 1, 2)
    # A pair turned by 5 degrees does not close.
    assert best_triplet([*pairs[:4], make(1, 3, 100, 0.09)]) == (0, 1, 2)
    assert best_triplet(pairs[:2]) is None


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
