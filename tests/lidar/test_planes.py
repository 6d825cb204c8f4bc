"""Planes of laser points: truth, covariance by simulation, rejection of blunders."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from jaxphoto.errors import InputError
from jaxphoto.lidar.planes import fit_plane, plane_distance, plane_feet

SIGMA_XY, SIGMA_Z = 0.5, 0.15
ORIGIN = np.array([4.1e5, 5.2e6, 310.0])
DRAWS = 400


def true_normal(slope_deg, heading_deg=53.0):
    up, east = np.deg2rad(slope_deg), np.deg2rad(heading_deg)
    return np.array([np.sin(up) * np.cos(east), np.sin(up) * np.sin(east), np.cos(up)])


def roof(rng, normal, n, half, blunders=0.0):
    """Points of a square roof that is scanned as a whole, some of them metres off, far from the origin."""
    xy = rng.uniform(-half, half, (n, 2))
    points = np.column_stack([xy, -(xy @ normal[:2]) / normal[2]])
    points += rng.normal(size=(n, 3)) * [SIGMA_XY, SIGMA_XY, SIGMA_Z]
    wrong = int(blunders * n)
    points[:wrong, 2] += rng.choice([-1, 1], wrong) * rng.uniform(2, 10, wrong)
    return points + ORIGIN


@pytest.mark.parametrize(("slope_deg", "half", "blunders"), [(0, 5, 0), (30, 5, 0), (30, 5, 0.3), (40, 3, 0.3)])
def test_covariance_is_that_of_many_draws(slope_deg, half, blunders):
    rng = np.random.default_rng(1)
    normal = true_normal(slope_deg)
    squares, sigma0, off = [], [], []
    place = np.array([2.0, 1.0, -(normal[0] * 2 + normal[1]) / normal[2]]) + ORIGIN
    for _ in range(DRAWS):
        plane = fit_plane(roof(rng, normal, 80, half, blunders), SIGMA_XY, SIGMA_Z)
        error = np.append(plane.normal - normal, normal @ (plane.centroid - ORIGIN))
        values, vectors = np.linalg.eigh(plane.covariance)
        # Of four numbers three are free: the normal keeps its length.
        assert values[0] < 1e-9 * values[1]
        squares.append(np.sum((vectors[:, 1:].T @ error) ** 2 / values[1:]))
        sigma0.append(plane.sigma0)
        distance, sigma = plane_distance(plane, place[None])
        off.append(distance[0] / sigma[0])
    # A variance from 50 residuals and more is itself off by some 20 %.
    assert 0.9 < np.mean(squares) / 3 < 1.2
    assert 0.03 < np.mean(np.array(squares) > chi2.ppf(0.95, 3)) < 0.09
    assert abs(np.mean(sigma0) - 1) < 0.03
    assert abs(np.mean(off)) < 4 / np.sqrt(DRAWS)
    assert kstest(off, "norm").pvalue > 1e-3


def test_regression_on_x_and_y_would_see_the_slope_too_small():
    rng = np.random.default_rng(2)
    normal = true_normal(30, 0)
    ours, theirs = [], []
    for _ in range(300):
        points = roof(rng, normal, 100, 3) - ORIGIN
        found = fit_plane(points, SIGMA_XY, SIGMA_Z).normal
        ours.append(-found[0] / found[2])
        theirs.append(np.linalg.lstsq(np.column_stack([points[:, :2], np.ones(100)]), points[:, 2])[0][0])
    true = -np.tan(np.pi / 6)
    sem = np.std(ours) / np.sqrt(300)
    assert abs(np.mean(ours) - true) < 4 * sem
    assert np.mean(theirs) - true > 10 * sem


def test_without_horizontal_errors_it_is_regression():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-5, 5, (50, 2))
    z = xy @ [0.3, -0.2] + 4 + 0.05 * rng.normal(size=50)
    plane = fit_plane(np.column_stack([xy, z]), 0.0, 0.05)
    assert plane.inliers.all()
    design = np.column_stack([xy, np.ones(50)])
    solution, square, *_ = np.linalg.lstsq(design, z)
    np.testing.assert_allclose(-plane.normal[:2] / plane.normal[2], solution[:2], rtol=0, atol=1e-6)
    # Variance of a height at the centroid: that of a mean.
    _, sigma = plane_distance(plane, plane.centroid[None])
    s0 = np.sqrt(square[0] / 47 / 0.9733)
    np.testing.assert_allclose(sigma[0] / plane.normal[2], s0 / np.sqrt(50), rtol=1e-4)


def test_blunders_are_told_apart_and_a_wall_is_a_plane_too():
    rng = np.random.default_rng(4)
    normal = true_normal(20)
    plane = fit_plane(roof(rng, normal, 200, 6, 0.3), SIGMA_XY, SIGMA_Z)
    assert not plane.inliers[:60].any()
    assert plane.inliers[60:].mean() > 0.98
    wall = np.column_stack([np.zeros(80), rng.uniform(-8, 8, 80), rng.uniform(0, 9, 80)])
    found = fit_plane(wall + rng.normal(size=(80, 3)) * [SIGMA_XY, SIGMA_XY, SIGMA_Z], SIGMA_XY, SIGMA_Z)
    assert abs(found.normal[0]) > 0.99


def test_feet_say_that_points_lie_on_the_plane():
    rng = np.random.default_rng(5)
    plane = fit_plane(roof(rng, true_normal(25), 100, 5), SIGMA_XY, SIGMA_Z)
    points = ORIGIN + rng.uniform(-4, 4, (6, 3))
    foot, normal, sigma = plane_feet(plane, points)
    np.testing.assert_allclose((foot - plane.centroid) @ plane.normal, 0, atol=1e-8)
    distance, _ = plane_distance(plane, points)
    np.testing.assert_allclose(np.sum((points - foot) * normal, axis=1), distance, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.cross(points - foot, normal), 0, atol=1e-8)
    assert (sigma > 0).all() and sigma.max() < 0.5


def test_what_determines_no_plane_is_told():
    rng = np.random.default_rng(6)
    with pytest.raises(InputError, match="needs 4 laser points, got 3"):
        fit_plane(np.eye(3), 0.5, 0.15)
    along = rng.uniform(-20, 20, 100)
    line = np.column_stack([along, 2 * along, 0 * along]) + rng.normal(size=(100, 3)) * [0.5, 0.5, 0.15]
    with pytest.raises(InputError, match="lie on a line"):
        fit_plane(line, 0.5, 0.15)
    with pytest.raises(InputError, match="lie on a line"):
        fit_plane(np.ones((5, 3)), 0.5, 0.15)
    with pytest.raises(InputError, match="must be positive in Z"):
        fit_plane(rng.normal(size=(10, 3)), 0.5, 0.0)
