"""Pseudo control of a block: convergence of orientation and control in turn, and which image a point is taken from."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, covariance, simulate
from jaxphoto.errors import BlockError
from jaxphoto.io import recipe_from
from jaxphoto.lidar.grid import index_cloud
from jaxphoto.lidar.pseudo_control import pseudo_control_of_block
from jaxphoto.simulation.scene import ROLLING
from tests.simulation.small import changed


@pytest.fixture(scope="module")
def flown():
    """A small block, stations only, whose c is wrong by 1 % and whose images by 1 m and 0.1 deg, and a lidar."""
    values = {
        "noise.image_mm": 0.004, "noise.station_m": 0.1, "sigmas.attitude_deg": None, "noise.attitude_deg": None,
        "points.ties": 150, "targets": None, "start": {"position_m": 1.0, "angle_deg": 0.1},
        "cameras.kodak.interior.c_mm": 34.25 * 1.01, "cameras.kodak.unknowns": {"c_mm": "free"},
        "cameras.kodak.truth": {"c_mm": 34.25},
    }  # fmt: skip
    recipe = recipe_from(changed(values))
    recipe = dataclasses.replace(recipe, terrain=dataclasses.replace(ROLLING, roughness_m=0.0))
    simulated = simulate(recipe, seed=3)
    block, truth = simulated.block, simulated.truth
    rng = np.random.default_rng(5)
    xy = (truth.points[:, None, :2] + rng.uniform(-20, 20, (len(block.points), 1600, 2))).reshape(-1, 2)
    cloud = np.column_stack([xy, recipe.terrain.height(xy)]) + rng.normal(size=(len(xy), 3)) * [0.5, 0.5, 0.15]
    return block, truth, index_cloud(cloud)


def in_turn(block, start, grid, rounds):
    """Control at the orientation, orientation with the control."""
    unknowns, results = start, []
    for _ in range(rounds):
        control = pseudo_control_of_block(block, unknowns, grid)
        adjusted = adjust(eqx.tree_at(lambda b: b.control, block, control.rows()))
        unknowns = adjusted.unknowns
        results.append((control, adjusted))
    return results


@pytest.mark.slow
def test_orientation_and_control_in_turn_converge(flown):
    block, truth, grid = flown
    start = block.start.unknowns
    assert abs(start.interior["kodak"].c / 34.25 - 1.01) < 1e-9
    results = in_turn(block, start, grid, 5)
    c = np.array([float(adjusted.unknowns.interior["kodak"].c) for _, adjusted in results])
    position = np.stack([np.asarray(adjusted.unknowns.exterior.position) for _, adjusted in results])
    control, adjusted = results[-1]
    sigma_c = float(covariance(adjusted).shared_sigma[0])
    # Each round changes less than a tenth of the one before, until nothing counts.
    assert np.abs(np.diff(c))[-1] < 1e-2 * sigma_c
    assert np.abs(position[-1] - position[-2]).max() < 2e-3
    assert abs(c[-1] - 34.25) < 3 * sigma_c < 3e-2
    assert abs(float(adjusted.sigma0) - 1) < 5 / np.sqrt(2 * adjusted.redundancy)
    assert len(control.rows().who) == len(block.points)
    error = control.control.xyz[:, 2] - truth.points[control.point, 2]
    assert np.mean(np.abs(error) < 1.96 * control.control.sigma_z) > 0.9
    # It is where one arrives from the truth as well.
    (_, near), *_ = reversed(in_turn(block, truth, grid, 2))
    assert abs(float(near.unknowns.interior["kodak"].c) - c[-1]) < 0.05 * sigma_c


def test_a_point_is_taken_from_the_image_that_sees_it_from_nearest_above(flown):
    block, truth, grid = flown
    some = np.array([3, 17, 40])
    found = pseudo_control_of_block(block, truth, grid, points=some)
    assert found.point.tolist() == some.tolist()
    rows = found.rows()
    assert (rows.axis == 2).all() and rows.who.tolist() == some.tolist()
    for k, point in enumerate(some):
        images = block.image_points.image[block.image_points.point == point]
        away = np.asarray(truth.exterior.position)[images] - truth.points[point]
        off_nadir = np.hypot(away[:, 0], away[:, 1]) / away[:, 2]
        assert found.image[k] == images[np.argmin(off_nadir)]
    with pytest.raises(BlockError, match="no image measured any of the points"):
        pseudo_control_of_block(block, truth, grid, points=np.array([], int))
