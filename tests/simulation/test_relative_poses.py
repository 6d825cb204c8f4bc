"""Relative control in a recipe: what it observes, that files keep it, and that its standard deviations are true."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as scipy_rotation

from jaxphoto import Outcome, adjust, covariance, monte_carlo
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import NOMINAL
from jaxphoto.io import read_block, recipe_from, write_block
from jaxphoto.observations import (
    CameraPositions,
    RelativeAttitudes,
    RelativePositions,
    correlated,
    exponential_covariance,
)
from jaxphoto.sensitivity import noise
from jaxphoto.variants import indirect, without_attitudes, without_stations
from tests.simulation.small import SMALL, changed, made
from tests.simulation.test_convergent import GOPRO

ARM = [0.1, -0.2, 0.8]
RELATIVE = {
    "sigmas.relative_position_m": 0.005, "sigmas.relative_attitude_deg": 0.002, "sigmas.attitude_deg": None,
    "mounts": {"default": {"lever_arm_m": ARM, "image_x": "left"}}, "noise.attitude_deg": None,
    "strips": {"default": {"shift": "free", "truth": {"shift_sigma_m": 0.5, "drift_sigma_m_per_s": 0.01}}},
    # What is held is true.
    "cameras.kodak.interior": SMALL["cameras"]["kodak"]["truth"],
}  # fmt: skip
EXACT = {"noise.relative_position_m": 0.0, "noise.relative_attitude_deg": 0.0}


@functools.cache
def flown():
    return made(RELATIVE | EXACT)


def test_it_is_how_antenna_and_body_move_along_each_strip():
    """By another rotation library, whatever the positions of the strip are off by."""
    block, truth, _ = flown()
    moved, turned = block.more
    first, second = (np.asarray(i) for i in (moved.image_1, moved.image_2))
    assert len(first) == 11
    assert all(block.image_strip[a] == block.image_strip[b] for a, b in zip(first, second, strict=True))
    np.testing.assert_array_equal(second, first + 1)
    body = np.swapaxes(np.asarray(truth.exterior.camera_from_object), 1, 2) @ NOMINAL["left"].T
    antenna = np.asarray(truth.exterior.position) + body @ ARM
    np.testing.assert_allclose(moved.value, antenna[second] - antenna[first], atol=1e-9)
    np.testing.assert_array_equal(turned.image_1, first)
    # Right, forward, up to forward, right, down on both sides.
    swap = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    between = swap @ np.swapaxes(body[first], 1, 2) @ body[second] @ swap
    yaw, pitch, roll = scipy_rotation.from_matrix(between).as_euler("ZYX").T
    np.testing.assert_allclose(turned.roll_pitch_yaw, np.stack([roll, pitch, yaw], -1), atol=1e-12)


def test_its_noise_is_its_own():
    exact, noisy = flown().block.more, made(RELATIVE).block.more
    for a, b in zip(exact, noisy, strict=True):
        off = (np.asarray(b.observation) - np.asarray(a.observation)) / np.asarray(b.sigmas)
        assert abs(off.std() - 1) < 4 / np.sqrt(2 * off.size)


def test_it_goes_through_files(tmp_path):
    block = flown().block
    write_block(block, tmp_path / "copy")
    assert (tmp_path / "copy/relative_positions.csv").read_text().splitlines()[0] == (
        "image_1,image_2,dX_m,dY_m,dZ_m,sigma_X_m,sigma_Y_m,sigma_Z_m"
    )
    for rows, own in zip(read_block(tmp_path / "copy").more, block.more, strict=True):
        assert type(rows) is type(own)
        np.testing.assert_array_equal(rows.image_2, own.image_2)
        np.testing.assert_allclose(rows.observation, own.observation, rtol=1e-14)


@pytest.mark.parametrize(
    ("table", "old", "new", "words"),
    [
        ("relative_positions.csv", "A_01,A_02", "A_01,A_01", r"row 2: image_1 and image_2 are the same; name two"),
        ("relative_attitudes.csv", "A_02,A_03", "A_02,A_01", r"row 3: this relative attitude is given twice"),
        ("relative_positions.csv", "A_01,A_02", "A_01,Z_02", r"row 2: image Z_02 is not in images\.csv"),
        ("block.toml", "[mounts.default]", "[mounts.default]\ntime_offset_s = 0.1", r"needs the motion of image A_01"),
    ],
)
def test_mistakes_are_named(tmp_path, table, old, new, words):
    block = dataclasses.replace(flown().block, stations=CameraPositions.none())
    write_block(block, tmp_path / "copy")
    path = tmp_path / "copy" / table
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new).replace("\ntime_offset_s = 0.0", ""))
    with pytest.raises((InputError, BlockError), match=words):
        read_block(tmp_path / "copy")


def test_there_are_no_strips_without_a_flight():
    with pytest.raises(
        InputError, match=r"relative_position_m.*: it applies between exposures of a strip, .* remove it"
    ):
        recipe_from(changed({"sigmas.relative_position_m": 0.005}, GOPRO))


def test_it_goes_with_what_gnss_and_imu_observe():
    block = flown().block
    assert [type(rows) for rows in without_stations(block).more] == [RelativeAttitudes]
    assert [type(rows) for rows in without_attitudes(block).more] == [RelativePositions]
    assert not indirect(drifting(block)).more


def drifting(block):
    """Stations of a strip and an axis correlated in time."""
    rows, strips = block.stations, np.array(block.image_strip)
    more = []
    for strip in dict.fromkeys(block.image_strip):
        sets = [np.flatnonzero((strips[rows.who] == strip) & (rows.axis == axis)) for axis in range(3)]
        in_time = exponential_covariance(np.asarray(block.image_time)[rows.who[sets[0]]], 0.1, 60.0)
        more.append(correlated(rows, np.stack(sets), np.stack([in_time] * 3)))
    return dataclasses.replace(block, stations=CameraPositions.none(), more=(*block.more, *more))


N_DRAWS = 60


@functools.cache
def adjusted(relative: bool):
    """At the truth, so that standard deviations are those of the geometry."""
    simulation = made(RELATIVE | EXACT | {"strips.default.truth": {}})
    block = drifting(simulation.block)
    if not relative:
        # Of no weight beside the images, so that the same program serves.
        none = [rows.with_sigmas_times(np.full(np.shape(rows.sigmas), 100.0)) for rows in block.more[:2]]
        block = dataclasses.replace(block, more=(*none, *block.more[2:]))
    found = adjust(block, simulation.truth)
    assert found.outcome is Outcome.CONVERGED
    return found


@pytest.mark.slow
def test_drifting_stations_gain_by_it_and_its_sigmas_are_true():
    without, beside = (np.asarray(covariance(adjusted(of)).matrix).diagonal() for of in (False, True))
    a = adjusted(True)
    n = 6 * len(a.block.images)
    centre = np.arange(n).reshape(-1, 6)[:, :3].ravel()
    assert beside[centre].mean() < 0.8 * without[centre].mean()
    found = monte_carlo(a, noise(a.block), N_DRAWS, seed=3, exterior=True)
    assert found.converged.all()
    off = found.exterior[:, :, :3] - np.asarray(a.unknowns.exterior.position)
    z = off.reshape(N_DRAWS, -1) / np.sqrt(beside[centre])
    assert abs(np.sqrt((z**2).mean()) - 1) < 0.1
    at = [found.labels.index(label) for label in a.structure.labels]
    shared = found.shared[:, at] - np.asarray(a.values.shared)[a.structure.free]
    z = shared / np.sqrt(beside[n:])
    assert abs(np.sqrt((z**2).mean()) - 1) < 4 / np.sqrt(2 * z.size) * 2
