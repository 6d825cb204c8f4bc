"""Refraction and curvature against the textbook's radial displacements, and against rays for tilted images."""

import numpy as np
import pytest

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project_ideal
from jaxphoto.georeferencing import Corrections, apparent_point, refraction_constant
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from tests.derivatives import check_derivatives, compiled

C, R = 35.0, 6_371_000.0
REFRACTION, CURVATURE = Corrections(refraction=True, sea_level_m=-40.0), Corrections(curvature=True)
GRID = [(east, north) for east in (-480.0, -3.0, 0.0, 250.0) for north in (-310.0, 0.0, 640.0)]
POSITION = np.array([120.0, -75.0, 1180.0])
TILTED = np.array([0.35, -0.2, 2.1])


def textbook_constant(camera_m, point_m):
    """Manual of Photogrammetry: K = (2410 H / (H^2 - 6 H + 250) - 2410 h / (h^2 - 6 h + 250) h / H) 1e-6, km."""
    high, low = camera_m / 1e3, point_m / 1e3
    first = 2410 * high / (high**2 - 6 * high + 250)
    second = 2410 * low / (low**2 - 6 * low + 250) * (low / high)
    return (first - second) * 1e-6


def imaged(corrections, angles):
    """The image (mm) of a point `east, north, up` from the projection centre, with and without `corrections`."""

    @compiled
    def both(offset):
        exterior = ExteriorOrientation(POSITION, matrix_from_omega_phi_kappa(angles))
        point = POSITION + offset
        aim, plain = apparent_point(POSITION, point, corrections), InteriorOrientation(C)
        return project_ideal(plain, exterior, aim), project_ideal(plain, exterior, point)

    return both


def inputs(height):
    return [np.array([east, north, -height]) for east, north in GRID]


@pytest.mark.parametrize("height", [700.0, 1150.0])
def test_refraction_of_vertical_images_is_the_textbooks(height):
    image = imaged(REFRACTION, np.zeros(3))
    k = textbook_constant(1180.0 + 40.0, 1180.0 - height + 40.0)
    for offset in inputs(height):
        got, straight = image(offset)
        square = straight @ straight
        np.testing.assert_allclose(got - straight, straight * k * (1 + square / C**2), rtol=0, atol=1e-10)
    assert abs(got - straight).max() > 1e-5


@pytest.mark.parametrize("height", [700.0, 1150.0])
def test_curvature_of_vertical_images_is_the_textbooks(height):
    image = imaged(CURVATURE, np.zeros(3))
    for offset in inputs(height):
        got, straight = image(offset)
        square = straight @ straight
        inward = height * square / (2 * R * C**2)
        np.testing.assert_allclose(got, straight / (1 + inward), rtol=0, atol=1e-10)
        # The textbook's dr = H r^3 / (2 R c^2) is that to first order.
        np.testing.assert_allclose(got - straight, -straight * inward, rtol=0, atol=1e-10 + np.sqrt(square) * inward**2)
    assert abs(got - straight).max() > 1e-5


def test_both_add_up():
    both = imaged(Corrections(True, True, -40.0), np.zeros(3))
    alone = [imaged(corrections, np.zeros(3)) for corrections in (REFRACTION, CURVATURE)]
    for offset in inputs(900.0):
        got, straight = both(offset)
        parts = sum(image(offset)[0] - straight for image in alone)
        np.testing.assert_allclose(got - straight, parts, rtol=0, atol=1e-7)


def test_refraction_of_tilted_images_is_that_of_the_ray():
    """The direction to the point, turned away from the nadir by K tan(angle off the nadir)."""
    image = imaged(REFRACTION, TILTED)
    k = textbook_constant(1220.0, 1220.0 - 900.0)
    rotation = np.asarray(compiled(matrix_from_omega_phi_kappa)(TILTED))
    for offset in inputs(900.0):
        got, straight = image(offset)
        level = np.hypot(*offset[:2])
        off_nadir = np.arctan2(level, -offset[2])
        turned = off_nadir + k * np.tan(off_nadir)
        away = offset[:2] / level if level else np.zeros(2)
        u, v, w = rotation @ np.array([*away * np.sin(turned), -np.cos(turned)])
        np.testing.assert_allclose(got, [-C * u / w, -C * v / w], rtol=0, atol=2e-8)
    assert abs(got - straight).max() > 1e-4


def test_curvature_of_tilted_images_is_that_of_a_point_below_the_tangent_plane():
    image = imaged(CURVATURE, TILTED)
    rotation = np.asarray(compiled(matrix_from_omega_phi_kappa)(TILTED))
    for offset in inputs(900.0):
        fall = R - np.sqrt(R**2 - offset[0] ** 2 - offset[1] ** 2)
        u, v, w = rotation @ (offset - [0, 0, fall])
        np.testing.assert_allclose(image(offset)[0], [-C * u / w, -C * v / w], rtol=0, atol=1e-9)


@pytest.mark.parametrize("height", [1000.0, 3000.0, 6000.0, 9000.0])
def test_the_constant_is_that_of_an_atmosphere(height):
    """K is the mean of n over the way, less n at the camera; low down the textbook's fit is a quarter too small."""
    z = np.linspace(0, height, 2001)
    n = 273e-6 * (1 - 0.0065 * z / 288.15) ** 4.256
    expected = np.mean(n) - n[-1]
    np.testing.assert_allclose(compiled(refraction_constant)(height, 0.0), expected, rtol=0.25)


def test_nothing_is_done_where_nothing_is_on():
    point = np.array([1.0, 2.0, 3.0])
    assert apparent_point(POSITION, point, Corrections(sea_level_m=7.0)) is point


def test_derivatives_of_corrections():
    rng = np.random.default_rng(2)
    both = Corrections(True, True, -40.0)

    # In kilometres, and the effects themselves, a hundred thousand times.
    def effect(position, point):
        return 1e2 * (apparent_point(1e3 * position, 1e3 * point, both) - 1e3 * point)

    position = rng.uniform([-1, -1, 1], [1, 1, 3], (6, 3))
    point = rng.uniform([-1, -1, 0], [1, 1, 0.3], (6, 3))
    point[0, :2] = position[0, :2]  # straight below
    check_derivatives(effect, position, point)
