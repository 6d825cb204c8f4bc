"""Exact derivatives of an adjustment against central differences of full ones, and the first-order matrix."""

import functools
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxphoto import FIXED, Weighted, adjust, covariance
from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.model.parameter_tables import shared_vector
from jaxphoto.errors import InputError
from jaxphoto.sensitivity.exact import response, sensitivity
from tests.adjustment.dense import couples, in_one_list, own_order
from tests.blocks import adjusted, simulated

POINTS = ("p1", "p17")


@functools.cache
def nominal(name: str):
    """An adjustment from its own optimum: constraints of a free network hold it there, as those of the differences."""
    block = simulated(name).block
    return adjust(block, adjusted(name).unknowns)


@functools.cache
def derivatives(name: str, curvature: bool = True):
    return sensitivity(nominal(name), curvature=curvature, points=POINTS)


def estimates(name: str, unknowns) -> np.ndarray:
    """What `Sensitivity` has a row of each, in this order."""
    a = nominal(name)
    exterior = np.hstack([unknowns.exterior.position, np.asarray(unknowns.exterior.omega_phi_kappa)])
    shared = np.array(
        shared_vector(unknowns, [n for g in a.structure.groups for n in g.names], a.structure.tables), float
    )[a.structure.free]
    at = [a.block.points.index(p) for p in POINTS]
    return np.concatenate([exterior.ravel(), shared, np.asarray(unknowns.points)[at].ravel()])


@functools.cache
def sigmas(name: str) -> np.ndarray:
    """Standard deviations of the estimates, so that all of them can be compared; 1 of what is fixed."""
    cov, a = covariance(nominal(name)), nominal(name)
    at = [a.block.points.index(p) for p in POINTS]
    variance = np.concatenate([np.diagonal(cov.matrix), np.diagonal(cov.points[at], axis1=1, axis2=2).ravel()])
    return np.sqrt(np.where(variance > 0, variance, 1.0))


def difference(name: str, changed, step: float) -> np.ndarray:
    """Fourth-order central difference of full adjustments; `changed(h)` gives block, start, priors."""

    def adjusted_anew(h: float) -> np.ndarray:
        block, unknowns, priors = changed(h)
        # Twice more, so that nothing of the iteration is left.
        for _ in range(3):
            unknowns = adjust(block, unknowns, priors).unknowns
        return estimates(name, unknowns)

    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    return np.sum([w * adjusted_anew(m * step) for m, w in weights.items()], axis=0) / (12 * step)


def off(name: str, found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference in standard deviations, relative to the largest effect."""
    size = np.abs(expected / sigmas(name)).max()
    assert size > 1e-6, "nothing depends on it: the check would pass for any derivative"
    return float(np.abs((found - expected) / sigmas(name)).max() / size)


def moved(name: str, where, index, h):
    """The block with one number changed."""
    a = nominal(name)
    values = np.array(where(a.block), float)
    values[index] += h
    return eqx.tree_at(where, a.block, values), a.unknowns, a.priors


OBSERVATIONS: dict[str, Any] = {
    "image_points": (lambda b: b.image_points.xy, (40, 0), 0.004),
    "stations": (lambda b: b.stations.value, 14, 0.05),
    "attitudes": (lambda b: b.attitudes.roll_pitch_yaw, (2, 1), 1e-4),
    "control_points": (lambda b: b.control.value, 4, 0.03),
    "distances": (lambda b: b.distances.value, 1, 0.03),
}


@pytest.mark.parametrize("group", OBSERVATIONS)
def test_derivatives_by_observations_are_those_of_full_adjustments(group: str) -> None:
    where, index, step = OBSERVATIONS[group]
    expected = difference("everything", lambda h: moved("everything", where, index, h), step)
    at = (slice(None), *np.atleast_1d(index))
    exact, first = (derivatives("everything", c)[group][at] for c in (True, False))
    assert off("everything", exact, expected) < 1e-6
    # The classical matrix leaves out the residuals' curvature, which is what makes the difference.
    assert 1e-5 < off("everything", first, expected) < 0.1


@pytest.mark.slow
def test_derivative_by_a_surface_of_the_laser_scanner() -> None:
    """Of a point that lies on surfaces of two strips, both along the normal of one."""
    a = nominal("surfaces")
    row = 35
    normal = a.block.surfaces.normal[row]
    where = lambda b: b.surfaces.foot  # noqa: E731
    expected = difference("surfaces", lambda h: moved("surfaces", where, row, h * normal), 0.05)
    exact, first = (derivatives("surfaces", c)["surfaces"][:, row] for c in (True, False))
    assert off("surfaces", exact, expected) < 1e-6
    assert 1e-5 < off("surfaces", first, expected) < 0.1


def test_derivative_by_a_weighted_prior() -> None:
    a = nominal("everything")
    (priors,) = (g for g in a.structure.observed if g.name == "priors")
    weighted = [a.structure.labels[k] for k in priors.column[0]]
    lever_arm = weighted.index("mounts[imu].lever_arm_up_m")

    def changed(h):
        prior = a.priors.mounts["imu"].lever_arm
        prior = Weighted(np.asarray(prior.value) + np.array([0, 0, h]), prior.sigma)
        return a.block, a.unknowns, eqx.tree_at(lambda p: p.mounts["imu"].lever_arm, a.priors, prior)

    expected = difference("everything", changed, 0.05)
    assert off("everything", derivatives("everything")["priors"][:, lever_arm], expected) < 1e-6


@pytest.mark.parametrize("label", ["interior[two].k2", "interior[one].b1", "points[p17].Y"])
def test_derivatives_by_what_is_fixed(label: str) -> None:
    a = nominal("everything")
    steps = {"interior[two].k2": 1e-9, "interior[one].b1": 1e-6, "points[p17].Y": 0.02}

    def changed(h):
        if label.startswith("points"):
            return moved("everything", lambda b: b.fixed.value, 1, h)
        camera, name = label.removeprefix("interior[").split("].")
        where = lambda u: getattr(u.interior[camera].distortion, name)  # noqa: E731
        return a.block, eqx.tree_at(where, a.unknowns, where(a.unknowns) + h), a.priors

    expected = difference("everything", changed, steps[label])
    found = derivatives("everything")
    assert off("everything", found.fixed[:, found.fixed_labels.index(label)], expected) < 1e-6


@pytest.mark.slow
def test_derivative_by_a_fixed_lever_arm() -> None:
    block, truth = simulated("mount")
    priors = eqx.tree_at(lambda p: p.mounts["imu"].lever_arm, block.priors, FIXED)
    a = adjust(block, truth, priors)
    found = sensitivity(a, curvature=True)
    column = found.fixed_labels.index("mounts[imu].lever_arm_forward_m")
    row = found.row("interior[one].yp_mm")

    def principal_point(h: float) -> float:
        moved = a.unknowns.mounts["imu"].lever_arm + np.array([0, h, 0])
        unknowns = eqx.tree_at(lambda u: u.mounts["imu"].lever_arm, a.unknowns, moved)
        for _ in range(3):
            unknowns = adjust(block, unknowns, priors).unknowns
        return float(unknowns.interior["one"].y_p)

    step = 0.05
    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    slope = sum(w * principal_point(m * step) for m, w in weights.items()) / (12 * step)
    assert found.fixed[row, column] == pytest.approx(slope, rel=1e-6)
    assert abs(slope) > 1e-4


@pytest.mark.parametrize("group", ["image_points", "distances"])
def test_free_network(group: str) -> None:
    where, index, _ = OBSERVATIONS[group]
    step = 0.002 if group == "image_points" else 1e-4
    expected = difference("inner", lambda h: moved("inner", where, index, h), step)
    at = (slice(None), *np.atleast_1d(index))
    assert off("inner", derivatives("inner")[group][at], expected) < 1e-6


@pytest.mark.parametrize("curvature", [True, False])
def test_response_is_the_sum_of_derivatives(curvature: bool) -> None:
    a, found = nominal("everything"), derivatives("everything", curvature)
    rng = np.random.default_rng(3)
    heights = 0.1 * rng.normal(size=len(a.block.stations.value))
    xy = 0.004 * rng.normal(size=a.block.image_points.xy.shape)
    where = lambda b: (b.stations.value, b.image_points.xy)  # noqa: E731
    block = eqx.tree_at(where, a.block, (a.block.stations.value + heights, a.block.image_points.xy + xy))
    change = response(a, block, curvature=curvature)
    angles = eqx.tree_at(lambda u: u.exterior, change.unknowns, _Exterior(change))
    expected = found["stations"] @ heights + np.einsum("ero,ro->e", found["image_points"], xy)
    assert off("everything", estimates("everything", angles), expected) < 1e-9


class _Exterior:
    """Stands for an exterior orientation whose angles are changes."""

    def __init__(self, change):
        self.position, self.omega_phi_kappa = change.unknowns.exterior.position, change.omega_phi_kappa


@pytest.mark.slow
def test_first_order_matrix_is_the_dense_one() -> None:
    """-N^-1 J' dr of the distances of a free network, from the dense Jacobian of all residuals."""
    a = nominal("inner")
    s, scale, values = a.equations.structure, a.equations.scale, a.equations.weighed.values
    flat, back = ravel_pytree(jax.tree.map(np.zeros_like, scale))
    at = lambda y: in_one_list(Linearised(back(y), scale, values, s).residuals())  # noqa: E731
    unknowns, rows = own_order(values, a.padded)
    j = np.asarray(jax.jit(jax.jacfwd(at))(flat))[np.ix_(rows, unknowns)]
    coupled = j[couples(a)]
    distances = coupled[: len(coupled) - len(a.residuals.datum)]
    change = -np.linalg.solve(j.T @ j, distances.T) / np.asarray(a.block.distances.sigma)
    change *= ravel_pytree(scale)[0][unknowns][:, None]
    images, shared = len(a.block.images), a.structure.n_shared
    found = derivatives("inner", False)["distances"]
    positions = found[: 6 * images].reshape(images, 6, -1)[:, :3].swapaxes(0, 1).reshape(3 * images, -1)
    of_shared = slice(6 * images, 6 * images + shared)
    for mine, dense in ((positions, change[: 3 * images]), (found[of_shared], change[of_shared])):
        np.testing.assert_allclose(mine, dense, rtol=0, atol=1e-7 * np.abs(dense).max())


def test_a_point_that_does_not_exist() -> None:
    with pytest.raises(InputError, match="no point nowhere"):
        sensitivity(nominal("everything"), points=("p1", "nowhere"))


def test_an_adjustment_that_did_not_converge() -> None:
    a = adjust(simulated("cross").block, simulated("cross").block.start.unknowns, max_steps=1)
    with pytest.raises(InputError, match="has not converged"):
        sensitivity(a)


def test_other_rows_than_the_adjusted_ones() -> None:
    a = nominal("everything")
    block = eqx.tree_at(lambda b: b.stations, a.block, a.block.stations.take(np.arange(len(a.block.stations) - 1)))
    with pytest.raises(InputError, match="other rows"):
        response(a, block)
