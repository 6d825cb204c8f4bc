"""PPA and PPS: both forms of a decentred lens, and what going from one to the other drops."""

import jax
import numpy as np
import pytest

from jaxphoto.camera import (
    Brown,
    InteriorOrientation,
    PpsRadial,
    Sensor,
    Smac,
    conversion_error,
    decentring_from_symmetry,
    principal_points,
    symmetry_from_decentring,
)
from tests.derivatives import check_derivatives, compiled

SENSOR = Sensor(4500, 3000, 0.008)
K1, K2, K3 = -9e-5, 1e-7, -5e-11
T = np.array([0.12, -0.08])
GRID = np.stack(np.meshgrid(np.linspace(-18, 18, 25), np.linspace(-12, 12, 25)), axis=-1).reshape(-1, 2)


def pps_camera(t=T, k1=K1, k2=K2, k3=K3, c=34.0):
    return InteriorOrientation(c, 0.065, 0.274, PpsRadial(k1=k1, k2=k2, k3=k3, pps_x=t[0], pps_y=t[1]))


@compiled
def ideal(interior, xy):
    return jax.vmap(interior.ideal_from_measured)(xy)


to_brown = compiled(decentring_from_symmetry)
to_pps = compiled(symmetry_from_decentring)
error = compiled(lambda before, after: conversion_error(before, after, SENSOR))
error_of_refit = compiled(lambda before, after: conversion_error(before, after, SENSOR, refit=True))


def loss(camera):
    return float(error(camera, to_brown(camera)).largest_mm)


def test_pps_radial_written_out():
    got = ideal(pps_camera(), GRID)
    x = GRID - [0.065, 0.274]
    from_pps = x - T
    r2 = np.sum(from_pps**2, axis=1, keepdims=True)
    np.testing.assert_allclose(got, x - from_pps * (K1 * r2 + K2 * r2**2 + K3 * r2**3), rtol=0, atol=1e-13)


def test_distortion_is_symmetric_about_the_pps_and_not_about_the_ppa():
    # Two image points opposite each other about the PPS; the distortions are opposite there.
    camera = pps_camera()
    points = compiled(principal_points)(camera)
    np.testing.assert_allclose(points.autocollimation, [0.065, 0.274], rtol=1e-15)
    np.testing.assert_allclose(points.symmetry, [0.185, 0.194], rtol=1e-14)
    for centre, symmetric in ((points.symmetry, True), (points.autocollimation, False)):
        pair = centre + np.array([[9.0, -5.0], [-9.0, 5.0]])
        distortion = pair - points.autocollimation - ideal(camera, pair)
        assert bool(np.abs(distortion.sum(axis=0)).max() < 1e-14) is symmetric


def test_conversion_is_decentring_and_goes_back():
    camera = pps_camera()
    brown = to_brown(camera)
    assert (brown.c, brown.xp, brown.yp) == (34.0, 0.065, 0.274)
    d = brown.distortion
    np.testing.assert_allclose([d.k1, d.k2, d.k3], [K1, K2, K3], rtol=1e-15)
    np.testing.assert_allclose([d.p1, d.p2], -K1 * T, rtol=1e-14)
    np.testing.assert_allclose(compiled(principal_points)(brown).symmetry, [0.185, 0.194], rtol=1e-14)
    back = to_pps(brown)
    assert type(back.distortion) is PpsRadial
    for a, b in zip(jax.tree.leaves(camera), jax.tree.leaves(back), strict=True):
        assert b == pytest.approx(a, rel=1e-14)


def test_with_k1_alone_the_conversion_is_right_to_first_order():
    losses = [loss(pps_camera(t=T / n, k2=0.0, k3=0.0)) for n in (1, 2, 4)]
    np.testing.assert_allclose(losses[0] / np.array(losses[1:]), [4, 16], rtol=0.02)
    # Far smaller than what is converted: without decentring, or with the other sign of it.
    brown = to_brown(pps_camera(k2=0.0, k3=0.0)).distortion
    for sign in (0, -1):
        other = Brown(k1=brown.k1, p1=sign * brown.p1, p2=sign * brown.p2)
        wrong = error(pps_camera(k2=0.0, k3=0.0), InteriorOrientation(34.0, 0.065, 0.274, other))
        assert wrong.largest_mm > 50 * losses[0]


def test_what_k2_drops_is_first_order_and_not_of_decentring_form():
    t = T / 100
    camera = pps_camera(t=t, k1=0.0, k3=0.0)
    x = GRID - [0.065, 0.274]
    r2 = np.sum(x**2, axis=1, keepdims=True)
    dropped = K2 * r2 * (t * r2 + 4 * x * (x @ t)[:, None])
    got = ideal(camera, GRID) - ideal(to_brown(camera), GRID)
    np.testing.assert_allclose(got, dropped, rtol=0, atol=0.01 * np.abs(dropped).max())
    losses = [loss(pps_camera(t=T / n)) for n in (1, 2, 4)]
    np.testing.assert_allclose(losses[0] / np.array(losses[1:]), [2, 4], rtol=0.02)
    # Whatever the decentring coefficients: the best pair leaves a part of it.
    decentring = np.stack(
        [np.stack([r2[:, 0] + 2 * x[:, 0] ** 2, 2 * x[:, 0] * x[:, 1]], axis=1).ravel(),
         np.stack([2 * x[:, 0] * x[:, 1], r2[:, 0] + 2 * x[:, 1] ** 2], axis=1).ravel()], axis=1,
    )  # fmt: skip
    left = dropped.ravel() - decentring @ np.linalg.lstsq(decentring, dropped.ravel(), rcond=None)[0]
    assert np.linalg.norm(left) > 0.15 * np.linalg.norm(dropped)


def test_conversion_error_is_the_displacement_over_the_format():
    camera = pps_camera()
    brown = to_brown(camera)
    moved = np.linalg.norm(ideal(camera, GRID) - ideal(brown, GRID), axis=1)
    got = error(camera, brown)
    assert float(got.largest_mm) == pytest.approx(moved.max(), rel=1e-9)
    assert float(got.rms_mm) == pytest.approx(np.sqrt(np.mean(moved**2)), rel=1e-9)
    assert got.rms_mm > 1e-3, "an error that nobody would see tests nothing"
    assert jax.tree.leaves(got.interior) == jax.tree.leaves(brown)


def test_a_refit_takes_up_a_part_and_says_what_is_left():
    camera = pps_camera()
    as_converted = error(camera, to_brown(camera))
    best = error_of_refit(camera, to_brown(camera))
    assert 1e-6 < best.rms_mm < 0.2 * as_converted.rms_mm
    again = error_of_refit(camera, best.interior)
    assert float(again.rms_mm) == pytest.approx(float(best.rms_mm), rel=1e-6), "the first re-fit was not the best"
    # Nothing is left where the other form can say it all.
    same = error_of_refit(camera, pps_camera(t=np.zeros(2)))
    assert same.largest_mm < 1e-10
    np.testing.assert_allclose([same.interior.distortion.pps_x, same.interior.distortion.pps_y], T, rtol=1e-6)


def test_a_shift_of_the_ppa_at_a_fixed_pps_is_a_rotation_to_first_order():
    d = np.array([0.004, -0.003])
    before = pps_camera()
    after = InteriorOrientation(34.0, 0.065 + d[0], 0.274 + d[1], pps_camera(T - d).distortion)
    np.testing.assert_allclose(compiled(principal_points)(after).symmetry, [0.185, 0.194], rtol=1e-13)
    # The lens is the same: the ideal coordinates are shifted as a whole, and nothing else.
    a, b = ideal(before, GRID), ideal(after, GRID)
    np.testing.assert_allclose(b, a - d, rtol=0, atol=1e-13)
    # The rotation by d / c about the axis across d, of all rays: right but for x (x.d) / c^2.
    c, size = 34.0, np.linalg.norm(d)
    u, angle = d / size, np.arctan(size / 34.0)
    along, across = a @ u, a @ [-u[1], u[0]]
    depth = np.cos(angle) * c + np.sin(angle) * along
    turned = c * np.outer((np.cos(angle) * along - np.sin(angle) * c) / depth, u)
    turned += c * np.outer(across / depth, [-u[1], u[0]])
    second = a * (a @ d)[:, None] / c**2
    np.testing.assert_allclose(turned, b - second, rtol=0, atol=3 * size**2 / c)
    # First order therefore means first order in the field angle: in the corner of this wide lens a quarter is left.
    near = np.linalg.norm(a, axis=1) < 3.5
    assert np.abs(turned - b)[near].max() < 0.015 * size
    assert np.abs(turned - b).max() > 0.2 * size


def test_other_distortions_are_refused():
    with pytest.raises(ValueError, match="needs PpsRadial; this camera has Brown"):
        decentring_from_symmetry(InteriorOrientation(34.0))
    for function in (symmetry_from_decentring, principal_points):
        with pytest.raises(ValueError, match="needs Brown; this camera has Smac"):
            function(InteriorOrientation(34.0, distortion=Smac()))


def test_what_has_no_symmetry_point_is_refused():
    centred = to_pps(InteriorOrientation(34.0, 0.1, 0.2, Brown(k2=1e-7)))
    assert (centred.distortion.pps_x, centred.distortion.pps_y) == (0, 0)
    for camera in (Brown(p1=1e-5), Brown(k2=1e-7, p2=1e-5)):
        with pytest.raises(Exception, match="without K1 has no principal point of symmetry"):
            jax.block_until_ready(to_pps(InteriorOrientation(34.0, distortion=camera)))
    for camera in (Brown(k1=1e-4, b1=1e-4), Brown(k1=1e-4, b2=1e-4)):
        with pytest.raises(Exception, match="no affinity and shear"):
            jax.block_until_ready(to_pps(InteriorOrientation(34.0, distortion=camera)))


def there_and_back(t, k1):
    brown = decentring_from_symmetry(pps_camera(t, 1e-4 * k1)).distortion
    symmetric = symmetry_from_decentring(InteriorOrientation(34.0, distortion=Brown(k1=1e-4 * k1, p1=1e-5, p2=2e-5)))
    return 1e5 * brown.p1, 1e5 * brown.p2, symmetric.distortion.pps_x, symmetric.distortion.pps_y


def test_derivatives_of_the_conversions():
    check_derivatives(there_and_back, np.array([[0.3, -0.2], [0.0, 0.0]]), np.array([0.9, -1.1]))
