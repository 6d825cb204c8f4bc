import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.georeferencing import (
    Exposure,
    Mount,
    StripBias,
    attitude_residual,
    body_from_camera,
    object_from_body,
    recorded_attitude,
    sensor_position,
)
from jaxphoto.rotation import matrix_from_omega_phi_kappa, matrix_from_roll_pitch_yaw, small_rotation
from tests.derivatives import check_derivatives, compiled

bounded = settings(max_examples=50, deadline=None, derandomize=True, database=None)
ARM = np.array([-0.035, 0.244, -0.055])  # paper 000, table 1
NONE = StripBias(np.zeros(3), np.zeros(3))
LEVEL = np.zeros(3)
FORWARD = Mount(LEVEL, LEVEL).nominal
STILL = Exposure(0.0, LEVEL, LEVEL, FORWARD)

attitude = compiled(matrix_from_roll_pitch_yaw)
observed_position = compiled(sensor_position)


@compiled
def residual_of(observed, camera, boresight):
    return attitude_residual(observed, recorded_attitude(camera, Mount(LEVEL, boresight), STILL))


@compiled
def camera_of(roll_pitch_yaw, boresight):
    """The camera orientation under which the body has this attitude."""
    return (matrix_from_roll_pitch_yaw(roll_pitch_yaw) @ body_from_camera(boresight, FORWARD)).T


def test_nominal_mount_has_camera_x_forward_y_left_z_up():
    object_from_camera = camera_of([0, 0, np.pi / 2], LEVEL).T  # flying east
    np.testing.assert_allclose(object_from_camera @ [1, 0, 0], [1, 0, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(object_from_camera @ [0, 1, 0], [0, 1, 0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(object_from_camera @ [0, 0, 1], [0, 0, 1], rtol=0, atol=1e-15)


@bounded
@given(st.floats(-3, 3), *[st.floats(-5, 5)] * 3)
def test_lever_arm_in_level_flight_is_a_bearing_and_a_distance(yaw, right, forward, up):
    # Paper 004, equations (2)-(4), against the matrix of equation (1).
    bearing, distance = yaw + np.arctan2(right, forward), np.hypot(right, forward)
    expected = np.array([distance * np.sin(bearing), distance * np.cos(bearing), up])
    mount = Mount(np.array([right, forward, up]), LEVEL)
    position = np.array([10.0, 20.0, 1000.0])
    got = observed_position(position, camera_of([0, 0, yaw], LEVEL), mount, NONE, STILL)
    np.testing.assert_allclose(got - position, expected, rtol=0, atol=1e-12)


def test_lever_arm_moves_with_roll_and_pitch():
    # First order (docs/models.md): dz = -l_right sin(roll) + l_forward sin(pitch).
    mount, level = Mount(ARM, LEVEL), camera_of([0, 0, 0.7], LEVEL)
    still = observed_position(LEVEL, level, mount, NONE, STILL)
    for angles, dz in (([0.02, 0, 0.7], -ARM[0] * np.sin(0.02)), ([0, 0.02, 0.7], ARM[1] * np.sin(0.02))):
        tilted = observed_position(LEVEL, camera_of(angles, LEVEL), mount, NONE, STILL)
        assert tilted[2] - still[2] == pytest.approx(dz, abs=0.055 * 0.02**2)


def test_shift_and_drift_of_a_strip():
    bias = StripBias(np.array([0.1, -0.2, 0.3]), np.array([0.01, 0.02, -0.03]))
    mount = Mount(np.zeros(3), LEVEL)
    got = observed_position(
        np.array([1.0, 2, 3]), camera_of([0.1, 0.2, 0.3], LEVEL), mount, bias, Exposure(10.0, LEVEL, LEVEL, FORWARD)
    )
    np.testing.assert_allclose(got, [1.2, 2.0, 3.0], rtol=0, atol=1e-15)


def test_boresight_turns_the_lever_arm_with_the_body_not_with_the_camera():
    boresight = np.array([0.01, -0.02, 0.03])
    camera = camera_of([0.1, -0.1, 2.0], boresight)
    body = compiled(object_from_body)(camera, boresight, FORWARD)
    np.testing.assert_allclose(body, attitude([0.1, -0.1, 2.0]), rtol=0, atol=1e-15)
    got = observed_position(LEVEL, camera, Mount(ARM, boresight), NONE, STILL)
    np.testing.assert_allclose(got, attitude([0.1, -0.1, 2.0]) @ ARM, rtol=0, atol=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_attitude_residual_is_observed_minus_computed_about_the_axis_of_the_angle(yaw, axis):
    boresight = np.array([0.01, -0.02, 0.03])
    observed = np.array([0.0, 0.0, yaw])
    observed[axis] += 1e-3
    residual = residual_of(attitude(observed), camera_of([0, 0, yaw], boresight), boresight)
    expected = np.zeros(3)
    expected[axis] = 1e-3
    np.testing.assert_allclose(residual, expected, rtol=0, atol=1e-12)


def test_attitude_residual_of_all_angles_at_once_and_of_none():
    at = np.array([0.02, -0.03, 1.3])
    error = np.array([2e-4, -1e-4, 3e-4])
    np.testing.assert_allclose(residual_of(attitude(at), camera_of(at, LEVEL), LEVEL), 0, rtol=0, atol=1e-15)
    # Away from level flight the angles mix by the tilt: 3 % of the largest.
    np.testing.assert_allclose(
        residual_of(attitude(at + error), camera_of(at, LEVEL), LEVEL), error, rtol=0, atol=1.2e-5
    )


def test_boresight_changes_the_residual_by_itself():
    # A misalignment not told to the model is a residual of its own size, the same in every image.
    delta = np.array([1e-3, -2e-3, 3e-3])
    sizes = []
    for at in ([0, 0, 0.3], [0.1, -0.1, -2.0]):
        residual = residual_of(attitude(at), camera_of(at, delta), LEVEL)
        sizes.append(residual)
    np.testing.assert_allclose(np.linalg.norm(sizes[0]), np.linalg.norm(delta), rtol=1e-6)
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=0, atol=1e-12)


# Derivatives ----------------------------------------------------------------------------------------------


def station_and_attitude(position, theta, angles, arm, boresight, offset, shift, drift, time, velocity, rate, observed):
    camera = small_rotation(theta) @ matrix_from_omega_phi_kappa(angles)
    mount, exposure = Mount(arm, boresight, offset), Exposure(time, velocity, rate, FORWARD)
    station = sensor_position(position, camera, mount, StripBias(shift, drift), exposure)
    computed = recorded_attitude(camera, mount, exposure)
    body = matrix_from_roll_pitch_yaw(observed) @ object_from_body(camera, boresight, FORWARD)
    return station, attitude_residual(body, computed), computed


def test_derivatives_of_station_and_attitude():
    rng = np.random.default_rng(14)
    n = 8
    angles = np.concatenate([rng.uniform(-3, 3, (4, 3)), [[0, 0, 0], [0.3, np.pi / 2, 1], [0.7, 0.6, -2], [0, 0, 2]]])
    small = 0.1 * rng.normal(size=(n, 3))
    zero_at_last = np.ones((n, 1))
    zero_at_last[-2:] = 0  # theta = 0, boresight = 0, no time offset and no residual at all
    vectors = [rng.normal(size=(n, 3)) for _ in range(6)]
    check_derivatives(
        station_and_attitude,
        vectors[0], small * zero_at_last, angles, vectors[1], small[::-1] * zero_at_last,
        0.1 * rng.normal(size=n) * zero_at_last[:, 0], vectors[2], vectors[3], rng.normal(size=n), vectors[4],
        vectors[5], small * zero_at_last,
    )  # fmt: skip
