"""JAX transformations of blocks and adjustments, compared with finite differences and loops."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxphoto
from jaxphoto import FIXED, FREE, InputError, Weighted, adjust, covariance
from jaxphoto.block import Block
from jaxphoto.static_values import StaticArray
from jaxphoto.statistics import correlations
from jaxphoto.statistics.sigma_map import sigma_map
from jaxphoto.unknowns import is_prior
from tests.blocks import adjusted, simulated

NAME = "mount"
MOUNT = "imu"


@functools.cache
def held() -> Block:
    """Block with a fixed lever arm, and the adjusted values as start values."""
    block = simulated(NAME).block.fix("lever_arm")
    found = adjust(block)
    known = dataclasses.replace(block.start, unknowns=found.unknowns, image_known=np.ones(10, bool))
    return dataclasses.replace(block, start=dataclasses.replace(known, point_known=np.ones(len(block.points), bool)))


def c_of(block, start=None):
    return adjust(block, start).unknowns.interior["one"].c


def arm_of(unknowns):
    return unknowns.mounts[MOUNT].lever_arm


def with_arm(block: Block, arm) -> Block:
    return eqx.tree_at(lambda b: arm_of(b.start.unknowns), block, arm)


def difference(function, at, k, step):
    """Central difference by the k-th number."""
    way = step * np.eye(np.size(at))[k].reshape(np.shape(at))
    return (float(function(at + way)) - float(function(at - way))) / (2 * step)


# The tree -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cross", "mount", "strips", "surfaces", "everything"])
def test_leaves_of_a_block_are_real_numbers(name):
    block = simulated(name).block
    leaves, structure = jax.tree.flatten(block)
    assert all(np.asarray(leaf).dtype == float for leaf in leaves)
    again = jax.tree.unflatten(structure, leaves)
    assert jax.tree.structure(again) == structure and hash(jax.tree.structure(again)) == hash(structure)
    assert list(again.start.unknowns.strips) == list(block.start.unknowns.strips)


def test_order_of_owners_survives_a_transformation():
    block = simulated("strips").block
    turned = {name: block.start.unknowns.strips[name] for name in reversed(block.start.unknowns.strips)}
    unknowns = dataclasses.replace(block.start.unknowns, strips=turned)
    assert list(jax.jit(lambda u: u)(unknowns).strips) == list(turned) != sorted(turned)


def test_structures_differ_by_indices_masks_and_priors():
    block = simulated("cross").block
    kind = jax.tree.structure(block)
    other = dataclasses.replace(block.stations, who=np.asarray(block.stations.who)[::-1])
    assert kind != jax.tree.structure(dataclasses.replace(block, stations=other))
    assert kind != jax.tree.structure(block.fix("k1"))
    unknown = dataclasses.replace(block.start, point_known=np.zeros(len(block.points), bool))
    assert kind != jax.tree.structure(dataclasses.replace(block, start=unknown))
    moved = eqx.tree_at(lambda b: b.stations.value, block, np.asarray(block.stations.value) + 1.0)
    assert kind == jax.tree.structure(moved)


def test_priors_are_nodes_that_can_be_exchanged():
    block = simulated("cross").block
    where = lambda b: b.priors.interior["one"].distortion.k1  # noqa: E731
    fixed = eqx.tree_at(where, block, FIXED)
    assert where(fixed) == FIXED != FREE == where(block)
    assert where(eqx.tree_at(where, fixed, Weighted(0.0, 1e-6))) != FREE
    assert jax.tree.leaves(fixed.priors.points) == [] != jax.tree.leaves(fixed.priors.points, is_leaf=is_prior)
    assert np.zeros(3) != FREE and jnp.zeros(3) != FREE


def test_indices_of_rows_are_plain_arrays_and_stay_the_same():
    rows = simulated("cross").block.stations
    assert type(rows.who) is np.ndarray and jax.vmap(lambda k: k + 1)(rows.who).shape == rows.who.shape
    again = dataclasses.replace(rows, value=np.asarray(rows.value) + 1.0)
    assert again.who is rows.who and rows.take(np.arange(len(rows))).who is not rows.who


def test_a_static_array_is_an_array():
    index = StaticArray([2, 0, 1])
    assert type(index == 2) is np.ndarray and type(index[1:]) is np.ndarray and type(index.astype(float)) is np.ndarray
    assert (jnp.arange(3.0)[index] == np.array([2.0, 0.0, 1.0])).all()
    assert jax.jit(lambda i: i)(index).tolist() == [2, 0, 1]
    with pytest.raises(ValueError, match="read-only"):
        index[0] = 1


# Blocks and adjustments as arguments ---------------------------------------------------------------------------


def test_jit_takes_blocks_and_shares_programs():
    traces = []

    def c(block, start):
        traces.append(0)
        return c_of(block, start)

    block, start, compiled = simulated("cross").block, adjusted("cross").unknowns, jax.jit(c)
    for one in (block, block.shift_stations([0.0, 0.0, 0.05])):
        assert float(compiled(one, start)) == pytest.approx(float(c_of(one, start)), rel=1e-9)
    assert len(traces) == 1


def test_gradient_by_the_whole_block_and_its_start():
    """One parameter of the second camera has a prior."""
    block, start = simulated("two_cameras").block, adjusted("two_cameras").unknowns
    gradient, by_start = jax.jit(jax.grad(c_of, argnums=(0, 1)))(block, start)
    assert jax.tree.structure(gradient) == jax.tree.structure(block)
    for where, k, step in (
        (lambda b: b.stations.value, 2, 0.02),
        (lambda b: b.stations.sigma, 5, 1e-3),
        (lambda b: b.image_points.xy, 7, 1e-4),
        (lambda b: b.image_points.sigma, 11, 1e-5),
        (lambda b: b.control.value, 1, 0.01),
        (lambda b: b.control.sigma, 2, 1e-4),
        (lambda b: b.priors.interior["two"].distortion.p1.value, 0, 1e-7),
        (lambda b: b.priors.interior["two"].distortion.p1.sigma, 0, 1e-7),
    ):
        # Adjusted twice, to remove the iteration error.
        changed = lambda v, where=where: eqx.tree_at(where, block, v)  # noqa: E731
        moved = lambda v, b=changed: c_of(b(v), adjust(b(v), start).unknowns)  # noqa: E731
        expected = difference(moved, np.asarray(where(block)), k, step)
        assert float(np.ravel(where(gradient))[k]) == pytest.approx(expected, rel=2e-3, abs=1e-7)
    # Estimates do not depend on their start values.
    assert np.abs(by_start.points).max() < 1e-12 and np.abs(by_start.interior["one"].c) < 1e-12


@functools.cache
def by_arm():
    """Differences of c by the lever arm, which is fixed, in the start values."""
    start, arm = held().start.unknowns, np.asarray(arm_of(held().start.unknowns))
    moved = lambda a: c_of(held(), eqx.tree_at(arm_of, start, a))  # noqa: E731
    found = np.array([difference(moved, arm, k, 0.01) for k in range(3)])
    assert np.abs(found).max() > 1e-3
    return found


@pytest.mark.slow
def test_derivative_by_a_fixed_lever_arm_of_the_block():
    """Without `start` the block's own values count, by themselves and as a part of the block."""
    block = held()
    arm = np.asarray(arm_of(block.start.unknowns))
    gradient, by_start = jax.jit(jax.grad(c_of, argnums=(0, 1)))(block, block.start.unknowns)
    assert np.abs(arm_of(gradient.start.unknowns)).max() == 0
    np.testing.assert_allclose(arm_of(by_start), by_arm(), rtol=1e-3, atol=1e-6)
    of_block = eqx.filter_jit(eqx.filter_grad(c_of))(block)
    np.testing.assert_allclose(arm_of(of_block.start.unknowns), by_arm(), rtol=1e-3, atol=1e-6)
    both = lambda a: c_of(with_arm(block, a), with_arm(block, a).start.unknowns)  # noqa: E731
    for way in (lambda a: c_of(with_arm(block, a)), both):
        found = [difference(way, arm, k, 0.01) for k in range(3)]
        np.testing.assert_allclose(found, by_arm(), rtol=1e-6, atol=1e-9)


def test_start_values_that_do_not_count_are_refused():
    block = simulated(NAME).block.fix("lever_arm")
    arm = np.asarray(arm_of(block.start.unknowns))
    for transformed in (jax.grad, lambda f: jax.jit(jax.grad(f))):
        with pytest.raises(InputError, match="start"):
            transformed(lambda a: c_of(with_arm(block, a), block.start.unknowns))(arm)


@pytest.mark.slow
def test_vmap_over_blocks_is_the_loop():
    block, start = simulated("cross").block, adjusted("cross").unknowns
    blocks = [block.shift_stations([0.0, 0.0, rise]) for rise in (-0.1, 0.05)]
    stacked = jax.tree.map(lambda *v: jnp.stack(v), *blocks)
    found = jax.jit(jax.vmap(lambda b: c_of(b, start)))(stacked)
    np.testing.assert_allclose(found, [float(c_of(b, start)) for b in blocks], rtol=1e-9)


def test_approximate_values_are_found_inside_a_transformation():
    block = simulated("cross").block
    unknown = dataclasses.replace(block.start, point_known=np.zeros(len(block.points), bool))
    bare = dataclasses.replace(block, start=unknown)
    assert float(jax.jit(c_of)(bare)) == pytest.approx(float(c_of(block)), rel=1e-8)
    nowhere = dataclasses.replace(bare, start=dataclasses.replace(unknown, image_known=np.zeros(10, bool)))
    with pytest.raises(InputError, match=r"adjust\(block, start\)"):
        jax.jit(c_of)(nowhere)


def test_adjustments_go_in_and_out():
    a = adjusted("cross")
    out = jax.jit(adjust)(a.block, a.unknowns)
    assert float(out.sigma0) == pytest.approx(float(a.sigma0), rel=1e-9)
    assert jax.tree.structure(jax.device_put(a)) == jax.tree.structure(a)
    moved = jax.device_put(a.block)
    np.testing.assert_array_equal(moved.stations.value, a.block.stations.value)
    expected = covariance(a)
    for found in (jax.jit(covariance)(a), eqx.filter_jit(covariance)(out)):
        np.testing.assert_allclose(found.matrix, expected.matrix, rtol=1e-6, atol=1e-9 * expected.matrix.max())


# Statistics ----------------------------------------------------------------------------------------------------


def summary(block: Block, start):
    """Numbers of each kind of statistics: a standard deviation, a correlation, a projection uncertainty."""
    a = adjust(block, start)
    known = covariance(a)
    rho = correlations(a, known)["one"]
    seen = sigma_map(a, points=np.array([[10.0, -5.0]]))
    return jnp.stack([known.shared_sigma[0], rho.exterior[2, 4, 0], rho.max_abs[0, 1], seen.worst[0]])


@pytest.mark.slow
def test_statistics_are_functions_of_the_block():
    block, start = simulated("cross").block, adjusted("cross").unknowns

    def of_sigma(factor):
        return summary(eqx.tree_at(lambda b: b.stations.sigma, block, factor * block.stations.sigma), start)

    at = jnp.array([1.0, 1.3])
    mapped, slopes = jax.jit(jax.vmap(lambda f: jax.jvp(of_sigma, (f,), (1.0,))))(at)
    np.testing.assert_allclose(mapped, [of_sigma(1.0), of_sigma(1.3)], rtol=1e-6)
    h = 1e-3
    expected = (of_sigma(1 + h) - of_sigma(1 - h)) / (2 * h)
    np.testing.assert_allclose(slopes[0], expected, rtol=1e-3, atol=1e-6)


# What is refused -------------------------------------------------------------------------------------------------


def test_what_cannot_be_traced_says_so():
    a = adjusted("cross")
    for function in (jaxphoto.Tables, lambda a: a.verdict(), lambda a: a.outcome, lambda a: a.plot()):
        with pytest.raises(InputError, match="outside"):
            jax.jit(lambda a, function=function: function(a) and 0.0)(a)
    with pytest.raises(InputError, match="outside"):
        jax.jit(lambda b: jaxphoto.write_block(b, "nowhere") or 0.0)(a.block)
