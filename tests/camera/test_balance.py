import jax
import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation, Smac, parameter_names, rebalance, rebalance_covariance
from tests.camera.models import GOPRO, GOPRO_XY
from tests.derivatives import check_derivatives, compiled

CORNERS = np.linspace(-1, 1, 9)[:, None] * GOPRO_XY
# Every coefficient at work; the decentring is exaggerated so that a wrong scale of it shows.
FULL = {
    "k0": -0.03,
    "k1": -3.9e-2,
    "k2": -1.2e-3,
    "k3": -1.3e-4,
    "k4": 1e-6,
    "p1": 2e-3,
    "p2": -1e-3,
    "p3": 0.02,
    "p4": -1e-3,
}


@compiled
def rays(interior, xy):
    ideal = jax.vmap(interior.ideal_from_measured)(xy)
    return ideal / interior.c


rebalanced = compiled(rebalance)


def camera(sign="subtract", **coefficients):
    return InteriorOrientation(2.6989, -0.0736, 0.0878, Smac(**coefficients, sign=sign))


@pytest.mark.parametrize("sign", ["subtract", "add"])
@pytest.mark.parametrize(("old", "new"), [(0.0, 3.0), (3.0, 0.0), (1.5, 2.5)])
def test_rays_are_equal_to_rounding_at_another_r0(sign, old, new):
    before = camera(sign, **FULL, r0=old)
    after = rebalanced(before, new)
    assert after.distortion.r0 == new
    assert after.distortion.k0 == 0
    assert after.distortion.sign == sign
    assert abs(after.c / before.c - 1) > 0.01, "nothing was rebalanced"
    np.testing.assert_allclose(rays(after, CORNERS), rays(before, CORNERS), rtol=0, atol=1e-12)


def test_k0_is_a_scale_of_the_principal_distance():
    # maths: s = 1 - K0, c0 = c / s, Ki0 = Ki / s.
    after = rebalanced(camera(**FULL), 0.0)
    assert after.c == pytest.approx(2.6989 / 1.03, rel=1e-14)
    assert after.distortion.k1 == pytest.approx(-3.9e-2 / 1.03, rel=1e-14)
    assert after.distortion.p2 == pytest.approx(-1e-3 / 1.03, rel=1e-14)
    assert after.distortion.p3 == 0.02
    assert (after.xp, after.yp) == (-0.0736, 0.0878)


def test_the_principal_distance_of_the_gopro_as_published():
    # Paper 002, tables 3 and 4: the same camera adjusted with R0 = 0 and 3 mm; the sigma of c is 0.003 mm, those
    # of K1 3e-4. Two adjustments of one data set agree better than their sigmas.
    after = rebalanced(InteriorOrientation(2.6989, -0.0736, 0.0878, GOPRO), 3.0)
    assert after.c == pytest.approx(1.7427, abs=0.003)
    assert after.distortion.k1 == pytest.approx(-2.5630e-2, abs=3e-4)


def test_there_and_back_again():
    before = camera(**{**FULL, "k0": 0.0}, r0=1.0)
    back = rebalanced(rebalanced(before, 3.0), 1.0)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(back), strict=True):
        assert b == pytest.approx(a, rel=1e-13)


def test_only_smac_has_a_balance_radius():
    with pytest.raises(ValueError, match="only SMAC has a balance radius to change; this camera has Brown"):
        rebalance(InteriorOrientation(35.0, distortion=Brown()), 3.0)


def test_a_singular_radius_is_refused():
    # Subtracted, 1 - (K1 R0^2) = 0 at R0 = 5.
    singular = camera(k1=1 / 25)
    assert np.isfinite(rebalanced(singular, 4.9).c)
    with pytest.raises(Exception, match=r"singular at R0 = .*: use a smaller R0"):
        jax.block_until_ready(rebalance(singular, 5.0))
    with pytest.raises(Exception, match=r"singular at R0 = .*: use a smaller R0"):
        jax.block_until_ready(rebalance(singular, 6.0))


def by_hand(vector, r0, new_r0):
    """The map of docs/models.md for sign "subtract" in plain NumPy: c, xp, yp, K0-K4, P1-P4."""
    c, xp, yp, k0, *k, p1, p2, p3, p4 = vector
    powers = np.arange(2, 9, 2)
    s = 1 - k0 + np.sum(k * r0**powers)
    zero = np.array([c, *k, p1, p2]) / s
    scale = 1 / (1 - np.sum(zero[1:5] * new_r0**powers))
    c, *k, p1, p2 = zero * scale
    return np.array([c, xp, yp, 0, *k, p1, p2, p3, p4])


def test_covariance_follows_the_map():
    before = camera(**FULL, r0=1.5)
    names = parameter_names(before)
    assert names[3:] == Smac.coefficients
    vector = np.array([2.6989, -0.0736, 0.0878, *FULL.values()])
    sigmas = np.array([2e-3, 1e-3, 1e-3, 1e-4, 3e-4, 9e-5, 9e-6, 1e-7, 1e-5, 1e-5, 1e-4, 1e-5])
    root = np.random.default_rng(9).normal(size=(12, 12)) * sigmas[:, None]
    covariance = root @ root.T

    got = compiled(lambda interior, q: rebalance_covariance(interior, 3.0, q))(before, covariance)

    jacobian = np.empty((12, 12))
    for i, h in enumerate(1e-3 * sigmas):
        step = np.zeros(12)
        step[i] = h
        jacobian[:, i] = (by_hand(vector + step, 1.5, 3.0) - by_hand(vector - step, 1.5, 3.0)) / (2 * h)
    expected = jacobian @ covariance @ jacobian.T
    size = np.sqrt(np.diag(expected))
    size[3] = 1.0  # K0 is 0 afterwards: its row is exactly zero
    np.testing.assert_allclose(got / np.outer(size, size), expected / np.outer(size, size), rtol=0, atol=1e-6)
    assert not got[3].any()

    drawn = np.random.default_rng(10).multivariate_normal(vector, 1e-2 * covariance, 5_000, method="cholesky")
    scatter = np.cov(np.array([by_hand(v, 1.5, 3.0) for v in drawn]).T) * 1e2
    keep = np.arange(12) != 3
    np.testing.assert_allclose(np.sqrt(np.diag(scatter))[keep], np.sqrt(np.diag(got))[keep], rtol=0.05)


def full_smac(numbers, c):
    units = np.array([1e-2, 1e-2, 1e-3, 1e-4, 1e-6, 1e-3, 1e-3, 1e-2, 1e-3])
    smac = Smac(**dict(zip(Smac.coefficients, numbers * units, strict=True)), r0=1.5)
    new = rebalance(InteriorOrientation(c, 0.0, 0.0, smac), 2.5)
    d = new.distortion
    return new.c, *(getattr(d, name) / unit for name, unit in zip(Smac.coefficients, units, strict=True))


def test_derivatives_of_the_map():
    rng = np.random.default_rng(11)
    numbers = np.concatenate([rng.uniform(-1, 1, (4, 9)), np.zeros((1, 9))])
    check_derivatives(full_smac, numbers, np.full(5, 2.7))
