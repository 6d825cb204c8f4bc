"""Resection by quaternions against the truth: exact, within its covariance, and where it is open."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.quaternion_resection import resect_by_quaternions
from jaxphoto.initial.resection import resect
from tests.checked_types import unchecked
from tests.formulas import random_rotations, turns
from tests.initial.image_pairs import normalised, rotation_error
from tests.initial.scene import K1, C, measured

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


def test_it_says_how_it_came_to_its_end():
    _, _, points, xy = case(7, n=12, sigma=SIGMA)
    found = resect_by_quaternions(CAMERA, xy, points, SIGMA)
    assert 1 <= found.iterations <= 50
    assert found.converged == (found.iterations < 50)
    assert 1 <= found.steps <= 50
    assert found.sigma0**2 == pytest.approx(np.sum(found.residuals**2) / SIGMA**2 / (2 * 12 - 6))


@pytest.mark.slow
def test_four_points_in_space():
    # Two orientations may fit four points equally well; where only one does, its covariance is right.
    squares, refused = [], 0
    for seed in range(120):
        position, matrix, points, xy = case(1000 + seed, n=4, sigma=SIGMA)
        try:
            found = resect_by_quaternions(CAMERA, xy, points, SIGMA)
        except BlockError:
            refused += 1
            continue
        error = np.concatenate([found.position - position, rotation_error(found.camera_from_object, matrix)])
        squares.append(normalised(error, found.covariance))
    assert refused <= 2
    assert kstest(squares, "chi2", (6,)).pvalue > 1e-3


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.integers(0, 1000), st.floats(0.01, 100), st.tuples(*[st.floats(-3, 3)] * 3), st.floats(-1e3, 1e3))
def test_another_frame_of_the_object_is_the_same_resection(seed, scale, turn, shift):
    _, _, points, xy = case(seed, n=9, sigma=SIGMA)
    turned, origin = turns(np.array(turn))[0], scale * shift * np.array([1.0, -0.5, 0.3])
    found = resect_by_quaternions(CAMERA, xy, points, SIGMA)
    again = resect_by_quaternions(CAMERA, xy, origin + scale * points @ turned.T, SIGMA)
    np.testing.assert_allclose((again.position - origin) / scale, turned @ found.position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(again.camera_from_object, found.camera_from_object @ turned.T, rtol=0, atol=1e-8)
    to_other = np.block([[scale * turned, np.zeros((3, 3))], [np.zeros((3, 3)), np.eye(3)]])
    expected = to_other @ found.covariance @ to_other.T
    sigmas = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        again.covariance / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-5
    )


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
    for method in (lambda *a: resect_by_quaternions(*a, SIGMA), resect):
        with pytest.raises(BlockError, match="danger cylinder or critical curve"):
            method(CAMERA, xy, points)
    # A few points off the curve are enough.
    points = np.concatenate([points, np.add(points[:4], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, -1]])])
    found = resect_by_quaternions(CAMERA, images(np.zeros(3), np.eye(3), points), points, 1e-4)
    np.testing.assert_allclose(found.position, 0, atol=1e-7)


@pytest.mark.parametrize("sigma", [1e-7, 1e-5, SIGMA])
@pytest.mark.parametrize("off", [0.0, 1e-3, 1e-2])
def test_near_a_dangerous_curve_it_is_refused_or_right(off, sigma):
    # Another orientation as good lies near, beyond the surface; the nearer, the less is the normal matrix worth.
    refused = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points = dangerous_curve(np.sort(rng.uniform(0.15, 1.2, 8)))
        points = points + off * rng.normal(size=points.shape)
        xy = images(np.zeros(3), np.eye(3), points) + sigma * rng.normal(size=(8, 2))
        try:
            found = resect_by_quaternions(CAMERA, xy, points, sigma)
        except BlockError as reason:
            assert "danger cylinder or critical curve" in str(reason) or "equally well" in str(reason)
            refused += 1
            continue
        error = np.concatenate([found.position, rotation_error(found.camera_from_object, np.eye(3))])
        assert normalised(error, found.covariance) < 30
    assert refused == 8 if off == 0 or (off == 1e-3 and sigma == SIGMA) else refused <= 4


def test_four_points_on_a_cylinder_through_the_projection_centre_are_refused_or_right():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        around = rng.uniform(0, 2 * np.pi, 5)
        circle = np.column_stack([np.cos(around), np.sin(around), np.zeros(5)])
        position = circle[4] * (1 + rng.choice([0, 1e-3])) + [0, 0, 3]
        back = position / np.linalg.norm(position)
        right = np.cross([0, 1.0, 0], back) / np.linalg.norm(np.cross([0, 1.0, 0], back))
        matrix = np.stack([right, np.cross(back, right), back])
        xy = images(position, matrix, circle[:4]) + SIGMA * rng.normal(size=(4, 2))
        try:
            found = resect_by_quaternions(CAMERA, xy, circle[:4], SIGMA)
        except BlockError:
            continue
        error = np.concatenate([found.position - position, rotation_error(found.camera_from_object, matrix)])
        assert normalised(error, found.covariance) < 35


def test_points_in_a_plane_with_the_projection_centre():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (9, 1)) * [1.0, 0.4, 0] + rng.uniform(-1, 1, (9, 1)) * [0, 0, 1.0]
    xy = images(np.array([0, 0, 8.0]), np.eye(3), points)
    for method in (lambda *a: resect_by_quaternions(*a, SIGMA, "A"), lambda *a: resect(*a, "A")):
        with pytest.raises(BlockError, match="image A lie in one plane with its projection centre"):
            method(CAMERA, xy, points)


def test_input_that_is_no_resection():
    _, _, points, xy = case(0, n=6)
    spoilt = points.copy()
    spoilt[2, 1] = np.nan
    for method in (lambda *a: resect_by_quaternions(*a, SIGMA, "A"), lambda *a: resect(*a, "A")):
        with pytest.raises(BlockError, match="1 of the 6 known points of image A have a coordinate that is NaN"):
            method(CAMERA, xy, spoilt)
        with pytest.raises(ValueError, match="but points of shape"), unchecked():
            method(CAMERA, xy[:5], points)
    with pytest.raises(ValueError, match=r"sigma_mm, .* must be positive, got 0"):
        resect_by_quaternions(CAMERA, xy, points, 0.0)
    # A point that is measured twice is one point.
    with pytest.raises(BlockError, match="sees 3 known points"):
        resect_by_quaternions(CAMERA, xy[[0, 1, 2, 2]], points[[0, 1, 2, 2]], SIGMA)


def test_points_that_lie_behind_the_camera():
    # Their straight lines are the same, but no camera sees them so: at best another place with a large sigma0.
    for seed in range(10):
        position, _, points, xy = case(seed, n=10)
        behind = 2 * position - points
        try:
            found = resect_by_quaternions(CAMERA, xy, behind, SIGMA)
        except BlockError as reason:
            assert "undetermined" in str(reason) or "no orientation fits" in str(reason)
            continue
        assert np.all((behind - found.position) @ found.camera_from_object[2] < 0)
        assert found.sigma0 > 50


def test_a_flat_figure_seen_from_afar_has_two_orientations():
    rng = np.random.default_rng(2)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.1
    matrix = turns([[0.3, 0.0, 0.0]])[0]
    position = -matrix.T @ np.array([0, 0, -8.0])
    xy = images(position, matrix, square) + SIGMA * rng.normal(size=(4, 2))
    with pytest.raises(
        BlockError, match=r"two orientations of image B, \d+(\.\d+)? deg apart|leave its orientation undetermined"
    ):
        resect_by_quaternions(CAMERA, xy, square, SIGMA, "B")


def test_wrong_points_fit_nowhere():
    _, _, points, xy = case(1, n=12)
    with pytest.raises(BlockError, match=r"resection of image \(unnamed\) failed"):
        resect_by_quaternions(CAMERA, xy[::-1] * 3, points, SIGMA)
