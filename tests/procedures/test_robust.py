"""Robust adjustments are optima, have exact derivatives, and resist blunders."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxphoto import BlockError, adjust, robust, snoop
from jaxphoto.adjustment import MAX_STEPS, MINIMAL_SIZES, solve
from jaxphoto.losses import Huber, StudentT
from jaxphoto.procedures.robust import solve_without_diverged
from tests.blocks import simulated


@pytest.fixture(scope="module")
def block():
    """With one in forty image points off by 5 to 500 of its standard deviations."""
    block, rng = simulated("cross").block, np.random.default_rng(4)
    p = block.image_points
    xy = np.array(p.xy)
    rows = rng.choice(len(p), len(p) // 40, replace=False)
    xy[rows] += (
        np.asarray(p.sigma)[rows] * rng.choice([-1, 1], (len(rows), 2)) * np.geomspace(5, 500, len(rows))[:, None]
    )
    return block.with_observations({p.group: dataclasses.replace(p, xy=xy)})


def reweighted(block, weights):
    factor = {name: w**-0.5 for name, w in weights.items()}
    rows = block.named_observations
    return block.with_observations(
        {n: rows[n].with_sigmas_times(f.reshape(-1, *[1] * (np.ndim(rows[n].sigmas) - 1))
         * np.ones(np.shape(rows[n].sigmas))) for n, f in factor.items()}
    )  # fmt: skip


def test_the_optimum_is_that_of_least_squares_with_its_weights(block):
    found = robust(block, Huber())
    again = adjust(reweighted(block, found.weights), found.unknowns)
    assert found.converged and min(w.min() for w in found.weights.values()) < 0.05
    # The optimum is known to 1e-5 of standard deviations, which are some centimetres.
    np.testing.assert_allclose(again.unknowns.points, found.unknowns.points, atol=1e-5)


# Least squares of a block with blunders may find its optimum from elsewhere, and say so; by the last bits of a machine.
@pytest.mark.filterwarnings("ignore:the adjustment fails from the given")
def test_student_s_estimate_hardly_moves_with_the_blunders(block):
    clean, found = adjust(simulated("cross").block), robust(block, {"image_points": StudentT()})
    assert list(found.losses) == ["image_points"]
    one, other = (u.interior["cam"].c if "cam" in u.interior else next(iter(u.interior.values())).c
                  for u in (clean.unknowns, found.unknowns))  # fmt: skip
    spoilt = next(iter(adjust(block).unknowns.interior.values())).c
    assert abs(float(other - one)) < 0.2 * abs(float(spoilt - one))


# Least squares of a block with blunders may find its optimum from elsewhere, and say so; by the last bits of a machine.
@pytest.mark.filterwarnings("ignore:the adjustment fails from the given")
@pytest.mark.slow
def test_derivatives_go_through_the_robust_optimum(block):
    start, p = adjust(block).unknowns, block.image_points
    losses = {p.group: Huber(scale=1.3)}

    def c(xy):
        moved = block.with_observations({p.group: dataclasses.replace(p, xy=xy)})
        solved = solve(moved, start, moved.priors, losses=losses)
        return next(iter(solved.unknowns.interior.values())).c

    direction = np.random.default_rng(5).normal(size=np.shape(p.xy)) * np.asarray(p.sigma)
    exact = float(jax.jvp(c, (np.asarray(p.xy),), (direction,))[1])
    h = 1e-3
    numeric = (float(c(np.asarray(p.xy) + h * direction)) - float(c(np.asarray(p.xy) - h * direction))) / (2 * h)
    assert exact == pytest.approx(numeric, rel=1e-3)


def test_snooping_gives_the_same_result_from_any_loss(block):
    rows = [{(s.group, s.row) for s in snoop(block, loss=loss).left_out} for loss in (None, StudentT())]
    assert rows[0] and len(rows[0] ^ rows[1]) <= 1


def test_an_unknown_group_is_refused(block):
    with pytest.raises(BlockError, match="no observations gnss"):
        robust(block, {"gnss": Huber()})


def test_an_adjustment_that_diverges_ends_the_search():
    """From a distortion whose numbers overflow: later adjustments would begin at NaN."""
    block = simulated("cross").block
    start = block.start.unknowns
    (name,) = start.interior
    camera = start.interior[name]
    camera = dataclasses.replace(camera, distortion=dataclasses.replace(camera.distortion, k1=1e308, k2=-1e308))
    left = {name: np.zeros(len(rows), bool) for name, rows in block.named_observations.items()}
    unknowns = dataclasses.replace(start, interior=type(start.interior)({name: camera}))
    with pytest.raises(BlockError, match="became infinite"):
        solve_without_diverged(block, left, unknowns, MAX_STEPS, MINIMAL_SIZES)
