import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.camera import (
    DISTORTIONS,
    Balanced,
    Brown,
    BundlerRadial,
    Ebner,
    InteriorOrientation,
    OpenCv,
    Sensor,
    Smac,
    invert,
)
from jaxphoto.camera.distortion import AffineBrown, BrownAffine, StretchedBrown
from tests.camera.models import AICON, FLICKR, GOPRO, GOPRO_XY, KODAK, MOST, UNITS, build
from tests.checked_types import unchecked
from tests.derivatives import check_derivatives, compiled
from tests.marks import slow_but

bounded = settings(max_examples=40, deadline=None, derandomize=True, database=None)


_ROWS = 64


@compiled
def _every_map(distortion, xy):
    def of_one(one):
        inverse, good = invert(distortion, one)
        maps = distortion.closed_form, distortion.ideal_from_measured, distortion.measured_from_ideal
        return *(of(one) for of in maps), inverse, good

    return jax.vmap(of_one)(xy)


def every_map(distortion, xy):
    """Closed form, ideal, measured, inverse and whether it is valid, in pieces of one shape: one compile a model."""
    xy = np.asarray(xy, float)
    numbers = jax.tree.map(lambda leaf: np.asarray(leaf, float), distortion)
    pieces = [np.resize(xy[k : k + _ROWS], (_ROWS, 2)) for k in range(0, len(xy), _ROWS)]
    parts = zip(*(_every_map(numbers, piece) for piece in pieces), strict=True)
    return [np.concatenate(part)[: len(xy)] for part in parts]


def closed(distortion, xy):
    return every_map(distortion, xy)[0]


def ideal(distortion, xy):
    return every_map(distortion, xy)[1]


def measured(distortion, xy):
    return every_map(distortion, xy)[2]


def inverted(distortion, xy):
    return every_map(distortion, xy)[3:]


def on_axis(radii):
    return np.stack([np.asarray(radii, float), np.zeros(len(radii))], axis=1)


# Truths ---------------------------------------------------------------------------------------------------


def test_usgs_self_test_of_smac():
    # Self-test of OSSIM's ossimSmacCallibrationSystem, "grabbed from a sample calibration report".
    smac = Smac(
        k0=-0.2165e-3, k1=0.4230e-7, k2=-0.1652e-11, k3=0.2860e-19, k4=0.5690e-26,
        p1=-0.1483e-6, p2=0.1558e-6, p3=-0.1464e-18, p4=0.1233e-38, sign="add",
    )  # fmt: skip
    reduced = np.array([[62.142 - 0.003, -62.336 + 0.001]])
    np.testing.assert_allclose(ideal(smac, reduced), [[62.136, -62.332]], rtol=0, atol=1e-3)
    # The correction (-2.5, 3.4 um) is what is tested: with the other sign it is off by 5 and 7 um.
    subtracted = Smac(**{n: getattr(smac, n) for n in Smac.coefficients})
    assert np.abs(ideal(subtracted, reduced) - [[62.136, -62.332]]).max() > 5e-3


def test_usgs_report_osl_2985_prints_the_distortion_of_its_coefficients():
    # "Symmetric radial (um)" at field angles 7.5 .. 40 deg; the correction added is its opposite.
    smac = Smac(k0=0.2616e-4, k1=-0.2295e-8, k2=0.1454e-13, sign="add")
    r = 153.743 * np.tan(np.deg2rad([7.5, 15, 22.7, 30, 35, 40]))
    corrections = 1e3 * (ideal(smac, on_axis(r))[:, 0] - r)
    np.testing.assert_array_equal(np.round(-corrections), [-1, -1, -1, -1, 0, 1])


def test_sign_of_k1_negative_is_a_barrel():
    # A barrel pulls image points inwards: the measured radius is smaller than the ideal one.
    r = np.array([5.0, 10.0, 20.0])
    assert (ideal(Brown(k1=-1e-4), on_axis(r))[:, 0] > r).all()
    assert (measured(Brown(k1=-1e-4), on_axis(r))[:, 0] < r).all()
    assert (measured(Balanced(a1=-1e-4), on_axis(r))[:, 0] < r).all()
    assert (measured(BundlerRadial(k1=-1e-4), on_axis(r))[:, 0] < r).all()
    assert (measured(Smac(k1=-1e-4), on_axis(r))[:, 0] < r).all()
    assert (measured(Smac(k1=-1e-4, sign="add"), on_axis(r))[:, 0] > r).all()


@bounded
@given(st.floats(-18, 18), st.floats(-12, 12))
def test_brown_and_smac_and_balanced_written_out(x, y):
    r2 = x * x + y * y
    k1, k2, k3, p1, p2, b1, b2 = 1.1e-4, -2.1e-7, 3.2e-10, 1.3e-5, -2.4e-5, 3.1e-4, -1.7e-4
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
    tangential = np.array([p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, p2 * (r2 + 2 * y * y) + 2 * p1 * x * y])
    affine = np.array([b1 * x + b2 * y, 0.0])
    xy = np.array([x, y])
    brown = Brown(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2, b1=b1, b2=b2)
    np.testing.assert_allclose(closed(brown, xy[None])[0], xy - xy * radial - tangential - affine, rtol=0, atol=1e-13)

    r0, k0, k4, p3, p4 = 9.0, 2e-3, -4e-14, 1.1e-3, -2e-6
    q = k0 + k1 * (r2 - 81) + k2 * (r2**2 - 81**2) + k3 * (r2**3 - 81**3) + k4 * (r2**4 - 81**4)
    delta = xy * q + (1 + p3 * r2 + p4 * r2**2) * tangential
    coefficients = {"k0": k0, "k1": k1, "k2": k2, "k3": k3, "k4": k4, "p1": p1, "p2": p2, "p3": p3, "p4": p4, "r0": r0}
    np.testing.assert_allclose(closed(Smac(**coefficients), xy[None])[0], xy - delta, rtol=0, atol=1e-13)
    np.testing.assert_allclose(closed(Smac(**coefficients, sign="add"), xy[None])[0], xy + delta, rtol=0, atol=1e-13)

    dr = k1 * (r2 - 81) + k2 * (r2**2 - 81**2) + k3 * (r2**3 - 81**3)
    balanced = Balanced(a1=k1, a2=k2, a3=k3, b1=p1, b2=p2, c1=b1, c2=b2, r0=r0)
    np.testing.assert_allclose(closed(balanced, xy[None])[0], xy + xy * dr + tangential + affine, rtol=0, atol=1e-13)


def test_the_direction_is_part_of_the_model():
    xy = np.array([[5.0, -3.0]])
    np.testing.assert_array_equal(ideal(KODAK, xy), closed(KODAK, xy))  # photogrammetric: to the ideal
    np.testing.assert_array_equal(measured(AICON, xy), closed(AICON, xy))  # balanced: to the measured
    assert np.abs(ideal(AICON, xy) - closed(AICON, xy)).max() > 0.1


def test_affine_brown_is_brown_of_the_coordinate_freed_of_affinity():
    radial = {"k1": -9e-5, "k2": 1e-7, "p1": 1e-5, "p2": -2e-5}
    xy = np.array([[12.0, -7.0], [-3.0, 9.0]])
    freed = np.column_stack([xy[:, 0] - 3e-3 * xy[:, 0] + 2e-3 * xy[:, 1], xy[:, 1]])
    both = closed(AffineBrown(**radial, b1=3e-3, b2=-2e-3), xy)
    np.testing.assert_allclose(both, closed(Brown(**radial), freed), rtol=0, atol=1e-13)
    assert np.abs(both - closed(Brown(**radial, b1=3e-3, b2=-2e-3), xy)).max() > 1e-4


@pytest.mark.parametrize("model", [BrownAffine, StretchedBrown])
def test_affinity_after_browns_distortion_and_around_it(model):
    radial = {"k1": -9e-5, "k2": 1e-7, "p1": 1e-5, "p2": -2e-5}
    xy = np.array([[12.0, -7.0], [-3.0, 9.0]])
    stretch, first = (np.diag([1 - 3e-3, 1.0]), model is StretchedBrown)
    freed = closed(Brown(**radial), xy @ stretch if first else xy)
    expected = np.column_stack([freed[:, 0] * (1.0 if first else 1 - 3e-3) + 2e-3 * freed[:, 1], freed[:, 1]])
    np.testing.assert_allclose(closed(model(**radial, b1=3e-3, b2=-2e-3), xy), expected, rtol=0, atol=1e-13)


def test_balanced_distortion_vanishes_at_r0():
    balanced = Balanced(a1=-1.1e-4, a2=1.5e-7, r0=13.488)
    r = measured(balanced, on_axis([6.0, 13.488, 18.0]))[:, 0] - [6.0, 13.488, 18.0]
    assert abs(r[1]) < 1e-14
    assert r[0] > 1e-3 > 0 > -1e-3 > r[2]


@bounded
@given(*[st.floats(-0.6, 0.6)] * 2, *[st.floats(-0.2, 0.2)] * 2, st.floats(5, 2000))
def test_bundler_radial_written_out_and_as_balanced(x, y, k1, k2, c):
    # p' = f r(p) p with r(p) = 1 + k1 |p|^2 + k2 |p|^4, of the coordinate p = (x, y) normalised by c.
    interior = InteriorOrientation(c, 0.7, -0.4, BundlerRadial(k1=k1, k2=k2))
    r2 = x * x + y * y
    expected = c * (1 + k1 * r2 + k2 * r2**2) * np.array([x, y])
    ideal_mm = c * np.array([x, y])
    got, own, back, valid = of_interior(interior, ideal_mm)
    np.testing.assert_allclose(own, expected, rtol=1e-14, atol=1e-13 * c)
    np.testing.assert_allclose(got - [0.7, -0.4], expected, rtol=1e-14, atol=1e-13 * c)
    np.testing.assert_allclose(back, ideal_mm, rtol=0, atol=1e-12 * c)
    assert valid
    in_mm = Balanced(a1=k1 / c**2, a2=k2 / c**4)
    np.testing.assert_allclose(closed(in_mm, [ideal_mm])[0], expected, rtol=1e-13, atol=1e-13 * c)


@compiled
def of_interior(interior, xy):
    measured = interior.measured_from_ideal(xy)
    return measured, interior.closed_form(xy), interior.ideal_from_measured(measured), interior.valid(xy)


def test_sign_of_smac_is_checked():
    with pytest.raises(ValueError, match='"subtract" or "add", got \'minus\''), unchecked():
        Smac(sign="minus")


def test_every_model_is_listed_and_has_its_coefficients():
    xy = np.array([[11.0, -8.0]])
    for model in DISTORTIONS.values():
        numbers = np.full(len(model.coefficients), 0.5)
        np.testing.assert_array_equal(closed(build(model, 0 * numbers), xy), xy)
        everything = closed(build(model, numbers), xy)
        for k, name in enumerate(model.coefficients):
            without = closed(build(model, np.where(np.arange(len(numbers)) == k, 0, numbers)), xy)
            assert np.abs(everything - without).max() > 1e-6, name


@pytest.mark.parametrize("model", DISTORTIONS.values())
def test_coefficients_scale_as_their_units_say(model):
    """The same lens drawn twice as large: lengths double, and so does the image of the doubled coordinate."""
    names, xy = model.coefficients, np.array([0.7, -0.4])
    powers = [model.power(name) for name in names]
    small = dict(zip(names, 0.01 + 0.003 * np.arange(len(names)), strict=True))
    lengths = dict.fromkeys(model.constants.values(), 0.5)
    large = {name: small[name] * 2.0**power for name, power in zip(names, powers, strict=True)}
    stretch = 1.0 if model.normalised else 2.0
    once = closed(model(**small, **lengths), xy)
    twice = closed(model(**large, **{n: stretch * v for n, v in lengths.items()}), stretch * xy)
    np.testing.assert_allclose(twice, stretch * once, rtol=1e-12)
    # Not by chance: each alone changes what is drawn.
    assert all(abs(closed(model(**lengths, **(small | {n: 0.2})), xy) - once).max() > 1e-6 for n in names)


def test_interior_orientation_reduces_to_the_principal_point():
    interior = InteriorOrientation(34.0, 0.065, 0.274, KODAK)
    xy = np.array([12.0, -7.0])
    there = compiled(lambda camera, one: camera.ideal_from_measured(one))(interior, xy)
    np.testing.assert_allclose(there, closed(KODAK, [xy - [0.065, 0.274]])[0], rtol=0, atol=1e-15)
    back = compiled(lambda camera, one: camera.measured_from_ideal(one))(interior, there)
    np.testing.assert_allclose(back, xy, rtol=0, atol=1e-13)


def test_pixels_have_their_first_centre_at_a_half_and_rows_run_down():
    sensor = Sensor(4500, 3000, 0.008)
    np.testing.assert_allclose(sensor.mm_from_px(np.array([[0.5, 0.5], [2250, 1500]])), [[-17.996, 11.996], [0, 0]])
    some = np.array([[12.5, 2999.0], [4400.0, 3.0]])
    np.testing.assert_allclose(sensor.px_from_mm(sensor.mm_from_px(some)), some, rtol=1e-14)


# Inversion ------------------------------------------------------------------------------------------------

NUMBERS = st.lists(st.floats(-1, 1), min_size=MOST, max_size=MOST)


@pytest.mark.parametrize("model", DISTORTIONS.values())
@settings(bounded, max_examples=10)
@given(numbers=NUMBERS)
def test_inversion_gives_the_coordinate_back(model, numbers):
    # Coefficients up to 5 mm of distortion in the corner, of either sign, well within the monotone range.
    distortion = build(model, 0.5 * np.array(numbers))
    xy = np.array([[0, 0], [1e-9, 0], [11, 8], [-14, 3], [0, -10], [-9.5, -9.5]], float)
    found, good = inverted(distortion, closed(distortion, xy))
    assert good.all()
    np.testing.assert_allclose(found, xy, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("distortion", "corner"), [(KODAK, [18, 12]), (GOPRO, GOPRO_XY), (AICON, [18, 12]), (FLICKR, [0.594, 0.396])]
)
def test_inversion_of_real_cameras_to_the_corner(distortion, corner):
    xy = np.linspace(-1, 1, 21)[:, None] * np.array(corner)
    found, good = inverted(distortion, closed(distortion, xy))
    assert good.all()
    np.testing.assert_allclose(found, xy, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("distortion", "fold"),
    [
        (Brown(k1=1e-3), np.sqrt(1 / 3e-3)),  # pincushion: ideal = r - k r^3 turns back
        (Balanced(a1=-1e-3), np.sqrt(1 / 3e-3)),  # barrel in the other direction
        (BundlerRadial(k1=-0.3), np.sqrt(1 / 0.9)),
        (Smac(k1=-1e-3, sign="add"), np.sqrt(1 / 3e-3)),
        (Brown(k1=-1e-3, k2=4e-6), 17.631),  # barrel first, then folded: 1 + 3e-3 r^2 - 2e-5 r^4 = 0
    ],
)
def test_inversion_says_false_beyond_the_fold(distortion, fold):
    around = closed(distortion, on_axis(fold * np.array([0.99, 1.0, 1.01])))[:, 0]
    assert around[1] > max(around[0], around[2]), "the map of this test does not fold where it says"
    inside = np.linspace(0, 0.98 * fold, 40)
    found, good = inverted(distortion, closed(distortion, on_axis(inside)))
    assert good.all()
    np.testing.assert_allclose(found[:, 0], inside, rtol=0, atol=1e-9)
    beyond = around[1] * np.array([1.0001, 1.01, 1.3, 3.0, 30.0])
    for direction in ([1.0, 0.0], [-0.6, 0.8]):
        _, good = inverted(distortion, beyond[:, None] * np.array(direction))
        assert not good.any()


def test_valid_range_of_an_interior_orientation():
    valid = compiled(lambda camera, one: camera.valid(one))
    pincushion = InteriorOrientation(35.0, distortion=Brown(k1=1e-3))  # its ideal radius ends at 12.172 mm
    assert valid(pincushion, [12.1, 0.0])
    assert not valid(pincushion, [12.2, 0.0])
    assert valid(InteriorOrientation(35.0, distortion=Balanced(a1=-1e-3)), [30.0, 0.0])


# Derivatives ----------------------------------------------------------------------------------------------

RNG = np.random.default_rng(8)
XY = np.concatenate([RNG.uniform(-1, 1, (8, 2)), [[0, 0], [0, 0.9], [-0.7, 0]]])
COEFFICIENTS = np.concatenate([RNG.uniform(-1, 1, (8, MOST)), np.full((1, MOST), 0.5), np.zeros((2, MOST))])


@pytest.mark.parametrize("model", slow_but((Brown, Smac, Balanced, OpenCv, Ebner), DISTORTIONS.values()))
def test_derivatives_in_both_directions(model):
    # By every coefficient and both coordinates, at random points and on the optical axis.
    def both(numbers, xy):
        distortion = build(model, 0.5 * numbers)
        return distortion.ideal_from_measured(15 * xy) / 15, distortion.measured_from_ideal(15 * xy) / 15

    check_derivatives(both, COEFFICIENTS[:, : len(UNITS[model])], XY)
