"""Stability analysis: alignment by independent minimisation, derivatives, and uncertainties by simulation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxphoto.camera import (
    Brown,
    InteriorOrientation,
    RadialPolynomial,
    Sensor,
    Smac,
    parameter_names,
    rebalance,
    rebalance_covariance,
)
from jaxphoto.errors import InputError
from jaxphoto.stability import (
    METHODS,
    UNKNOWNS,
    QuadraticForm,
    bundle_offsets,
    check_rays,
    image_grid,
    image_rays,
    offset_uncertainty,
    parameter_vector,
    rmse_offset,
    with_parameters,
)
from tests.checked_types import unchecked

GOPRO = Sensor(3000, 2250, 0.00155)
GRID = image_grid(GOPRO)


def smac(c, xp, yp, k1, k2, k3):
    return InteriorOrientation(c, xp, yp, Smac(k1=k1, k2=k2, k3=k3))


ONE = smac(2.6989, -7.3634e-02, 8.7821e-02, -3.9445e-02, -1.1881e-03, -1.3126e-04)
TWO = smac(2.6987, -7.7553e-02, 8.4873e-02, -3.9280e-02, -1.2408e-03, -1.2604e-04)
# Standard deviations of a calibration like those of paper 002, Table 3; and a correlation of some of them.
SIGMAS = {"c_mm": 2.2e-3, "xp_mm": 1.4e-3, "yp_mm": 1.4e-3, "k1": 3.1e-4, "k2": 9.5e-5, "k3": 9.4e-6}


def covariance(scale=1.0):
    names = parameter_names(ONE)
    sigma = np.array([SIGMAS.get(n, 0.0) for n in names]) * scale
    rho = np.eye(len(names))
    for a, b, r in (("k1", "k2", -0.9), ("k2", "k3", -0.97), ("k1", "k3", 0.8), ("c_mm", "xp_mm", 0.3)):
        i, j = names.index(a), names.index(b)
        rho[i, j] = rho[j, i] = r
    return np.outer(sigma, sigma) * rho


def offsets_by_hand(first, second, method, depth=None):
    """Offsets v by definition, minimised by SciPy with its rotations and numerical derivatives."""
    a, b = np.asarray(image_rays(first, GRID)), np.asarray(image_rays(second, GRID))
    c1, c2 = float(first.c), float(second.c)

    def v(unknowns):
        r = Rotation.from_rotvec(unknowns[:3]).as_matrix()
        if method == "rot":
            w = b @ r.T
            return (a[:, :2] + c1 * w[:, :2] / w[:, 2:]).ravel()
        d = np.ones(len(a)) if depth is None else depth
        q = (a / c1 * d[:, None] - unknowns[3:]) @ r.T
        return (-c1 * q[:, :2] / q[:, 2:] - b[:, :2] * c1 / c2).ravel()

    if method == "zrot":
        return (a - b * c1 / c2)[:, :2].ravel()
    result = least_squares(v, np.zeros(UNKNOWNS[method]), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return result.fun


@pytest.mark.parametrize("method", METHODS)
def test_offsets_are_those_of_an_independent_minimisation(method):
    ours = bundle_offsets(ONE, TWO, GRID, method)
    by_hand = offsets_by_hand(ONE, TWO, method)
    assert bool(ours.converged)
    np.testing.assert_allclose(np.asarray(ours.offsets).ravel(), by_hand, atol=1e-9)
    rmse = np.sqrt(by_hand @ by_hand / (2 * len(GRID) - UNKNOWNS[method]))
    assert float(ours.rmse_mm) == pytest.approx(rmse, rel=1e-7)
    assert float(rmse_offset(ONE, TWO, GRID, method)) == pytest.approx(rmse, rel=1e-7)


def test_a_resection_over_relief_is_that_of_scipy_and_stricter_than_over_a_plane():
    depth = np.where(np.arange(len(GRID)) % 2, 0.8, 1.2)
    ours = bundle_offsets(ONE, TWO, GRID, "spr", depth)
    np.testing.assert_allclose(np.asarray(ours.offsets).ravel(), offsets_by_hand(ONE, TWO, "spr", depth), atol=1e-9)
    assert ours.rmse_mm > bundle_offsets(ONE, TWO, GRID, "spr").rmse_mm


@pytest.mark.parametrize("method", METHODS)
def test_one_bundle_in_two_balance_radii_is_one_bundle(method):
    assert float(bundle_offsets(ONE, rebalance(ONE, 3.0), GRID, method).rmse_mm) < 1e-12
    assert float(bundle_offsets(rebalance(ONE, 3.0), ONE, GRID, method).rmse_mm) < 1e-12


def test_in_the_image_as_measured_the_balance_radius_does_not_count():
    """On the virtual image plane it does: with R0 = 3 mm c is smaller, and so are the offsets."""
    as_printed = bundle_offsets(ONE, TWO, GRID)
    balanced = bundle_offsets(rebalance(ONE, 3.0), rebalance(TWO, 3.0), GRID)
    np.testing.assert_allclose(balanced.measured, as_printed.measured, atol=1e-12)
    shrunk = float(rebalance(ONE, 3.0).c / ONE.c)
    assert float(balanced.rmse_mm) == pytest.approx(shrunk * float(as_printed.rmse_mm), rel=1e-9)


def test_what_a_method_leaves_free_makes_no_offset():
    """A rotation of the camera in its housing and, over a plane, another principal distance are no instability."""
    straight = InteriorOrientation(35.0)
    shifted = InteriorOrientation(35.0, 1e-3, -2e-3)
    grid = image_grid(Sensor(4500, 3000, 0.008))
    zrot, rot = (float(rmse_offset(straight, shifted, grid, m)) for m in ("zrot", "rot"))
    assert zrot == pytest.approx(np.sqrt((1e-6 + 4e-6) / 2), rel=1e-9)
    assert rot < 0.3 * zrot
    longer = InteriorOrientation(35.1)
    assert float(rmse_offset(straight, longer, grid, "rot")) > 0.01
    assert float(rmse_offset(straight, longer, grid, "spr")) < 1e-12
    # Over relief it is detectable.
    depth = np.where(np.arange(len(grid)) % 2, 0.8, 1.2)
    assert float(rmse_offset(straight, longer, grid, "spr", depth)) > 1e-3


def test_models_of_any_kind_are_compared():
    """One lens in the measured coordinate, with another sign, and in other models that represent it exactly."""
    d = ONE.distortion
    added = InteriorOrientation(ONE.c, ONE.xp, ONE.yp, Smac(k1=-d.k1, k2=-d.k2, k3=-d.k3, sign="add"))
    brown = InteriorOrientation(ONE.c, ONE.xp, ONE.yp, Brown(k1=d.k1, k2=d.k2, k3=d.k3))
    assert float(bundle_offsets(added, brown, GRID).rmse_mm) < 1e-12
    in_ideal = bundle_offsets(ONE, InteriorOrientation(2.7, 0.0, 0.0, RadialPolynomial(k1=0.05)), GRID)
    assert bool(in_ideal.converged)
    assert np.isfinite(in_ideal.offsets).all()


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_by_both_sets_are_numerical_ones(method):
    """The alignment is re-estimated for each: it depends on both sets."""
    result = bundle_offsets(ONE, TWO, GRID, method)
    start = np.concatenate([parameter_vector(ONE), parameter_vector(TWO)])
    names = 2 * parameter_names(ONE)
    n = len(names) // 2

    @eqx.filter_jit
    def v(vector):
        return bundle_offsets(with_parameters(ONE, vector[:n]), with_parameters(TWO, vector[n:]), GRID, method).offsets

    for j, name in enumerate(names):
        step = np.zeros(len(names))
        step[j] = 1e-3 * SIGMAS.get(name, 1e-5)
        numerical = np.asarray(v(start + step) - v(start - step)).ravel() / (2 * step[j])
        scale = np.abs(numerical).max()
        np.testing.assert_allclose(result.jacobian[:, j], numerical, atol=2e-6 * scale + 1e-9)


def test_rmse_is_differentiable_through_the_optimum():
    names = parameter_names(ONE)

    def of(vector):
        return rmse_offset(with_parameters(ONE, vector), TWO, GRID, "rot")

    start = parameter_vector(ONE)
    gradient = jax.jit(jax.grad(of))(start)
    evaluate = jax.jit(of)
    for j, name in enumerate(names):
        step = np.zeros(len(names))
        step[j] = 1e-3 * SIGMAS.get(name, 1e-6)
        numerical = (evaluate(start + step) - evaluate(start - step)) / (2 * step[j])
        assert float(gradient[j]) == pytest.approx(float(numerical), rel=1e-4, abs=1e-6)


# The distribution of v'v


@pytest.mark.parametrize(("freedom", "shift"), [(1, 0.0), (2, 0.0), (7, 0.0), (1, 3.0), (4, 10.0), (3, 1000.0)])
def test_equal_weights_give_the_chi_square_distribution_far_into_its_tails(freedom, shift):
    form = QuadraticForm(np.ones(freedom), np.full(freedom, shift / freedom), 0.5)
    reference = stats.ncx2(freedom, shift, loc=0.5) if shift else stats.chi2(freedom, loc=0.5)
    for p in (1e-4, 0.025, 0.3, 0.5, 0.7, 0.975):
        assert form.tail_probability(reference.ppf(p)) == pytest.approx(1 - p, rel=1e-9)
        assert form.quantile(p) == pytest.approx(reference.ppf(p), rel=1e-9)
    far = reference.isf(1e-12)
    assert form.tail_probability(far) == pytest.approx(reference.sf(far), rel=1e-6)
    assert (form.mean, form.variance) == pytest.approx((reference.mean(), reference.var()))
    assert form.tail_probability(0.4) == 1.0


def test_mean_and_spread_of_the_root_are_exact():
    half_normal = QuadraticForm(np.ones(1), np.zeros(1))
    assert half_normal.mean_of_root == pytest.approx(np.sqrt(2 / np.pi), rel=1e-12)
    assert half_normal.sigma_of_root == pytest.approx(np.sqrt(1 - 2 / np.pi), rel=1e-12)
    # Far from zero a root is linear: sqrt((b + z)^2) = b + z.
    far = QuadraticForm(np.ones(1), np.array([1e12]))
    assert far.mean_of_root == pytest.approx(1e6, rel=1e-12)
    assert far.sigma_of_root == pytest.approx(1.0, rel=1e-9)
    nothing = QuadraticForm(np.zeros(0), np.zeros(0), 4.0)
    assert (nothing.mean_of_root, nothing.sigma_of_root, nothing.quantile(0.3)) == (2.0, 0.0, 4.0)
    assert (nothing.tail_probability(3.9), nothing.tail_probability(4.1)) == (1.0, 0.0)


def test_unequal_weights_are_as_sampled():
    rng = np.random.default_rng(5)
    for _ in range(12):
        n = rng.integers(1, 12)
        weights = 10 ** rng.uniform(-6, 0, n)
        shifts = weights * 10 ** rng.uniform(-3, 4, n) * (rng.random(n) < 0.5)
        form = QuadraticForm(weights, shifts, weights.max() * rng.choice([0.0, 3.0]))
        drawn = form.constant + ((np.sqrt(shifts) + np.sqrt(weights) * rng.standard_normal((40_000, n))) ** 2).sum(1)
        for p in (0.01, 0.2, 0.5, 0.8, 0.99):
            off = (1 - form.tail_probability(float(np.quantile(drawn, p)))) - p
            assert abs(off) < 4.5 * np.sqrt(p * (1 - p) / len(drawn))
            assert form.tail_probability(form.quantile(p)) == pytest.approx(1 - p, abs=1e-9)
        root = np.sqrt(drawn)
        assert abs(form.mean_of_root - root.mean()) < 4.5 * root.std() / np.sqrt(len(root))
        assert form.sigma_of_root == pytest.approx(root.std(), rel=0.03)


# Uncertainty of RMSE_offset


@pytest.fixture(scope="module")
def repeated():
    """Exact RMSE_offset of many pairs of random sets: draw(first, second, method, n, seed)."""
    half = covariance()
    names = parameter_names(ONE)

    @eqx.filter_jit
    def rmse(first, second, e, method):
        n = len(names)
        p1, p2 = parameter_vector(first), parameter_vector(second)

        def one(d):
            return rmse_offset(with_parameters(first, p1 + d[:n]), with_parameters(second, p2 + d[n:]), GRID, method)

        return jax.lax.map(one, e, batch_size=250)

    def draw(first, second, method, n, seed):
        both = block_diag(half, half)
        e = np.random.default_rng(seed).multivariate_normal(np.zeros(len(both)), both, n, method="eigh")
        return np.asarray(rmse(first, second, jnp.asarray(e), method))

    return draw


@pytest.mark.parametrize("method", ["rot", "spr"])
def test_repeated_calibrations_scatter_as_predicted(repeated, method):
    """Standard deviation and quantiles of RMSE_offset of two different sets, by 4000 exact comparisons."""
    rmse = repeated(ONE, TWO, method, 4000, 1)
    reference = offset_uncertainty(bundle_offsets(ONE, TWO, GRID, method), covariance(), covariance())
    assert reference.sigma_mm == pytest.approx(rmse.std(), rel=0.05)
    for limit, p in ((reference.low_mm, 0.025), (reference.high_mm, 0.975)):
        # Four standard deviations of a proportion.
        assert (rmse < limit).mean() == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / len(rmse)))


def test_two_calibrations_of_one_camera_differ_as_predicted(repeated):
    """Null hypothesis: mean and 95 % quantile of the RMSE, and uniform p-values."""
    rmse = repeated(ONE, ONE, "rot", 4000, 2)
    reference = offset_uncertainty(bundle_offsets(ONE, ONE, GRID), covariance(), covariance())
    assert reference.expected_of_one_mm == pytest.approx(rmse.mean(), abs=4 * rmse.std() / np.sqrt(len(rmse)))
    assert (rmse > reference.limit_of_one_mm).mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / len(rmse)))
    assert reference.p_value == 1.0
    assert reference.unexplained_mm == 0.0
    same = bundle_offsets(ONE, ONE, GRID)
    both = block_diag(covariance(), covariance())
    form = QuadraticForm.of_normal(np.zeros(2 * len(GRID)), np.asarray(same.jacobian), both)
    p_values = [form.tail_probability(same.redundancy * r**2) for r in rmse[:400]]
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    # With derivatives at the estimates, p is the same.
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(len(both)), both, method="eigh").reshape(2, -1)
    pair = [with_parameters(ONE, parameter_vector(ONE) + e) for e in drawn]
    result = bundle_offsets(*pair, GRID)
    p = offset_uncertainty(result, covariance(), covariance()).p_value
    assert p == pytest.approx(form.tail_probability(same.redundancy * float(result.rmse_mm) ** 2), abs=0.02)


def test_a_set_without_covariance_is_taken_as_exact():
    v = bundle_offsets(ONE, TWO, GRID)
    assert offset_uncertainty(v) is None
    zero = np.zeros_like(covariance())
    assert offset_uncertainty(v, covariance()) == pytest.approx(offset_uncertainty(v, covariance(), zero), rel=1e-9)
    assert offset_uncertainty(v, None, covariance()) == pytest.approx(offset_uncertainty(v, zero, covariance()))
    with pytest.raises(ValueError, match="covariances have 3 and 12 parameters, but the two sets have 24"), unchecked():
        offset_uncertainty(v, np.eye(3), covariance())


def test_the_balance_radius_changes_scale_and_nothing_else_of_an_uncertainty():
    reference = offset_uncertainty(bundle_offsets(ONE, TWO, GRID), covariance(), covariance())
    other = offset_uncertainty(
        bundle_offsets(rebalance(ONE, 3.0), rebalance(TWO, 3.0), GRID),
        rebalance_covariance(ONE, 3.0, covariance()),
        rebalance_covariance(TWO, 3.0, covariance()),
    )
    assert other.p_value == pytest.approx(reference.p_value, rel=1e-3)
    # The first set defines both scales.
    shrunk = float(rebalance(ONE, 3.0).c / ONE.c)
    assert other.sigma_mm == pytest.approx(shrunk * reference.sigma_mm, rel=1e-3)


# Invalid input


def test_a_grid_reaches_over_the_format_or_a_given_extent():
    assert GRID.shape == (165, 2)
    np.testing.assert_allclose(np.abs(GRID).max(0), [GOPRO.width_mm / 2, GOPRO.height_mm / 2])
    np.testing.assert_allclose(np.abs(image_grid(GOPRO, 5, 3, (2.0, 1.0))).max(0), [1.0, 0.5])
    with pytest.raises(ValueError, match="2 columns and 2 rows"):
        image_grid(GOPRO, 1, 5)
    with pytest.raises(ValueError, match="must be positive"):
        image_grid(GOPRO, 5, 5, (1.0, -1.0))
    with pytest.raises(ValueError, match="too few for"):
        bundle_offsets(ONE, TWO, GRID[:3], "spr")


def test_a_distortion_that_folds_inside_the_grid_is_named():
    check_rays(ONE, GRID, "A")
    with pytest.raises(
        InputError,
        match=r"B: its distortion is not invertible.* at \d+ of 165 points .* smaller extent",
    ):
        check_rays(smac(2.7, 0.0, 0.0, 0.2, 0.0, 0.0), GRID, "B")
    with pytest.raises(InputError, match="B: its distortion"):
        check_rays(InteriorOrientation(2.7, 0.0, 0.0, RadialPolynomial(k1=-0.2)), GRID, "B")
