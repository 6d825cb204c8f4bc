"""Visibility compared with formulas, for every pair of image and point."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.camera import Balanced, Brown, InteriorOrientation, RadialPolynomial, Sensor, Smac
from jaxphoto.collinearity import ExteriorOrientation, project, project_ideal
from jaxphoto.simulation import Rays, photograph
from jaxphoto.simulation.points import thin_rays
from tests.formulas import camera_from_object, collinearity

SENSOR = Sensor(4500, 3000, 0.008)
INTERIOR = InteriorOrientation(34.25, 0.064, 0.273, Brown(k1=-9.12e-5, k2=1.0435e-7))
bounded = settings(max_examples=50, deadline=None, derandomize=True, database=None)


def exterior_of(angles, positions) -> ExteriorOrientation:
    return ExteriorOrientation(np.array(positions, float), np.array([camera_from_object(*a) for a in angles]))


def ideal_of(xy):
    """Brown's formula once more."""
    x, y = (np.asarray(xy) - [0.064, 0.273]).T
    r2 = x * x + y * y
    return np.column_stack([x, y]) * (1 - (-9.12e-5 * r2 + 1.0435e-7 * r2 * r2))[:, None]


def test_coordinates_are_right_and_no_point_is_missed():
    rng = np.random.default_rng(4)
    angles, positions = rng.normal(0, 0.1, (6, 3)), rng.normal([0, 0, 1000], 300, (6, 3))
    points = rng.uniform([-1500, -1500, 0], [1500, 1500, 50], (5000, 3))
    camera = dict.fromkeys(("one", "two"), INTERIOR)
    names = ("one", "two", "one", "one", "two", "two")
    rays = photograph(camera, dict.fromkeys(camera, SENSOR), names, exterior_of(angles, positions), points, 0.5)
    assert (np.diff(rays.point * 6 + rays.image) > 0).all()
    seen = np.zeros((6, 5000), bool)
    seen[rays.image, rays.point] = True
    # A point must be seen where it lies inside the border of the format, brought to ideal coordinates.
    for k in range(6):
        expected = np.array([collinearity(34.25, angles[k], positions[k], p) for p in points])
        mine = rays.image == k
        np.testing.assert_allclose(ideal_of(rays.xy[mine]), expected[rays.point[mine]], rtol=0, atol=1e-9)
        assert (np.abs(rays.xy[mine]) < [17.5, 11.5]).all()
        border = ideal_of(_frame(17.5, 11.5))
        np.testing.assert_array_equal(seen[k], _inside(expected, border))


@pytest.mark.parametrize("name", ["balanced", "smac", "radial"])
def test_every_model_is_imaged_as_project_does(name):
    interior = {
        "balanced": InteriorOrientation(35.4, 0.02, 0.03, Balanced(a1=8e-5, a2=-5e-8, b1=1e-5, c1=1e-4, r0=10.0)),
        "smac": InteriorOrientation(34.8, -0.04, 0.06, Smac(k1=-8e-5, k2=9e-8, p1=1e-5, r0=9.0)),
        "radial": InteriorOrientation(34.8, 1.0, -1.0, RadialPolynomial(k1=3e-4)),
    }[name]
    rng = np.random.default_rng(5)
    exterior = exterior_of(rng.normal(0, 0.1, (2, 3)), rng.normal([0, 0, 1000], 50, (2, 3)))
    points = rng.uniform([-900, -700, 0], [900, 700, 50], (700, 3))
    rays = photograph({"c": interior}, {"c": SENSOR}, ("c", "c"), exterior, points)
    each = jax.jit(jax.vmap(jax.vmap(_imaged, in_axes=(None, None, 0)), in_axes=(None, 0, None)))
    xy, valid = map(np.asarray, each(interior, exterior, points))
    seen = valid & (np.abs(xy) < [18, 12]).all(axis=2)
    pairs = np.argwhere(seen.T)
    assert 300 < len(pairs) < 1300
    np.testing.assert_array_equal(np.column_stack([rays.point, rays.image]), pairs)
    np.testing.assert_allclose(rays.xy, xy[pairs[:, 1], pairs[:, 0]], rtol=0, atol=1e-11)


def _imaged(interior, exterior, point):
    return project(interior, exterior, point), interior.valid(project_ideal(interior, exterior, point))


def _frame(x: float, y: float) -> np.ndarray:
    t = np.linspace(-1, 1, 4001)
    sides = ((x * t, -y + 0 * t), (x + 0 * t, y * t), (x * t, y + 0 * t), (-x + 0 * t, y * t))
    return np.vstack([np.column_stack(side) for side in sides])


def _inside(xy: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Whether places lie inside a closed line that is star-shaped around the origin."""
    angle, radius = np.arctan2(*border.T[::-1]), np.hypot(*border.T)
    order = np.argsort(angle)
    return np.hypot(*xy.T) < np.interp(np.arctan2(*xy.T[::-1]), angle[order], radius[order], period=2 * np.pi)


def test_nothing_behind_the_camera_or_beyond_the_fold_is_seen():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2000.0], [1e-9, 0.0, 1000.0], [300.0, 0.0, 0.0], [580.0, 0.0, 0.0]])
    exterior = exterior_of([[0, 0, 0]], [[0, 0, 1000]])
    # With k1 = +2e-3 the map folds at r = 1 / sqrt(3 k1) = 12.9 mm, where the ideal radius is 8.6 mm.
    folding = InteriorOrientation(34.25, 0.0, 0.0, Brown(k1=2e-3))
    rays = photograph({"c": folding}, {"c": SENSOR}, ("c",), exterior, points)
    assert rays.point.tolist() == [0]
    # This one folds at 9.2 mm and unfolds beyond 14.2 mm: a point of ideal 5.9 mm has an image at 17 mm, a false one.
    unfolding = InteriorOrientation(34.25, 0.0, 0.0, Brown(k1=5.56e-3, k2=-1.157e-5))
    beyond = np.array([[5.9 / 34.25 * 1000, 0.0, 0.0], [100.0, 0.0, 0.0]])
    rays = photograph({"c": unfolding}, {"c": SENSOR}, ("c",), exterior, beyond)
    assert rays.point.tolist() == [1]
    straight = InteriorOrientation(34.25)
    rays = photograph({"c": straight}, {"c": SENSOR}, ("c",), exterior, points)
    assert rays.point.tolist() == [0, 3]
    np.testing.assert_allclose(rays.xy, [[0, 0], [0.3 * 34.25, 0]], atol=1e-12)


@bounded
@given(st.integers(0, 2**32), st.floats(2, 6), st.integers(1, 3))
def test_thinning_leaves_the_mean_asked_for(seed, mean, least):
    rng = np.random.default_rng(seed)
    pairs = np.argwhere(rng.random((40, 12)) < 0.4)
    rays = Rays(pairs[:, 1], pairs[:, 0], np.zeros((len(pairs), 2)))
    before = rays.per_point(40)
    after = thin_rays(rays, 40, least, mean, rng).per_point(40)
    assert (after <= before).all()
    assert (after >= np.minimum(before, least)).all()
    bound = max(round(mean * 40), int(np.minimum(before, least).sum()))
    assert after.sum() == min(before.sum(), bound)
