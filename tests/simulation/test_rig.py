"""A rig in a recipe: where its cameras are, what the block is told, and that the block finds them."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jaxphoto import Outcome, RankError, adjust, covariance
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import rig_place, rig_turn
from jaxphoto.io import read_block, read_truth, recipe_from, write_simulation
from jaxphoto.parameters import numbers_of
from jaxphoto.procedures.rig import with_rig
from jaxphoto.simulation import remeasure, simulate
from jaxphoto.simulation.further_rows import observed_anew
from jaxphoto.variants import some_images
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
def flown(bends: bool = True):
    still = {} if bends else {"noise.rig_place_m": 0.0, "noise.rig_turn_deg": 0.0}
    return simulate(recipe_from(changed(RIG | still)), 1)


def poses(simulation):
    """Of every event, the place (m) and turn (degrees) of the oblique camera beside the other."""
    position, rotation = (np.asarray(v) for v in vars(simulation.truth.exterior).values())
    place = compiled(jax.vmap(rig_place))(position[::2], rotation[::2], position[1::2])
    return np.asarray(place), np.degrees(compiled(jax.vmap(rig_turn))(rotation[::2], rotation[1::2]))


def test_cameras_sit_beside_the_one_that_is_flown():
    place, turn = poses(flown(bends=False))
    np.testing.assert_allclose(place, np.tile(TRUE_PLACE, (14, 1)), atol=1e-9)
    np.testing.assert_allclose(turn, np.tile(TRUE_TURN, (14, 1)), atol=1e-9)


def test_the_rig_bends_by_its_noise():
    place, turn = poses(flown())
    for off in ((place - TRUE_PLACE) / 0.001, (turn - TRUE_TURN) / 0.001):
        assert abs(np.std(off) - 1) < 4 / np.sqrt(2 * off.size)


def test_the_block_is_told_which_photographs_belong_together():
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
    for label, value, want in zip(own.labels("oblique"), numbers_of(own), numbers_of(true), strict=True):
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


def test_measured_once_more_the_rig_bends_anew():
    block, truth, _ = flown()
    place, _ = poses(flown())
    off = np.array([observed_anew(block.more[0], block, truth, jax.random.key(k)).off for k in range(40)])
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
    with pytest.raises(InputError, match="nothing says where oblique is in the rig; orient the block first"):
        with_rig(dataclasses.replace(bare, start=unknown), "kodak", 0.001, 1e-5)
    fewer = tuple(f"{name} alone" if k == 1 else name for k, name in enumerate(events))
    with pytest.warns(UserWarning, match="1 photographs are in no event of the rig"):
        assert len(with_rig(dataclasses.replace(bare, partitions={"event": fewer}), "kodak", 0.001, 1e-5).more[0]) == 13


def test_a_photograph_of_a_camera_outside_the_rig_is_refused():
    block = flown().block
    places = dataclasses.replace(block.more[0], image=np.roll(block.more[0].reference, 1))
    with pytest.raises(RankError, match=r"rig_places has image C_04, but its camera kodak is not in the rig: add"):
        adjust(dataclasses.replace(block, more=(places,)))


def test_a_rig_of_which_nobody_says_how_rigid_it_is_is_refused():
    unsaid = {key: value for key, value in RIG.items() if not key.startswith("sigmas")}
    with pytest.raises(InputError, match=r"\[sigmas\]: nothing says how rigid the rig is; add rig_place_m"):
        recipe_from(changed(unsaid))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sigmas.rig_turn_deg": 0.0}, r"\[sigmas\] rig_turn_deg: 0\.0 is not positive"),
        ({"cameras.third": OBLIQUE}, r"\[rig_cameras\]: all cameras but one sit in a rig beside that one"),
        ({"rig_cameras.oblique.turn_deg": [1.0]}, r"turn_deg: \[1\.0\] is not a list of three numbers"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        recipe_from(changed(RIG | changes))
