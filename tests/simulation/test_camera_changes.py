"""Cameras that change during a flight, and rolling shutters: projection, block and truth."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import FREE, BlockError, InputError
from jaxphoto.camera import RowMotion
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.io import read_block, read_truth, recipe_from, write_simulation
from jaxphoto.simulation import image_coordinates
from jaxphoto.simulation.camera_changes import draw_changes
from jaxphoto.simulation.flight import fly
from tests.camera.test_rolling_shutter import by_bisection
from tests.derivatives import compiled
from tests.simulation.small import changed, made, plain

TRUE = {"c_rate_mm_per_h": 0.5, "xp_rate_mm_per_h": -0.3}
RATES = {"camera_rates": {"kodak": {"c_rate": "free", "xp_rate": {"sigma_mm_per_h": 0.4}, "truth": TRUE}}}


def test_every_exposure_sees_through_the_camera_of_its_time():
    block, truth, _ = made(RATES | {"flight.turn_s": 120.0})
    rows, camera = block.image_points, truth.interior["kodak"]
    time = block.flight_time
    assert abs(time.mean()) < 1e-9
    strips = np.array(block.image_strip)
    a, b = time[strips == "A"], time[strips == "B"]
    assert b[0] - a[-1] == pytest.approx(120.0)
    np.testing.assert_allclose(a - a.mean(), block.image_time[strips == "A"], atol=1e-9)
    seen = compiled(lambda c, x_p, position, rotation, point: project(
        dataclasses.replace(camera, c=c, xp=x_p), ExteriorOrientation(position, rotation), point
    ))  # fmt: skip
    for k in range(0, len(rows), 41):
        i, hours = rows.image[k], time[rows.image[k]] / 3600
        position, rotation = (np.asarray(v)[i] for v in (truth.exterior.position, truth.exterior.camera_from_object))
        own = seen(camera.c + 0.5 * hours, camera.xp - 0.3 * hours, position, rotation, truth.points[rows.point[k]])
        np.testing.assert_allclose(rows.xy[k], own, atol=1e-9)
    assert 0.01 < np.abs(rows.xy - plain().block.image_points.xy).max() < 0.1


def test_the_block_knows_what_the_recipe_says_and_truth_is_told():
    block, truth, _ = made(RATES)
    start, prior = block.start.unknowns.more["camera_rates"]["kodak"], block.priors.more["camera_rates"]["kodak"]
    assert float(start.c_rate) == 0.0 and prior.c_rate == FREE and float(prior.xp_rate.sigma) == 0.4
    assert float(truth.more["camera_rates"]["kodak"].c_rate) == 0.5
    unknowing = made({"camera_rates": {"default": {"truth": TRUE}}})
    assert not unknowing.block.start.unknowns.more
    assert np.array_equal(unknowing.block.image_points.xy, block.image_points.xy)


THERMAL = {
    "thermal_rates": {"kodak": {"c_rate": "free", "truth": {"c_rate_mm_per_K": 0.002, "yp_rate_mm_per_K": -0.001}}},
    "temperature": {"begin_c": 25.0, "air_c": 5.0, "time_constant_s": 100.0, "reference_c": 20.0},
}


def test_a_camera_cools_as_newton_says():
    block, _, _ = made(THERMAL)
    time = block.flight_time - block.flight_time[0]
    np.testing.assert_allclose(block.temperatures.celsius, 5 + 20 * np.exp(-time / 100), atol=1e-9)
    assert block.temperatures.reference_c == 20.0


STRIPS = {
    "strip_cameras": {
        "default": {
            "c_more": {"sigma_mm": 0.02}, "xp_more": {"sigma_mm": 0.02}, "yp_more": {"sigma_mm": 0.02},
            "truth": {"yp_more": {"sigma_mm": 0.01}},
        },
        "A": {"truth": {"c_more_mm": 0.01}},
    },
    "camera_walk": {"c_mm": 0.1, "xp_mm": 0.05, "yp_mm": 0.05, "truth": {"xp_mm": 0.2}},
    "flight.turn_s": 300.0,
}  # fmt: skip
SPLINE = {"camera_splines": {"kodak": {
    "knots": 6, "interval_s": 100.0, "c_spline": {"walk_mm": 0.1}, "truth": {"c_spline": {"walk_mm": 0.3}},
}}}  # fmt: skip


def test_cameras_of_strips_walk():
    """Of strip A the block knows nothing; each draws its own, and all a walk from strip to strip."""
    block, truth, _ = made(STRIPS)
    cameras, walks = truth.more["strip_cameras"], []
    assert float(cameras["A"].c_more) == 0.01 and float(cameras["A"].xp_more) == 0.0
    assert float(cameras["B"].c_more) == 0.0 and float(cameras["B"].yp_more) != 0.0
    assert list(block.start.unknowns.more["strip_cameras"]) == ["B", "C"]
    (steps,) = block.more
    hours = np.diff([block.flight_time[np.array(block.image_strip) == name].mean() / 3600 for name in "ABC"])
    np.testing.assert_allclose(steps.sigma, np.sqrt(hours[1:]) * [[0.1, 0.05, 0.05]])
    for seed in range(60):
        own = draw_changes(recipe_from(changed(STRIPS)), flown(), block.flight_time, seed)["strip_cameras"]
        walks.append(np.diff([float(own[name].truth.xp_more) for name in "ABC"]) / np.sqrt(hours) / 0.2)
    assert abs(np.std(walks) - 1) < 4 / np.sqrt(2 * np.size(walks))


def flown():
    recipe = recipe_from(changed(STRIPS))
    return fly(recipe, recipe.plan, 0.0, 1)


def test_a_camera_wanders_along_its_spline():
    walks = [draw_changes(recipe_from(changed(SPLINE)), flown(), np.zeros(14), seed) for seed in range(60)]
    ends = np.array([np.asarray(walk["camera_splines"]["kodak"].truth.c_spline)[[0, -1]] for walk in walks])
    assert abs(np.std(ends) / (0.3 * np.sqrt(250 / 3600)) - 1) < 4 / np.sqrt(2 * ends.size)
    assert not np.asarray(walks[0]["camera_splines"]["kodak"].truth.xp_spline).any()


@pytest.mark.parametrize("changes", [RATES, THERMAL, STRIPS, SPLINE])
def test_measured_once_more_it_is_the_same_flight(changes):
    block, truth, _ = made(changes)
    np.testing.assert_allclose(image_coordinates(block, truth), block.image_points.xy, atol=1e-9)
    assert 0.001 < np.abs(block.image_points.xy - plain().block.image_points.xy).max() < 0.1


def test_it_goes_through_files(tmp_path):
    simulation = made(RATES)
    write_simulation(simulation, tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.priors.more == simulation.block.priors.more
    np.testing.assert_allclose(again.flight_time, simulation.block.flight_time, atol=1e-9)
    told = read_truth(tmp_path / "block")["georeferencing"].set_index("parameter").value
    assert told["camera_rates[kodak].c_rate_mm_per_h"] == 0.5


def test_a_photograph_without_a_time_is_named(tmp_path):
    write_simulation(made(RATES), tmp_path / "block")
    table = tmp_path / "block" / "images.csv"
    lines = table.read_text().splitlines()
    cells = lines[3].split(",")
    cells[lines[0].split(",").index("time_s")] = ""
    table.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]) + "\n")
    with pytest.raises(
        BlockError, match=r"row 4: image A_03 has no time_s, but in \[unknowns.camera_rates\] its camera kodak drifts"
    ):
        read_block(tmp_path / "block")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_rates.kodak.rate": 1.0}, r"\[camera_rates.kodak\] rate: unknown key"),
        ({"camera_rates.kodak.truth.c_rate": 1.0}, r"\[camera_rates.kodak.truth\] c_rate: 1.0 is not a status"),
        ({"camera_rates.leica": {}}, r"\[camera_rates\] leica: unknown key"),
        ({"flight.turn_s": -1.0}, r"\[flight\] turn_s"),
        ({"thermal_rates": THERMAL["thermal_rates"]}, "thermal_rates: the recipe has no temperature"),
        ({"camera_walk": {"c_mm": 0.1}}, r"camera_walk: no strip cameras"),
        (STRIPS | {"camera_walk.c_mm": 0.0}, r"\[camera_walk\]: give c_mm, xp_mm and yp_mm above zero"),
        (STRIPS | {"strip_cameras.A.truth": {"c_more": "free"}}, r"A\.truth\] c_more: a true value cannot be free"),
        (SPLINE | {"camera_splines.kodak.knots": 7}, r"kodak\.truth\]: knots = 7 is not an even number"),
        (THERMAL | {"temperature.time_constant_s": 0.0}, r"\[temperature\] time_constant_s: 0.0 is not positive"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        recipe_from(changed(RATES | changes))


def test_a_convergent_set_has_no_time():
    set_ = {"field_m": [1.0, 1.0], "stations": [{"name": "a", "distance_m": 2.0, "tilt_deg": 30.0}]}
    with pytest.raises(InputError, match=r"camera_rates: a convergent set has no strips and no times"):
        recipe_from(changed(RATES | {"flight": None, "convergent": set_}))


SHUTTER = {"shutters": {"kodak": {"readout_ms": 10.0, "readout": "free", "truth": {"readout_ms": 30.0}}}}


def test_rows_are_seen_at_their_true_time():
    still, rolling = made(), made(SHUTTER)
    block, truth = rolling.block, rolling.truth
    camera, rows = truth.interior["kodak"], block.image_points
    difference = np.asarray(rows.xy) - np.asarray(still.block.image_points.xy)
    # 60 m/s for 15 ms are 0.9 m or 0.03 mm on the ground 1000 m below; the turn adds to it.
    assert 0.02 < np.abs(difference).max() < 0.2
    for k in range(0, len(rows), 37):
        name = block.images[rows.image[k]]
        position, rotation = (
            np.asarray(v)[rows.image[k]] for v in (truth.exterior.position, truth.exterior.camera_from_object)
        )
        own = truth.more["motions"][name]
        motion = np.concatenate([own.velocity, own.rate])
        seen = by_bisection(camera, position, rotation, motion, 30.0, truth.points[rows.point[k]])
        np.testing.assert_allclose(rows.xy[k], seen, atol=1e-9)
    np.testing.assert_allclose(image_coordinates(block, truth), rows.xy, atol=1e-9)


def test_the_block_is_told_motions_with_the_error_that_it_states():
    told = {"velocity_m_per_s": 0.5, "rate_deg_per_s": 0.2}
    block, truth, _ = made({"shutters": {"default": SHUTTER["shutters"]["kodak"] | told}})
    assert float(block.start.unknowns.more["shutters"]["kodak"].readout) == 10.0
    assert float(truth.more["shutters"]["kodak"].readout) == 30.0
    start, true = (
        np.array([[*m.velocity, *np.degrees(m.rate)] for m in u.more["motions"].values()])
        for u in (block.start.unknowns, truth)
    )
    z = (start - true) / np.repeat([0.5, 0.2], 3)
    assert 0.7 < z.std() < 1.3
    # Forward is where the camera's x axis points.
    assert (true[:, 0] > 55).all()
    prior = block.priors.more["motions"][block.images[0]]
    assert np.allclose(prior.velocity.sigma, 0.5) and np.allclose(prior.rate.sigma, np.radians(0.2))


def test_a_block_need_not_know():
    rolling = made({"shutters": {"kodak": {"truth": {"readout_ms": 30.0}}}})
    assert not rolling.block.start.unknowns.more
    assert np.array_equal(rolling.block.image_points.xy, made(SHUTTER).block.image_points.xy)


def test_a_readout_adds_up_to_rows():
    rows = RowMotion(1e-3, 5.0, 0.0, 0.0)
    assert np.allclose(rows.at_row(-12.0, (0.0, 0.0, -100.0)), (-0.06, 0.0, -100.0))
