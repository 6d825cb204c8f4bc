"""A thousand intersections of two to eight rays: errors as the covariance says, exact ones exact, weak ones told."""

import numpy as np
from scipy.stats import kstest

from jaxphoto.initial.intersection import intersect_with_covariance
from tests.initial.image_pairs import normalised, rays_of
from tests.initial.random_scenes import intersections

SIGMA_RAD = 1e-4


def found_in(scene, sigma_rad):
    return intersect_with_covariance(*scene[:5], len(scene.truth), sigma_rad)


def test_errors_are_those_that_the_covariance_says():
    scene = intersections(1000, 1, SIGMA_RAD)
    found = found_in(scene, SIGMA_RAD)
    assert found.determined.mean() > 0.99
    who = np.flatnonzero(found.determined)
    squares = np.array([normalised(found.points[k] - scene.truth[k], found.covariance[k]) for k in who])
    assert kstest(squares, "chi2", (3,)).pvalue > 1e-3
    assert abs(np.mean(squares) - 3) < 4 * np.sqrt(6 / len(squares))
    rays = np.bincount(scene.point)[who]
    for n in range(2, 9):
        assert kstest(squares[rays == n], "chi2", (3,)).pvalue > 1e-3


def test_weak_intersections_are_right_or_told():
    scene = intersections(1000, 2, 40 * SIGMA_RAD)
    found = found_in(scene, 40 * SIGMA_RAD)
    assert 0.05 < np.mean(~found.determined) < 0.5
    assert np.isnan(found.points[~found.determined]).all()
    who = np.flatnonzero(found.determined)
    squares = np.array([normalised(found.points[k] - scene.truth[k], found.covariance[k]) for k in who])
    assert np.mean(squares) < 4
    assert np.mean(squares > 30) < 0.01


def test_exact_rays_meet_in_the_exact_point():
    scene = intersections(1000, 3, 0.0)
    found = found_in(scene, 1e-6)
    assert found.determined.all()
    np.testing.assert_allclose(found.points, scene.truth, rtol=0, atol=1e-9)


def test_map_coordinates_cost_no_more_than_their_rounding():
    scene = intersections(1000, 4, 0.0, origin=np.array([5e5, 6e6, 100.0]))
    found = found_in(scene, 1e-6)
    # A coordinate of 6e6 m is rounded to 1e-9 m, and a base of a hundredth magnifies that a hundred times in depth.
    error = np.linalg.norm(found.points - scene.truth, axis=1)
    assert np.max(error) < 1e-6
    assert np.median(error) < 1e-8


def test_images_from_one_place_and_far_points_determine_nothing():
    rng = np.random.default_rng(0)
    xy = np.repeat(rng.uniform(-0.5, 0.5, (200, 2)), 2, axis=0) + SIGMA_RAD * rng.normal(size=(400, 2))
    image, point, matrices = np.tile([0, 1], 200), np.repeat(np.arange(200), 2), np.tile(np.eye(3), (2, 1, 1))
    for base in (0.0, 1e-3, 1.0):
        positions = np.array([[0.0, 0, 0], [base, 0, 0]])
        found = intersect_with_covariance(positions, matrices, image, rays_of(xy), point, 200, SIGMA_RAD)
        assert not found.determined.any()
        assert np.isnan(found.points).all()


def test_a_ray_that_is_no_number_spoils_its_point_only():
    scene = intersections(20, 5, 0.0)
    rays = scene.rays.copy()
    rays[0] = np.nan
    found = found_in(scene._replace(rays=rays), 1e-6)
    assert not found.determined[0]
    assert found.determined[1:].all()
    np.testing.assert_allclose(found.points[1:], scene.truth[1:], rtol=0, atol=1e-9)
