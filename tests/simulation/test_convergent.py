"""Convergent sets: positions, directions and rotations as given, and the test fields of the papers."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxphoto
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, read_recipe, recipe_from, write_simulation
from jaxphoto.report import Tables
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from jaxphoto.simulation import Field, Simulation, Station, simulate
from tests.simulation.small import RECIPES, changed

GOPRO = tomllib.loads((RECIPES / "002.toml").read_text())
TEST_FIELD = Path(__file__).parents[2] / "experiments" / "004" / "testfield.toml"
bounded = settings(max_examples=60, deadline=None, derandomize=True, database=None)


def made(changes, seed: int = 3) -> Simulation:
    return simulate(recipe_from(changed(changes, GOPRO)), seed)


@bounded
@given(st.floats(0.1, 10), st.floats(-360, 360), st.floats(0, 89), st.floats(-360, 360))
def test_a_station_aims_tilts_and_rolls_as_asked(distance, azimuth, tilt, roll):
    station = Station("S", "c", distance, azimuth, tilt, roll)
    matrix, level = station.camera_from_object, Station("S", "c", distance, azimuth, tilt).camera_from_object
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) > 0
    # The middle of the field lies on the axis, in front.
    np.testing.assert_allclose(matrix @ -station.position, [0, 0, -distance], atol=1e-9)
    looks = -station.position / distance
    assert np.rad2deg(np.arccos(np.clip(-looks[2], -1, 1))) == pytest.approx(tilt, abs=1e-5)
    a = np.deg2rad(azimuth)
    np.testing.assert_allclose(looks[:2], np.sin(np.deg2rad(tilt)) * np.array([np.sin(a), np.cos(a)]), atol=1e-9)
    # Without roll x is level and y up; the roll is a turn about z, from x towards y.
    assert abs(level[0, 2]) < 1e-12
    assert level[1, 2] >= 0
    r = np.deg2rad(roll)
    np.testing.assert_allclose(matrix[0], np.cos(r) * level[0] + np.sin(r) * level[1], atol=1e-9)


@pytest.mark.parametrize("tilt, roll", [(0.0, 0.0), (40.0, 0.0), (0.0, 90.0), (25.0, -30.0)])
def test_looking_north_tilt_is_omega_and_roll_is_kappa(tilt, roll):
    expected = matrix_from_omega_phi_kappa(np.deg2rad([tilt, 0.0, roll]))
    np.testing.assert_allclose(Station("S", "c", 1.0, 0.0, tilt, roll).camera_from_object, expected, atol=1e-12)


def test_test_field_of_002():
    recipe = read_recipe(RECIPES / "002.toml")
    block, truth, _ = simulate(recipe, 7)
    assert (len(block.images), len(block.points), len(set(block.control.who))) == (18, 35, 35)
    places = truth.exterior.position
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.75)
    assert len(np.unique(np.round(places, 9), axis=0)) == 9
    tilts = np.rad2deg(np.arccos(places[:, 2] / 0.75))
    np.testing.assert_allclose(tilts, [0.0] * 2 + [40.0] * 16, atol=1e-6)
    # Two images a station, the second on its side.
    first, second = truth.exterior.camera_from_object.reshape(9, 2, 3, 3).transpose(1, 0, 2, 3)
    np.testing.assert_allclose(second[:, 0], first[:, 1], atol=1e-12)
    seen = block.image_points
    assert np.bincount(seen.image)[0] == 35
    assert np.bincount(seen.point, minlength=35).min() >= 8
    assert np.bincount(seen.image).min() >= 26
    np.testing.assert_allclose(truth.points[[0, 1, 6, 7, 34], :2], [[-0.6, -0.45], [-0.4, -0.45], [0.6, -0.45],
                                                                  [-0.6, -0.225], [0.6, 0.45]], atol=1e-12)  # fmt: skip
    assert (block.stations.who.size, block.attitudes.image.size, block.motion) == (0, 0, None)
    assert set(block.image_strip) == {""}


def test_test_field_of_004():
    recipe = read_recipe(TEST_FIELD)
    for seed in range(4):
        block, truth, _ = simulate(recipe, seed)
        assert (len(block.points), len(set(block.control.who)), len(block.check.who)) == (60, 60, 0)
        assert not np.any(truth.points[:, 2])
        assert np.bincount(block.image_points.point, minlength=60).min() >= 2
        assert set(block.control.sigma) == {0.001}
        assert (block.image_points.sigma == 0.00395).all()


@pytest.mark.slow
def test_calibration_over_the_test_field_is_about_as_good_as_printed():
    sigma = {"c_mm": 0.012, "xp_mm": 0.005, "yp_mm": 0.006, "k1": 1.0635e-6, "k2": 2.3956e-9}
    result = jaxphoto.adjust(simulate(read_recipe(TEST_FIELD), 0).block)
    found = {s.parameter: s for s in Tables(result).significance}
    assert set(found) == set(sigma)
    for name, printed in sigma.items():
        assert found[name].sigma == pytest.approx(printed, rel=0.5)


def test_jitter_moves_turns_and_rolls_by_what_is_asked():
    stations = [{"name": f"S{k}", "distance_m": 0.75, "tilt_deg": 20.0, "roll_deg": [0.0] * 50} for k in range(4)]
    jitter = {"position_m": [0.01, 0.02, 0.03], "angle_deg": 0.5, "crab_deg": 2.0}
    plan = {"convergent.stations": stations}
    still, moved = made(plan).truth.exterior, made(plan | {"jitter": jitter}).truth.exterior
    spread = (moved.position - still.position).std(axis=0)
    # A standard deviation of 200 is known to 5 %; four of these.
    np.testing.assert_allclose(spread, jitter["position_m"], rtol=0.2)
    turn = moved.camera_from_object @ still.camera_from_object.transpose(0, 2, 1)
    angles = np.rad2deg([turn[:, 1, 2], turn[:, 2, 0], turn[:, 0, 1]]).std(axis=1)
    np.testing.assert_allclose(angles, [0.5, 0.5, 2.0], rtol=0.2)


def test_points_fill_the_field_and_places_are_parts_of_it():
    targets = [{"role": "check", "count": 200}, {"role": "control", "at": [[1.0, 0.0], [0.0, -0.5]], "prefix": "P"}]
    block, truth, _ = made({"points": {"ties": 200}, "targets": targets})
    spread = truth.points[:400, :2]
    assert (np.abs(spread) <= [0.6, 0.45]).all()
    np.testing.assert_allclose(spread.std(axis=0), np.array([1.2, 0.9]) / np.sqrt(12), rtol=0.1)
    np.testing.assert_allclose(truth.points[400:, :2], [[0.6, 0.0], [0.0, -0.225]])
    assert (len(set(block.check.who)), len(set(block.control.who))) == (200, 2)
    turned = np.array([[0.6, 0.8], [-0.8, 0.6]])
    np.testing.assert_allclose(Field((2.0, 1.0)).extent(turned), [[-1.0, -1.1], [1.0, 1.1]])


def test_arms_of_a_field_are_its_sides():
    choice = {"role": "control", "outermost": 1, "centre": True}
    block, truth, _ = made({"targets": [{"role": "check", "grid": [5, 5], "choice": choice}], "noise.control_m": 0.0})
    chosen = truth.points[sorted(set(block.control.who)), :2]
    assert len(chosen) == 5
    assert {tuple(np.sign(np.round(xy, 9))) for xy in chosen} >= {(0.0, 0.0)}
    assert (chosen.min(axis=0) == [-0.6, -0.45]).all()
    assert (chosen.max(axis=0) == [0.6, 0.45]).all()


def test_the_field_may_lie_high_and_stations_may_be_observed():
    block, truth, offset = made({"terrain": {"height_m": 5.0}, "sigmas.station_m": 0.001, "noise": {"station_m": 0.0},
                                 "truth": {"datum_offset_m": [0.1, 0.0, 0.0]}})  # fmt: skip
    assert truth.exterior.position[0] == pytest.approx([0, 0, 5.75])
    observed = np.asarray(block.stations.value).reshape(-1, 3)
    np.testing.assert_allclose(observed, truth.exterior.position + offset, atol=1e-12)


def test_a_convergent_block_is_written_without_what_it_has_not(tmp_path):
    simulation = made({})
    write_simulation(simulation, tmp_path / "block")
    names = {path.name for path in (tmp_path / "block").iterdir()}
    assert not names & {"stations.csv", "attitudes.csv"}
    again = read_block(tmp_path / "block")
    assert again.images == simulation.block.images
    np.testing.assert_array_equal(again.image_points.xy, simulation.block.image_points.xy)


def test_approximate_positions_are_near_as_distances_are():
    recipe = recipe_from(GOPRO)
    assert recipe.start.position_m == pytest.approx(0.015)
    assert recipe_from(changed({"start.position_m": 0.3}, GOPRO)).start.position_m == 0.3


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"flight": {}}, r"\[flight\] strips: the key is missing"),
        ({"convergent": None}, r"\[flight\] or a table \[convergent\]; give one of the two"),
        ({"strips.default": {}}, "strips: a convergent set has no strips"),
        ({"convergent.size_m": 1.0}, r"\[convergent\] size_m: no such key is known; use field_m"),
        ({"convergent.field_m": 1.2}, "field_m: 1.2 is not a list"),
        ({"convergent.field_m": [1.2, 0.0]}, "field_m: 0.0 is not positive"),
        ({"convergent.stations": []}, "there are 0 images in all"),
        ({"convergent.stations.1.name": "front"}, "stations: two tables have the name front"),
        ({"convergent.stations.0.distance_m": [0.7, -1]}, "distance_m: -1 is not positive"),
        ({"convergent.stations.0.tilt_deg": 90.0}, "tilt_deg: a field is seen from tilts of 0 or more"),
        ({"convergent.stations.0.tilt_deg": None}, "tilt_deg: the key is missing"),
        ({"convergent.stations.0.roll_deg": []}, r"roll_deg: \[\] has 0 entries"),
        ({"convergent.stations.0.roll_deg": [0, "x"]}, "roll_deg: 'x' is not a finite number"),
        ({"convergent.stations.0.camera": "leica"}, r"no table \[cameras.leica\]; use one of gopro"),
        ({"points.across": 0.9}, r"\[points\] across: only a flight has this key"),
        ({"targets.0.grid": [7]}, r"\[targets, number 1\] grid: \[7\] has 1 entries; give 2"),
        ({"targets.0.grid": [7, 1]}, "grid: 1 is less than 2"),
        ({"targets.0.grid": [7, True]}, "grid: True is not a whole number"),
    ],
)
def test_mistakes_are_named_with_a_remedy(changes, message):
    with pytest.raises(InputError, match=f"^gopro.toml.*{message}"):
        recipe_from(changed(changes, GOPRO), "gopro.toml")


def test_a_camera_that_takes_no_image_is_refused():
    values = changed({"convergent.stations.0.camera": "gopro", "convergent.stations.1.camera": "gopro"}, GOPRO)
    values["cameras"]["spare"] = values["cameras"]["gopro"]
    with pytest.raises(InputError, match="spare: no image is taken with this camera"):
        recipe_from(values)


def test_a_field_that_is_not_seen_is_refused():
    with pytest.raises(BlockError, match=r"target at X -6.0 m.*seen in 1 image"):
        made({"convergent.field_m": [12.0, 9.0]})
