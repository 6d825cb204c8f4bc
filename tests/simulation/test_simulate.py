"""Simulated blocks are their truth plus the noise and the systematic effects of the recipe."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxphoto.block import Block
from jaxphoto.compiling.fast_compilation import jit_quickly
from jaxphoto.errors import BlockError
from jaxphoto.io import recipe_from
from jaxphoto.simulation import Choice, Simulation, remeasure
from jaxphoto.simulation.points import _chosen
from jaxphoto.unknowns import FIXED, FREE
from tests.blocks import observed
from tests.formulas import axis_rotation, camera_from_object, collinearity
from tests.simulation.small import changed, made, plain

ARM = np.array([0.4, -1.2, 2.0])
HEADINGS = np.repeat([75.0, 255.0, 345.0], [5, 5, 4])
LIST = {"image_mm": 0.002, "control_m": 0.05, "station_m": [0.1, 0.2, 0.3], "attitude_deg": [0.01, 0.02, 0.04]}
EXACT = dict.fromkeys((*LIST, "target_mm"), 0.0)


def body_of(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """`object_from_body` as three turns of the aircraft: yaw clockwise, nose up, right wing down (x right, y ahead)."""
    return (axis_rotation(1, roll) @ axis_rotation(0, pitch) @ axis_rotation(2, -yaw)).T


def true_positions(simulation: Simulation) -> np.ndarray:
    return np.asarray(simulation.truth.exterior.position)


def stations_of(simulation: Simulation) -> np.ndarray:
    return np.asarray(simulation.block.stations.value).reshape(-1, 3)


def same_numbers(a, b) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in pairs)


def wrapped(angle):
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def test_cameras_hang_in_the_aircraft_and_look_down():
    block, truth, _ = plain()
    attitude = np.asarray(block.attitudes.roll_pitch_yaw)
    # Columns: camera x (forward), y (left), z (up) in body axes right, forward, up.
    forward = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    for matrix, angles in zip(np.asarray(truth.exterior.camera_from_object), attitude, strict=True):
        np.testing.assert_allclose(matrix, (body_of(*angles) @ forward).T, atol=1e-12)
    off = np.rad2deg(wrapped(attitude - np.deg2rad(HEADINGS)[:, None] * [0, 0, 1]))
    assert (np.abs(off.mean(axis=0)) < 3 * np.array([2, 2, 3]) / np.sqrt(14)).all()
    assert ((off.std(axis=0) > np.array([1, 1, 1.5])) & (off.std(axis=0) < np.array([3.2, 3.2, 4.8]))).all()


def test_crab_turns_the_camera_and_not_the_track():
    crabbed, straight = made(), made({"jitter.crab_deg": 0.0})
    np.testing.assert_array_equal(true_positions(crabbed), true_positions(straight))
    yaw = np.asarray(straight.block.attitudes.roll_pitch_yaw)[:, 2]
    np.testing.assert_allclose(wrapped(yaw - np.deg2rad(HEADINGS)), 0, atol=1e-12)


@pytest.mark.parametrize("image_x, turn", [("forward", 0.0), ("left", 90.0), ("back", 180.0), ("right", -90.0)])
def test_image_x_points_where_the_mount_says(image_x, turn):
    simulation = made({"mounts.default.image_x": image_x, "jitter": {}, "points.ties": 60, "points.ends": 1.0})
    matrices = np.asarray(simulation.truth.exterior.camera_from_object)
    heading = np.deg2rad(HEADINGS - turn)
    np.testing.assert_allclose(matrices[:, 0, :2], np.column_stack([np.sin(heading), np.cos(heading)]), atol=1e-12)
    np.testing.assert_allclose(matrices[:, 2], np.tile([0, 0, 1.0], (14, 1)), atol=1e-12)


def test_heights_are_above_the_mean_terrain():
    slope = {"kind": "plane", "height_m": 500.0, "slope_east_percent": 3.0}
    simulation = made({"terrain": slope, "jitter": {}, "flight.strips.1.height_m": 1200.0})
    up = true_positions(simulation)[:, 2]
    np.testing.assert_allclose(up[5:10] - up[:5], 200, atol=1e-9)
    points = np.asarray(simulation.truth.points)
    np.testing.assert_allclose(points[:, 2], 500 + 0.03 * points[:, 0], atol=1e-9)
    # The swaths lie around the origin, so their mean height is near that of the plane there.
    assert abs(up[0] - 1500) < 3


def test_points_are_imaged_where_the_formulas_say():
    block, truth, _ = plain()
    rows, angles = block.image_points, np.asarray(truth.exterior.omega_phi_kappa)
    for matrix, three in zip(truth.exterior.camera_from_object, angles, strict=True):
        np.testing.assert_allclose(camera_from_object(*three), matrix, atol=1e-12)
    for image, point, xy in zip(rows.image, rows.point, np.asarray(rows.xy), strict=True):
        reduced = xy - [0.064, 0.273]
        r2 = reduced @ reduced
        ideal = reduced * (1 - (-9.12e-5 * r2 + 1.0435e-7 * r2 * r2))
        expected = collinearity(34.25, angles[image], true_positions(plain())[image], truth.points[point])
        np.testing.assert_allclose(ideal, expected, atol=1e-9)
    assert (np.abs(rows.xy) < [18, 12]).all()
    assert np.bincount(rows.point).min() >= 2


def test_start_is_what_the_block_knows_and_truth_what_is():
    block, truth, _ = plain()
    start = block.start.unknowns
    kodak, true = start.interior["kodak"], truth.interior["kodak"]
    assert (float(kodak.c), float(kodak.distortion.k1), float(kodak.distortion.k2)) == (34.0, -8e-5, 0.0)
    assert (float(true.c), float(true.distortion.k1), float(true.distortion.k2)) == (34.25, -9.12e-5, 1.0435e-7)
    priors = block.priors.interior["kodak"]
    assert (priors.c, priors.xp, priors.distortion.k1) == (FREE, FIXED, FREE)
    off = np.asarray(start.exterior.position) - true_positions(plain())
    assert 3 < off.std() < 7
    turn = np.einsum("nij,nkj->nik", start.exterior.camera_from_object, truth.exterior.camera_from_object)
    assert 0.6 < np.rad2deg(np.stack([turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2]]).std()) < 1.4
    given = np.unique(block.control.who)
    np.testing.assert_array_equal(np.flatnonzero(block.start.point_known), given)
    np.testing.assert_array_equal(np.asarray(start.points)[given], truth.points[given])
    near = made({"start": {"position_m": 0.0, "angle_deg": 0.0, "points_m": 0.5}})
    np.testing.assert_array_equal(near.block.start.unknowns.exterior.position, true_positions(near))
    assert near.block.start.point_known.all()
    assert 0.3 < (near.block.start.unknowns.points - near.truth.points)[:40].std() < 0.7


def test_without_noise_observations_are_true():
    block, truth, offset = plain()
    np.testing.assert_array_equal(stations_of(plain()), true_positions(plain()))
    np.testing.assert_array_equal(block.control.value, truth.points[block.control.who, block.control.axis])
    np.testing.assert_array_equal(block.check.value, truth.points[block.check.who, block.check.axis])
    assert not offset.any()
    assert (truth.strips, truth.mounts, block.motion) == ({}, {}, None)


def test_datum_offset_is_added_to_every_station_and_is_in_no_model():
    simulation = made({"truth.datum_offset_m": [-0.131, 0.186, 0.0]})
    off = stations_of(simulation) - true_positions(simulation)
    np.testing.assert_allclose(off, np.tile([-0.131, 0.186, 0.0], (14, 1)), atol=1e-9)
    assert simulation.block.start.unknowns.strips == {}
    np.testing.assert_array_equal(simulation.truth.strips["B"].shift, [-0.131, 0.186, 0.0])
    np.testing.assert_array_equal(stations_of(plain()), true_positions(simulation))


def test_shift_and_drift_of_a_strip_grow_from_the_mean_time():
    changes = {
        "strips.A.truth": {"shift_m": [0.5, -0.4, 0.3], "drift_m_per_s": [0.01, 0.02, -0.03]},
        "strips.default": {"shift": "free", "shift_m": [0.1, 0.0, 0.0], "truth": {"drift_m_per_s": [0.0, 0.0, 0.1]}},
    }
    simulation = made(changes)
    off = stations_of(simulation) - true_positions(simulation)
    base = 0.4 * 36 * 1000 / 34.25
    seconds = (np.arange(5) - 2) * base / 60
    np.testing.assert_allclose(off[:5], [0.5, -0.4, 0.3] + seconds[:, None] * [0.01, 0.02, -0.03], atol=1e-9)
    np.testing.assert_allclose(off[5:10], [0.1, 0, 0] + seconds[:, None] * [0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(simulation.block.image_time[:5], seconds, atol=1e-12)
    # The model of every strip is the default's; truth is each one's own.
    assert list(simulation.block.start.unknowns.strips) == ["A", "B", "C"]
    assert simulation.block.priors.strips["A"].shift == FREE
    np.testing.assert_array_equal(simulation.block.start.unknowns.strips["A"].shift, [0.1, 0, 0])


def test_strips_that_only_have_a_truth_stay_out_of_the_model():
    spread = {"shift_sigma_m": [0.3, 0.3, 0.0], "drift_sigma_m_per_s": 0.01}
    one, other = made({"strips.default.truth": spread}), made({"strips.default.truth": spread}, seed=2)
    assert one.block.start.unknowns.strips == {}
    shifts = np.array([s.shift for x in (one, other) for s in x.truth.strips.values()])
    assert (shifts[:, 2] == 0).all()
    assert len(np.unique(shifts[:, :2])) == 12
    assert 0.1 < shifts[:, :2].std() < 0.6
    for simulation in (one, other):
        off = (stations_of(simulation) - true_positions(simulation))[10:]
        expected = [
            b.shift + np.outer(simulation.block.image_time[10:], b.drift) for b in [simulation.truth.strips["C"]]
        ]
        np.testing.assert_allclose(off, expected[0], atol=1e-9)


def test_lever_arm_and_boresight_of_the_truth():
    truth = {"lever_arm_m": ARM.tolist(), "boresight_deg": [0.3, -0.2, 0.5]}
    simulation = made({"mounts.default": {"boresight": "free", "truth": truth}})
    attitude = np.asarray(simulation.block.attitudes.roll_pitch_yaw)
    np.testing.assert_allclose(attitude, plain().block.attitudes.roll_pitch_yaw, atol=1e-12)
    arms = np.array([body_of(*angles) @ ARM for angles in attitude])
    np.testing.assert_allclose(stations_of(simulation) - true_positions(simulation), arms, atol=1e-9)
    # The camera is turned against the same aircraft by the boresight, as seen in its own frame.
    was, now = (np.asarray(s.truth.exterior.camera_from_object) for s in (plain(), simulation))
    turn = np.einsum("nij,nkj->nik", was, now)
    x, y, z = np.deg2rad([0.3, -0.2, 0.5])
    first_order = np.eye(3) - np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    np.testing.assert_allclose(turn, np.tile(first_order, (14, 1, 1)), atol=1e-4)
    start = simulation.block.start.unknowns.mounts["default"]
    assert not np.any(start.lever_arm) and not np.any(start.boresight)
    assert simulation.block.priors.mounts["default"].boresight == FREE


def test_time_offset_moves_stations_back_and_attitudes_on():
    simulation = made({"mounts.default.truth.time_offset_s": 0.05})
    motion = simulation.block.motion
    heading = np.deg2rad(HEADINGS)
    velocity = 60 * np.column_stack([np.sin(heading), np.cos(heading), 0 * heading])
    np.testing.assert_allclose(motion.velocity, velocity, atol=1e-12)
    np.testing.assert_allclose(stations_of(simulation) - true_positions(simulation), -0.05 * velocity, atol=1e-9)
    rate = np.asarray(motion.rate)
    assert 0.3 < np.rad2deg(rate).std() < 0.7
    # What still has to turn after the recorded time: nose up about right, right wing down about forward.
    off = wrapped(np.asarray(plain().block.attitudes.roll_pitch_yaw) - simulation.block.attitudes.roll_pitch_yaw)
    np.testing.assert_allclose(off, 0.05 * rate[:, [1, 0, 2]] * [1, 1, -1], atol=0.06 * 0.05 * np.abs(rate).max())
    assert made({"mounts.default.time_offset": "free"}).block.motion is not None


def test_noise_has_the_true_sigmas_and_the_block_the_stated_ones():
    changes = {
        "noise": LIST | {"target_mm": 0.001},
        "sigmas": {"image_mm": 0.004, "target_mm": 0.003, "control_m": [0.01, 0.02, 0.03], "station_m": 0.1}
        | {"attitude_deg": 0.01},
        "targets": [{"count": 150, "role": "control"}],
        "points.ties": 150,
        "flight.strips.0.images": 40,
        "flight.strips.1.images": 40,
    }
    noisy, exact = made(changes), made(changes | {"noise": EXACT})
    target = np.asarray(exact.block.image_points.point) >= 150
    image = np.asarray(noisy.block.image_points.xy) - np.asarray(exact.block.image_points.xy)
    control = (np.asarray(noisy.block.control.value) - exact.block.control.value).reshape(-1, 3)
    station = stations_of(noisy) - stations_of(exact)
    attitude = np.rad2deg(np.asarray(noisy.block.attitudes.roll_pitch_yaw) - exact.block.attitudes.roll_pitch_yaw)
    for found, sigma in (
        (image[~target], 0.002), (image[target], 0.001), (control, 0.05), (station, [0.1, 0.2, 0.3]),
        (attitude, [0.01, 0.02, 0.04]),
    ):  # fmt: skip
        unit = found / np.broadcast_to(sigma, found.shape)
        assert abs(unit.mean()) < 4 / np.sqrt(unit.size)
        assert abs(unit.std() - 1) < 4 / np.sqrt(2 * unit.size)
        assert (np.abs(unit.std(axis=0) - 1) < 4 / np.sqrt(2 * len(unit))).all()
    # Each kind draws for itself.
    kinds = (station / [0.1, 0.2, 0.3], attitude / [0.01, 0.02, 0.04], image[: len(station)], control[: len(station)])
    for k, one in enumerate(kinds):
        for other in kinds[:k]:
            flat = np.ravel(one)[: other.size], np.ravel(other)[: one.size]
            assert abs(np.corrcoef(*flat)[0, 1]) < 4 / np.sqrt(len(flat[0]))
    block = noisy.block
    np.testing.assert_array_equal(block.image_points.sigma, np.where(target, 0.003, 0.004)[:, None] * np.ones(2))
    np.testing.assert_array_equal(block.control.sigma, np.tile([0.01, 0.02, 0.03], 150))
    np.testing.assert_array_equal(block.stations.sigma, 0.1)
    np.testing.assert_allclose(block.attitudes.sigma, np.deg2rad(0.01))


def test_targets_are_measured_like_ties_unless_told_apart():
    changes = {"noise": LIST, "targets": [{"count": 40, "role": "check"}]}
    noisy, exact = made(changes), made(changes | {"noise": EXACT})
    off = np.asarray(noisy.block.image_points.xy) - np.asarray(exact.block.image_points.xy)
    assert 0.0015 < off[np.asarray(noisy.block.image_points.point) >= 40].std() < 0.0025


def test_one_seed_one_block_bit_for_bit():
    noisy = {"noise": LIST}
    one, again, other = made(noisy), made(noisy), made(noisy, seed=2)
    assert same_numbers(one, again)
    assert one.block.images == other.block.images
    assert not np.array_equal(true_positions(one), true_positions(other))
    assert not np.array_equal(one.truth.points[:20], other.truth.points[:20])


def test_one_sigma_changes_one_kind_of_observation():
    one, other = made({"noise": LIST}), made({"noise": LIST | {"station_m": [0.2, 0.4, 0.6]}})
    assert same_numbers(one.truth, other.truth)
    same = dataclasses.replace(other.block, stations=one.block.stations)
    assert same_numbers(one.block, same)
    exact = true_positions(one)
    np.testing.assert_allclose(stations_of(other) - exact, 2 * (stations_of(one) - exact), atol=1e-9)


def test_more_targets_leave_the_ties_where_they_are():
    one, other = plain(), made({"targets.0.count": 20})
    np.testing.assert_array_equal(one.truth.points[:40], other.truth.points[:40])
    np.testing.assert_array_equal(true_positions(one), true_positions(other))


def roles_of(block: Block) -> dict[str, str]:
    roles = {}
    for k, point in enumerate(block.points):
        axes = "".join("XYZ"[a] for a in block.control.axis[block.control.who == k])
        roles[point] = axes or ("check" if k in block.check.who else "tie")
    return roles


def test_roles_of_targets():
    changes = {
        "targets": [
            {"role": "control", "count": 2},
            {"role": "vertical", "at": [[0.0, 0.0]], "prefix": "Z"},
            {"role": "check", "at_m": [[10.0, 20.0], [-30.0, 5.0, 77.0]]},
            {"role": "tie", "count": 1, "choice": {"role": "vertical", "first": 0}},
        ]
    }
    simulation = made(changes)
    roles = roles_of(simulation.block)
    assert list(roles)[40:] == ["T1", "T2", "Z1", "T3", "T4", "T5"]
    assert list(roles.values())[40:] == ["XYZ", "XYZ", "Z", "check", "check", "tie"]
    assert set(list(roles.values())[:40]) == {"tie"}
    points = simulation.truth.points
    np.testing.assert_array_equal(points[43, :2], [10.0, 20.0])
    np.testing.assert_array_equal(points[44], [-30.0, 5.0, 77.0])


def test_the_outermost_of_each_arm_and_the_centre():
    choice = {"role": "control", "outermost": 2, "centre": True, "first": 1}
    simulation = made({"targets": [{"count": 30, "role": "check", "choice": choice}]})
    xy = simulation.truth.points[40:, :2]
    arms = [np.array([np.sin(a), np.cos(a)]) for a in np.deg2rad([75, 255, 345, 165])]
    # The middle of the block, from where the strips begin and end and how wide they are.
    low, high = recipe_from(changed({})).ground.extent(np.eye(2))
    chosen = {k for k, role in enumerate(list(roles_of(simulation.block).values())[40:]) if role == "XYZ"}
    assert len(chosen) == 1 + 1 + 4 * 2
    assert {0, int(np.argmin(np.hypot(*(xy - (low + high) / 2).T)))} < chosen
    for arm in arms:
        outermost = np.argsort(-(xy @ arm))
        assert {int(k) for k in outermost[:2]} < chosen


@pytest.mark.parametrize("seed", range(20))
def test_a_target_at_two_ends_is_chosen_once(seed):
    recipe = recipe_from(changed({"targets": [{"count": 9, "role": "check"}]}))
    choice = Choice("control", outermost=2, centre=True)
    xy = np.random.default_rng(seed).uniform(-500, 500, (9, 2))
    chosen = _chosen(choice, xy, recipe.ground)
    assert sorted(chosen) == list(range(9))


def test_places_are_parts_of_the_block():
    corners = [[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]
    simulation = made({"targets": [{"role": "control", "at": corners}], "flight.strips.2": None})
    xy = simulation.truth.points[40:, :2]
    heading = np.deg2rad(75)
    ahead, right = np.array([np.sin(heading), np.cos(heading)]), np.array([np.cos(heading), -np.sin(heading)])
    base, width = 0.4 * 36 * 1000 / 34.25, 24 * 1000 / 34.25
    half_width = 0.25 * width + 0.95 * width / 2
    np.testing.assert_allclose(xy, [[0, 0], base * ahead, half_width / 2 * right], atol=1e-9)


def test_thinning_reaches_the_mean_number_of_rays():
    simulation = made({"points.mean_rays": 2.5})
    rows = simulation.block.image_points
    assert len(rows.point) == round(2.5 * 52)
    assert np.bincount(rows.point).min() == 2


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"points.min_images": 14}, "only 0 of 40 points are seen in 14 images"),
        ({"targets.0": {"role": "control", "at_m": [[9000.0, 0.0]]}}, "target at X 9000.0 m.*seen in 0 image"),
        ({"points.ties": 3, "targets": None, "noise.control_m": None}, "image . sees . point|image A_0. sees"),
    ],
)
def test_blocks_that_cannot_be_are_refused(changes, message):
    with pytest.raises(BlockError, match=message):
        made(changes)


def test_remeasuring_with_the_truth_gives_the_same_observations():
    changes = {
        "truth.datum_offset_m": [0.5, 0.0, 0.0],
        "strips.default.truth": {"shift_sigma_m": 0.5},
        "mounts.default.truth": {"lever_arm_m": ARM.tolist(), "boresight_deg": [0.1, 0.2, 0.3], "time_offset_s": 0.1},
        "sigmas": {"image_mm": 1e-12, "control_m": 1e-12, "station_m": 1e-12, "attitude_deg": 1e-12},
    }
    block, truth, _ = made(changes)
    # Compiled, because eager JAX would compile every operation.
    once = jit_quickly(lambda u, k: observed(remeasure(block, u, k)))
    xy, attitudes, *values = once(truth, jax.random.key(1))
    xy_was, attitudes_were, *values_were = observed(block)
    np.testing.assert_allclose(xy, xy_was, rtol=0, atol=1e-8)
    np.testing.assert_allclose(wrapped(attitudes - attitudes_were), 0, atol=1e-11)
    for value, was in zip(values, values_were, strict=True):
        np.testing.assert_allclose(value, was, rtol=0, atol=1e-8)
