"""Strip adjustment recovers the errors of scanner and trajectory."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jaxphoto import BlockError, InputError
from jaxphoto.adjustment import Outcome
from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import StripSpline, TrajectoryKnot
from jaxphoto.io.recipe.truth import truth_tables
from jaxphoto.lidar.correction import (
    correct_flight,
    correct_strips,
    corrected_strip,
    in_portions,
    scanner_path,
    scanner_poses,
)
from jaxphoto.lidar.strip_planes import StripSettings
from jaxphoto.procedures.lidar import ScannerPriors, adjust_strips
from jaxphoto.procedures.lidar.strip_model import _angles, check_measured_from, knot_sigmas, step_rows
from jaxphoto.report.strips import calibration_table, trajectory_errors_table
from jaxphoto.rotation import (
    matrix_from_quaternion,
    matrix_from_roll_pitch_yaw,
    quaternion_from_matrix,
    roll_pitch_yaw_from_matrix,
)
from jaxphoto.simulation import Simulation
from jaxphoto.unknowns import FIXED
from jaxphoto_command.lidar import scanner_priors
from tests.lidar.clouds import SURFACES, ground
from tests.procedures.strips import AROUND, NOISE_M, PRIORS_AROUND, SETTINGS, STRIPS, TRUTH, fitted, flown
from tests.simulation.small import made

GROUND = 2


def above_ground(cloud: Cloud) -> np.ndarray:
    some = np.flatnonzero(cloud.classification == GROUND)[::20]
    return cloud.xyz[some, 2] - flown().terrain.height(cloud.xyz[some, :2])


def test_true_errors_correct_the_cloud():
    flight = flown()
    off = above_ground(correct_strips(flight.cloud, flight.errors, scanner_path(flight.trajectory)))
    assert abs(off.mean()) < 0.002 and off.std() == pytest.approx(NOISE_M, rel=0.1)
    assert above_ground(flight.cloud).std() > 2 * NOISE_M


def test_strips_fit_to_the_noise_of_their_planes():
    found = fitted()
    assert found.converged and found.adjusted.outcome is Outcome.CONVERGED
    assert len(found.differences) == 3
    for d in found.differences:
        assert d.rms_before_m > 0.06
        assert d.rms_m < 0.016
        assert d.rms_m == pytest.approx(d.noise_m, rel=0.15)
    assert float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1)


def test_parts_of_a_cloud_of_any_length_compile_nothing_new(caplog):
    """Each round and each pair of strips has another number of planes."""
    flight = flown()
    path, cloud = scanner_path(flight.trajectory), flight.cloud
    (own,) = np.nonzero(cloud.strip == 0)
    with jax.log_compiles():
        for n in (300, 7, 1000):
            caplog.clear()
            some = own[:n]
            corrected_strip(cloud.xyz[some], cloud.time[some], 0, flight.errors, path)
            angles = in_portions(_angles, (scanner_poses(path, cloud.time[some]).object_from_body,))
            assert angles.shape == (n, 3)
            messages = [r.getMessage() for r in caplog.records]
            assert n == 300 or not any(m.startswith(("Compiling", "Finished tr")) for m in messages)


@functools.cache
def flown_around() -> Simulation:
    return made(AROUND, 5)


def chi_squared_of_the_scanner(flight, found) -> float:
    """Of what was found of a scanner, all of it together, because some of it is told apart badly."""
    errors = flight.errors
    truth = [*errors.boresight, float(errors.calibration.range_offset), float(errors.calibration.angle_scale)]
    own = [k for k, label in enumerate(found.adjusted.structure.labels) if label.startswith("scanner")]
    value = np.asarray(found.adjusted.values.shared)[found.adjusted.structure.free][own]
    # Of a block without images there are shared unknowns alone.
    matrix = np.asarray(found.covariance.matrix)
    assert len(matrix) == len(found.adjusted.structure.free)
    off = value - truth
    return float(off @ np.linalg.solve(matrix[np.ix_(own, own)], off))


def test_scanner_parameters_are_recovered():
    found = fitted()
    assert chi_squared_of_the_scanner(flown(), found) < 20.5  # 99.9 %
    # All but the range offset are many sigma: not to find them would show.
    table = calibration_table(found).set_index("parameter")
    assert len(table) == 5 and (table.value.abs() > 4 * table.sigma).sum() >= 4


@pytest.mark.slow
def test_a_risley_scanner_is_calibrated_by_its_two_looks():
    flight = flown_around()
    found = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS_AROUND)
    assert found.converged and float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1)
    assert chi_squared_of_the_scanner(flight, found) < 20.5  # 99.9 %
    within = [d for d in found.differences if (d.one, d.other) == ("1 ahead", "1 behind")]
    assert len(within) == 1 and within[0].rms_before_m > 0.03
    assert within[0].rms_m == pytest.approx(within[0].noise_m, rel=0.2)
    # What is seen ahead and behind tells the boresight about right, which lines across the track tell less well.
    sigma = {r.parameter: r.sigma for r in calibration_table(found).itertuples()}
    of_lines = {r.parameter: r.sigma for r in calibration_table(fitted()).itertuples()}
    assert sigma["scanner.boresight_right_deg"] < 0.8 * of_lines["scanner.boresight_right_deg"]


@pytest.mark.slow
def test_angles_and_clock_of_a_scanner_are_recovered():
    """By the options of the command, in the words of a recipe; errors of the trajectory as they drift."""
    true = {"eccentricity_deg": [0.02, -0.03], "time_offset_s": 0.005}
    drifts = {key: TRUTH[key] for key in ("drift_sigma_m", "drift_sigma_deg", "correlation_s", "knots_s")}
    lidar = {"density_per_m2": 0.2, "scan_angle_deg": 25.0, "truth": drifts | true}
    flight, priors = made(STRIPS | {"lidar": lidar}, 5), scanner_priors(["eccentricity", "time-offset"], "line")
    found = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, priors)
    table, told = calibration_table(found), truth_tables(flight)["scanner"].set_index("parameter").value
    assert len(table) == 3 and found.converged
    assert (np.abs(table.value - told[table.parameter].to_numpy()) < 3 * table.sigma).all()
    assert (table.value.abs() > 4 * table.sigma).all()


def test_a_wrong_scan_pattern_is_refused():
    flight, other = flown(), flown_around()
    with pytest.raises(BlockError, match="as for a line scan"):
        check_measured_from(flight.cloud, scanner_path(flight.trajectory), "circle")
    with pytest.raises(BlockError, match="as for a circle scan"):
        check_measured_from(other.cloud, scanner_path(other.trajectory), "line")
    check_measured_from(flight.cloud, scanner_path(flight.trajectory), "line")
    check_measured_from(other.cloud, scanner_path(other.trajectory), "circle")


def test_trajectory_errors_are_recovered():
    """At the times of the flight, as far as their covariance says."""
    table, errors, w = trajectory_errors_table(fitted()), flown().errors, []
    names = ["X_m", "Y_m", "Z_m", "right_deg", "forward_deg", "up_deg"]
    for k, (_, own) in enumerate(table.groupby("strip", sort=False)):
        spline = errors.splines[k]
        assert len(own) == spline.size
        true = np.column_stack([errors.position, np.rad2deg(errors.attitude)])[spline.first :][: spline.size]
        w.append((own[names].to_numpy() - true) / own[[f"sigma_{n}" for n in names]].to_numpy())
    assert np.mean(np.abs(np.concatenate(w)) < 3) > 0.95


def test_cloud_and_trajectory_are_corrected_consistently():
    found, flight = fitted(), flown()
    assert found.cloud.strips == flight.cloud.strips
    np.testing.assert_array_equal(found.cloud.time, flight.cloud.time)
    true = correct_flight(flight.trajectory, flight.errors)
    both = (flight.trajectory, found.trajectory)
    before, after = (np.asarray(t.quaternion) - np.asarray(true.quaternion) for t in both)
    assert np.sqrt((after**2).mean()) < np.sqrt((before**2).mean())
    # What strips have in common no difference of strips can tell.
    assert above_ground(found.cloud).std() < 1.2 * NOISE_M


def two_strips(shift, side: float = 150.0) -> Cloud:
    parts = [ground(SURFACES["rolling"], 4.0, 0.02, 0.02, side, seed) for seed in (1, 2)]
    strip = np.repeat([0, 1], [len(p) for p in parts])
    return Cloud(np.concatenate([parts[0], parts[1] + shift]), strip=strip, strips=("1", "2"))


# As many planes as another test takes, so that one program serves both.
MOST = 1000
COARSE = StripSettings(cell_m=2.0, roughness_m=0.04, returns=8, most=MOST)


@pytest.mark.slow
def test_without_a_trajectory_shifts_are_estimated():
    shift = np.array([0.15, -0.2, 0.1])
    found = adjust_strips(two_strips(shift), settings=COARSE)
    sigma = np.asarray(found.covariance.shared_sigma)
    assert found.converged
    assert (np.abs(found.errors.position[1] - shift) < 3.5 * sigma).all() and (sigma < 0.01).all()
    assert not found.errors.position[0].any()
    other = adjust_strips(two_strips(shift), settings=COARSE, fixed=("2",))
    np.testing.assert_allclose(other.errors.position[0], -found.errors.position[1], atol=2 * sigma.max())


def test_a_real_cloud_cut_in_two(data_dir):
    from jaxphoto.io.clouds import read_cloud

    path = data_dir / "lidar" / "autzen_trim.laz"
    if not path.exists():
        pytest.skip(f"no {path}: set JAXPHOTO_DATA to the folder that holds lidar/autzen_trim.laz")
    cloud, shift = read_cloud(path), np.array([0.4, -0.3, 0.25])
    half = np.random.default_rng(0).random(len(cloud)) < 0.5
    both = Cloud(cloud.xyz + half[:, None] * shift, strip=half.astype(int), strips=("1", "2"))
    found = adjust_strips(both, settings=StripSettings(cell_m=3.0, returns=8, roughness_m=0.08, most=MOST))
    sigma = np.asarray(found.covariance.shared_sigma)
    assert (np.abs(found.errors.position[1] - shift) < 3 * sigma).all() and (sigma < 0.015).all()


def test_what_cannot_be_adjusted():
    cloud, flight = two_strips(np.zeros(3), 30.0), flown()
    with pytest.raises(InputError, match="returns of one plane are seconds apart: omit time-offset"):
        adjust_strips(flight.cloud, flight.trajectory, SETTINGS, scanner_priors(["time-offset"], "circle"))
    with pytest.raises(InputError, match="without a trajectory only strip shifts are estimated"):
        adjust_strips(flight.cloud, priors=PRIORS_AROUND)
    with pytest.raises(InputError, match="the cloud has one strip"):
        adjust_strips(dataclasses.replace(cloud, strip=None, strips=()))
    with pytest.raises(InputError, match="unknown strip north; choose among 1, 2"):
        adjust_strips(cloud, fixed=("north",))
    with pytest.raises(InputError, match="all strips are fixed"):
        adjust_strips(cloud, fixed=("1", "2"))
    with pytest.raises(InputError, match="all strips are fixed"):
        adjust_strips(flight.cloud, flight.trajectory, priors=ScannerPriors(FIXED), fixed="all")
    with pytest.raises(InputError, match=r"with knots 1e-05 s apart .* increase --knots-s"):
        adjust_strips(flight.cloud, flight.trajectory, StripSettings(knots_s=1e-5))
    with pytest.raises(InputError, match="the cloud has no times"):
        adjust_strips(cloud, flight.trajectory)
    with pytest.raises(InputError, match="strip 3 of the cloud has no points"):
        adjust_strips(dataclasses.replace(cloud, strips=("1", "2", "3")))
    # Heights above the ellipsoid beside those above the geoid.
    up = dataclasses.replace(cloud, xyz=cloud.xyz + cloud.strip[:, None] * np.array([0.0, 0.0, 46.0]))
    with pytest.raises(BlockError, match=r"strip 1 is 4[56]\.\d m below strip 2: check the height unit"):
        adjust_strips(up, settings=COARSE)
    apart = dataclasses.replace(cloud, xyz=cloud.xyz + 1000.0 * cloud.strip[:, None])
    with pytest.raises(BlockError, match="strip 1 has fewer than 10 planes in common with any other"):
        adjust_strips(apart, settings=COARSE)


def test_inconsistent_trajectories_are_refused():
    flight = flown()
    path = flight.trajectory
    cut = dataclasses.replace(path, **{f: getattr(path, f)[:1500] for f in vars(path)})
    with pytest.raises(BlockError, match="measured where the trajectory has no records"):
        adjust_strips(flight.cloud, cut)
    moved = dataclasses.replace(path, position=np.asarray(path.position) + np.array([5e5, 4e6, 0.0]))
    with pytest.raises(BlockError, match="bring cloud and trajectory into one coordinate system"):
        adjust_strips(flight.cloud, moved)


def test_knots_are_named_by_strip_and_time():
    owners = list(fitted().adjusted.unknowns.more[TrajectoryKnot.kind])
    assert owners[1].startswith("1 at 0.0") and owners[-1].startswith("3 at ")


@pytest.mark.parametrize(
    ("coordinates", "sentence"),
    [
        (lambda xyz, q: (xyz + np.array([3000.0, 0.0, 0.0]), q), "scatter about the scanner"),
        (lambda xyz, q: (xyz / 0.3048, q), "scatter about the scanner"),
        (lambda xyz, q: (xyz + np.array([4e5, 5e6, 0.0]), q), r"are \d+ km from the scanner's trajectory"),
        (lambda xyz, q: (xyz, as_radians(q)), "not across the x axis|scatter about the scanner"),
    ],
)
def test_a_trajectory_that_cannot_be_the_cloud_s_is_refused(coordinates, sentence):
    flight = flown()
    xyz, quaternion = coordinates(np.asarray(flight.trajectory.position), np.asarray(flight.trajectory.quaternion))
    other = dataclasses.replace(flight.trajectory, position=xyz, quaternion=quaternion)
    with pytest.raises(BlockError, match=sentence):
        adjust_strips(flight.cloud, other, SETTINGS)


def as_radians(quaternion):
    """Angles in radians, read as degrees."""
    angles = np.asarray(jax.vmap(roll_pitch_yaw_from_matrix)(jax.vmap(matrix_from_quaternion)(quaternion)))
    return np.asarray(jax.vmap(quaternion_from_matrix)(jax.vmap(matrix_from_roll_pitch_yaw)(np.deg2rad(angles))))


def test_the_sigmas_of_a_trajectory_are_those_of_its_knots():
    trajectory = flown().trajectory
    splines = StripSpline.over(0, 0.0, 20.0, 5.0), StripSpline.over(7, 40.0, 50.0, 5.0)
    n = len(np.asarray(trajectory.time))
    stated = dataclasses.replace(
        trajectory,
        time=np.linspace(-10.0, 60.0, n),
        sigma_position=np.linspace(0.02, 0.09, n)[:, None] * [1.0, 1.0, 0.0],
        sigma_attitude=np.tile([0.001, 0.002, 0.003], (n, 1)),
    )
    sigmas = knot_sigmas(splines, stated, SETTINGS)
    times = np.concatenate([s.times for s in splines])
    np.testing.assert_allclose(sigmas.position[:, :2], np.tile(0.03 + times / 1000, (2, 1)).T)
    # What is not stated is that of the settings; roll, pitch and yaw are turns about forward, right and up.
    np.testing.assert_allclose(sigmas.position[:, 2], SETTINGS.sigma_position_m)
    np.testing.assert_allclose(sigmas.attitude, np.tile([0.002, 0.001, 0.003], (len(times), 1)))
    # The process that the steps make has these standard deviations at all knots.
    steps, _ = step_rows(splines, sigmas, SETTINGS)
    variance = sigmas.position**2
    grown = steps.kept[:, None] ** 2 * variance[steps.start] + np.asarray(steps.sigma) ** 2
    np.testing.assert_allclose(grown, variance[steps.end])
