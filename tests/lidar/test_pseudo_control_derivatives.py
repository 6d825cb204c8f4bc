"""Pseudo control points have derivatives by camera, orientation and image coordinates."""

import jax
import numpy as np
import pytest

from jaxphoto import ExteriorOrientation, InteriorOrientation
from jaxphoto.camera import Brown
from jaxphoto.lidar.height_estimate import HeightFlag, HeightSettings
from jaxphoto.lidar.pseudo_control import pseudo_control_points
from tests.lidar.test_pseudo_control import anywhere, image, indexed, measured, scanned, slope
from tests.marks import slow_but


@pytest.mark.parametrize("interpolation", slow_but(("plane",), ("weighted", "plane")))
def test_derivatives_are_those_of_differences(interpolation):
    rng = np.random.default_rng(3)
    grid = indexed(scanned(slope(20, 100), 2, rng))
    exterior = image(20)
    xy = measured(exterior, np.column_stack([anywhere(rng, 40, 2), np.full(40, 100.0)]))
    # A laser point that the image shows in the very place of the feature.
    xy[0] = measured(exterior, np.asarray(grid.xyz)[700:701])[0]
    settings = HeightSettings(refuse=HeightFlag.OK)
    # c, x_p, y_p, k1, position, angles; and a shift of all features.
    theta = np.array([34.0, 0.06, 0.27, -9e-5, *np.asarray(exterior.position), 0.01, -0.02, 0.3, 0, 0])
    # So small that hardly any neighbour changes: where one does, the feature is off by orders of magnitude.
    step = np.array([1e-6, 1e-6, 1e-6, 1e-9, 1e-4, 1e-4, 1e-4, 1e-8, 1e-8, 1e-8, 1e-6, 1e-6])

    def points(theta):
        interior = InteriorOrientation(theta[0], theta[1], theta[2], Brown(k1=theta[3]))
        taken = ExteriorOrientation.from_angles(theta[4:7], theta[7:10])
        return pseudo_control_points(interior, taken, xy + theta[10:], grid, settings, interpolation=interpolation).xyz

    differences = np.stack([(points(theta + d) - points(theta - d)) / (2 * d.sum()) for d in np.diag(step)], axis=-1)
    exact = np.asarray(jax.jit(jax.jacfwd(points))(theta))
    wrong = np.abs(exact - differences).max(axis=1) > 1e-4 * np.abs(differences).max(axis=(0, 1))
    assert wrong.any(axis=1).sum() <= 1
    assert np.abs(differences[:, 2]).max(axis=0).min() > 0
    if interpolation == "weighted":
        backward = jax.jit(jax.grad(lambda theta: points(theta)[:, 2].mean()))(theta)
        np.testing.assert_allclose(backward, exact[:, 2].mean(axis=0), rtol=1e-9, atol=1e-12)
