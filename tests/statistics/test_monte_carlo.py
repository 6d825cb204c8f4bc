"""Predicted standard deviations compared with 500 simulated re-measurements of one block."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

from jaxphoto import adjust, covariance
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.rotation import small_angles
from jaxphoto.simulation import remeasure
from tests.blocks import observed, simulated

DRAWS = 500
# Probability that any bound below fails by chance.
FALSE_ALARM = 1e-3
# sensitivity/test_monte_carlo.py tests the scatter of 600 vectorised draws.
pytestmark = pytest.mark.slow

_turn = jax.jit(jax.vmap(lambda estimated, true: small_angles(estimated @ true.T)))


class Draws(eqx.Module):
    """Standardised errors, one row a draw and one column an unknown, and v'Pv of every draw."""

    standardised: np.ndarray
    square_sums: np.ndarray
    redundancy: int


@pytest.fixture(scope="module")
def draws() -> Draws:
    block, truth = simulated("cross")
    numbers = jax.jit(lambda key: observed(remeasure(block, truth, key)))

    def adjusted_draw(seed: int):
        new = jax.tree.map(np.asarray, numbers(jax.random.key(seed)))
        return adjust(eqx.tree_at(observed, block, new), truth)

    # A priori prediction: the drawn observations enter only through the linearisation point.
    nominal = adjusted_draw(10**6)
    sigma = np.sqrt(np.diagonal(np.asarray(covariance(nominal, "camera").matrix)))
    errors, square_sums = [], []
    for seed in range(DRAWS):
        adjusted = adjusted_draw(seed)
        assert bool(adjusted.converged)
        errors.append(_errors(adjusted, truth, nominal))
        square_sums.append(float(adjusted.sum_of_squares))
    return Draws(np.array(errors) / sigma, np.array(square_sums), nominal.redundancy)


def _errors(adjusted, truth, nominal) -> np.ndarray:
    """Estimate minus truth of X, Y, Z, small rotations by image, then of the free interior orientation."""
    result = adjusted.unknowns
    position = np.asarray(result.exterior.position) - np.asarray(truth.exterior.position)
    turns = _turn(result.exterior.camera_from_object, truth.exterior.camera_from_object)
    interior = []
    for camera, estimated in result.interior.items():
        for name in parameter_names(estimated):
            if f"interior[{camera}].{name}" in nominal.structure.labels:
                interior.append(get_parameter(estimated, name) - get_parameter(truth.interior[camera], name))
    return np.concatenate([np.hstack([position, turns]).ravel(), np.array(interior, float)])


def test_scatter_of_every_unknown_is_its_predicted_sigma(draws):
    share = FALSE_ALARM / (3 * draws.standardised.shape[1])
    low, high = stats.chi2.ppf([share / 2, 1 - share / 2], DRAWS - 1) / (DRAWS - 1)
    scatter = draws.standardised.var(axis=0, ddof=1)
    # The bound is effective: a sigma wrong by a fifth would fail.
    assert high < 1.2**2
    assert low > 0.8**2
    assert (scatter > low).all(), scatter.min()
    assert (scatter < high).all(), scatter.max()


def test_estimates_are_unbiased(draws):
    bound = stats.norm.isf(FALSE_ALARM / (6 * draws.standardised.shape[1]))
    means = draws.standardised.mean(axis=0) * np.sqrt(DRAWS)
    assert (np.abs(means) < bound).all(), np.abs(means).max()


def test_square_sums_are_distributed_as_chi_square_of_the_redundancy(draws):
    """Residuals refer to the measured image by default, so distortion does not scale their noise."""
    f = draws.redundancy
    bound = stats.norm.isf(FALSE_ALARM / 6) * np.sqrt(2 * f / DRAWS)
    assert abs(draws.square_sums.mean() - f) < bound
    assert abs(draws.square_sums.std(ddof=1) / np.sqrt(2 * f) - 1) < 0.15
    assert stats.kstest(draws.square_sums, "chi2", (f,)).pvalue > FALSE_ALARM / 3
