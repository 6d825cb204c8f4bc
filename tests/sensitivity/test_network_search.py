"""Designs found by gradient: better than a grid and than the usual layout, also when they are measured and adjusted."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxphoto
from jaxphoto import DatumError, InputError
from jaxphoto.sensitivity.network.covariance import largest_correlation, sigma_of
from jaxphoto.sensitivity.network.layout import block_from_layout
from jaxphoto.sensitivity.network.search import (
    best_designs,
    evaluate_designs,
    grid_designs,
    optimise_design,
    random_designs,
    stack_designs,
)
from jaxphoto.statistics import correlations
from tests.sensitivity.network import PLAN, USUAL

TILTS = eqx.Partial(largest_correlation, exterior=("omega", "phi"), interior=("xp_mm", "yp_mm"))
SMOOTH = eqx.Partial(largest_correlation, exterior=("omega", "phi"), interior=("xp_mm", "yp_mm"), power=16.0)
LOW = dataclasses.replace(USUAL, heading=np.array([USUAL.heading[0], 0.0, 0.0, 0.0]), height=np.full(4, 850.0))
HIGH = dataclasses.replace(
    USUAL, heading=np.array([USUAL.heading[0], *np.full(3, 2 * np.pi)]), height=np.full(4, 1150.0)
)


@pytest.fixture(scope="module")
def grid():
    """Headings of eight directions, heights as usual."""
    last = np.append(USUAL.heading[0], np.full(3, 1.75 * np.pi))
    low = dataclasses.replace(LOW, height=USUAL.height)
    return grid_designs(low, dataclasses.replace(low, heading=last), 8)


@pytest.fixture(scope="module")
def optimised(grid):
    starts = stack_designs(USUAL, jax.tree.map(lambda v: v[0], best_designs(TILTS, PLAN, grid, 1)))
    return optimise_design(TILTS, PLAN, LOW, HIGH, starts, SMOOTH, max_steps=25)


def test_search_beats_the_grid_and_the_usual_layout(grid, optimised):
    values = evaluate_designs(TILTS, PLAN, grid)
    assert len(values) == 8**3
    assert optimised.start_values[1] == pytest.approx(np.nanmin(values))
    assert optimised.value < 0.97 * np.nanmin(values)
    assert optimised.value < 0.8 * optimised.start_values[0]
    assert (optimised.values < optimised.start_values).all()
    np.testing.assert_allclose(
        evaluate_designs(TILTS, PLAN, stack_designs(optimised.best)), optimised.value, rtol=1e-12
    )


def test_search_stays_between_its_bounds(optimised):
    for low, value, high in zip(*map(jax.tree.leaves, (LOW, optimised.designs, HIGH)), strict=True):
        slack = 1e-12 * (1 + np.abs(value))
        assert ((value >= low - slack) & (value <= high + slack)).all()
    np.testing.assert_allclose(optimised.best.heading[0], USUAL.heading[0])
    np.testing.assert_array_equal(optimised.best.control, USUAL.control)


@pytest.mark.slow
def test_the_gain_is_there_when_the_layout_is_measured(optimised):
    """By `jaxphoto.covariance` of a block with whole image points only."""
    measured = []
    for design in (USUAL, optimised.best):
        block, truth, _ = block_from_layout(eqx.filter_jit(PLAN)(design))
        adjusted = jaxphoto.adjust(block, truth)
        rho = correlations(adjusted, jaxphoto.covariance(adjusted))["camera"].exterior
        measured.append(np.abs(rho[:, 3:5, 1:3]).max())
    # Points in the edge of the format change the largest correlation by a few per cent.
    np.testing.assert_allclose(measured, [optimised.start_values[0], optimised.value], rtol=0.06)
    assert measured[1] < 0.85 * measured[0]


def budget(shares):
    """A budget shared between stations and control."""
    layout = PLAN(USUAL)
    station, control = shares["station"] / 0.05**2, shares["control"] / 0.01**2
    weight = jnp.zeros(layout.points.shape).at[-1].set(control)
    return dataclasses.replace(layout, station_weight=station, control_weight=weight)


def test_a_budget_without_stations_and_control_leaves_no_datum():
    starts = {"station": np.array([0.5, 0.0]), "control": np.array([0.5, 0.0])}
    low, high = ({name: np.array(end) for name in starts} for end in (0.0, 1.0))
    with pytest.raises(DatumError, match=r"start 2 of the search has no datum: .* defect of 7"):
        optimise_design(eqx.Partial(sigma_of, name="c_mm"), budget, low, high, starts)


def test_what_cannot_be_searched_is_said_in_a_sentence():
    sigma = eqx.Partial(sigma_of, name="c_mm")
    start = stack_designs(USUAL)
    with pytest.raises(InputError, match=r"the bounds of height are reversed: the low one, 1150, exceeds .* 850"):
        upside = dataclasses.replace(LOW, height=HIGH.height), dataclasses.replace(HIGH, height=LOW.height)
        optimise_design(sigma, PLAN, *upside, start)
    outside = stack_designs(dataclasses.replace(USUAL, height=np.full(4, 1300.0)))
    with pytest.raises(InputError, match="a start of height is outside its bounds"):
        optimise_design(sigma, PLAN, LOW, HIGH, outside)
    with pytest.raises(InputError, match=r"the starts of heading have the shape \(4,\), but the variable has \(4,\)"):
        optimise_design(sigma, PLAN, LOW, HIGH, USUAL)
    with pytest.raises(InputError, match="the bounds of height are not all finite"):
        random_designs(LOW, dataclasses.replace(HIGH, height=np.full(4, np.inf)), 3)
    with pytest.raises(InputError, match="needs the covariance of k2, which is fixed"):
        optimise_design(eqx.Partial(sigma_of, name="k2"), PLAN, LOW, HIGH, start)


def test_grid_and_random_designs_fill_the_region():
    designs = grid_designs(LOW, HIGH, 2)
    assert len(designs.heading) == 2 ** (3 + 4)
    assert len(np.unique(np.column_stack([designs.heading, designs.height]), axis=0)) == 2**7
    drawn = random_designs(LOW, HIGH, 50, seed=4)
    np.testing.assert_array_equal(drawn.height, random_designs(LOW, HIGH, 50, seed=4).height)
    assert drawn.height.min() > 850 and drawn.height.max() < 1150 and np.ptp(drawn.height) > 200
    assert np.ptp(drawn.control) == np.ptp(USUAL.control)
