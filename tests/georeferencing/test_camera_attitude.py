"""Attitudes of cameras as makers write them: the axes they must give, and the house's own convention."""

import numpy as np
import pytest

from jaxphoto.georeferencing.camera_attitude import level_from_belly, level_from_gimbal
from jaxphoto.rotation import matrix_from_roll_pitch_yaw

EAST, NORTH, UP = np.eye(3)


def axes(matrix):
    """Right and up in the picture, and the way the camera looks."""
    return matrix[:, 0], matrix[:, 1], -matrix[:, 2]


@pytest.mark.parametrize(
    ("angles", "right", "up", "view"),
    [
        ((0, 0, 0), EAST, UP, NORTH),
        ((90, 0, 0), -NORTH, UP, EAST),
        ((0, -90, 0), EAST, NORTH, -UP),
        ((90, -90, 0), -NORTH, EAST, -UP),
        ((0, 0, 90), -UP, EAST, NORTH),
    ],
)
def test_a_gimbal_counts_from_the_horizon(angles, right, up, view):
    for found, expected in zip(axes(level_from_gimbal(*angles)), (right, up, view), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_at_the_nadir_yaw_and_roll_of_a_gimbal_are_one_turn():
    """DJI writes such as yaw -92.7, roll 180 where the gimbal passes the nadir."""
    np.testing.assert_allclose(level_from_gimbal(-92.7, -90, 180), level_from_gimbal(87.3, -90, 0), atol=1e-12)
    steps = [level_from_gimbal(30 + roll, -90 + 1e-7, -roll) for roll in np.linspace(0, 180, 7)]
    np.testing.assert_allclose(steps, [steps[0]] * 7, atol=1e-8)


def test_both_habits_of_one_packet_agree():
    """Of a Parrot: Camera (Pix4D) and drone-parrot, a tenth of a degree apart as its documentation prints them."""
    one, other = (
        level_from_belly(146.781036, 38.011101, -0.041258),
        level_from_gimbal(146.848038, -51.988888, -0.052789),
    )
    assert np.degrees(np.arccos((np.trace(one @ other.T) - 1) / 2)) < 0.1


def test_a_camera_in_the_belly_is_the_body_of_the_conventions():
    rng = np.random.default_rng(3)
    for roll, pitch, yaw in rng.uniform(-80, 80, (5, 3)):
        expected = matrix_from_roll_pitch_yaw(np.deg2rad([roll, pitch, yaw]))
        np.testing.assert_allclose(level_from_belly(yaw, pitch, roll), expected, atol=1e-6)
