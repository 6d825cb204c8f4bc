import itertools

import jax
import numpy as np
import pytest

from jaxphoto.camera import (
    DISTORTIONS,
    AffineBrown,
    Agisoft,
    Balanced,
    Brown,
    BrownAffine,
    BundlerRadial,
    Ebner,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    PpsRadial,
    RadialPolynomial,
    Sensor,
    Smac,
    StretchedBrown,
    exact,
    get_parameter,
    parameter_names,
    rebalance,
    with_sign,
)
from jaxphoto.camera.conversion import converted, fitted
from tests.derivatives import compiled

SENSOR = Sensor(4500, 3000, 0.008)
XY = np.stack(np.meshgrid(np.linspace(-18, 18, 7), np.linspace(-12, 12, 5)), -1).reshape(-1, 2)


@compiled
def _rays(interior, xy):
    return jax.vmap(interior.ideal_from_measured)(xy) / interior.c


def rays(interior, xy=XY):
    return np.asarray(_rays(jax.tree.map(lambda v: np.asarray(v, float), interior), xy))


def camera(distortion):
    return InteriorOrientation(35.0, 0.065, -0.274, distortion)


MEASURED = {"k1": -9e-5, "k2": 1e-7, "k3": -3e-11}
P = {"p1": 1e-5, "p2": -2e-5}
NORMALISED = {"k1": -0.11, "k2": 0.15}
# A camera of each model with all terms that others of its direction may have, and with only the usual ones.
FULL = {
    Brown: Brown(**MEASURED, **P, b1=1e-3, b2=-5e-4),
    AffineBrown: AffineBrown(**MEASURED, **P, b1=1e-3, b2=-5e-4),
    BrownAffine: BrownAffine(**MEASURED, **P, b1=1e-3, b2=-5e-4),
    StretchedBrown: StretchedBrown(**MEASURED, **P, b1=1e-3, b2=-5e-4),
    Smac: Smac(k0=0.01, **MEASURED, k4=1e-14, **P, p3=1e-3, p4=1e-6, r0=9.0, sign="add"),
    RadialPolynomial: RadialPolynomial(**MEASURED),
    PpsRadial: PpsRadial(**MEASURED, pps_x=0.1),
    Balanced: Balanced(a1=-1e-4, a2=1e-7, a3=-1e-11, b1=1e-5, b2=-1e-5, c1=1e-3, c2=-5e-4, r0=13.0),
    BundlerRadial: BundlerRadial(**NORMALISED),
    OpenCv: OpenCv(**NORMALISED, k3=0.01, k4=0.02, k5=0.03, k6=0.01, p1=1e-3, p2=-2e-3, b1=1e-3, b2=5e-4),
    Agisoft: Agisoft(**NORMALISED, k3=0.01, k4=0.02, p1=1e-3, p2=-2e-3, p3=0.1, p4=0.2, b1=1e-3, b2=5e-4),
    OpenCvFisheye: OpenCvFisheye(**NORMALISED, k3=0.01, k4=0.02, p1=1e-3, p2=-2e-3, s1=1e-3, s2=2e-3, b1=1e-3, b2=5e-4),
}
USUAL = {
    Brown: Brown(**MEASURED, **P),
    AffineBrown: AffineBrown(**MEASURED, **P),
    BrownAffine: BrownAffine(**MEASURED, **P),
    StretchedBrown: StretchedBrown(**MEASURED, **P),
    Smac: Smac(k0=0.01, **MEASURED, **P, r0=9.0, sign="add"),
    PpsRadial: PpsRadial(**MEASURED),
    Balanced: Balanced(a1=-1e-4, a2=1e-7, a3=-1e-11, b1=1e-5, b2=-1e-5, r0=13.0),
    OpenCv: OpenCv(**NORMALISED, k3=0.01, p1=1e-3, p2=-2e-3),
    Agisoft: Agisoft(**NORMALISED, k3=0.01, p1=1e-3, p2=-2e-3),
    OpenCvFisheye: OpenCvFisheye(**NORMALISED, k3=0.01, p1=1e-3, p2=-2e-3),
}
# Which others of its direction hold it exactly.
_BROWNS = (Brown, AffineBrown, BrownAffine, StretchedBrown)
FULL_TO = {**dict.fromkeys(_BROWNS, ()), Smac: (), RadialPolynomial: (*_BROWNS, Smac, PpsRadial), PpsRadial: ()}
FULL_TO |= {Balanced: (), BundlerRadial: (Balanced, OpenCv, Agisoft, OpenCvFisheye), OpenCv: (), Agisoft: ()}
FULL_TO[OpenCvFisheye] = ()
USUAL_TO = {
    **{one: (*(other for other in _BROWNS if other is not one), Smac) for one in _BROWNS},
    Smac: _BROWNS,
    PpsRadial: (*_BROWNS, Smac, RadialPolynomial),
    Balanced: (OpenCv, Agisoft, OpenCvFisheye),
    OpenCv: (Balanced, Agisoft, OpenCvFisheye),
    Agisoft: (Balanced, OpenCv, OpenCvFisheye),
    OpenCvFisheye: (Balanced, OpenCv, Agisoft),
}


@pytest.mark.parametrize(("cameras", "expected"), [(FULL, FULL_TO), (USUAL, USUAL_TO)], ids=["full", "usual"])
def test_exact_conversions_are_exact_and_are_all_there_are(cameras, expected):
    for (source, distortion), target in itertools.product(cameras.items(), DISTORTIONS.values()):
        before = camera(distortion)
        after = exact(before, target)
        if target is source:
            assert after is before
        elif target not in expected[source]:
            assert after is None, (source, target)
        else:
            assert type(after.distortion) is target
            np.testing.assert_allclose(rays(after), rays(before), rtol=0, atol=1e-13, err_msg=f"{source} {target}")


def test_affinity_alone_converts_and_without_distortion_any_direction():
    # Added or applied to the coordinate is the same where there is nothing else.
    brown, product = camera(Brown(b1=1e-3, b2=2e-3)), exact(camera(Brown(b1=1e-3, b2=2e-3)), AffineBrown)
    np.testing.assert_allclose(rays(product), rays(brown), rtol=0, atol=1e-15)
    for target in (OpenCv, Balanced, Smac):
        np.testing.assert_allclose(rays(exact(camera(Brown()), target)), rays(camera(Brown())), rtol=0, atol=1e-15)
    assert exact(camera(Brown()), Ebner) is None


def test_sign_of_smac():
    added = camera(FULL[Smac])
    subtracted = with_sign(added, "subtract")
    assert subtracted.distortion.sign == "subtract"
    np.testing.assert_allclose(rays(subtracted), rays(added), rtol=0, atol=1e-15)
    assert with_sign(added, "add") is added
    with pytest.raises(ValueError, match="only SMAC has a sign; this camera has Brown"):
        with_sign(camera(Brown()), "add")


# Fits -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def to_opencv():
    return fitted(camera(USUAL[Brown]), OpenCv, SENSOR)


def opencv_px(values, source_rays):
    """Pixel (mm / 0.008) of rays by OpenCV's formula with c, xp, yp, k1-k3, p1, p2 = `values`, in NumPy."""
    c, x_p, y_p, k1, k2, k3, p1, p2 = values
    x, y = source_rays[:, 0], -source_rays[:, 1]
    r2 = x * x + y * y
    q = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([c * u + x_p, -c * v + y_p]) / 0.008


def test_a_fit_is_the_least_squares_fit_and_states_its_residual(to_opencv):
    names = ("c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2")
    found = {n: float(get_parameter(to_opencv.interior, n)) for n in parameter_names(to_opencv.interior)}
    grid = np.stack(np.meshgrid(np.linspace(-18, 18, 25), np.linspace(-12, 12, 25)), -1).reshape(-1, 2)
    source_rays = rays(camera(USUAL[Brown]), grid)

    def residual(values):
        return (opencv_px(values, source_rays) - grid / 0.008).ravel()

    # The plain terms alone leave more than 0.01 px, so the rational ones are taken: a fit of the former is worse.
    values = np.array([35.0, 0.065, -0.274, 0.1, 0.0, 0.0, 0.0, 0.0])
    for _ in range(12):
        steps = np.array([1e-4, 1e-4, 1e-4, *[1e-6] * 5])
        jacobian = np.column_stack(
            [(residual(values + h) - residual(values - h)) / (2 * h.sum()) for h in np.diag(steps)]
        )
        values = values - np.linalg.lstsq(jacobian, residual(values), rcond=None)[0]
    length = np.linalg.norm(residual(values).reshape(-1, 2), axis=1)
    assert length.max() > 0.01
    assert 0 < to_opencv.rms_px < np.sqrt(np.mean(length**2))
    assert to_opencv.covered == 1.0
    # With the rational terms held it is that fit.
    held = fitted(camera(USUAL[Brown]), OpenCv, SENSOR, ("k4", "k5", "k6", "b1", "b2"))
    np.testing.assert_allclose(held.rms_px, np.sqrt(np.mean(length**2)), rtol=1e-6)
    np.testing.assert_allclose(held.max_px, length.max(), rtol=1e-5)
    of_held = [float(get_parameter(held.interior, n)) for n in names]
    np.testing.assert_allclose(of_held, values, rtol=1e-5, atol=1e-8)
    assert found["k4"] != 0
    assert all(float(get_parameter(held.interior, n)) == 0 for n in ("k4", "k5", "k6", "b1", "b2"))


def test_a_fit_finds_what_is_exact(to_opencv):
    found = fitted(rebalance(camera(Smac(**MEASURED, **P)), 9.0), Brown, SENSOR)
    assert found.max_px < 1e-6
    names = parameter_names(found.interior)
    got = [float(get_parameter(found.interior, n)) for n in names]
    expected = [float(get_parameter(camera(USUAL[Brown]), n)) for n in names]
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-15)
    # And back from a fit, no worse than the fit itself.
    back = fitted(to_opencv.interior, Brown, SENSOR)
    assert back.rms_px < 1.1 * to_opencv.rms_px


def test_converted_takes_the_exact_way_where_it_may():
    brown = camera(USUAL[Brown])
    assert converted(brown, Smac, SENSOR)[1:] == (0.0, 0.0, 1.0, None)
    skewed = camera(OpenCv(k1=-0.1, b2=1e-3))
    assert converted(skewed, OpenCv, SENSOR).max_px == 0
    without = converted(skewed, OpenCv, SENSOR, ("b2",))
    # A skew of a thousandth turns half of it into a rotation, which a camera file does not have.
    assert 0.5 < without.max_px < 2
    assert float(without.interior.distortion.b2) == 0


def test_corners_of_which_a_camera_says_nothing_are_left_out():
    # measured = p (1 - 0.9 |p|^2) c turns back at |p| = 0.61, a measured radius of 0.406 c.
    folding = InteriorOrientation(45.0, 0.0, 0.0, BundlerRadial(k1=-0.9))
    found = fitted(folding, Brown, SENSOR)
    x, y = np.meshgrid(np.linspace(-18, 18, 25), np.linspace(-12, 12, 25))
    assert found.covered == pytest.approx(np.mean(np.hypot(x, y) < 45 * 2 / 3 / np.sqrt(2.7)))
    assert 0.8 < found.covered < 1
    with pytest.raises(ValueError, match=r"the distortion of this camera is not invertible over 9\d% of its format"):
        fitted(InteriorOrientation(10.0, 0.0, 0.0, BundlerRadial(k1=-0.9)), Brown, SENSOR)
