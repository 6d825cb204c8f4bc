"""The lever arm against NumPy, and the error of the approximation against the table of docs/georeferencing.md."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.georeferencing import (
    Mount,
    arm_to_camera,
    direct_orientation,
    exact_offset,
    level_error,
    level_offset,
    worst_level_error,
)
from tests.derivatives import check_derivatives, compiled
from tests.formulas import attitudes
from tests.georeferencing.test_mount import LEVEL, NONE, STILL

bounded = settings(max_examples=50, deadline=None, derandomize=True, database=None)
ARM_000, ARM_004 = np.array([-0.035, 0.244, -0.055]), np.array([-0.039, 0.180, -0.074])
metres, angle = st.floats(-5, 5), st.floats(-3, 3)

exact, level = compiled(exact_offset), compiled(level_offset)
error, worst = compiled(level_error), compiled(worst_level_error)


def attitude_of(*angles):
    return attitudes(np.array(angles))[0]


@bounded
@given(st.tuples(metres, metres, metres), st.tuples(angle, angle, angle))
def test_equation_1_is_the_attitude_matrix_times_the_arm(arm, attitude):
    np.testing.assert_allclose(exact(arm, attitude), attitude_of(*attitude) @ arm, rtol=0, atol=1e-13)


@bounded
@given(st.tuples(metres, metres, metres), angle)
def test_equations_2_to_4_are_a_bearing_and_a_distance(arm, azimuth):
    bearing, distance = azimuth + np.arctan2(arm[0], arm[1]), np.hypot(arm[0], arm[1])
    expected = [distance * np.sin(bearing), distance * np.cos(bearing), arm[2]]
    np.testing.assert_allclose(level(arm, azimuth), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(level(arm, azimuth), exact(arm, [0, 0, azimuth]), rtol=0, atol=1e-13)


def test_arm_of_the_papers_runs_the_other_way():
    mount = Mount(-ARM_004, LEVEL)
    np.testing.assert_array_equal(arm_to_camera(mount), ARM_004)
    sensor, attitude = np.array([10.0, 20.0, 1000.0]), np.array([0.02, -0.03, 2.1])
    camera = compiled(direct_orientation)(sensor, attitude, mount, NONE, STILL)
    np.testing.assert_allclose(camera.position, sensor + attitude_of(*attitude) @ ARM_004, rtol=0, atol=1e-10)


# mm, horizontal and vertical.
TABLE = [
    (ARM_000, 1, 1.4, 4.9), (ARM_000, 2, 2.9, 9.8), (ARM_000, 3, 4.4, 14.8), (ARM_000, 5, 7.7, 24.7),
    (ARM_000, 10, 17, 50), (ARM_004, 1, 1.9, 3.8), (ARM_004, 3, 5.8, 11.7), (ARM_004, 5, 9.9, 19.6),
]  # fmt: skip


@pytest.mark.parametrize(("arm", "degrees", "horizontal", "vertical"), TABLE)
def test_worst_error_of_the_approximation(arm, degrees, horizontal, vertical):
    got = 1000 * worst(arm, np.deg2rad(degrees))
    half_a_digit = 0.5 if degrees == 10 else 0.05
    np.testing.assert_allclose(got, [horizontal, vertical], rtol=0, atol=1.01 * half_a_digit)


def test_error_of_the_approximation_is_level_minus_exact_at_any_azimuth():
    for azimuth in (0.0, 1.0, -2.5):
        turned = attitude_of(0, 0, azimuth) @ error(ARM_000, 0.05, -0.08)
        expected = level(ARM_000, azimuth) - attitude_of(0.05, -0.08, azimuth) @ ARM_000
        np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-15)
    # First order: up is off by dX sin(roll) - dY sin(pitch).
    tiny = error(ARM_000, 1e-4, 2e-4)
    assert tiny[2] == pytest.approx(-0.035 * 1e-4 - 0.244 * 2e-4, abs=1e-8)


def offsets(arm, attitude):
    return exact_offset(arm, attitude), level_offset(arm, attitude[2]), level_error(arm, attitude[0], attitude[1])


def test_derivatives_of_the_offsets():
    rng = np.random.default_rng(3)
    arm, attitude = rng.normal(size=(6, 3)), rng.uniform(-3, 3, (6, 3))
    # A vertical arm, for which atan2(dX, dY) has no derivative; no arm at all; level flight.
    arm[3], arm[4], attitude[5] = [0, 0, 1], 0, 0
    check_derivatives(offsets, arm, attitude)
