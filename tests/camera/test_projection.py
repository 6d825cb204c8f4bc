"""Projections: their formulas, beyond 90 degrees too, their inverses and derivatives, and OpenCV's fisheye camera."""

import cv2
import jax
import numpy as np
import pytest

from jaxphoto.camera import (
    PROJECTIONS,
    Brown,
    Equidistant,
    InteriorOrientation,
    OpenCvFisheye,
    Orthographic,
    Perspective,
    Sensor,
)
from jaxphoto.camera.conversion import converted
from jaxphoto.collinearity import (
    ExteriorOrientation,
    image_ray,
    image_residual,
    in_field,
    project,
    project_ideal,
)
from jaxphoto.errors import InputError
from tests.derivatives import check_derivatives, compiled

C = 1.7
# The distance from the principal point over c, of the angle from the axis.
FORMULAS = {
    "perspective": np.tan,
    "equidistant": lambda theta: theta,
    "equisolid": lambda theta: 2 * np.sin(theta / 2),
    "stereographic": lambda theta: 2 * np.tan(theta / 2),
    "orthographic": np.sin,
}
RNG = np.random.default_rng(17)


def directions(theta, azimuth, length=1.0):
    """Directions (n, 3) in the camera's frame at the angle `theta` from its axis, which is -w."""
    theta, azimuth = np.broadcast_arrays(np.asarray(theta, float), azimuth)
    across = np.sin(theta)[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    return length * np.concatenate([across, -np.cos(theta)[..., None]], -1)


def angles_of(projection, degrees):
    return np.deg2rad([d for d in degrees if d < projection.widest_deg])


@compiled
def forth_and_back(interior, uvw):
    def one(uvw):
        xy = interior.ideal_from_direction(*uvw)
        return xy, jax.numpy.stack(interior.direction_from_ideal(xy)), interior.projection.sees(*uvw)

    return jax.vmap(one)(uvw)


def test_every_projection_has_a_formula_here():
    assert set(FORMULAS) == set(PROJECTIONS)


@pytest.mark.parametrize("name", PROJECTIONS)
def test_images_of_directions_on_both_sides_of_the_image_plane(name):
    projection = PROJECTIONS[name]()
    theta = angles_of(projection, [0.0, 1e-7, 0.1, 5.7, 5.8, 30, 80, 89.9, 90, 100, 120, 150, 170])
    azimuth = RNG.uniform(-np.pi, np.pi, len(theta))
    uvw = directions(theta, azimuth, 37.0)
    xy, back, seen = forth_and_back(InteriorOrientation(C, projection=projection), uvw)
    wanted = C * FORMULAS[name](theta)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    np.testing.assert_allclose(xy, wanted, rtol=1e-12, atol=1e-15)
    assert seen.all()
    if name == "orthographic":
        # sin is flat at 90 degrees: half of the digits of the angle are lost there.
        uvw, back = uvw[theta < 1.5], back[theta < 1.5]
    unit = back / np.linalg.norm(back, axis=1, keepdims=True)
    np.testing.assert_allclose(unit, uvw / 37.0, rtol=0, atol=1e-12 if name != "stereographic" else 1e-11)


@pytest.mark.parametrize("name", PROJECTIONS)
def test_what_has_no_image_is_said_so(name):
    projection = PROJECTIONS[name]()
    interior = InteriorOrientation(C, projection=projection)
    assert not forth_and_back(interior, np.array([[0.0, 0.0, 1.0]]))[2].any()
    assert forth_and_back(interior, directions(np.deg2rad([projection.widest_deg - 0.1]), 0.3))[2].all()
    if projection.widest_deg < 180:
        assert not forth_and_back(interior, directions(np.deg2rad([projection.widest_deg + 0.1]), 0.3))[2].any()
    # Beyond the edge of the image nothing has a direction.
    edge = {"equidistant": np.pi * C, "equisolid": 2 * C, "orthographic": C}.get(name)
    if edge is not None:
        to = compiled(lambda camera, xy: jax.numpy.stack(camera.direction_from_ideal(xy)))
        assert np.isfinite(to(interior, [0.0, 0.999 * edge])).all()
        assert np.isnan(to(interior, [0.0, 1.001 * edge])).any()


@pytest.mark.parametrize("name", PROJECTIONS)
def test_first_and_second_derivatives(name):
    # At random directions, on the axis, near it on both sides of where a series ends, at 90 degrees and beyond.
    projection = PROJECTIONS[name]()
    theta = angles_of(projection, [0.0, 1e-9, 1e-3, 5.6, 5.71, 5.72, 5.8, 20, 45, 70, 90.0, 91, 110, 135, 150])
    uvw = directions(theta, RNG.uniform(-np.pi, np.pi, len(theta)), 3.0)

    def image(c, uvw):
        return jax.numpy.stack(projection.ideal_from_direction(c, *uvw))

    def ray(c, xy):
        return jax.numpy.stack(projection.direction_from_ideal(c, *xy))

    c = np.full(len(theta), C)
    # Relative to the largest number of a case, which at 85 degrees of a perspective plane is large.
    check_derivatives(image, c, uvw)
    check_derivatives(jax.jacfwd(image, (0, 1)), c, uvw, rtol=1e-5)
    xy = np.stack([np.asarray(v) for v in projection.ideal_from_direction(C, *uvw.T)], -1)
    if name == "orthographic":
        c, xy = c[theta < 1.5], xy[theta < 1.5]
    check_derivatives(ray, c, xy)
    if name != "perspective":  # whose rays are straight
        check_derivatives(jax.jacfwd(ray, (0, 1)), c, xy, rtol=1e-5)


def test_the_perspective_plane_is_what_it_always_was():
    # To the last bit: x = u (-c / w).
    uvw = RNG.normal(size=(50, 3)) - [0, 0, 9]
    x, y = Perspective().ideal_from_direction(C, *uvw.T)
    scale = -C / uvw[:, 2]
    np.testing.assert_array_equal(np.stack([x, y]), np.stack([uvw[:, 0] * scale, uvw[:, 1] * scale]))
    ray = Perspective().direction_from_ideal(C, 0.3, -0.2)
    assert ray == (0.3, -0.2, -C)


# OpenCV's and COLMAP's fisheye -----------------------------------------------------------------------------

KB = {"k1": -0.012, "k2": 0.003, "k3": -0.0011, "k4": 0.00012}
EXTERIOR = ExteriorOrientation.from_angles(np.array([1.0, -2.0, 0.5]), np.array([0.3, -0.4, 1.1]))


def fisheye(c=C, **more):
    return InteriorOrientation(c, 0.013, -0.021, OpenCvFisheye(**(KB | more)), projection=Equidistant())


def placed(uvw):
    """Points (m) in the object frame of directions in the camera's."""
    return np.asarray(EXTERIOR.position) + uvw @ np.asarray(EXTERIOR.camera_from_object)


project_ = compiled(lambda camera, points: jax.vmap(lambda p: project(camera, EXTERIOR, p))(points))
ray_ = compiled(lambda camera, xy: jax.vmap(lambda one: image_ray(camera, EXTERIOR, one))(xy))
in_field_ = compiled(lambda camera, points: jax.vmap(lambda p: in_field(camera, EXTERIOR, p))(points))


def test_images_are_those_of_opencv():
    sensor = Sensor(2000, 1600, 0.002)
    theta, azimuth = RNG.uniform(0, np.deg2rad(88), 200), RNG.uniform(-np.pi, np.pi, 200)
    uvw = directions(theta, azimuth, RNG.uniform(1, 9, 200)[:, None])
    fx, fy, cx, cy, alpha = 861.0, 850.0, 1003.2, 788.4, 0.004
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    down = uvw * [1, -1, -1]
    wanted = cv2.fisheye.projectPoints(
        down[:, None], np.zeros(3), np.zeros(3), k, np.array(list(KB.values())), None, alpha
    )
    x_p, y_p = sensor.mm_from_px(np.array([[cx + 0.5, cy + 0.5]]))[0]
    distortion = OpenCvFisheye(**KB, b1=fx / fy - 1, b2=alpha * fx / fy)
    camera = InteriorOrientation(fy * sensor.pixel_mm, x_p, y_p, distortion, projection=Equidistant())
    found = sensor.px_from_mm(project_(camera, placed(uvw))) - 0.5
    np.testing.assert_allclose(found, wanted[0][:, 0], rtol=0, atol=1e-9)


def test_images_beyond_ninety_degrees_are_those_of_the_formula():
    # cv2.fisheye divides by the depth and ends there; the formula of Kannala and Brandt does not.
    theta, azimuth = np.deg2rad([90.0, 95, 105, 118, 130]), np.array([0.1, 2.0, -2.5, -0.7, 1.0])
    camera, uvw = fisheye(), directions(theta, azimuth, 5.0)
    r = C * theta * (1 + sum(k * theta ** (2 * i) for i, k in enumerate(KB.values(), start=1)))
    wanted = r[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1) + [0.013, -0.021]
    found = project_(camera, placed(uvw))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
    origin, direction = ray_(camera, found)
    np.testing.assert_allclose(direction, (placed(uvw) - origin) / 5.0, rtol=0, atol=1e-11)
    assert in_field_(camera, placed(uvw)).all()


def test_a_thin_prism_is_that_of_colmap_written_out():
    p1, p2, s1, s2 = 0.002, -0.001, 0.0015, -0.0007
    theta, azimuth = np.deg2rad([20.0, 60, 100]), np.array([0.4, 2.0, -1.5])
    # COLMAP: x right, y down, z forwards; u, v are theta along the azimuth.
    u, v = theta * np.cos(azimuth), -theta * np.sin(azimuth)
    r2 = u * u + v * v
    radial = sum(k * r2**i for i, k in enumerate(KB.values(), start=1))
    x = u + u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2
    y = v + v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + s2 * r2
    found = project_(fisheye(p1=p1, p2=p2, s1=s1, s2=s2), placed(directions(theta, azimuth)))
    np.testing.assert_allclose(found, np.stack([C * x + 0.013, -C * y - 0.021], -1), rtol=0, atol=1e-13)


def test_a_polynomial_that_turns_back_is_out_of_the_field():
    camera = fisheye(k1=-0.1, k2=0.0, k3=0.0, k4=0.0)  # 1 - 0.3 theta^2 = 0 at 104.6 degrees
    seen = in_field_(camera, placed(directions(np.deg2rad([100.0, 104, 106, 120]), 0.5)))
    assert seen.tolist() == [True, True, False, False]
    plane = InteriorOrientation(C, distortion=Brown())
    assert in_field_(plane, placed(directions(np.deg2rad([0.0, 89, 91, 170]), 0.5))).tolist() == [
        True,
        True,
        False,
        False,
    ]


def test_derivatives_of_a_fisheye_image_and_its_residual():
    # By c, coefficients and the point, at random places, on the axis and beyond 90 degrees.
    theta = np.deg2rad([0.0, 0.01, 5.7, 40, 88, 90, 92, 115, 150])
    points = placed(directions(theta, RNG.uniform(-np.pi, np.pi, len(theta)), 2.0))
    numbers = np.tile([C, 0.013, -0.021, *KB.values()], (len(theta), 1)) * RNG.uniform(0.9, 1.1, (len(theta), 7))

    def residual(numbers, point, xy):
        camera = InteriorOrientation(*numbers[:3], OpenCvFisheye(*numbers[3:]), projection=Equidistant())
        return image_residual(camera, EXTERIOR, point, xy), project_ideal(camera, EXTERIOR, point)

    check_derivatives(residual, numbers, points, RNG.uniform(-1, 1, (len(theta), 2)))


# Conversions -----------------------------------------------------------------------------------------------

WIDE = Sensor(1800, 1800, 0.0025)


@pytest.mark.parametrize("name", ["equisolid", "stereographic"])
def test_other_fisheyes_convert_to_the_polynomial_of_opencv(name):
    # The corners of the format are farther than 84 degrees from the axis, those of the equisolid one 130.
    camera = InteriorOrientation(C, 0.01, -0.02, Brown(k1=1e-4), projection=PROJECTIONS[name]())
    ray = ray_(camera, np.array([[2.2, 2.2]]))[1][0] @ np.asarray(EXTERIOR.camera_from_object).T
    assert np.rad2deg(np.arccos(-ray[2])) > 84
    done = converted(camera, OpenCvFisheye, WIDE, ("b2",), Equidistant())
    assert isinstance(done.interior.projection, Equidistant)
    assert 0 < done.max_px < 0.01
    grid = np.stack(np.meshgrid(*[np.linspace(-2.2, 2.2, 7)] * 2), -1).reshape(-1, 2)
    points = np.asarray(EXTERIOR.position) + ray_(camera, grid)[1]
    assert np.abs(project_(done.interior, points) - grid).max() < 0.01 * WIDE.pixel_mm


def test_what_a_plane_cannot_show_is_not_converted_to_it():
    with pytest.raises(ValueError, match="the projection perspective does not cover all directions in the format"):
        converted(fisheye(), OpenCvFisheye, WIDE, (), Perspective())


def test_a_conversion_within_one_projection_keeps_it():
    camera = InteriorOrientation(C, 0.01, -0.02, Brown(k1=1e-4), projection=PROJECTIONS["equisolid"]())
    done = converted(camera, OpenCvFisheye, WIDE)
    assert type(done.interior.projection).name == "equisolid"
    assert done.max_px < 0.1


def test_a_coefficient_of_projection_and_distortion_is_refused():
    class Bent(Orthographic):
        k1: float = 0.0
        name = "bent"
        coefficients = ("k1",)
        powers = {"k1": 0}  # noqa: RUF012

    with pytest.raises(InputError, match="k1 is a coefficient of both the projection bent and the distortion brown"):
        InteriorOrientation(C, projection=Bent())
