import numpy as np

from jaxphoto.collinearity import intersect
from jaxphoto.initial.intersection import intersect_points
from tests.derivatives import compiled


def rays(points, origins):
    offsets = points - origins
    return offsets / np.linalg.norm(offsets, axis=1, keepdims=True)


ORIGINS = np.add([[0, 0, 1000.0], [500, 0, 1010], [0, 600, 990]], [6e5, 7e6, 0])
POINTS = np.add([[210.0, 340, 35], [10, 20, 70]], [6e5, 7e6, 0])


def test_all_points_at_once_equal_each_by_itself():
    rng = np.random.default_rng(0)
    image, point = np.array([0, 0, 1, 1, 2]), np.array([0, 1, 0, 1, 0])
    directions = rays(POINTS[point], ORIGINS[image]) + 1e-4 * rng.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    got, determined = intersect_points(ORIGINS[image], directions, point, 2)
    assert determined.all()
    one_by_one = compiled(intersect)
    for k in range(2):
        rows = point == k
        np.testing.assert_allclose(got[k], one_by_one(ORIGINS[image][rows], directions[rows]), rtol=0, atol=1e-5)
        assert 1e-3 < np.linalg.norm(got[k] - POINTS[k]) < 1


def test_one_ray_no_ray_and_parallel_rays_determine_nothing():
    far = np.array([6e5 + 100, 7e6, -3e6])
    origins = ORIGINS[[0, 0, 1]]
    directions = rays(np.array([POINTS[0], far, far]), origins)
    got, determined = intersect_points(origins, directions, np.array([0, 1, 1]), 3)
    np.testing.assert_array_equal(determined, [False, False, False])
    assert np.isnan(got).all()


def test_the_smallest_angle_is_the_angle_between_two_rays():
    angle = np.deg2rad(0.5)
    origins = np.array([[0.0, 0, 0], [1, 0, 0]])
    directions = np.array([[0, 0, -1.0], [-np.sin(angle), 0, -np.cos(angle)]])
    for factor, expected in ((0.99, True), (1.01, False)):
        _, determined = intersect_points(origins, directions, np.zeros(2, int), 1, min_angle=factor * angle)
        assert determined[0] == expected


def test_one_ray_and_a_height_determine_a_point():
    direction = rays(POINTS[:1], ORIGINS[:1])
    height = (np.array([0]), np.array([2]), POINTS[:1, 2])
    got, determined = intersect_points(ORIGINS[:1], direction, np.array([0]), 1, height)
    assert determined.all()
    np.testing.assert_allclose(got, POINTS[:1], rtol=0, atol=1e-6)
