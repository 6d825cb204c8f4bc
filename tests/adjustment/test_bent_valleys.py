"""Blocks whose principal distance is hardly determined: a straight step leaves the valley of their square sum."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize_scalar

from jaxphoto import Outcome, adjust
from jaxphoto.adjustment import common_sizes
from jaxphoto.adjustment.adjust import build_problem
from jaxphoto.adjustment.iteration_log import step_lines
from jaxphoto.adjustment.model.numbers import state_at
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import typical_scale
from jaxphoto.adjustment.solver.reduced import linearise_rows, reduce_normal
from jaxphoto.adjustment.weakness_messages import weaknesses_of
from jaxphoto.report.results import convergence_words
from jaxphoto.report.tables import convergence_table
from tests.adjustment.dense import in_one_list
from tests.blocks import adjusted, simulated
from tests.marks import slow_but
from tests.simulation.small import made

FLAT = {
    "cameras.kodak.unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2"), "free"),
    "flight.strips": [
        {"name": "A", "heading_deg": 30.0, "images": 4, "count": 2},
        {"name": "B", "heading_deg": 120.0, "images": 4, "count": 2},
    ],
    "jitter": {"position_m": 3.0, "angle_deg": 0.05},
    "terrain": {"kind": "random", "count": 12, "rms_m": 4.0, "length_m": 700.0},
    "points.ties": 80,
    "targets": [{"count": 5, "role": "control"}],
    "sigmas": {"image_mm": 0.002, "control_m": 0.05},
    "noise": {"image_mm": 0.002},
    "start": {"position_m": 10.0, "angle_deg": 0.3},
}
SEEDS = range(1, 9)


@functools.cache
def flat(seed: int):
    """A flat nadir block without stations, 16 images 1000 m above ground."""
    return made(FLAT, seed)


@functools.cache
def optimum(seed: int):
    return adjust(flat(seed).block, sizes=common_sizes(flat(k).block for k in SEEDS))


@pytest.mark.parametrize("seed", SEEDS)
def test_flat_blocks_converge_within_forty_steps(seed):
    found = optimum(seed)
    assert found.outcome is Outcome.CONVERGED and int(found.steps) <= 40
    # What is refused is not taken, and no step makes the square sum larger.
    sums = np.append(found.history.sum_of_squares, float(found.sum_of_squares))
    assert (np.diff(sums) <= 1e-6 * sums[:-1]).all()
    assert (np.diff(sums)[found.history.accepted == 0] == 0).all()


def test_some_steps_follow_a_curve_and_the_course_tells():
    found = next(optimum(seed) for seed in SEEDS if (optimum(seed).history.bent > 0).any())
    table, bent = convergence_table(found), found.history.bent
    assert (table["bent"].notna().to_numpy()[: len(bent)] == (bent > 0)).all()
    assert ((bent >= 0) & (bent <= 1)).all()
    assert sum("along a curve" in line for line in step_lines(found)) == (bent > 0).sum()


def test_what_is_not_determined_is_told_early_and_named():
    """Flat ground and level cameras at one height: nothing tells c from the flying height."""
    sizes = common_sizes(flat(k).block for k in SEEDS)
    level = {"terrain.rms_m": 0.01, "jitter": {"position_m": 0.0, "angle_deg": 0.0}}
    results = [adjust(made(FLAT | level, seed).block, sizes=sizes) for seed in SEEDS]
    assert all(int(found.steps) <= 60 for found in results)
    open_ends = [found for found in results if found.outcome is Outcome.FLAT]
    assert open_ends
    for found in open_ends:
        labels = frozenset().union(*(w.labels for w in weaknesses_of(found)))
        assert "interior[kodak].c_mm" in labels
        assert "not determine" in convergence_words(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_optimum_is_that_of_a_search_over_the_principal_distance(seed):
    """Dense Gauss-Newton for each c, from the truth, and the c of the least square sum: no valley is followed."""
    block, truth = flat(seed).block, flat(seed).truth
    laid = build_problem(block, truth, block.priors, alone=True)
    values, structure = laid.padded_values, laid.padded.structure
    scale = typical_scale(values, structure)
    flat_scale, back = ravel_pytree(scale)
    free = np.flatnonzero(flat_scale > 0)
    (j,) = [k for k, label in enumerate(laid.padded.own.labels) if label.endswith("c_mm")]
    c = int(np.searchsorted(free, scale.eop.size + j))

    def at(x):
        return back(jnp.zeros(flat_scale.shape).at[free].set(x))

    residuals = jax.jit(lambda x: in_one_list(Linearised(at(x), scale, values, structure).residuals()))
    jacobian = jax.jit(jax.jacfwd(residuals))
    others, x = np.delete(np.arange(len(free)), c), np.zeros(len(free))

    def gauss_newton(x, which, steps):
        for _ in range(steps):
            a = np.asarray(jacobian(x))[:, which]
            x = x.copy()
            x[which] -= np.linalg.solve(a.T @ a, a.T @ np.asarray(residuals(x)))
        return x

    def best(of_c):
        nonlocal x
        begin = x.copy()
        begin[c] = of_c
        x = gauss_newton(begin, others, 3)
        return float(np.sum(np.asarray(residuals(x)) ** 2))

    step = float(optimum(seed).unknowns.interior["kodak"].c - truth.interior["kodak"].c) / float(scale.shared[j])
    minimize_scalar(best, (0.0, 0.5 * step), options={"xtol": 1e-2})
    x = gauss_newton(x, np.arange(len(free)), 4)
    a = np.asarray(jacobian(x))
    covariance = np.linalg.inv(a.T @ a)
    deviation = np.zeros(flat_scale.shape)
    deviation[free] = np.sqrt(np.diag(covariance))
    eop, shared, points = jax.tree.map(np.multiply, back(deviation), scale)
    theirs = laid.padded.crop_state(state_at(at(x), scale, values, structure))
    places, ours = laid.padded.places, optimum(seed).unknowns
    assert abs(float(ours.interior["kodak"].c - theirs.shared[0])) < 1e-5 * shared[j]
    off = np.asarray(ours.exterior.position) - np.asarray(theirs.position).T
    assert (np.abs(off) < 1e-5 * np.asarray(eop[:3, places.image]).T).all()
    off = np.asarray(ours.points) - np.asarray(theirs.points).T
    assert (np.abs(off) < 1e-5 * np.asarray(points[:, places.point]).T + 1e-12).all()


def test_a_well_determined_block_takes_straight_steps():
    found = adjusted("cross")
    assert not (found.history.bent > 0).any() and (found.history.accepted > 0).all()
    assert int(found.steps) <= 4


@pytest.mark.parametrize("name", slow_but(("cross",), ("cross", "everything")))
def test_the_right_hand_side_of_other_residuals(name):
    """J'r with r elsewhere, less what is subtracted: what the acceleration is solved from."""
    block = simulated(name).block
    laid = build_problem(block, block.start.unknowns, block.priors, alone=True)
    values, structure = laid.padded_values, laid.padded.structure
    scale = typical_scale(values, structure)
    free, back = ravel_pytree(jax.tree.map(lambda v: v > 0, scale))
    zero = back(jnp.zeros(free.shape))
    moved = back(jnp.sin(jnp.arange(len(free)) + 1.0) * free)
    here = Linearised(zero, scale, values, structure)

    @jax.jit
    def both():
        there = here._replace(increments=moved)
        *_, right = reduce_normal(here, 0.0, linearise_rows(here, there.residual_rows()), moved)
        residuals = lambda y: in_one_list(here._replace(increments=y).residuals())  # noqa: E731
        r = residuals(moved)
        (pulled,) = jax.vjp(residuals, zero)[1](r)
        expected = jax.tree.map(jnp.subtract, pulled, moved)
        return (
            ravel_pytree(right.b)[0],
            ravel_pytree(expected)[0],
            there.residual_rows().sum_of_squares(structure),
            r @ r,
        )

    found, expected, sum_of_squares, expected_sum = both()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * float(jnp.max(jnp.abs(expected))))
    assert float(sum_of_squares) == pytest.approx(float(expected_sum))
