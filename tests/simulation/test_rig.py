"""Rigs in recipes: poses of their cameras, observations, and recovery by adjustment."""

import dataclasses
import functools

import jax
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation as scipy_rotation

from jaxphoto import FREE, Outcome, RankError, adjust, covariance
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import NOMINAL, rig_place, rig_turn
from jaxphoto.io import read_block, read_truth, recipe_from, write_block, write_simulation
from jaxphoto.parameters import numbers_of
from jaxphoto.procedures.rig import with_rig
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.simulation.simulate import remeasure_rows
from jaxphoto.variants import indirect, some_images
from tests.derivatives import compiled
from tests.simulation.small import SMALL, changed

TURN, PLACE = [10.0, -25.0, 80.0], [0.5, 0.1, -0.05]
TRUE_TURN, TRUE_PLACE = [10.1, -25.1, 80.2], [0.52, 0.08, -0.06]
OBLIQUE = SMALL["cameras"]["kodak"] | {"interior": {"c_mm": 40.0}, "truth": {"c_mm": 40.05}}
RIG = {
    "cameras.oblique": OBLIQUE,
    # What is held is true.
    "cameras.kodak.truth": {"c_mm": 34.05},
    "rig_cameras": {"oblique": {
        "turn_deg": TURN, "turn": "free", "place_m": PLACE, "place": {"sigma_m": 0.03},
        "truth": {"turn_deg": TRUE_TURN, "place_m": TRUE_PLACE},
    }},
    "points": {"ties": 90, "ends": 1.0, "across": 1.5},
    "sigmas.rig_place_m": 0.001, "sigmas.rig_turn_deg": 0.001, "noise.image_mm": 0.004, "noise.control_m": 0.03,
    "noise.station_m": 0.1, "noise.attitude_deg": 0.01,
}  # fmt: skip


@functools.cache
def flown(noisy: bool = True):
    exact = {} if noisy else {"noise.rig_place_m": 0.0, "noise.rig_turn_deg": 0.0}
    return simulate(recipe_from(changed(RIG | exact)), 1)


def poses(simulation):
    """Of every event, the place (m) and turn (degrees) of the oblique camera beside the other."""
    position, rotation = (np.asarray(v) for v in vars(simulation.truth.exterior).values())
    place = compiled(jax.vmap(rig_place))(position[::2], rotation[::2], position[1::2])
    return np.asarray(place), np.degrees(compiled(jax.vmap(rig_turn))(rotation[::2], rotation[1::2]))


def test_cameras_sit_beside_the_one_that_is_flown():
    place, turn = poses(flown(noisy=False))
    np.testing.assert_allclose(place, np.tile(TRUE_PLACE, (14, 1)), atol=1e-9)
    np.testing.assert_allclose(turn, np.tile(TRUE_TURN, (14, 1)), atol=1e-9)


def test_the_rig_has_flexure_of_its_noise():
    place, turn = poses(flown())
    for off in ((place - TRUE_PLACE) / 0.001, (turn - TRUE_TURN) / 0.001):
        assert abs(np.std(off) - 1) < 4 / np.sqrt(2 * off.size)


def test_the_block_has_the_rows_of_its_rig():
    block = flown().block
    assert block.images[:4] == ("A_01", "A_01_oblique", "A_02", "A_02_oblique")
    assert block.image_camera[:2] == ("kodak", "oblique")
    places, turns = block.more
    np.testing.assert_array_equal(places.reference, np.arange(0, 28, 2))
    np.testing.assert_array_equal(turns.image, np.arange(1, 28, 2))
    np.testing.assert_allclose(turns.sigma, np.deg2rad(0.001))
    assert not (set(block.stations.who) | set(block.attitudes.image)) & set(range(1, 28, 2))


@functools.cache
def found():
    adjusted = adjust(flown().block)
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted


def test_the_relative_orientation_is_recovered():
    sigma = dict(zip(found().structure.labels, np.asarray(covariance(found()).shared_sigma), strict=True))
    own, true = (u.more["rig_cameras"]["oblique"] for u in (found().unknowns, flown().truth))
    # All but the delay, which is held.
    for label, value, want in list(zip(own.labels("oblique"), numbers_of(own), numbers_of(true), strict=True))[:-1]:
        assert abs(float(value) - want) < 3.3 * sigma[label], label
    assert sigma["rig_cameras[oblique].turn_z_rad"] < np.deg2rad(0.02)
    assert 0.9 < found().sigma0 < 1.1


def test_it_goes_through_files(tmp_path):
    write_simulation(flown(), tmp_path / "block")
    again = read_block(tmp_path / "block")
    for rows, own in zip(again.more, flown().block.more, strict=True):
        assert type(rows) is type(own)
        np.testing.assert_array_equal(rows.reference, own.reference)
        np.testing.assert_allclose(rows.sigma, own.sigma, rtol=1e-15)
    told = read_truth(tmp_path / "block")["georeferencing"].set_index("parameter").value
    assert told["rig_cameras[oblique].turn_y_deg"] == pytest.approx(-25.1)
    table = tmp_path / "block/rig_turns.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0], lines[1].replace("A_01_oblique", "A_01"), *lines[2:]]) + "\n")
    with pytest.raises(InputError, match=r"rig_turns\.csv, row 2: the image is its own reference; name that"):
        read_block(tmp_path / "block")


def test_remeasured_rigs_have_new_flexure():
    block, truth, _ = flown()
    place, _ = poses(flown())
    off = np.array([remeasure_rows(block.more[0], block, truth, jax.random.key(k)).off for k in range(40)])
    np.testing.assert_allclose(off.mean(0), place - TRUE_PLACE, atol=4 * 0.001 / np.sqrt(40))
    assert abs(off.std(0).mean() / 0.001 - 1) < 0.1
    assert not np.array_equal(remeasure(block, truth, jax.random.key(1)).more[1].off, block.more[1].off)


def test_a_rig_is_made_of_photographs_of_one_event():
    """Its start is where approximate orientations have it, and its rows are those of the recipe."""
    block, _, _ = flown()
    events = tuple(name.removesuffix("_oblique") for name in block.images)
    bare = some_images(block, np.ones(28, bool))
    bare = dataclasses.replace(bare, more=(), partitions={"event": events})
    made = with_rig(bare, "kodak", 0.001, np.deg2rad(0.001))
    for rows, own in zip(made.more, block.more, strict=True):
        np.testing.assert_array_equal(rows.image, own.image)
        np.testing.assert_allclose(rows.sigma, own.sigma)
    near = made.start.unknowns.more["rig_cameras"]["oblique"]
    np.testing.assert_allclose(np.degrees(near.turn), TRUE_TURN, atol=3.0)
    assert np.abs(np.asarray(near.place) - TRUE_PLACE).max() < 10.0
    with pytest.raises(InputError, match="no image of camera leica"):
        with_rig(bare, "leica", 0.001, 1e-5)
    with pytest.raises(InputError, match="has no partition event"):
        with_rig(block, "kodak", 0.001, 1e-5)
    apart = dataclasses.replace(bare, partitions={"event": bare.images})
    with pytest.raises(InputError, match="no image of another camera is in an event of camera kodak"):
        with_rig(apart, "kodak", 0.001, 1e-5)
    unknown = dataclasses.replace(bare.start, image_known=np.zeros(28, bool))
    with pytest.raises(InputError, match="which locate oblique in the rig; orient the block first"):
        with_rig(dataclasses.replace(bare, start=unknown), "kodak", 0.001, 1e-5)
    fewer = tuple(f"{name} alone" if k == 1 else name for k, name in enumerate(events))
    with pytest.warns(UserWarning, match="1 photographs are in no event of the rig"):
        assert len(with_rig(dataclasses.replace(bare, partitions={"event": fewer}), "kodak", 0.001, 1e-5).more[0]) == 13


LATE = {
    "rig_cameras.oblique.delay_s": 0.0, "rig_cameras.oblique.delay": "free", "rig_cameras.oblique.truth.delay_s": 0.004,
    "rig_cameras.oblique.place": {"sigma_m": 0.005}, "rig_cameras.oblique.truth.place_m": [0.503, 0.102, -0.049],
    "jitter.rate_deg_per_s": 2.0,
    "mounts": {"default": {"lever_arm_m": [0.3, 2.0, 1.0], "truth": {"lever_arm_m": [0.3, 2.0, 1.0]}}},
}  # fmt: skip


@functools.cache
def late(noisy: bool = True):
    exact = {} if noisy else {"noise.rig_place_m": 0.0, "noise.rig_turn_deg": 0.0}
    return simulate(recipe_from(changed(RIG | LATE | exact)), 1)


def test_a_delayed_camera_is_at_the_later_pose_of_the_rig():
    """Beside the reference as it was at its own exposure: the way flown in the meantime, and the turn."""
    simulation = late(noisy=False)
    position, rotation = (np.asarray(v) for v in vars(simulation.truth.exterior).values())
    motion = simulation.block.motion
    for k in range(0, 28, 2):
        # The body's axes in the object frame; it turns about them for 4 ms, right-handed.
        body, rate = rotation[k].T @ NOMINAL["forward"].T, np.asarray(motion.rate)[k]
        turn = scipy_rotation.from_rotvec(body @ rate * 0.004).as_matrix()
        # The GNSS/IMU goes about the camera with its lever arm, the camera does not.
        flown = np.asarray(motion.velocity)[k] - body @ np.cross(rate, [0.3, 2.0, 1.0])
        there = position[k] + flown * 0.004 + turn @ rotation[k].T @ [0.503, 0.102, -0.049]
        np.testing.assert_allclose(position[k + 1], there, atol=1e-8)
        own = scipy_rotation.from_rotvec(-np.deg2rad(TRUE_TURN)).as_matrix() @ rotation[k] @ turn.T
        np.testing.assert_allclose(rotation[k + 1], own, atol=1e-12)


@pytest.mark.slow
def test_the_delay_of_a_camera_is_recovered():
    adjusted = adjust(late().block)
    assert adjusted.outcome is Outcome.CONVERGED
    sigma = dict(zip(adjusted.structure.labels, np.asarray(covariance(adjusted).shared_sigma), strict=True))
    estimated = float(adjusted.unknowns.more["rig_cameras"]["oblique"].delay)
    assert sigma["rig_cameras[oblique].delay_s"] < 4e-4
    assert abs(estimated - 0.004) < 3.3 * sigma["rig_cameras[oblique].delay_s"]
    assert 0.9 < adjusted.sigma0 < 1.1


def test_a_delay_goes_through_files_and_needs_the_motion(tmp_path):
    write_simulation(late(), tmp_path / "block")
    again = read_block(tmp_path / "block")
    np.testing.assert_allclose(again.motion.rate[::2], late().block.motion.rate[::2], rtol=1e-12)
    assert again.priors.more["rig_cameras"]["oblique"].delay == FREE
    table = pd.read_csv(tmp_path / "block/attitudes.csv")
    table.loc[table.image == "A_03", [c for c in table.columns if "rate" in c]] = np.nan
    table.to_csv(tmp_path / "block/attitudes.csv", index=False)
    with pytest.raises(BlockError, match=r"delay of \[unknowns\.rig_cameras\.oblique\] needs the motion of image A_03"):
        read_block(tmp_path / "block")
    with pytest.raises(RankError, match=r"rig_cameras\[oblique\]\.delay needs the motion of the rig"):
        adjust(dataclasses.replace(late().block, motion=None))
    bare = indirect(late().block)
    assert bare.motion is not None and not len(bare.stations)
    with pytest.raises(BlockError, match="needs the motion of image A_01, which is stored in stations"):
        write_block(bare, tmp_path / "bare")
    assert indirect(flown().block).motion is None


def test_a_trajectory_gives_nothing_to_heads_that_the_rig_alone_places(tmp_path):
    write_simulation(flown(), tmp_path / "block")
    images = pd.read_csv(tmp_path / "block/images.csv")
    images["time_s"] = 10.0 + np.repeat(np.arange(14.0), 2)
    images.to_csv(tmp_path / "block/images.csv", index=False)
    for name in ("stations", "attitudes"):
        (tmp_path / f"block/{name}.csv").unlink()
    time = np.linspace(0.0, 40.0, 81)
    level = {"roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0}
    level |= {f"sigma_{what}": 0.05 for what in ("X_m", "Y_m", "Z_m", "roll_deg", "pitch_deg", "yaw_deg")}
    flight = pd.DataFrame({"time_s": time, "X_m": 60.0 * time, "Y_m": 0.0, "Z_m": 1000.0} | level)
    flight.to_csv(tmp_path / "block/flight.csv", index=False)
    with (tmp_path / "block/block.toml").open("a") as file:
        file.write('\n[trajectory]\nfile = "flight.csv"\n')
    block = read_block(tmp_path / "block")
    assert set(block.stations.who) == set(block.attitudes.image) == set(range(0, 28, 2))


def test_a_rig_flies_beside_a_scanner_on_one_trajectory():
    """As one camera would: the scanner sees the same, and stations are those of the reference, on its clock."""
    with_rig_on = {name: RIG[name] for name in ("cameras.oblique", "rig_cameras", "points")}
    drift = {"drift_sigma_m": [0.2] * 3, "correlation_s": 60.0}
    rigidity = {"sigmas.rig_place_m": 0.001, "sigmas.rig_turn_deg": 0.001}
    scanned = {"terrain": {"kind": "waves"}, "lidar": {"density_per_m2": 0.01, "same_trajectory": True, "truth": drift},
               "sigmas.lidar_m": 0.03, "noise.station_m": 0.0}  # fmt: skip
    one, rigged = (simulate(recipe_from(changed(own | scanned)), 1) for own in ({}, with_rig_on | rigidity))
    np.testing.assert_array_equal(rigged.cloud.xyz, one.cloud.xyz)
    time = np.asarray(rigged.block.flight_time)
    np.testing.assert_array_equal(time[::2], one.block.flight_time)
    np.testing.assert_array_equal(time[1::2], one.block.flight_time)
    np.testing.assert_array_equal(rigged.block.stations.value, one.block.stations.value)
    off = np.asarray(rigged.block.stations.value).reshape(-1, 3) - np.asarray(rigged.truth.exterior.position)[::2]
    assert 0.05 < off.std() < 0.5 and np.abs(np.diff(off[:4], axis=0)).max() < 0.2


def test_a_photograph_of_a_camera_outside_the_rig_is_refused():
    block = flown().block
    places = dataclasses.replace(block.more[0], image=np.roll(block.more[0].reference, 1))
    with pytest.raises(RankError, match=r"rig_places has image C_04, but its camera kodak is not in the rig: add"):
        adjust(dataclasses.replace(block, more=(places,)))


def test_a_rig_without_rigidity_is_refused():
    unsaid = {key: value for key, value in RIG.items() if not key.startswith("sigmas")}
    with pytest.raises(InputError, match=r"\[sigmas\]: the rigidity of the rig is missing; add rig_place_m"):
        recipe_from(changed(unsaid))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sigmas.rig_turn_deg": 0.0}, r"\[sigmas\] rig_turn_deg: 0\.0 is not positive"),
        ({"cameras.third": OBLIQUE}, r"\[rig_cameras\]: all cameras but the reference camera need a rig table"),
        ({"rig_cameras.oblique.turn_deg": [1.0]}, r"turn_deg: \[1\.0\] has 1 entries; give 3"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        recipe_from(changed(RIG | changes))
