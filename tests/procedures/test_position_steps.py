"""Steps of recorded positions: detection, false alarms by white and correlated noise, correction."""

import dataclasses
import functools

import equinox as eqx
import numpy as np
import pytest

from jaxphoto.io import recipe_from
from jaxphoto.procedures.georeference_photographs import georeference_photographs
from jaxphoto.procedures.position_steps import detect_steps
from jaxphoto.simulation import simulate
from tests.procedures.test_georeference_photographs import recorded

ZERO = np.zeros(3)


def flight(rng, n, a_strip):
    """Photographs to and fro, 20 m apart, in strips 40 m apart."""
    strip, along = np.divmod(np.arange(n), a_strip)
    x = np.where(strip % 2, a_strip - 1 - along, along) * 20.0
    return np.column_stack([x, strip * 40.0, 80 + rng.normal(0, 1, n)])


def noise(rng, n, persistence):
    e = rng.normal(size=(n, 3)) * [1.0, 1.0, 2.0]
    for k in range(1, n):
        e[k] += persistence * e[k - 1]
    return e


def similarity(rng, at):
    """What a network a little too large and turned is off by."""
    turn = np.cross(np.eye(3), rng.normal(0, 0.02, 3)) + 0.02 * rng.normal() * np.eye(3)
    return (at - at.mean(axis=0)) @ turn.T


@pytest.mark.parametrize("persistence", [0.0, 0.5, 1.0])
def test_noise_is_no_step_in_95_of_100_flights(persistence):
    rng = np.random.default_rng(3)
    for n, a_strip in ((20, 10), (60, 12)):
        at = flight(rng, n, a_strip)
        found = [bool(detect_steps(noise(rng, n, persistence) + similarity(rng, at), at, ZERO)) for _ in range(150)]
        # Five of 100, and what 150 flights may have more by chance (99 %).
        assert np.mean(found) <= 0.05 + 2.3 * np.sqrt(0.05 * 0.95 / 150), (n, np.mean(found))


@pytest.mark.parametrize("by", [(14.0, 0.0, 0.0), (0.0, 0.0, 28.0)])
def test_a_step_is_found_where_it_is_with_its_size(by):
    rng, n, off, found = np.random.default_rng(5), 60, [], 0
    at = flight(rng, n, 12)
    for _ in range(40):
        first = int(rng.integers(5, n - 5))
        stepped = np.arange(n)[:, None] >= first
        offsets = noise(rng, n, 0.0) + similarity(rng, at) + stepped * np.array(by)
        offsets[(first + 9) % n] += [40.0, -30.0, 0.0]
        steps = detect_steps(offsets, at, ZERO)
        if [s.first for s in steps] == [first]:
            found += 1
            off.append((steps[0].by_m - by) / steps[0].sigma_m)
    assert found >= 34
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5
    # The same, where standard deviations allow as much.
    assert detect_steps(offsets, at, np.array(by) + 10.0) == []


def test_an_excursion_is_two_steps_and_a_change_at_every_strip_none():
    rng, n = np.random.default_rng(8), 60
    at = flight(rng, n, 12)
    gone = ((np.arange(n) >= 20) & (np.arange(n) < 31))[:, None] * np.array([10.0, -20.0, 0.0])
    assert [s.first for s in detect_steps(noise(rng, n, 0.0) + gone, at, ZERO)] == [20, 31]
    # As an exposure that is told too late puts them.
    late = np.where(np.arange(n) // 12 % 2, -1.0, 1.0)[:, None] * np.array([20.0, 0.0, 0.0])
    assert detect_steps(noise(rng, n, 0.0) + late, at, ZERO) == []


@functools.cache
def flown():
    """Twenty-four photographs, and the positions that the truth has of them."""
    strips = [{"name": "S", "heading_deg": 0.0, "images": 8, "count": 3}]
    recipe = {
        "cameras": {
            "drone": {
                "width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "brown",
                "interior": {"c_mm": 8.8},
            }
        },
        "mounts": {"default": {"image_x": "right"}},
        "flight": {
            "height_m": 100.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 60.0, "strips": strips,
        },
        "points": {"ties": 80},
        "sigmas": {"image_mm": 0.0012},
    }  # fmt: skip
    simulated = simulate(recipe_from(recipe), 3)
    truth = np.asarray(simulated.truth.exterior.position)
    block = eqx.tree_at(lambda b: b.start.unknowns, simulated.block, simulated.truth)
    # As a network is oriented: its photographs are in one strip that has no name.
    return dataclasses.replace(block, image_strip=("",) * len(truth)), truth


def test_a_part_that_is_off_has_a_shift_of_its_own_and_the_block_does_not_tilt():
    block, truth = flown()
    rng, by = np.random.default_rng(2), np.array([0.4, -0.3, 0.6])
    n = len(truth)
    position = truth + rng.normal(0, 0.02, truth.shape)
    # Taken in another order than that of their names; sixteen photographs count.
    order, off = [*block.images[8:], *block.images[:8]], (np.arange(n) < 8)[:, None]
    sigma = (0.02, 0.02, 0.02)
    found, clean, blind = (
        georeference_photographs(block, recorded(p, block.images, sigma), order=o)
        for p, o in ((position + off * by, order), (position, order), (position + off * by, ()))
    )
    assert found.used.all() and not clean.steps and len(found.steps) == 1
    assert f"between {block.images[-1]} and {block.images[0]} " in found.steps[0]
    assert f"the 16 photographs from {block.images[8]} on are the reference" in found.steps[0]
    (shift,) = found.block.start.unknowns.strips.values()
    np.testing.assert_allclose(shift.shift, by, atol=0.1)
    assert [s != "" for s in found.block.image_strip] == [k < 8 for k in range(n)]
    np.testing.assert_allclose(
        found.block.start.unknowns.exterior.position, clean.block.start.unknowns.exterior.position, atol=0.05
    )
    # In the order of the names it is the other part's begin.
    assert f"between {block.images[7]} and {block.images[8]}" in blind.steps[0]
