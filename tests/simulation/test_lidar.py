"""Simulated clouds lie on ground and roofs, except for the simulated errors."""

import functools
import tomllib
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import corrected_point, covered, interpolate
from jaxphoto.io import read_block, recipe_from, write_simulation
from jaxphoto.io.clouds import read_cloud
from jaxphoto.io.recipe.truth import truth_tables
from jaxphoto.io.trajectory import read_flight_csv
from jaxphoto.lidar.correction import correct_strips, scanner_path
from jaxphoto.rotation import matrix_from_quaternion
from jaxphoto.simulation import Simulation
from jaxphoto.simulation.scene import roof_height
from tests.commands import run
from tests.simulation.small import RECIPES, changed, made

STRIPS = [
    {"name": "A", "heading_deg": 75.0, "images": 3, "across_spacings": 0.5},
    {"name": "B", "heading_deg": 255.0, "images": 3, "across_spacings": 0.5},
]
WAVES = [{"amplitude_m": 6.0, "length_m": 900.0}, {"amplitude_m": 4.0, "length_m": 700.0, "heading_deg": 30.0}]
TRUTH = {"boresight_deg": [0.08, -0.05, 0.2], "shift_m": {"A": [0.4, -0.3, 0.2]}, "shift_sigma_m": [0.1, 0.1, 0.05]}
SCENE: dict[str, Any] = {
    "flight.height_m": 400.0,
    "flight.strips": STRIPS,
    "jitter": {"position_m": 3.0, "angle_deg": 1.0, "crab_deg": 3.0, "rate_deg_per_s": 0.5},
    "terrain": {
        "kind": "waves",
        "waves": WAVES,
        "buildings": [{"roof": roof, "count": 12} for roof in ("flat", "gable", "monopitch")],
        "trees": [{"count": 60}],
    },
    "sigmas.lidar_m": [0.5, 0.5, 0.15],
    "noise.lidar_m": 0.0,
    "lidar": {"density_per_m2": 0.3, "truth": TRUTH},
}
GROUND, TREES, ROOFS = 2, 5, 6


@functools.cache
def exact() -> Simulation:
    """Without noise."""
    return made(SCENE)


@functools.cache
def noisy() -> Simulation:
    """With noise as stated, over the same flight."""
    return made(SCENE | {"noise.lidar_m": [0.5, 0.5, 0.15]})


def cloud_of(simulation: Simulation) -> Cloud:
    assert simulation.cloud is not None
    return simulation.cloud


@jax.jit
def _poses(trajectory, time):
    return interpolate(trajectory, time, 0.1)


@jax.jit
def _corrected(poses, boresight, xyz, shift):
    each = jax.vmap(corrected_point, in_axes=(0, 0, 0, None, 0))
    return each(xyz, poses.position, poses.object_from_body, boresight, shift)


def shift_of_points(simulation: Simulation) -> np.ndarray:
    cloud, scanner = cloud_of(simulation), simulation.truth.scanner
    return np.array([scanner.shifts[name] for name in cloud.strips])[cloud.strip]


def corrected(simulation: Simulation) -> np.ndarray:
    """The points of the cloud, corrected with the true scanner at the poses interpolated from the trajectory."""
    cloud = cloud_of(simulation)
    poses, boresight = _poses(simulation.trajectory, cloud.time), simulation.truth.scanner.boresight
    return np.asarray(_corrected(poses, boresight, cloud.xyz, shift_of_points(simulation)))


def test_with_the_true_scanner_points_come_back_onto_ground_and_roofs():
    simulation, cloud = exact(), cloud_of(exact())
    points, terrain = corrected(simulation), simulation.terrain
    assert bool(np.all(covered(simulation.trajectory, cloud.time, 0.02)))
    on_roof, on_ground = (cloud.classification == k for k in (ROOFS, GROUND))
    assert on_roof.sum() > 500 and on_ground.sum() > 100_000
    z = points[on_ground, 2]
    np.testing.assert_allclose(z, terrain.height(points[on_ground, :2]), rtol=0, atol=1e-4)
    # On an edge rounding may tell the place to lie beside the roof.
    off = points[on_roof, 2] - roof_height(terrain.buildings, points[on_roof, :2])
    assert (np.abs(off) < 1e-4).mean() > 0.999
    # As measured they are off by the shift, and by boresight times height.
    moved = cloud.xyz - points
    assert 0.3 < np.median(np.linalg.norm(moved, axis=1)) < 1.5
    assert set(np.unique(cloud.classification)) == {GROUND, TREES, ROOFS}


def test_boresight_and_shift_move_points_as_the_conventions_say():
    """Level flight east at 400 m: what a boresight of each axis and a shift do, by hand."""
    level = {
        "flight.strips": [{"name": "A", "heading_deg": 90.0, "images": 3}],
        "terrain": {"kind": "flat"},
        "jitter": {},
    }
    angle = np.deg2rad(0.1)
    for axis, boresight in enumerate(np.eye(3) * 0.1):
        truth = {"boresight_deg": boresight.tolist(), "shift_m": {"default": [1.0, 2.0, 3.0]}}
        simulation = made(SCENE | level | {"lidar": {"density_per_m2": 0.01, "truth": truth}})
        off = cloud_of(simulation).xyz - corrected(simulation) - [1.0, 2.0, 3.0]
        x = corrected(simulation)
        # Right is south, forward is east. `small_rotation` takes V to V - theta x V; the file has it undone.
        ahead, right, up = 0 * x[:, 0], -x[:, 1], 0 * x[:, 0] - 400
        turn = np.cross(np.eye(3)[axis] * angle, np.column_stack([right, ahead, up]))
        np.testing.assert_allclose(off, np.column_stack([turn[:, 1], -turn[:, 0], turn[:, 2]]), atol=3e-3)
        assert np.abs(off).max() > 0.1


def test_noise_is_as_stated_for_every_class():
    cloud = cloud_of(noisy())
    noise = (corrected(noisy()) - corrected(exact())) / [0.5, 0.5, 0.15]
    for k in (GROUND, TREES, ROOFS):
        mine = noise[cloud.classification == k]
        for axis in mine.T:
            low, high = chi2.ppf([1e-5, 1 - 1e-5], len(axis))
            assert low < (axis**2).sum() < high
            assert abs(axis.mean()) < 4.5 / np.sqrt(len(axis))
        assert np.abs(np.corrcoef(mine.T) - np.eye(3)).max() < 5 / np.sqrt(len(mine))
    # On level enough ground the heights are off by what a vertical sigma and slopes make of it.
    points = corrected(noisy())[cloud.classification == GROUND]
    assert noisy().terrain.buildings == exact().terrain.buildings
    off = points[:, 2] - noisy().terrain.height(points[:, :2])
    assert np.median(np.abs(off)) / 0.6745 == pytest.approx(np.hypot(0.15, 0.5 * 0.035), rel=0.03)


WRONG_ATTITUDE_DEG = [0.05, 0.02, -0.1]
WRONG = TRUTH | {
    "drift_m_per_s": {"A": [0.02, -0.01, 0.03]},
    "attitude_deg": {"default": WRONG_ATTITUDE_DEG},
    "attitude_drift_deg_per_s": {"B": [0.004, -0.002, 0.01]},
    "eccentricity_deg": [0.02, -0.03],
    "time_offset_s": 0.002,
}


@pytest.mark.parametrize("kind", ["line", "circle"])
def test_all_errors_are_removed_by_the_truth(kind):
    simulation = made(SCENE | {"lidar": {"density_per_m2": 0.02, "pattern": kind, "truth": WRONG}})
    cloud, errors = cloud_of(simulation), simulation.errors
    ground = cloud.classification == GROUND
    points = correct_strips(cloud, errors, scanner_path(simulation.trajectory)).xyz[ground]
    np.testing.assert_allclose(points[:, 2], simulation.terrain.height(points[:, :2]), rtol=0, atol=2e-4)
    assert np.abs(cloud.xyz[ground] - points).max() > 0.5
    # Shift and attitude at the middle of each strip, and how they go on.
    for k, strip in enumerate("AB"):
        spline, shift = errors.splines[k], simulation.truth.scanner.shifts[f"{k + 1}"]
        gone = np.array([-5.0, 0.0, 5.0])
        off, turn = errors.at(k, spline.times.mean() + gone)
        drift, rate = (WRONG[key].get(strip, np.zeros(3)) for key in ("drift_m_per_s", "attitude_drift_deg_per_s"))
        np.testing.assert_allclose(off, shift + np.outer(gone, drift), atol=1e-9)
        np.testing.assert_allclose(np.rad2deg(turn), np.add(WRONG_ATTITUDE_DEG, np.outer(gone, rate)), atol=1e-9)
    tables = truth_tables(simulation)
    told = tables["scanner"].set_index("parameter").value
    names = [f"scanner_calibration.eccentricity_{word}_deg" for word in ("cos", "sin")]
    np.testing.assert_allclose(told[names], WRONG["eccentricity_deg"], rtol=1e-12)
    assert told["scanner_calibration.time_offset_s"] == WRONG["time_offset_s"]
    table = tables["trajectory_errors"].set_index("strip")
    steps = table.loc["2"].filter(["time_s", "right_deg", "up_deg"]).diff().dropna()
    np.testing.assert_allclose(steps.right_deg / steps.time_s, 0.004, rtol=1e-9)
    np.testing.assert_allclose(steps.up_deg / steps.time_s, 0.01, rtol=1e-9)


def test_density_lines_and_returns():
    cloud = cloud_of(exact())
    points = corrected(exact())
    assert cloud.strips == ("1", "2")
    assert cloud.time is not None and cloud.returns is not None and cloud.strip is not None
    assert (np.diff(cloud.time) >= 0).all() and (np.diff(cloud.strip) >= 0).all()
    # In a circle below the middle of the strip; relief and height jitter change it by some per cent.
    recipe = recipe_from(changed(SCENE))
    for number, strip in enumerate(recipe.plan.strips):
        mine = points[(cloud.strip == number) & (cloud.returns[:, 0] == 1)]
        within = np.hypot(*(mine[:, :2] - strip.middle).T) < 90
        assert within.sum() / (np.pi * 90**2) == pytest.approx(0.3, rel=0.15)
        n = len(mine)
        swath = 2 * np.tan(np.deg2rad(20)) * 400 * (2 * strip.base_m + strip.footprint.along)
        assert n == pytest.approx(0.3 * swath, rel=0.02)
    # Returns of a pulse: of one time, numbered down its ray, the last but one and before from crowns.
    number, of = cloud.returns.T.astype(int)
    _, pulse, count = np.unique(cloud.time, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(of, count[pulse])
    np.testing.assert_array_equal(number == 1, np.diff(pulse, prepend=-1) == 1)
    np.testing.assert_array_equal(number[1:][np.diff(pulse) == 0] - number[:-1][np.diff(pulse) == 0], 1)
    assert (cloud.classification[number < of] == TREES).all()
    assert (np.diff(points[:, 2])[np.diff(pulse) == 0] < 0).all()
    assert of.max() >= 3
    # Some of what enters a crown comes through.
    through = (number > 1) & (cloud.classification == GROUND)
    assert through.sum() > 20


def test_crowns_hold_the_returns_of_vegetation():
    points = corrected(exact())[cloud_of(exact()).classification == TREES]
    inside = np.zeros(len(points), bool)
    for tree in exact().terrain.trees:
        middle = np.array([*tree.at_m, tree.foot_m + 0.65 * tree.height_m])
        half = np.array([tree.radius_m, tree.radius_m, 0.35 * tree.height_m])
        inside |= (((points - middle) / half) ** 2).sum(axis=1) <= 1 + 1e-4
    assert inside.all() and len(points) > 300


def test_buildings_throw_shadows():
    """No ray passes through a building: from the scanner to every point on the ground, by marching."""
    simulation, cloud = exact(), cloud_of(exact())
    points, terrain = corrected(simulation), simulation.terrain
    from_ = np.asarray(_poses(simulation.trajectory, cloud.time).position) - shift_of_points(simulation)
    near = np.zeros(len(points), bool)
    for b in terrain.buildings:
        near |= np.hypot(*(points[:, :2] - b.centre_m).T) < b.radius_m + 8
    chosen = np.flatnonzero(near & (cloud.classification == GROUND))
    assert len(chosen) > 2000
    length = np.linalg.norm(from_ - points, axis=1)[chosen]
    back = (from_ - points)[chosen] / length[:, None]
    for way in np.arange(0.05, 25, 0.25):
        on_ray = points[chosen] + way * back
        assert (roof_height(terrain.buildings, on_ray[:, :2]) < on_ray[:, 2] + 1e-3).all()
    # Under a roof there is no ground.
    assert np.isneginf(roof_height(terrain.buildings, points[cloud.classification == GROUND, :2])).all()


def test_the_trajectory_passes_through_the_exposures():
    """Of a block without noise, with a lever arm: stations and attitudes are on the trajectory, but for its shifts."""
    arm = {"mounts.default.truth": {"lever_arm_m": [0.3, -0.5, 1.0], "boresight_deg": [0.2, 0.1, -0.3]}}
    biased = {"strips.default.truth": {"shift_m": [0.7, 0.0, 0.0]}, "truth.datum_offset_m": [0.0, 0.4, 0.0]}
    simulation = made(SCENE | arm | biased)
    block, trajectory = simulation.block, simulation.trajectory
    shifts = list(simulation.truth.scanner.shifts.values())
    np.testing.assert_allclose(np.mean(shifts[0] - [0.4, -0.3, 0.2]), 0, atol=0.3)
    gaps = np.flatnonzero(np.diff(trajectory.time) > 0.02)
    assert len(gaps) == 1 and trajectory.time[0] == 0
    starts = trajectory.time[[0, gaps[0] + 1]]
    base, half_footprint = 0.4 * 36 * 400 / 34.25 / 60, 36 * 400 / 34.25 / 2 / 60
    for k in (0, 1):
        times = starts[k] + half_footprint + base * np.arange(3)
        poses = _poses(trajectory, times)
        station = np.asarray(block.stations.value).reshape(-1, 3)[3 * k : 3 * k + 3] - [0.7, 0.4, 0.0]
        np.testing.assert_allclose(poses.position - shifts[k], station, rtol=0, atol=1e-5)
        heading = np.deg2rad([75, 255][k])
        speed = 60 * np.array([np.sin(heading), np.cos(heading), 0])
        np.testing.assert_allclose(poses.velocity, np.tile(speed, (3, 1)), rtol=0, atol=0.01)
        angles = np.asarray(block.attitudes.roll_pitch_yaw)[3 * k : 3 * k + 3]
        body = np.stack([_body(*a) for a in angles])
        np.testing.assert_allclose(poses.object_from_body, body, rtol=0, atol=1e-6)
    lengths = np.linalg.norm(trajectory.quaternion, axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-12)


def test_photographs_have_the_errors_of_the_trajectory_that_they_share_with_the_scanner():
    """Without noise: stations and attitudes are those of the recorded trajectory at the times of the exposures."""
    drifts = {"drift_sigma_m": [0.3, 0.3, 0.3], "drift_sigma_deg": [0.05, 0.05, 0.1], "knots_s": 5.0}
    given = {"lidar.same_trajectory": True, "lidar.truth": TRUTH | drifts}
    flight, alone = made(SCENE | given), made(SCENE | {"lidar.truth": TRUTH | drifts})
    block, time = flight.block, np.asarray(flight.block.flight_time)
    assert abs(time.mean()) < 1e-9 and (np.diff(time) > 0).all()
    poses = _poses(flight.trajectory, time)
    np.testing.assert_allclose(np.reshape(block.stations.value, (-1, 3)), poses.position, rtol=0, atol=1e-5)
    body = np.stack([_body(*a) for a in np.asarray(block.attitudes.roll_pitch_yaw)])
    np.testing.assert_allclose(body, poses.object_from_body, rtol=0, atol=1e-6)
    # Everything else is that of a flight whose stations know nothing of the scanner's errors.
    np.testing.assert_array_equal(block.image_points.xy, alone.block.image_points.xy)
    np.testing.assert_allclose(flight.cloud.xyz, alone.cloud.xyz, rtol=0, atol=1e-6)
    off = np.reshape(block.stations.value - alone.block.stations.value, (-1, 3))
    at = [flight.errors.at(k, time[3 * k : 3 * k + 3])[0] for k in (0, 1)]
    np.testing.assert_allclose(off, np.concatenate(at), rtol=0, atol=1e-9)
    assert np.abs(off).max() > 0.2


def _body(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    ned = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
    ned = ned @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return swap @ ned @ swap


def test_one_seed_one_cloud_and_other_purposes_draw_apart():
    one, again = cloud_of(exact()), cloud_of(made(SCENE))
    for name in ("xyz", "classification", "returns", "time", "strip"):
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    other = made(SCENE, seed=2)
    assert not np.array_equal(cloud_of(other).xyz[:100], one.xyz[:100])

    bare = made({k: v for k, v in SCENE.items() if "lidar" not in k})
    denser = made(SCENE | {"lidar": SCENE["lidar"] | {"density_per_m2": 0.5}})
    for simulation in (bare, denser):
        for a, b in zip(jax.tree.leaves(simulation.block), jax.tree.leaves(exact().block), strict=True):
            np.testing.assert_array_equal(a, b)
        assert simulation.terrain == exact().terrain
    assert bare.cloud is None and bare.trajectory is None and bare.truth.scanner is None
    for a, b in zip(jax.tree.leaves(denser.trajectory), jax.tree.leaves(exact().trajectory), strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(jax.tree.leaves(denser.truth), jax.tree.leaves(exact().truth), strict=True):
        np.testing.assert_array_equal(a, b)
    # Another sigma scales the noise of the cloud, and changes nothing else.
    double = made(SCENE | {"noise.lidar_m": [1.0, 1.0, 0.3]})
    noise, twice = (corrected(s) - corrected(exact()) for s in (noisy(), double))
    np.testing.assert_allclose(twice, 2 * noise, rtol=0, atol=1e-9)
    block, truth, offset = exact()
    assert (block, truth, offset) == (exact().block, exact().truth, exact().datum_offset_m)


def test_what_is_written_is_what_was_scanned(tmp_path):
    simulation = noisy()
    write_simulation(simulation, tmp_path / "block")
    folder = tmp_path / "block"
    block = read_block(folder)
    np.testing.assert_array_equal(block.stations.value, simulation.block.stations.value)
    cloud, want = read_cloud(folder / "cloud.laz", block.frame), cloud_of(simulation)
    np.testing.assert_allclose(cloud.xyz, want.xyz, rtol=0, atol=0.00051)
    np.testing.assert_array_equal(cloud.classification, want.classification)
    np.testing.assert_array_equal(cloud.returns, want.returns)
    np.testing.assert_array_equal(cloud.time, want.time)
    np.testing.assert_array_equal(np.array(cloud.strips)[cloud.strip], np.array(want.strips)[want.strip])
    records = read_flight_csv(folder / "trajectory.csv")
    np.testing.assert_array_equal(records.time, simulation.trajectory.time)
    np.testing.assert_array_equal(records.coordinates, simulation.trajectory.position)
    some = slice(0, None, 500)
    angles = np.deg2rad(records.roll_pitch_yaw_deg[some])
    body = jax.jit(jax.vmap(matrix_from_quaternion))(jax.numpy.asarray(simulation.trajectory.quaternion[some]))
    np.testing.assert_allclose(np.stack([_body(*a) for a in angles]), body, rtol=0, atol=1e-12)
    truth = pd.read_csv(folder / "truth" / "scanner.csv").set_index("parameter")["value"]
    scanner = simulation.truth.scanner
    names = [f"scanner.boresight_{axis}_deg" for axis in ("right", "forward", "up")]
    np.testing.assert_allclose(truth[names], TRUTH["boresight_deg"], rtol=1e-12)
    for strip, shift in scanner.shifts.items():
        np.testing.assert_array_equal(truth[[f"scanner[{strip}].shift_{a}_m" for a in "XYZ"]], shift)
    assert len(truth) == 3 + 6
    # A simulation without a lidar takes the old one's cloud away, and leaves any other alone.
    write_simulation(made(), folder)
    assert not {"cloud.laz", "trajectory.csv"} & {p.name for p in folder.iterdir()}
    (folder / "cloud.laz").write_text("mine")
    write_simulation(made(), folder)
    assert (folder / "cloud.laz").read_text() == "mine"


def test_the_command_says_what_it_writes(tmp_path, monkeypatch, capsys):
    recipe = tmp_path / "recipe.toml"
    text = (RECIPES / "001.toml").read_text().replace('kind = "rolling"', 'kind = "flat"')
    text = text.replace("[sigmas]", "[lidar]\ndensity_per_m2 = 0.01\n[sigmas]\nlidar_m = [0.5, 0.5, 0.15]")
    recipe.write_text(text)
    assert tomllib.loads(text)["lidar"]
    code, said, errors = run(monkeypatch, capsys, "simulate", recipe, "--out", tmp_path / "block")
    assert (code, errors) == (0, "")
    count = len(read_cloud(tmp_path / "block" / "cloud.laz"))
    assert f"{count} laser points in cloud.laz, their trajectory in trajectory.csv (seed 0)" in said


@functools.cache
def seen_by(kind: str) -> np.ndarray:
    """Where a kind of scanner looked, to the right and ahead: tangents of angles, as parts of the widest."""
    flight = made(SCENE | {"terrain": {"kind": "flat"}, "lidar": {"density_per_m2": 0.05, "pattern": kind}})
    cloud = cloud_of(flight)
    poses = _poses(flight.trajectory, cloud.time)
    shot = np.einsum("nji,nj->ni", poses.object_from_body, cloud.xyz - poses.position)
    return shot[:, :2] / -shot[:, 2:] / np.tan(np.deg2rad(20.0))


def test_prisms_look_as_far_to_all_sides():
    """What the scanner measured lies in a circle about its nadir."""
    aside = np.hypot(*seen_by("circle").T)
    assert aside.max() == pytest.approx(1.0, abs=0.02)
    # Of two equal arrows whose directions are independent: |cos| of half the angle between them.
    for part in (0.25, 0.5, 0.75):
        assert np.quantile(aside, part) == pytest.approx(np.sin(np.pi / 2 * part), abs=0.06)
    assert abs((seen_by("circle")[:, 1] > 0).mean() - 0.5) < 0.05


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"lidar": None}, r"\[sigmas\] lidar_m: missing table \[lidar\]"),
        ({"sigmas.lidar_m": None, "noise.lidar_m": None}, "lidar_m: the key is missing, but the recipe has lidar"),
        ({"lidar.density_per_m2": 0.0}, "density_per_m2: 0.0 is not positive"),
        ({"lidar.scan_angle_deg": 70.0}, "scan_angle_deg: 70.0 exceeds the maximum 60"),
        ({"lidar.pattern": "zigzag"}, r"\[lidar\] pattern: 'zigzag' is unknown; write .line"),
        ({"lidar.rate_hz": 100.0}, r"\[lidar\] rate_hz: unknown key"),
        ({"lidar.truth.shift_m.C": [0, 0, 0]}, r"\[lidar.truth.shift_m\] C: unknown key; use default, A, B"),
        ({"lidar.truth.attitude_deg.A": [0, 0]}, r"\[lidar.truth.attitude_deg\] A: .* has 2 entries; give 3"),
        ({"lidar.truth.eccentricity_deg": [0, 0, 0]}, r"eccentricity_deg: .* has 3 entries; give 2"),
        ({"lidar.truth.boresight": [0, 0, 0]}, r"\[lidar.truth\] boresight: unknown key"),
        ({"lidar.same_trajectory": 1}, r"\[lidar\] same_trajectory: 1 is neither true nor false"),
        ({"terrain.roughness_m": 2.0}, r"\[terrain\] roughness_m: points 2 m above or below the ground are not on"),
        ({"terrain": {"kind": "rolling"}}, r"roughness_m: points 6 m .* replace .rolling. by its waves"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_a_remedy(changes, message):
    with pytest.raises(InputError, match=f"^small.toml.*{message}") as error:
        recipe_from(changed(changes, changed(SCENE)), "small.toml")
    assert "\n" not in str(error.value)


def test_a_convergent_set_has_no_lidar():
    values = tomllib.loads((RECIPES / "002.toml").read_text())
    with pytest.raises(InputError, match="lidar: a convergent set has no lidar strips"):
        recipe_from(changed({"lidar": {"density_per_m2": 1.0}}, values))


def test_a_scan_of_nothing_is_refused():
    with pytest.raises(BlockError, match="no laser pulse reaches the ground"):
        made(SCENE | {"lidar": {"density_per_m2": 1e-9}})
