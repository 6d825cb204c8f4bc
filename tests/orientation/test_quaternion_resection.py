"""Resection by quaternions against the truth: exact, within its covariance, and where it is open."""

import numpy as np
import pytest
from scipy.stats import kstest

from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.orientation import resect, resect_by_quaternions
from tests.formulas import random_rotations, turns
from tests.orientation.image_pairs import normalised, rotation_error
from tests.orientation.scene import K1, C, measured

CAMERA = InteriorOrientation(C)
SIGMA = 0.005


def images(position, matrix, points):
    x, y, z = matrix @ (points - position).T
    return np.column_stack([-C * x / z, -C * y / z])


def case(seed, n=10, flat=False, tilt=0.9, any_attitude=False, sigma=0.0):
    """A camera some 8 m from a figure of 4 m, inclined by up to `tilt` (rad) against its normal."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n, 3)) * [2, 2, 0 if flat else 1.5]
    side = rng.uniform(0, 2 * np.pi)
    lean = tilt * np.sqrt(rng.uniform()) * np.array([np.cos(side), np.sin(side), 0])
    matrix = turns([[0, 0, rng.uniform(-3, 3)]])[0] @ turns(lean)[0]
    if any_attitude:
        matrix = random_rotations(rng, 1)[0]
    position = -matrix.T @ np.array([0.5 * rng.normal(), 0.5 * rng.normal(), -8.0])
    return position, matrix, points, images(position, matrix, points) + sigma * rng.normal(size=(n, 2))


KINDS = {
    "space": {},
    "any attitude": {"any_attitude": True, "n": 6},
    "flat, convergent": {"flat": True, "n": 12, "tilt": 1.1},
    "flat, near-vertical": {"flat": True, "n": 12, "tilt": 0.02},
    "four": {"n": 4},
    "flat four": {"flat": True, "n": 4},
}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_exact_images_give_the_exact_orientation(kind):
    for seed in range(25):
        position, matrix, points, xy = case(seed, **kind)
        found = resect_by_quaternions(CAMERA, xy, points, 1e-6)
        np.testing.assert_allclose(found.position, position, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.camera_from_object, matrix, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.residuals, 0, atol=1e-8)
        assert 1 <= found.iterations <= 50


@pytest.mark.parametrize("kind", list(KINDS)[:4])
def test_errors_are_those_that_the_covariance_says(kind):
    squares, variance_factors = [], []
    n = KINDS[kind].get("n", 10)
    for seed in range(100):
        position, matrix, points, xy = case(1000 + seed, **KINDS[kind], sigma=SIGMA)
        found = resect_by_quaternions(CAMERA, xy, points, SIGMA)
        error = np.concatenate([found.position - position, rotation_error(found.camera_from_object, matrix)])
        squares.append(normalised(error, found.covariance))
        variance_factors.append(found.sigma0**2)
        assert np.isclose(np.sum(found.residuals**2) / SIGMA**2, found.sigma0**2 * (2 * n - 6))
    assert kstest(squares, "chi2", (6,)).pvalue > 1e-3
    assert abs(np.mean(squares) - 6) < 4 * np.sqrt(12 / 100)
    assert abs(np.mean(variance_factors) - 1) < 4 * np.sqrt(2 / (100 * (2 * n - 6)))


def test_distortion_and_map_coordinates():
    position, matrix, points, xy = case(5, n=12)
    interior, origin = InteriorOrientation(C, 0.3, -0.2, Brown(k1=K1)), np.array([5e5, 6e6, 100.0])
    found = resect_by_quaternions(interior, np.add(measured(xy), [0.3, -0.2]), points + origin, SIGMA)
    np.testing.assert_allclose(found.position, position + origin, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.camera_from_object, matrix, rtol=0, atol=1e-7)


def test_it_agrees_with_the_resection_from_three_points():
    _, _, points, xy = case(3, n=15, sigma=SIGMA)
    found, robust = resect_by_quaternions(CAMERA, xy, points, SIGMA), resect(CAMERA, xy, points)
    np.testing.assert_allclose(found.position, robust.position, rtol=0, atol=0.02)


def test_few_points_and_points_on_a_line():
    _, _, points, xy = case(0, n=4)
    with pytest.raises(BlockError, match=r"image A sees 3 known points, and a resection needs 4"):
        resect_by_quaternions(CAMERA, xy[:3], points[:3], SIGMA, "A")
    line = np.linspace(-1, 1, 8)[:, None] * [1.0, 0.5, 0.2]
    with pytest.raises(BlockError, match=r"image A lie on a line"):
        resect_by_quaternions(CAMERA, images(np.array([0, 0, 8.0]), np.eye(3), line), line, SIGMA, "A")


def dangerous_curve(parameters):
    """Points of a twisted cubic through the projection centre: the motion (d, w) leaves all their images as they are.

    A point V in the camera frame moves by d + w x V, which must be along V: V = (s I - [w]x)^-1 d for any s.
    """
    d, w = np.array([1.0, 0.3, -0.5]), np.array([0.2, 0.6, 0.1])
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    return np.array([np.linalg.solve(s * np.eye(3) - cross, d) for s in parameters])


def test_points_on_a_dangerous_curve_through_the_projection_centre():
    points = dangerous_curve(np.linspace(0.15, 1.2, 8))
    assert np.all(points[:, 2] < 0)
    assert np.linalg.svd(points - points.mean(0))[1][2] > 0.05, "a plane"
    xy = images(np.zeros(3), np.eye(3), points)
    with pytest.raises(BlockError, match="dangerous cylinder or curve"):
        resect_by_quaternions(CAMERA, xy, points, SIGMA)
    # A few points off the curve are enough.
    points = np.concatenate([points, np.add(points[:4], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, -1]])])
    found = resect_by_quaternions(CAMERA, images(np.zeros(3), np.eye(3), points), points, 1e-4)
    np.testing.assert_allclose(found.position, 0, atol=1e-7)


def test_a_flat_figure_seen_from_afar_has_two_orientations():
    rng = np.random.default_rng(2)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.1
    matrix = turns([[0.3, 0.0, 0.0]])[0]
    position = -matrix.T @ np.array([0, 0, -8.0])
    xy = images(position, matrix, square) + SIGMA * rng.normal(size=(4, 2))
    with pytest.raises(
        BlockError, match=r"two orientations of image B, turned by \d+\.\d deg|leave its orientation open"
    ):
        resect_by_quaternions(CAMERA, xy, square, SIGMA, "B")


def test_wrong_points_fit_nowhere():
    _, _, points, xy = case(1, n=12)
    with pytest.raises(BlockError, match=r"no position and attitude of image \(unnamed\)"):
        resect_by_quaternions(CAMERA, xy[::-1] * 3, points, SIGMA)
