import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.camera import Balanced, Brown, BundlerRadial, InteriorOrientation, Smac, rebalance
from jaxphoto.collinearity import (
    ExteriorOrientation,
    camera_coordinates,
    image_ray,
    image_residual,
    intersect,
    intersection_angle,
    project,
    project_ideal,
)
from jaxphoto.rotation import matrix_from_omega_phi_kappa, small_rotation
from tests.camera.models import AICON, FLICKR, KODAK
from tests.derivatives import check_derivatives, compiled
from tests.formulas import camera_from_object, collinearity

bounded = settings(max_examples=50, deadline=None, derandomize=True, database=None)
POSITION = np.array([1000.0, -2000.0, 1500.0])
BROWN = InteriorOrientation(34.253, 0.065, 0.274, KODAK)
BALANCED = InteriorOrientation(28.785, 0.017, 0.057, AICON)
GOPRO = InteriorOrientation(2.6989, -0.0736, 0.0878, Smac(k1=-3.9445e-2, k2=-1.1881e-3, k3=-1.3126e-4, p1=1e-4))
BUNDLER = InteriorOrientation(30.0, 0.03, -0.02, FLICKR)

ideal_of = compiled(project_ideal)
project_ = compiled(project)
image_ray_ = compiled(image_ray)
image_residual_ = compiled(image_residual)
intersect_ = compiled(intersect)


def exterior_of(angles, position=POSITION):
    return ExteriorOrientation(np.asarray(position, float), camera_from_object(*angles))


def seen_point(exterior, xy, c, depth=1000.0):
    """The object point whose ideal image is xy, `depth` in front of the camera."""
    return exterior.position + exterior.camera_from_object.T @ (np.array([xy[0] / c, xy[1] / c, -1.0]) * depth)


@bounded
@given(*[st.floats(-3, 3)] * 3, st.floats(-18, 18), st.floats(-12, 12))
def test_projection_equals_the_equations_written_out(omega, phi, kappa, x, y):
    angles = (omega, phi, kappa)
    exterior = exterior_of(angles)
    point = seen_point(exterior, (x, y), 34.0)
    np.testing.assert_allclose(collinearity(34.0, angles, POSITION, point), [x, y], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ideal_of(InteriorOrientation(34.0), exterior, point), [x, y], rtol=0, atol=1e-9)


def test_axes_of_a_vertical_photograph():
    # No rotation: x is east, y north, the camera looks down; scale c / H.
    plain, exterior = InteriorOrientation(35.0), exterior_of((0, 0, 0), (0, 0, 1000.0))
    np.testing.assert_allclose(ideal_of(plain, exterior, [100.0, 0, 0]), [3.5, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(ideal_of(plain, exterior, [0, 100.0, 0]), [0, 3.5], rtol=0, atol=1e-15)
    assert compiled(camera_coordinates)(exterior, [0, 0, 0])[2] == -1000.0


def test_exterior_orientation_from_angles_and_back():
    angles = np.array([[0.1, -0.2, 2.0], [-1.0, 0.5, -3.0]])
    exterior = compiled(ExteriorOrientation.from_angles)(np.zeros((2, 3)), angles)
    for matrix, one in zip(exterior.camera_from_object, angles, strict=True):
        np.testing.assert_allclose(matrix, camera_from_object(*one), rtol=0, atol=1e-15)
    np.testing.assert_allclose(compiled(lambda e: e.omega_phi_kappa)(exterior), angles, rtol=0, atol=1e-14)


@pytest.mark.parametrize("interior", [BROWN, BALANCED, BUNDLER])
def test_the_ray_of_a_projection_meets_the_point(interior):
    exterior = exterior_of((0.3, -0.8, 2.0))
    point = seen_point(exterior, (9.0, -5.0), interior.c)
    origin, direction = image_ray_(interior, exterior, project_(interior, exterior, point))
    np.testing.assert_array_equal(origin, POSITION)
    assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-15)
    depth = (point - origin) @ direction
    assert depth > 0, "the ray leaves through the back of the camera"
    np.testing.assert_allclose(origin + depth * direction, point, rtol=0, atol=1e-9)


@pytest.mark.parametrize("interior", [BROWN, BALANCED, BUNDLER])
def test_residual_is_observed_minus_computed(interior):
    exterior = exterior_of((0.3, -0.8, 2.0))
    point = seen_point(exterior, (14.0, -9.0), interior.c)
    xy = project_(interior, exterior, point)
    np.testing.assert_allclose(image_residual_(interior, exterior, point, xy), [0, 0], rtol=0, atol=1e-12)
    error = np.array([0.004, -0.002])
    residual = image_residual_(interior, exterior, point, xy + error)
    np.testing.assert_allclose(residual, error, rtol=1e-4 if interior is BROWN else 1e-9)
    # In the corrected image it differs by the slope of the distortion, about 3 % here.
    corrected = image_residual_(dataclasses.replace(interior, residuals="model"), exterior, point, xy + error)
    if interior is not BROWN:
        np.testing.assert_array_equal(corrected, residual)
    else:
        slope = compiled(jax.jacfwd(interior.ideal_from_measured))(xy)
        np.testing.assert_allclose(corrected, slope @ error, rtol=1e-4)
        assert np.abs(corrected / error - 1).max() > 0.01


@pytest.mark.parametrize("r0_mm", [0.0, 3.0])
def test_a_residual_of_the_measured_image_is_free_of_the_balance_radius(r0_mm):
    """In the model's image, which is stretched to the double in the corner, it is neither the error nor the same."""
    exterior = exterior_of((0.1, -0.05, 0.3))
    point = seen_point(exterior, (2.9, 1.8), GOPRO.c)
    error = np.array([3e-6, -5e-6])
    xy = project_(GOPRO, exterior, point) + error
    own = rebalance(GOPRO, r0_mm)
    in_model = image_residual_(dataclasses.replace(own, residuals="model"), exterior, point, xy)
    assert np.abs(in_model / error - 1).max() > 0.1
    found = image_residual_(own, exterior, point, xy)
    # Beyond the first order: the bend of the lens over the error.
    np.testing.assert_allclose(found, error, rtol=0, atol=1e-5 * np.abs(error).max())
    np.testing.assert_allclose(found, image_residual_(GOPRO, exterior, point, xy), rtol=0, atol=1e-14)


def test_residual_of_bundle_adjustment_in_the_large():
    # P = R X + t; p = -P / P.z; p' = f r(p) p: the residual is p' - measured there, with y up and -z forwards as here.
    f, k1, k2, t = 30.0, -0.17, 0.16, np.array([0.3, -1.2, -9.0])
    rotation = camera_from_object(0.3, -0.8, 2.0)
    point, measured = np.array([1.0, 2.0, -0.5]), np.array([3.0, -4.0])
    seen = rotation @ point + t
    p = -seen[:2] / seen[2]
    theirs = f * (1 + k1 * (p @ p) + k2 * (p @ p) ** 2) * p - measured
    interior = InteriorOrientation(f, distortion=BundlerRadial(k1=k1, k2=k2))
    ours = image_residual_(interior, ExteriorOrientation(-rotation.T @ t, rotation), point, measured)
    np.testing.assert_allclose(ours, -theirs, rtol=0, atol=1e-13)


def rays_to(point, origins):
    offsets = np.asarray(point, float) - origins
    return offsets / np.linalg.norm(offsets, axis=1, keepdims=True)


ORIGINS = np.add([[0, 0, 1000.0], [500, 0, 1010], [0, 600, 990], [480, 610, 1005]], [6e5, 7e6, 0])


def test_intersection_recovers_a_point_far_from_the_origin_of_the_frame():
    point = np.array([6e5 + 210.0, 7e6 + 340.0, 35.0])
    np.testing.assert_allclose(intersect_(ORIGINS, rays_to(point, ORIGINS)), point, rtol=0, atol=1e-6)


def test_rays_of_weight_zero_do_not_count_and_weights_pull():
    point = np.array([6e5 + 210.0, 7e6 + 340.0, 35.0])
    directions = rays_to(point, ORIGINS)
    directions[3] = rays_to(np.add(point, [30.0, 0, 0]), ORIGINS)[3]
    good = intersect_(ORIGINS, directions, np.array([1.0, 2.0, 0.5, 0.0]))
    np.testing.assert_allclose(good, point, rtol=0, atol=1e-6)
    light, heavy = (intersect_(ORIGINS, directions, np.array([1.0, 1, 1, w]))[0] - point[0] for w in (0.1, 10))
    assert 0.1 < light < heavy < 30


def test_intersection_is_nearest_to_skew_rays():
    # Two rays 2 m apart at their nearest: the point lies in the middle of the common perpendicular.
    origins = np.array([[0.0, 0, 1], [0, 0, -1]])
    got = intersect_(origins, np.array([[1.0, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(got, [0, 0, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(compiled(intersection_angle)(np.array([[1.0, 0, 0], [0, 1, 0]])), np.pi / 2)


# Derivatives: by interior orientation, position, small rotation, angles, point and image ------------------------


def brown(n):
    distortion = Brown(k1=1e-4 * n[3], k2=1e-7 * n[4], p1=1e-5 * n[5], b2=1e-3 * n[6])
    return InteriorOrientation(30 + n[0], n[1], n[2], distortion)


def balanced(n):
    distortion = Balanced(a1=1e-4 * n[3], a2=1e-7 * n[4], b1=1e-5 * n[5], c2=1e-3 * n[6], r0=8.0)
    return InteriorOrientation(30 + n[0], n[1], n[2], distortion)


def bundler(n):
    return InteriorOrientation(30 + n[0], n[1], n[2], BundlerRadial(k1=0.2 * n[3], k2=0.2 * n[4]))


def models_of(camera):
    """Projection, ray and residual with one camera: one compile for the three."""

    def models(numbers, position, theta, angles, point, xy):
        interior = camera(numbers)
        exterior = ExteriorOrientation(position, small_rotation(theta) @ matrix_from_omega_phi_kappa(angles))
        return (
            project(interior, exterior, point) / 10,
            image_ray(interior, exterior, 10 * xy),
            image_residual(interior, exterior, point, 10 * xy) / 10,
        )

    return models


def cases():
    """Random images, then: nadir, phi = 90 deg, oblique; the point on the optical axis in the last four."""
    rng = np.random.default_rng(12)
    angles = np.concatenate([rng.uniform(-3, 3, (6, 3)), [[0, 0, 0], [0, 0, 0], [0.2, np.pi / 2, 1], [0.8, -0.7, 2]]])
    image = np.concatenate([rng.uniform(-1, 1, (6, 2)), [[0.5, 0.3]], np.zeros((3, 2))])
    numbers = rng.uniform(-1, 1, (10, 7))
    numbers[6:, 1:3] = 0  # the principal point at the origin, so that image (0, 0) is r = 0
    position = rng.normal(size=(10, 3))
    in_camera = np.column_stack([image / 3, -np.ones(10)]) * rng.uniform(5, 8, (10, 1))
    point = position + np.stack([camera_from_object(*a).T @ v for a, v in zip(angles, in_camera, strict=True)])
    theta = np.zeros((10, 3))
    theta[:3] = 0.05 * rng.normal(size=(3, 3))
    return numbers, position, theta, angles, point, image


@pytest.mark.parametrize("camera", [brown, balanced, bundler])
def test_derivatives_of_projection_ray_and_residual(camera):
    check_derivatives(models_of(camera), *cases())


def test_derivatives_of_intersection():
    rng = np.random.default_rng(13)
    origins = rng.normal(size=(5, 4, 3)) * 2
    directions = rng.normal(size=(5, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    weights = rng.uniform(0.5, 1.5, (5, 4))
    weights[0, 2:] = 0  # two rays only
    check_derivatives(intersect, origins, directions, weights)
