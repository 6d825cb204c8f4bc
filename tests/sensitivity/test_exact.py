"""Exact derivatives of an adjustment: by central differences of full adjustments, dense matrices and `jax.grad`."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxphoto
from jaxphoto import Weighted, adjust, covariance
from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.parameter_tables import shared_vector
from jaxphoto.camera import Agisoft, OpenCv, set_parameter
from jaxphoto.camera.conversion import converted
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Corrections
from jaxphoto.sensitivity import image_rows as listed
from jaxphoto.sensitivity.exact import response, sensitivity
from jaxphoto.sensitivity.hessian import image_columns
from jaxphoto.unknowns import FIXED, FREE
from tests.adjustment.dense import couples, in_one_list, own_order
from tests.blocks import adjusted, simulated
from tests.marks import slow_but
from tests.test_examples import ROOT

POINTS = ("p1", "p17")


@functools.cache
def nominal(name: str):
    """An adjustment restarted at its optimum, where the constraints of a free network refer to it."""
    block = simulated(name).block
    return adjust(block, adjusted(name).unknowns)


@functools.cache
def derivatives(name: str, curvature: bool = True):
    return sensitivity(nominal(name), curvature=curvature, points=POINTS)


def estimates(name: str, unknowns) -> np.ndarray:
    """Estimates in the order of the rows of `Sensitivity`."""
    a = nominal(name)
    exterior = np.hstack([unknowns.exterior.position, np.asarray(unknowns.exterior.omega_phi_kappa)])
    shared = np.array(
        shared_vector(unknowns, [n for g in a.structure.groups for n in g.names], a.structure.tables), float
    )[a.structure.free]
    at = [a.block.points.index(p) for p in POINTS]
    return np.concatenate([exterior.ravel(), shared, np.asarray(unknowns.points)[at].ravel()])


@functools.cache
def sigmas(name: str) -> np.ndarray:
    """Standard deviations of the estimates; 1 for fixed ones."""
    cov, a = covariance(nominal(name)), nominal(name)
    at = [a.block.points.index(p) for p in POINTS]
    variance = np.concatenate([np.diagonal(cov.matrix), np.diagonal(cov.points[at], axis1=1, axis2=2).ravel()])
    return np.sqrt(np.where(variance > 0, variance, 1.0))


def difference(name: str, changed, step: float) -> np.ndarray:
    """Fourth-order central difference of full adjustments; `changed(h)` returns block, start, priors."""

    def readjusted(h: float) -> np.ndarray:
        block, unknowns, priors = changed(h)
        # Twice more, so that the iteration error vanishes.
        for _ in range(3):
            unknowns = adjust(block, unknowns, priors).unknowns
        return estimates(name, unknowns)

    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    return np.sum([w * readjusted(m * step) for m, w in weights.items()], axis=0) / (12 * step)


def relative_error(name: str, computed: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference in standard deviations, relative to the largest effect."""
    size = np.abs(expected / sigmas(name)).max()
    assert size > 1e-6, "no estimate depends on it: the check would pass for any derivative"
    return float(np.abs((computed - expected) / sigmas(name)).max() / size)


def moved(name: str, where, index, h):
    """The block with one value changed."""
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
    assert relative_error("everything", exact, expected) < 1e-6
    # The classical matrix neglects the curvature of the residuals.
    assert 1e-5 < relative_error("everything", first, expected) < 0.1


@pytest.mark.slow
def test_derivative_by_a_surface_of_the_laser_scanner() -> None:
    """A point on surfaces of two strips, changed along the normal of one."""
    a = nominal("surfaces")
    row = 35
    normal = a.block.surfaces.normal[row]
    where = lambda b: b.surfaces.foot  # noqa: E731
    expected = difference("surfaces", lambda h: moved("surfaces", where, row, h * normal), 0.05)
    exact, first = (derivatives("surfaces", c)["surfaces"][:, row] for c in (True, False))
    assert relative_error("surfaces", exact, expected) < 1e-6
    assert 1e-5 < relative_error("surfaces", first, expected) < 0.1


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
    assert relative_error("everything", derivatives("everything")["priors"][:, lever_arm], expected) < 1e-6


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
    result = derivatives("everything")
    assert relative_error("everything", result.fixed[:, result.fixed_labels.index(label)], expected) < 1e-6


@pytest.mark.slow
def test_derivative_by_a_fixed_lever_arm() -> None:
    block, truth = simulated("mount")
    priors = eqx.tree_at(lambda p: p.mounts["imu"].lever_arm, block.priors, FIXED)
    a = adjust(block, truth, priors)
    result = sensitivity(a, curvature=True)
    column = result.fixed_labels.index("mounts[imu].lever_arm_forward_m")
    row = result.row("yp")

    def principal_point(h: float) -> float:
        moved = a.unknowns.mounts["imu"].lever_arm + np.array([0, h, 0])
        unknowns = eqx.tree_at(lambda u: u.mounts["imu"].lever_arm, a.unknowns, moved)
        for _ in range(3):
            unknowns = adjust(block, unknowns, priors).unknowns
        return float(unknowns.interior["one"].yp)

    step = 0.05
    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    slope = sum(w * principal_point(m * step) for m, w in weights.items()) / (12 * step)
    assert result.fixed[row, column] == pytest.approx(slope, rel=1e-6)
    assert abs(slope) > 1e-4


@pytest.mark.parametrize("group", ["image_points", "distances"])
def test_free_network(group: str) -> None:
    where, index, _ = OBSERVATIONS[group]
    step = 0.002 if group == "image_points" else 1e-4
    expected = difference("inner", lambda h: moved("inner", where, index, h), step)
    at = (slice(None), *np.atleast_1d(index))
    assert relative_error("inner", derivatives("inner")[group][at], expected) < 1e-6


@pytest.mark.parametrize("curvature", slow_but([True], [True, False]))
def test_response_is_the_sum_of_derivatives(curvature: bool) -> None:
    a, result = nominal("everything"), derivatives("everything", curvature)
    rng = np.random.default_rng(3)
    heights = 0.1 * rng.normal(size=len(a.block.stations.value))
    xy = 0.004 * rng.normal(size=a.block.image_points.xy.shape)
    where = lambda b: (b.stations.value, b.image_points.xy)  # noqa: E731
    block = eqx.tree_at(where, a.block, (a.block.stations.value + heights, a.block.image_points.xy + xy))
    change = response(a, block, curvature=curvature)
    angles = eqx.tree_at(lambda u: u.exterior, change.unknowns, _Exterior(change))
    expected = result["stations"] @ heights + np.einsum("ero,ro->e", result["image_points"], xy)
    assert relative_error("everything", estimates("everything", angles), expected) < 1e-9


class _Exterior:
    """Exterior orientation with changes instead of angles."""

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
    result = derivatives("inner", False)["distances"]
    positions = result[: 6 * images].reshape(images, 6, -1)[:, :3].swapaxes(0, 1).reshape(3 * images, -1)
    of_shared = slice(6 * images, 6 * images + shared)
    for mine, dense in ((positions, change[: 3 * images]), (result[of_shared], change[of_shared])):
        np.testing.assert_allclose(mine, dense, rtol=0, atol=1e-7 * np.abs(dense).max())


def test_a_point_that_does_not_exist() -> None:
    with pytest.raises(InputError, match="unknown point nowhere"):
        sensitivity(nominal("everything"), points=("p1", "nowhere"))


def test_an_adjustment_that_did_not_converge() -> None:
    a = adjust(simulated("cross").block, simulated("cross").block.start.unknowns, max_steps=1)
    with pytest.raises(InputError, match="needs a converged adjustment"):
        sensitivity(a)


def test_other_rows_than_the_adjusted_ones() -> None:
    a = nominal("everything")
    block = eqx.tree_at(lambda b: b.stations, a.block, a.block.stations.take(np.arange(len(a.block.stations) - 1)))
    with pytest.raises(InputError, match="other rows"):
        response(a, block)


STATION = 14


def scalar(result):
    """Sum of unknowns, residuals, sigma naught and standard deviations."""
    cov = covariance(result)
    sigmas = 100 * cov.shared_sigma[0] + 10 * cov.exterior_sigma[2, 4] + cov.point_sigma[3, 2]
    return result.sigma0 + result.residuals["control_points"][3] + result.unknowns.interior["one"].c + sigmas


def with_station(height, unknowns):
    """The cross block adjusted with the height of one station changed (m)."""
    block = adjusted("cross").block
    move = height * (np.arange(len(block.stations.value)) == STATION)
    return adjust(eqx.tree_at(lambda b: b.stations.value, block, block.stations.value + move), unknowns)


@pytest.mark.slow
def test_gradient_of_statistics_in_jit_and_vmap() -> None:
    start = adjusted("cross").unknowns
    heights = np.array([0.0, 0.2])
    gradient = jax.jit(jax.vmap(jax.grad(lambda h: scalar(with_station(h, start)))))
    actual = np.asarray(gradient(jnp.asarray(heights)))

    def readjusted(height: float) -> float:
        unknowns = start
        for _ in range(3):
            result = with_station(height, unknowns)
            unknowns = result.unknowns
        return float(scalar(result))

    step = 0.05
    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    for k, height in enumerate(heights):
        slope = sum(w * readjusted(height + m * step) for m, w in weights.items()) / (12 * step)
        assert actual[k] == pytest.approx(slope, rel=1e-6)


def test_statistics_of_a_batch_are_asked_for_inside() -> None:
    nominal = adjusted("cross")
    values = jax.tree.map(lambda v: np.stack([v, v]), nominal.padded_values)
    with pytest.raises(ValueError, match="inside the function that jax"):
        _ = dataclasses.replace(nominal, padded_values=values, factored=None).equations


def leaves_of(model):
    block = jaxphoto.read_block(ROOT / "examples/cross_block")
    ((name, values),) = block.start.unknowns.interior.items()
    interior = jax.tree.map(np.asarray, converted(values, model, block.sensors[name]).interior)
    priors = jax.tree.map(lambda _: FIXED, interior)
    for parameter in ("c_mm", "xp_mm", "yp_mm", "k1", "k2"):
        priors = set_parameter(priors, parameter, FREE)
    unknowns = dataclasses.replace(block.start.unknowns, interior={name: interior})
    block = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, interior={name: priors}),
    )
    derivatives = sensitivity(jaxphoto.adjust(block))
    return [np.asarray(v) for v in jax.tree.leaves(derivatives) if hasattr(v, "dtype")]


@pytest.fixture(scope="module")
def both():
    return leaves_of(OpenCv), leaves_of(Agisoft)


@pytest.mark.slow
def test_two_names_of_one_camera_have_one_sensitivity(both):
    # Regression test for "mul got incompatible shapes"; with these coefficients both are the same polynomial.
    of_opencv, of_agisoft = both
    # Image points, stations and control.
    assert len(of_opencv) == len(of_agisoft) == 3
    for one, other in zip(of_opencv, of_agisoft, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * max(np.abs(one).max(initial=0), 1e-300))
    assert max(np.abs(v).max(initial=0) for v in of_opencv) > 1


# The row tested.
ROW = 57


@functools.cache
def corrected():
    """Two cameras of different models, refraction and curvature of the earth: everything a row may depend on."""
    block = simulated("everything").block
    block = dataclasses.replace(block, corrections=Corrections(refraction=True, curvature=True, sea_level_m=-50.0))
    return adjust(block, adjusted("everything").unknowns, max_steps=2)


@functools.cache
def dense_products():
    """Second derivatives of all residuals by the unknowns and the measurement of `ROW`, as functions of `curved`, and
    the mask of the columns of shared unknowns."""
    a = corrected()
    structure, places, equations = a.structure, a.padded.places, a.equations
    s, scale = equations.structure, jax.tree.map(jnp.asarray, equations.scale)
    values, zero = jax.tree.map(jnp.asarray, equations.weighed.values), jax.tree.map(jnp.zeros_like, scale)
    batch, m, p = np.unravel_index(places.row[ROW], s.rays.ray_point.shape)
    image, point = places.image[structure.image[ROW]], places.point[structure.point[ROW]]
    columns = np.asarray(image_columns(s))[image, 6:] - 6 * s.n_images

    def half_square(y, xy, curved):
        """Half the square of the row's residuals, with the second derivative J'J + curved r d2r."""
        shared = zero.shared.at[columns].add(y[9:], mode="drop")
        moved = Increments(zero.eop.at[:, image].set(y[:6]), shared, zero.points.at[:, point].set(y[6:9]))
        v = eqx.tree_at(lambda v: v.xy, values, jnp.asarray(values.xy).at[batch, :, m, p].set(xy))
        r = Linearised(moved, scale, v, s).residuals().image[batch, :, m, p]
        return jnp.sum(0.5 * r * r - (1 - curved) * jax.lax.stop_gradient(r) * r)

    at = jnp.zeros(9 + len(columns)), jnp.asarray(values.xy)[batch, :, m, p]
    return functools.partial(jax.jit(jax.hessian(half_square, (0, 1))), *at), columns < s.n_shared


@pytest.mark.slow
@pytest.mark.parametrize("curved", [0.0, 1.0])
@pytest.mark.parametrize("at_once", [8192, 64])
def test_products_of_rows_are_the_dense_ones(curved: float, at_once: int, monkeypatch) -> None:
    monkeypatch.setattr(listed, "_BATCH", at_once)
    a = corrected()
    s, scale = a.equations.structure, jax.tree.map(jnp.asarray, a.equations.scale)
    values, rows = jax.tree.map(jnp.asarray, a.equations.weighed.values), listed.image_rows(a)
    result = eqx.filter_jit(listed.row_products)(values, scale, rows, jnp.asarray(curved), s)

    products, there = dense_products()
    (h, b), _ = products(jnp.asarray(curved))
    kept = np.append(np.full(9, True), there)
    by_point = np.where(kept[:, None], result.by_point[:, :, ROW], 0.0)
    np.testing.assert_allclose(by_point, h[:, 6:9], rtol=0, atol=1e-12 * np.abs(h).max())
    np.testing.assert_allclose(-result.measured[ROW].T, b, rtol=0, atol=1e-12 * np.abs(b).max())
