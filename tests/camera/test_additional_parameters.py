"""Ebner, Gruen, Brown's fourteen, the radial polynomial: their formulas, and the orthogonality they were made for."""

import jax
import numpy as np
import pytest

from jaxphoto.camera import Brown14, Ebner, Gruen, RadialPolynomial
from tests.camera.models import UNITS, build
from tests.derivatives import compiled

XY = np.random.default_rng(21).uniform(-18, 18, (12, 2))


@compiled
def ideal(distortion, xy):
    return jax.vmap(distortion.ideal_from_measured)(xy)


def columns(model, b, xy):
    """What each coefficient of one does to the image at `xy`: (2 n, coefficients), all x before all y."""
    constants = dict.fromkeys(model.constants.values(), b)
    deltas = [xy - ideal(model(**constants, **{name: 1.0}), xy) for name in model.coefficients]
    return np.column_stack([delta.T.ravel() for delta in deltas])


def orientation(xy):
    """What x_p, y_p, c, kappa and the two tilts do, to second order in the image."""
    x, y = xy.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    pairs = [(one, zero), (zero, one), (x, y), (-y, x), (x * x, x * y), (x * y, y * y)]
    return np.column_stack([np.concatenate(pair) for pair in pairs])


def grid(positions):
    return np.stack(np.meshgrid(positions, positions), axis=-1).reshape(-1, 2)


def cosines(a, b):
    a, b = a / np.linalg.norm(a, axis=0), b / np.linalg.norm(b, axis=0)
    return a.T @ b


def rank(a):
    # Of scaled columns: the coefficients differ in size by ten orders.
    return np.linalg.matrix_rank(a / np.linalg.norm(a, axis=0))


# Formulas -------------------------------------------------------------------------------------------------


def test_ebner_written_out():
    b = dict(enumerate([3e-4, -2e-4, 1e-5, 2e-5, -3e-5, 4e-5, 1e-6, -2e-6, 3e-6, -4e-6, 5e-8, -6e-8], start=1))
    x, y = XY.T
    k, m = x**2 - 2 * 11.0**2 / 3, y**2 - 2 * 11.0**2 / 3
    dx = b[1] * x + b[2] * y - b[3] * 2 * k + b[4] * x * y + b[5] * m + b[7] * x * m + b[9] * y * k + b[11] * k * m
    dy = -b[1] * y + b[2] * x + b[3] * x * y - b[4] * 2 * m + b[6] * k + b[8] * y * k + b[10] * x * m + b[12] * k * m
    got = ideal(Ebner(b=11.0, **{f"b{i}": value for i, value in b.items()}), XY)
    np.testing.assert_allclose(got, XY - np.column_stack([dx, dy]), rtol=0, atol=1e-13)


def test_brown14_written_out():
    a = dict(
        enumerate([3e-4, -2e-4, 1e-5, 2e-5, 3e-6, 4e-6, 5e-8, 6e-5, -7e-5, 8e-6, 9e-6, -1e-7, 2e-6, -9e-5], start=1)
    )
    x, y = XY.T
    dx = a[1] * x + a[2] * y + a[3] * x * y + a[4] * y**2 + a[5] * x**2 * y + a[6] * x * y**2 + a[7] * x**2 * y**2
    dy = a[8] * x * y + a[9] * x**2 + a[10] * x**2 * y + a[11] * x * y**2 + a[12] * x**2 * y**2
    outwards = a[13] / 30.0 * x**2 * y**2 + a[14] * (x**2 + y**2)
    got = ideal(Brown14(f=30.0, **{f"a{i}": value for i, value in a.items()}), XY)
    expected = XY - np.column_stack([dx, dy]) - XY * outwards[:, None]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


def test_gruen_is_made_of_the_orthogonal_polynomials_of_five_points():
    # Monic polynomials made orthogonal on the five positions by Gram and Schmidt, not copied from the formula.
    b = 11.0
    positions = b * np.array([-1, -0.5, 0, 0.5, 1])
    polynomials: list[np.polynomial.Polynomial] = []
    for degree in range(5):
        new = np.polynomial.Polynomial([0] * degree + [1])
        for old in polynomials:
            new = new - old * (np.sum(new(positions) * old(positions)) / np.sum(old(positions) ** 2))
        polynomials.append(new)
    f = [polynomial(XY.T) for polynomial in polynomials]  # f[degree] is (2, points): of x and of y
    numbers = np.random.default_rng(22).uniform(-1, 1, 44)
    values = {name: n * UNITS[Gruen][name] for name, n in zip(Gruen.coefficients, numbers, strict=True)}
    delta = np.zeros_like(XY)
    for name, value in values.items():
        letter, i, j = name[0], int(name[1]), int(name[2])
        delta[:, "ab".index(letter)] += value * f[i - 1][1] * f[j - 1][0]
    # Three of them stand in both coordinates, and one more.
    x, y = XY.T
    delta[:, 0] -= values["b22"] * 10 / 7 * f[2][0]
    delta[:, 1] += values["a21"] * x - values["a12"] * y - values["a22"] * 10 / 7 * f[2][1]
    np.testing.assert_allclose(ideal(Gruen(b=b, **values), XY), XY - delta, rtol=0, atol=1e-12)


def test_radial_polynomial_of_odd_degree_is_added():
    k1, k2, k3 = 9e-5, -1e-7, 2e-10
    r = np.linalg.norm(XY, axis=1)
    dr = k1 * r**3 + k2 * r**5 + k3 * r**7
    got = ideal(RadialPolynomial(k1=k1, k2=k2, k3=k3), XY)
    np.testing.assert_allclose(got, XY * (1 + dr / r)[:, None], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(ideal(RadialPolynomial(k1=k1), np.zeros((12, 2))), np.zeros((12, 2)))


@pytest.mark.parametrize("model", [Ebner, Gruen, Brown14])
def test_constants_must_be_given_and_positive(model):
    (name,) = model.constants.values()
    with pytest.raises(TypeError, match=f"'{name}'"):
        model()
    for wrong in (0.0, -3.0, np.nan):
        with pytest.raises(ValueError, match=f"{name} of {model.__name__}, .* must be positive .mm., got {wrong}"):
            model(**{name: wrong})


# What the parameters are for ------------------------------------------------------------------------------

NINE, TWENTY_FIVE = grid([-7.0, 0.0, 7.0]), grid([-8.0, -4.0, 0.0, 4.0, 8.0])


@pytest.mark.parametrize(("model", "b", "points"), [(Ebner, 7.0, NINE), (Gruen, 8.0, TWENTY_FIVE)])
def test_parameters_are_orthogonal_on_their_points(model, b, points):
    effects, others = columns(model, b, points), orientation(points)
    np.testing.assert_allclose(cosines(effects, effects), np.eye(effects.shape[1]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(cosines(effects, others), 0, rtol=0, atol=1e-12)
    # Together with the six of the orientation they are as many as the coordinates of the points, and span them all.
    assert effects.shape[1] + 6 == 2 * len(points) == rank(np.column_stack([effects, others]))


def test_another_spacing_is_not_orthogonal():
    for model, points in ((Ebner, NINE), (Gruen, TWENTY_FIVE)):
        effects = columns(model, 6.0, points)
        assert np.abs(cosines(effects, effects) - np.eye(effects.shape[1])).max() > 0.05


@pytest.mark.parametrize("model", [Ebner, Gruen, Brown14])
def test_no_parameter_does_what_the_orientation_does(model):
    # On image points that are no grid: the largest cosine of any combination with any of the orientation.
    points = np.random.default_rng(23).uniform(-18, 18, (200, 2)) * [1, 2 / 3]
    effects, others = columns(model, 12.0, points), orientation(points)
    assert rank(np.column_stack([effects, others])) == effects.shape[1] + 6
    a, b = (np.linalg.qr(m / np.linalg.norm(m, axis=0))[0] for m in (effects, others))
    closest = np.linalg.svd(a.T @ b, compute_uv=False)[0]
    assert closest < 0.97
    # A part of the scale, which is that of c, can be imitated by polynomials, but never all of it.
    scale = others[:, 2] / np.linalg.norm(others[:, 2])
    assert np.linalg.norm(scale - a @ (a.T @ scale)) > 0.25


def test_a_coefficient_is_no_more_than_its_column():
    # Linear in the coefficients: what the tests above say of columns holds of any numbers.
    for model in (Ebner, Gruen, Brown14):
        numbers = np.linspace(-1, 1, len(model.coefficients))
        full = XY - ideal(build(model, numbers), XY)
        half = XY - ideal(build(model, 0.5 * numbers), XY)
        np.testing.assert_allclose(2 * half, full, rtol=0, atol=1e-12)
