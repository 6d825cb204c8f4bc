"""Monte Carlo draws compared with full adjustments, theory and each other."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import InputError, adjust, bias, covariance, monte_carlo, readjust
from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.draw_gradients import image_gradients
from jaxphoto.sensitivity import Readjustment, noise
from jaxphoto.sensitivity.monte_carlo import common_of
from jaxphoto.unknowns import FIXED, Weighted
from tests.blocks import adjusted, simulated
from tests.checked_types import unchecked
from tests.marks import slow_but

KINDS = slow_but(("cross",), ("cross", "everything", "inner"))


def sigmas(nominal: Adjustment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A priori standard deviations of shared unknowns, exterior orientations and points."""
    cov = covariance(nominal)
    sigma, n = np.sqrt(np.diagonal(cov.matrix)), 6 * cov.n_images
    return sigma[n:], sigma[:n].reshape(-1, 6), np.sqrt(np.diagonal(cov.points, axis1=1, axis2=2))


def estimates(a: Adjustment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    u = a.unknowns
    exterior = np.hstack([u.exterior.position, np.asarray(u.exterior.omega_phi_kappa)])
    return np.asarray(a.values.shared)[a.structure.free], exterior, np.asarray(u.points)


def close(draws, k: int, full: Adjustment, nominal: Adjustment, tolerance: float) -> None:
    """Draw `k` is the optimum of `full` within a fraction of each standard deviation."""
    for one, other, sigma in zip(
        (draws.shared[k], draws.exterior[k], draws.points[k]), estimates(full), sigmas(nominal), strict=True
    ):
        free = sigma > 0
        difference = np.asarray(one) - other
        if difference.shape[-1:] == (6,):
            difference[:, 3:] = (difference[:, 3:] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(difference[free] / sigma[free]).max(initial=0.0) < tolerance


@pytest.mark.parametrize("name", KINDS)
def test_a_draw_is_the_optimum_of_its_own_block(name):
    nominal = adjusted(name)
    errors = noise(nominal.block)
    draws = monte_carlo(nominal, errors, 3, seed=4, exterior=True, points=True)
    assert draws.converged.all()
    assert not draws.fallback.any()
    for k in range(3):
        block, _ = errors(jax.random.fold_in(jax.random.key(4), k), nominal.block)
        # The start of the nominal adjustment: the datum of a free network refers to it.
        full = adjust(block, nominal.block.start.unknowns, block.priors)
        # Adjustments converge to 1e-5 of a sigma.
        close(draws, k, full, nominal, 2e-5)


@pytest.mark.slow
def test_what_is_held_can_be_drawn():
    nominal = adjusted("fixed_interior")
    wrong = bias(nominal.block, "interior", 0.02, parameter="c")
    draws = monte_carlo(nominal, wrong, 2, exterior=True, points=True)
    (name,) = draws.recorded
    assert name == "one.c_mm"
    for k in range(2):
        start = eqx.tree_at(
            lambda u: u.interior["one"].c,
            nominal.unknowns,
            nominal.unknowns.interior["one"].c + draws.recorded[name][k],
        )
        close(draws, k, adjust(nominal.block, start, nominal.priors), nominal, 2e-5)


@pytest.mark.slow
def test_a_lever_arm_that_is_held_can_be_drawn():
    block, truth = simulated("mount")
    (name,) = block.priors.mounts
    held = eqx.tree_at(lambda p: p.mounts[name].lever_arm, block.priors, FIXED)
    nominal = adjust(block, truth, held)
    wrong = bias(dataclasses.replace(nominal.block, priors=held), "lever-arm", (0.1, 0.1, 0.2))
    draws = monte_carlo(nominal, wrong, 1, exterior=True, points=True)
    moved = np.array([draws.recorded[f"{name}.lever_arm_{axis}_m"][0] for axis in ("right", "forward", "up")])
    start = eqx.tree_at(
        lambda u: u.mounts[name].lever_arm, nominal.unknowns, nominal.unknowns.mounts[name].lever_arm + moved
    )
    assert np.abs(moved).max() > 0.01
    close(draws, 0, adjust(nominal.block, start, held), nominal, 2e-5)


@pytest.mark.slow
def test_a_lever_arm_that_is_known_beforehand_can_be_drawn():
    nominal = adjusted("everything")
    (name,) = nominal.block.priors.mounts
    reference = eqx.tree_at(lambda p: p.mounts[name].lever_arm, nominal.priors, Weighted(np.zeros(3), np.full(3, 0.05)))
    block = dataclasses.replace(nominal.block, priors=reference)
    nominal = adjust(block, nominal.unknowns, reference)
    wrong = bias(block, "lever-arm", 0.1)
    draws = monte_carlo(nominal, wrong, 1, exterior=True, points=True)
    moved = jnp.array([draws.recorded[f"{name}.lever_arm_{axis}_m"][0] for axis in ("right", "forward", "up")])
    changed = wrong.applied(moved, block)
    assert np.abs(moved).max() > 0.01
    close(draws, 0, adjust(block, nominal.unknowns, changed.priors), nominal, 2e-5)
    assert any(target[0] == "priors" for target in noise(block).targets)
    scalar = eqx.tree_at(lambda p: p.mounts[name].lever_arm, reference, Weighted(0.0, 0.05))
    with pytest.raises(InputError, match="give three"):
        bias(dataclasses.replace(block, priors=scalar), "lever-arm", 0.1)


def test_scatter_under_noise_is_the_covariance():
    nominal = adjusted("cross")
    n = 600
    draws = monte_carlo(nominal, noise(nominal.block), n, seed=1, exterior=True, points=True)
    assert draws.converged.all()
    for values, sigma in zip((draws.shared, draws.exterior, draws.points), sigmas(nominal), strict=True):
        free = sigma > 0
        ratio = values.std(axis=0, ddof=1)[free] / sigma[free]
        # A sample standard deviation has the relative error 1 / sqrt(2 n); five times that for the worst of hundreds.
        assert np.abs(ratio - 1).max() < 5 / np.sqrt(2 * n)
        # The distortion scales the noise of a measured coordinate, but not its weight: two per cent.
        assert abs(ratio.mean() - 1) < 0.03


def test_large_errors_depart_from_first_order_by_their_square():
    nominal = adjusted("cross")
    shift = np.random.default_rng(3).normal(0, 1, (1, 3))

    def change(errors, block):
        rows = block.stations
        return eqx.tree_at(lambda b: b.stations.value, block, rows.value + errors[rows.axis] * (rows.who % 3 - 1.0))

    even = {}
    at = estimates(nominal)[0]
    for size in (0.1, 1.0):
        both_signs = np.concatenate([size * shift, -size * shift])
        run = Readjustment(nominal, change, both_signs)
        (exact,) = run.batches(both_signs)
        change_of_first = run.first_order(both_signs).shared[0] - at
        odd, even[size] = exact.shared[0] - exact.shared[1], exact.shared.mean(axis=0) - at
        # First order neglects the curvature of the residuals, which is small.
        assert odd / 2 == pytest.approx(change_of_first, rel=0.02, abs=0.02 * np.abs(change_of_first).min())
    # The second-order part grows with the square.
    assert even[1.0] / even[0.1] == pytest.approx(np.full(len(at), 100.0), rel=0.1)


def test_a_draw_that_does_not_contract_is_adjusted_by_itself():
    nominal = adjusted("cross")

    def change(turn, block):
        # Stations rotated by a large angle about the vertical: far from the linearisation point of the factor.
        rows = block.stations
        xyz = jnp.asarray(rows.value).reshape(-1, 3)
        c, s = jnp.cos(turn), jnp.sin(turn)
        turned = jnp.stack([c * xyz[:, 0] - s * xyz[:, 1], s * xyz[:, 0] + c * xyz[:, 1], xyz[:, 2]], axis=1)
        return eqx.tree_at(lambda b: b.stations.value, block, turned.reshape(-1))

    turns = np.array([0.0, 1e-4, 0.5])
    draws = readjust(nominal, change, turns, exterior=True, points=True)
    assert list(draws.fallback) == [False, False, True]
    assert draws.converged.all()
    full = adjust(change(turns[2], nominal.block), nominal.unknowns, nominal.priors)
    close(draws, 2, full, nominal, 1e-4)


def test_draws_do_not_depend_on_how_many_there_are():
    nominal = adjusted("cross")
    errors = bias(nominal.block, "station", 0.2, "image")
    few, many = (monte_carlo(nominal, errors, n, seed=7) for n in (2, 140))
    assert np.array_equal(few.shared, many.shared[:2])
    assert all(np.array_equal(values, many.recorded[name][:2]) for name, values in few.recorded.items())
    other = monte_carlo(nominal, errors, 2, seed=8)
    assert not np.array_equal(few.shared, other.shared)


@pytest.mark.parametrize("name", slow_but(["everything"], ["everything", "three_models"]))
@pytest.mark.parametrize("measured", slow_but([True], [True, False]))
def test_rows_that_come_in_chunks_add_up_to_the_same(name, measured):
    nominal, rng = adjusted(name), np.random.default_rng(5)
    near = jax.tree.map(lambda v: rng.normal(0, 0.3, (*v.shape, 3)), nominal.equations.scale)
    xy = np.asarray(nominal.values.xy)
    varying = {"xy": xy[..., None] + rng.normal(0, 0.01, (*xy.shape, 3))} if measured else {}
    whole, chunks = (image_gradients(near, varying, common_of(nominal, at_once)) for at_once in (100_000, 7))
    for one, other in zip(whole, chunks, strict=True):
        assert np.abs(one).max() > 1
        assert np.asarray(other) == pytest.approx(np.asarray(one), rel=1e-11, abs=1e-12 * np.abs(one).max())


def test_a_function_of_ones_own_records_what_it_drew():
    nominal = adjusted("cross")

    def perturb(key, block):
        rise = 0.1 * jax.random.laplace(key)
        heights = block.stations.value + rise * (block.stations.axis == 2)
        return eqx.tree_at(lambda b: b.stations.value, block, heights), {"rise_m": rise}

    draws = monte_carlo(nominal, perturb, 40)
    assert set(draws.recorded) == {"rise_m"}
    c = next(k for k, label in enumerate(draws.labels) if label.endswith("c_mm"))
    # A common change of the heights determines c.
    assert abs(np.corrcoef(draws.recorded["rise_m"], draws.shared[:, c])[0, 1]) > 0.999


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("station", 0.1, "strip", ("S9",)), "unknown strip 'S9'"),
        (("station", 0.1, "image", ("nowhere",)), "unknown image 'nowhere'"),
        (("station", 0.0, None, ()), "above zero"),
        (("station", -0.1, None, ()), "above zero"),
        (("station", (0.1, 0.2), None, ()), "one for each of"),
        (("station", 0.1, "point", ()), "not per point"),
        (("stations", 0.1, None, ()), "unknown kind of bias"),
        (("interior", 0.1, None, ()), "a parameter name"),
        (("lever-arm", 0.1, None, ()), "no mount"),
        (("attitude", 0.1, None, ()), "no observation"),
    ],
)
def test_a_bias_that_cannot_be_is_refused(arguments, words):
    kind, sigma, per, of = arguments
    block = simulated("strips" if per == "strip" else "cross").block
    with pytest.raises(InputError, match=words):
        bias(block, kind, sigma, per, of=of)


def test_a_bias_of_what_is_free_is_refused():
    with pytest.raises(InputError, match="is free"):
        bias(simulated("cross").block, "interior", 0.1, parameter="c_mm")
    with pytest.raises(InputError, match="no parameter 'k9': choose among c_mm"):
        bias(simulated("cross").block, "interior", 0.1, parameter="k9")


@pytest.mark.parametrize("draws", [0, -3])
def test_no_draws_are_refused(draws):
    nominal = adjusted("cross")
    with pytest.raises(InputError, match="must be positive"):
        monte_carlo(nominal, bias(nominal.block, "station", 0.1), draws)


def test_a_perturbation_that_changes_nothing_is_refused():
    with pytest.raises(InputError, match="changes no value"):
        monte_carlo(adjusted("cross"), lambda key, block: block, 3)


def test_a_perturbation_of_more_than_numbers_is_refused():
    fewer = lambda key, block: eqx.tree_at(lambda b: b.stations, block, block.stations.take(np.arange(3)))  # noqa: E731
    held = lambda key, block: eqx.tree_at(lambda b: b.priors.interior["one"].c, block, FIXED)  # noqa: E731
    for perturb in (fewer, held, lambda key, block: block.stations.value):
        with pytest.raises(InputError, match="ids, indices, shapes"), unchecked():
            monte_carlo(adjusted("cross"), perturb, 3)
