"""Direct georeferencing against independent NumPy code, and its covariance against the scatter of many draws."""

import jax
import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.georeferencing import (
    Exposure,
    Mount,
    SensorCovariance,
    StripBias,
    direct_covariance,
    direct_orientation,
    recorded_attitude,
    sensor_position,
)
from jaxphoto.rotation import matrix_from_roll_pitch_yaw
from tests import formulas
from tests.derivatives import check_derivatives, compiled
from tests.georeferencing.test_mount import FORWARD, LEVEL, NONE, STILL

STATION, ATTITUDE = np.array([350.0, -120.0, 1033.0]), np.array([0.06, -0.08, 2.2])
ARM, BORESIGHT = np.array([0.35, -0.52, 1.10]), np.array([0.006, -0.009, 0.013])
STATION_SIGMA, ATTITUDE_SIGMA = np.array([0.03, 0.04, 0.06]), np.array([1e-4, 2e-4, 5e-4])
MOUNT_SIGMA = np.array([0.02, 0.03, 0.01, 3e-4, 2e-4, 6e-4])

orientation, covariance = compiled(direct_orientation), compiled(direct_covariance)


def test_lever_arm_and_boresight_agree_with_numpy():
    rng = np.random.default_rng(8)
    for _ in range(20):
        attitude, boresight = rng.uniform(-1.2, 1.2, 3), rng.normal(0, 0.1, 3)
        station, arm = rng.normal(0, 1000, 3), rng.normal(size=3)
        got = orientation(station, attitude, Mount(arm, boresight, 0.0), NONE, STILL)
        position, camera_from_object = formulas.direct(station, attitude, arm, boresight)
        np.testing.assert_allclose(got.position, position[0], rtol=0, atol=1e-10)
        np.testing.assert_allclose(got.camera_from_object, camera_from_object[0], rtol=0, atol=1e-10)


MOVING = Exposure(-7.0, np.array([60.0, -20.0, 1.0]), np.array([0.02, -0.01, 0.03]), FORWARD)
BIAS = StripBias(np.array([0.1, -0.2, 0.3]), np.array([0.01, 0.02, -0.03]))
OFFSET = Mount(ARM, BORESIGHT, 0.013)


@compiled
def there_and_back(station, attitude):
    """What sensors would record of the camera that direct georeferencing finds."""
    found = direct_orientation(station, attitude, OFFSET, BIAS, MOVING)
    body = recorded_attitude(found.camera_from_object, OFFSET, MOVING)
    back = sensor_position(found.position, found.camera_from_object, OFFSET, BIAS, MOVING)
    return back, body, matrix_from_roll_pitch_yaw(attitude)


def test_direct_orientation_undoes_the_observation_model():
    station, body, recorded = there_and_back(STATION, ATTITUDE)
    np.testing.assert_allclose(station, STATION, rtol=0, atol=1e-10)
    np.testing.assert_allclose(body, recorded, rtol=0, atol=1e-14)


@pytest.mark.parametrize("known", [0.0, 1.0])
def test_covariance_is_the_scatter_of_many_draws(known):
    rng, n = np.random.default_rng(9), 4000
    draw = lambda sigma: sigma * rng.normal(size=(n, 3))  # noqa: E731
    arm, boresight = (1 - known) * draw(MOUNT_SIGMA[:3]), (1 - known) * draw(MOUNT_SIGMA[3:])
    position, matrix = formulas.direct(
        STATION + draw(STATION_SIGMA), ATTITUDE + draw(ATTITUDE_SIGMA), ARM + arm, BORESIGHT + boresight
    )
    centre, still = (v[0] for v in formulas.direct(STATION, ATTITUDE, ARM, BORESIGHT))
    turn = matrix @ still.T  # I - [theta]x
    theta = 0.5 * np.stack(
        [turn[:, 1, 2] - turn[:, 2, 1], turn[:, 2, 0] - turn[:, 0, 2], turn[:, 0, 1] - turn[:, 1, 0]], 1
    )
    given = np.diag(np.append((1 - known) * MOUNT_SIGMA, 0.0) ** 2)
    sensors = SensorCovariance(np.diag(STATION_SIGMA**2), np.diag(ATTITUDE_SIGMA**2), given)
    predicted = covariance(STATION, ATTITUDE, Mount(ARM, BORESIGHT, 0.0), NONE, STILL, sensors)
    formulas.assert_scatter(np.hstack([position - centre, theta]), predicted)


SIDEWAYS = {"forward": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}


@pytest.mark.parametrize("image_x", SIDEWAYS)
def test_the_camera_sits_as_its_mount_says(image_x):
    """Turned about the vertical in a level aircraft heading east, the camera's x axis is that of the mount."""
    mount = Mount(ARM, LEVEL, 0.0, image_x)
    found = direct_orientation(STATION, np.array([0.0, 0.0, np.pi / 2]), mount, NONE, Exposure(0.0, LEVEL, LEVEL))
    turn = np.deg2rad(SIDEWAYS[image_x])
    x_axis = np.array([np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(found.camera_from_object[0], x_axis, rtol=0, atol=1e-15)
    # The lever arm is one of the aircraft, however the camera is turned: right is south, forward east.
    np.testing.assert_allclose(STATION - found.position, [ARM[1], -ARM[0], ARM[2]], rtol=0, atol=1e-12)
    given = np.diag([0.02, 0.03, 0.01, 1e-3, 2e-3, 3e-3, 0.0]) ** 2
    sensors = SensorCovariance(np.zeros((3, 3)), np.zeros((3, 3)), given)
    seen = direct_covariance(STATION, ATTITUDE, mount, NONE, Exposure(0.0, LEVEL, LEVEL), sensors)
    told = Exposure(0.0, LEVEL, LEVEL, mount.nominal)
    same = direct_covariance(STATION, ATTITUDE, Mount(ARM, LEVEL, 0.0), NONE, told, sensors)
    np.testing.assert_allclose(seen, same, rtol=0, atol=1e-15)


def test_a_mount_and_an_exposure_that_differ_are_refused():
    left = Mount(ARM, BORESIGHT, 0.0, "left")
    with pytest.raises(
        InputError, match=r"image_x = 'left' of the mount contradicts the nominal mount of the exposure"
    ):
        direct_orientation(STATION, ATTITUDE, left, NONE, MOVING)
    with pytest.raises(RuntimeError, match="contradicts the nominal mount"):
        jax.block_until_ready(orientation(STATION, ATTITUDE, left, NONE, MOVING))


def found(station, attitude, arm, boresight, offset, shift, drift, time, velocity, rate):
    mount, exposure = Mount(arm, boresight, offset), Exposure(time, velocity, rate, FORWARD)
    exterior = direct_orientation(station, attitude, mount, StripBias(shift, drift), exposure)
    return exterior.position, exterior.camera_from_object


def test_derivatives_of_the_orientation():
    rng = np.random.default_rng(10)
    n = 5
    vectors = [rng.normal(size=(n, 3)) for _ in range(5)]
    attitude, boresight = rng.uniform(-1.5, 1.5, (n, 3)), 0.1 * rng.normal(size=(n, 3))
    offset, rate = 0.1 * rng.normal(size=n), 0.1 * rng.normal(size=(n, 3))
    attitude[-1] = boresight[-1] = offset[-1] = rate[-1] = LEVEL[0]  # level flight, no misalignment, nothing turns
    check_derivatives(
        found, vectors[0], attitude, vectors[1], boresight, offset, vectors[2], vectors[3], rng.normal(size=n),
        vectors[4], rate,
    )  # fmt: skip
