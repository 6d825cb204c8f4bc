"""The structured adjustment against dense linear algebra, on every kind of block."""

import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from jax.flatten_util import ravel_pytree

from jaxphoto import adjust, covariance
from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.layout import padding
from jaxphoto.adjustment.layout.rays import sizes_of
from jaxphoto.adjustment.model.numbers import state_at, zero_increments
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.elimination import gradient, solve_factored, solve_reduced
from jaxphoto.adjustment.solver.optimum import typical_scale, unit_scale, weigh_datum
from jaxphoto.adjustment.solver.reduced import linearise_rows, reduce_normal
from jaxphoto.statistics import redundancy_numbers
from tests.adjustment.dense import DAMPINGS, assemble, at_optimum, in_one_list, prepared, split
from tests.blocks import FIELDS, VARIANTS, adjusted, covariance_of, simulated
from tests.marks import slow_but

# Each shape of block is compiled for itself: what one camera, two, and a mount without more would show, the others
# do. The other kinds (surfaces of a lidar, fixed control, free shifts, ...) are slow only by what compiling takes; all
# of them together are in `tests.test_declared`.
QUICK = ("inner", "inner_images", "inner_some", "minimal")
KINDS = slow_but(QUICK, [name for name in VARIANTS if name not in ("cross", "two_cameras", "mount")])
KINDS += slow_but((), FIELDS)
# The defect of each.
FREE_NETWORKS = {"inner": 6, "inner_images": 6, "inner_some": 6, "inner_scale": 7, "inner_shift": 3, "minimal": 6}


@pytest.mark.parametrize("name", KINDS)
def test_rays_give_the_jacobian_of_image_rows_entry_by_entry(name):
    a, dense = adjusted(name), at_optimum(name)
    found = assemble(dense, a.structure)
    expected = dense.jacobian[: len(found)]
    scale = np.abs(expected).max()
    assert scale > 0
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13 * scale)
    # A residual is a difference of coordinates, and has their rounding errors.
    rows = a.block.image_points
    rounding = 4 * np.finfo(float).eps * np.abs(rows.xy / rows.sigma).max()
    assert rounding < 1e-10
    np.testing.assert_allclose(dense.columns.residual.ravel(), dense.residuals[: len(found)], rtol=0, atol=rounding)


@pytest.mark.parametrize("name", KINDS)
def test_sums_are_products_with_the_jacobian(name):
    dense = at_optimum(name)
    terms = np.abs(dense.jacobian).T @ np.abs(dense.residuals)
    for found in (dense.gradient, dense.sums):
        np.testing.assert_allclose(found, dense.jacobian.T @ dense.residuals, atol=1e-13 * terms.max())
    np.testing.assert_allclose(dense.square_sums, (dense.residuals**2).sum(), rtol=1e-12)
    np.testing.assert_allclose(*dense.taken_down, atol=1e-11 * terms.max())


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("name", KINDS)
def test_elimination_solves_the_dense_normal_equations(name, damping):
    dense = at_optimum(name)
    j = dense.jacobian[:, dense.free]
    n = j.T @ j + damping * np.diag(dense.weight[dense.free])
    # By Cholesky of the whole matrix; the error is measured in the matrix' own metric.
    expected = scipy.linalg.cho_solve(scipy.linalg.cho_factor(n), dense.vector[dense.free])
    found = dense.solutions[DAMPINGS.index(damping)]
    assert (found[~dense.free] == 0).all()
    error = found[dense.free] - expected
    assert np.sqrt(error @ n @ error) < 1e-9 * np.sqrt(expected @ n @ expected)


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("name", slow_but(("inner",), ("everything", "surfaces", "inner", "minimal")))
def test_many_batches_solve_the_normal_equations(name, damping, monkeypatch):
    """Several batches of rays and pairs, some of them padding. Products are those of the whole Jacobian."""
    for limit in ("_RAYS", "_PAIRS", "_FEWEST"):
        monkeypatch.setattr(padding, limit, 256)
    block = simulated(name).block
    sizes = sizes_of(structure_of(block, block.priors))._replace(point_groups=40, chunks=140, pair_chunks=900)
    values, s, _ = prepared(block, sizes=sizes)
    assert 1 < s.rays.used[0, 0] < len(s.rays.chunk_image) and 1 < s.rays.used[0, 1] < len(s.rays.pair)
    # An array, so that one program serves all of them.
    b, *others = _solved(weigh_datum(values, s), s, np.asarray(damping))
    for found in others:
        for one, two in zip(b, found, strict=True):
            np.testing.assert_allclose(two, one, atol=1e-10 * np.abs(one).max())


@eqx.filter_jit
def _solved(values, s, damping):
    """J'r by sums, a gradient and JAX, and (N + damping W) x for the x that solves it: at once, or in two steps."""
    scale = typical_scale(values, s)
    at = Linearised(zero_increments(s), scale, values, s)
    rows = linearise_rows(at)
    a, reduced, right = reduce_normal(at, damping, rows)
    factor = factor_band(a)
    _, j_product = jax.linearize(lambda y: at._replace(increments=y).residuals(), at.increments)
    jt_product = jax.linear_transpose(j_product, at.increments)

    def multiplied(x):
        return jax.tree.map(lambda nx, w, x: nx + damping * w * x, jt_product(j_product(x))[0], reduced.weight, x)

    at_once = solve_factored(reduced, factor, right.b, at)
    before = solve_reduced(reduced, factor, right.reduced, right.d, right.b.points, at)
    return right.b, gradient(rows, at), jt_product(at.residuals())[0], multiplied(at_once), multiplied(before)


@pytest.mark.parametrize("name", KINDS)
def test_gradient_vanishes_at_the_result(name):
    """What a dense Gauss-Newton step would still change, in units of each unknown's standard deviation."""
    dense = at_optimum(name)
    j = dense.jacobian[:, dense.free]
    step = np.linalg.lstsq(j, dense.residuals, rcond=None)[0]
    sigma = np.sqrt(np.diag(np.linalg.inv(j.T @ j)))
    np.testing.assert_array_less(np.abs(step) / sigma, 1e-5)


def dense_covariance(name):
    """Inverse of the dense normal matrix with the datum's constraints imposed exactly, in scaled increments."""
    dense, k = at_optimum(name), adjusted(name).n_constraints
    free, n_free = dense.free, int(dense.free.sum())
    observed, constraints = dense.observed(k)[:, free], dense.jacobian[len(dense.jacobian) - k :, free]
    bordered = np.block([[observed.T @ observed, constraints.T], [constraints, np.zeros((k, k))]])
    q = np.zeros((len(free), len(free)))
    q[np.ix_(free, free)] = np.linalg.inv(bordered)[:n_free, :n_free]
    return q, dense


@pytest.mark.parametrize("name", KINDS)
def test_covariance(name):
    """Every entry of the reduced matrix and of the points' blocks, against the bordered dense inverse."""
    q, at = dense_covariance(name)
    s, cov = adjusted(name).structure, covariance_of(name)
    physical = q * at.scale[:, None] * at.scale[None, :]
    index = split(np.arange(len(at.scale)), s)
    reduced = np.concatenate([index.eop.T.reshape(-1), index.shared])
    expected, found = physical[np.ix_(reduced, reduced)], np.asarray(cov.matrix)
    sigma = np.sqrt(np.diag(expected))
    unit = np.where(sigma > 0, sigma, 1.0)
    assert (found[sigma == 0] == 0).all()
    np.testing.assert_allclose(found / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-7)
    points = np.asarray(cov.points)
    blocks = [physical[np.ix_(own, own)] for own in index.points.T]
    # Points that minimal constraints hold have rounding of the others' size for variances.
    rounding = 1e-12 * np.median([np.trace(block) for block in blocks])
    for found, block in zip(points, blocks, strict=True):
        np.testing.assert_allclose(found, block, atol=max(1e-7 * np.trace(block), rounding))


@pytest.mark.parametrize("name", slow_but(QUICK, FREE_NETWORKS))
def test_covariance_of_a_free_network_does_not_move_along_its_datum(name):
    """Constraints C x = 0 hold exactly, so C Q = 0; over all points, inner constraints give the least trace."""
    q, at = dense_covariance(name)
    n_datum = adjusted(name).n_constraints
    constraints = at.jacobian[len(at.jacobian) - n_datum :]
    assert n_datum == FREE_NETWORKS[name]
    np.testing.assert_allclose(constraints @ q, 0.0, atol=1e-6 * np.abs(q).max())


def test_inner_constraints_over_all_points_have_the_least_trace():
    trace = lambda name: float(np.trace(np.asarray(covariance_of(name).points).sum(0)))  # noqa: E731
    assert all(trace(name) > 1.001 * trace("inner") for name in ("inner_images", "inner_some", "minimal"))


def test_inner_constraints_over_all_points_are_the_pseudo_inverse():
    """About the result itself: the points' covariance is the pseudo-inverse of the normal matrix reduced to them."""
    a, dense = adjusted("inner"), at_optimum("inner")
    again = covariance(adjust(a.block, a.unknowns))
    observed, n_points = dense.observed(a.n_constraints), 3 * a.structure.n_points
    rest, points = observed[:, :-n_points], observed[:, -n_points:]
    projected = points - rest @ np.linalg.lstsq(rest, points, rcond=None)[0]
    values, vectors = np.linalg.eigh(projected.T @ projected)
    assert values[6] > 1e4 * abs(values[5])
    pseudo = (vectors[:, 6:] / values[6:]) @ vectors[:, 6:].T * dense.scale[-1] ** 2
    for p in range(a.structure.n_points):
        own = np.arange(3) * a.structure.n_points + p
        expected = pseudo[np.ix_(own, own)]
        np.testing.assert_allclose(again.points[p], expected, atol=1e-6 * np.trace(expected))


@pytest.mark.parametrize("name", KINDS)
def test_redundancy_numbers(name):
    q, at = dense_covariance(name)
    observed = at.observed(adjusted(name).n_constraints)
    expected = 1 - ((observed @ q) * observed).sum(1)
    numbers = redundancy_numbers(adjusted(name), covariance_of(name))
    found = np.concatenate([np.ravel(v) for v in numbers.named.values()])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert abs(found.sum() - adjusted(name).redundancy) < 1e-4
    assert (found > -1e-6).all()
    assert (found < 1 + 1e-9).all()


@pytest.mark.parametrize("name", slow_but(("inner",), ("everything", "inner")))
def test_scipy_finds_the_same_optimum(name):
    """scipy's dense least squares on the same residuals, from the same start."""
    values, s, padded = prepared(simulated(name).block)
    _, back = ravel_pytree(zero_increments(s))

    def setup(values):
        values = weigh_datum(values, s)
        return values, typical_scale(values, s)

    values, scale = jax.jit(setup)(values)
    of = lambda x: in_one_list(Linearised(back(x), scale, values, s).residuals())  # noqa: E731
    fn = jax.jit(of)
    jac = jax.jit(jax.jacfwd(of))
    free = np.asarray(ravel_pytree(scale)[0]) > 0

    def spread(x):
        full = np.zeros(len(free))
        full[free] = x
        return full

    found = scipy.optimize.least_squares(
        lambda x: np.asarray(fn(spread(x))),
        np.zeros(free.sum()),
        lambda x: np.asarray(jac(spread(x)))[:, free],
        method="trf",
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    )
    a = adjusted(name)
    assert abs(2 * found.cost / float(a.sum_of_squares) - 1) < 1e-9
    increments = jax.tree.map(lambda y, k: y * k, back(spread(found.x)), scale)
    state = padded.crop_state(jax.jit(lambda x: state_at(x, unit_scale(s), values, s))(increments))
    cov = covariance_of(name)
    sigma = np.sqrt(np.diag(np.asarray(cov.matrix)))
    exterior = sigma[: 6 * a.structure.n_images].reshape(-1, 6)
    position = (np.asarray(state.position).T - np.asarray(a.unknowns.exterior.position)) / exterior[:, :3]
    np.testing.assert_array_less(np.abs(position), 1e-3)
    shared = np.asarray(state.shared)[s.free] - np.asarray(a.values.shared)[s.free]
    np.testing.assert_array_less(np.abs(shared) / sigma[6 * a.structure.n_images :], 1e-3)
    points = np.asarray(state.points).T - np.asarray(a.unknowns.points)
    point_sigma = np.sqrt(np.diagonal(np.asarray(cov.points), axis1=1, axis2=2))
    np.testing.assert_array_less(np.abs(points), 1e-3 * point_sigma + 1e-12)
