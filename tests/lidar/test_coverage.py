"""Clouds that do not match their trajectory: messages with cause and remedy."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError, JaxphotoError
from jaxphoto.georeferencing import Trajectory, covered
from jaxphoto.georeferencing.time_scales import shift_that_fits
from jaxphoto.lidar.correction import scanner_path
from jaxphoto.lidar.coverage import CoveredTimes, check_covered, longest_interval
from jaxphoto.procedures.lidar.scanner_checks import check_measured_from

WEEK, DAY = 604_800.0, 86_400.0


def flown(time: np.ndarray, moved: np.ndarray | None = None) -> Trajectory:
    """At 60 m/s along X; `moved` (s) says where, if not where it should be at `time`."""
    along = 60.0 * (time if moved is None else moved)
    position = np.stack([along, 0 * time, 500 + 0 * time], axis=1)
    eastwards = np.tile(np.sqrt([0.5, 0, 0, 0.5]) * [1, 1, 1, -1], (len(time), 1))
    return Trajectory(time, position, eastwards, np.zeros_like(position), np.zeros_like(position))


def scanned(*strips: tuple[float, float], names: tuple[str, ...] = ()) -> Cloud:
    """Two hundred points of each strip, between two times."""
    time = np.concatenate([np.linspace(first, last, 200) for first, last in strips])
    return Cloud(
        np.zeros((len(time), 3)),
        time=time,
        strip=np.repeat(np.arange(len(strips)), 200),
        strips=names or tuple(str(k + 1) for k in range(len(strips))),
    )


TIME = np.arange(0.0, 100.0, 0.01)
CLOUD = scanned((10.0, 30.0), (50.0, 80.0))


def said(cloud: Cloud, trajectory: Trajectory, shift_s: float = 0.0) -> str:
    with pytest.raises(JaxphotoError) as caught:
        check_covered(cloud, trajectory, shift_s)
    return str(caught.value)


def test_what_goes_together_is_let_through():
    check_covered(CLOUD, flown(TIME))
    check_covered(dataclasses.replace(CLOUD, time=None), flown(TIME + 1e6))
    # Between two strips records may be missing, and one of them anywhere.
    check_covered(CLOUD, flown(np.delete(TIME, [1500, *range(3100, 4900)])))
    # A strip of one return has one time.
    check_covered(CLOUD.take(np.arange(201)), flown(TIME))


def test_covered_as_the_spline_is():
    rng = np.random.default_rng(3)
    path = flown(np.sort(np.delete(TIME, rng.integers(0, len(TIME), 3000))) + 3e8)
    times = np.concatenate([rng.uniform(-1, 101, 20_000) + 3e8, np.asarray(path.time)])
    asked = np.asarray(covered(path, times, longest_interval(path)))
    assert 0.2 < asked.mean() < 0.98
    np.testing.assert_array_equal(CoveredTimes(path).covers(times), asked)


def test_a_gap_inside_a_strip():
    message = said(CLOUD, flown(np.delete(TIME, range(6001, 6300))))
    assert "laser points of strip 2 were measured where the trajectory has no records" in message
    assert "a gap of 3.000 s, from 60.000 to 63.000 s" in message and "records of this time" in message


def test_a_clock_that_jumps_inside_a_strip():
    message = said(CLOUD, flown(np.where(TIME > 60, TIME + 1.0, TIME), TIME))
    assert "a gap of 1.010 s, from 60.000 to 61.010 s" in message and "take 1.000 s off its times" in message


def test_a_turn_that_ends_where_it_began_is_no_jump_of_a_clock():
    """As where the trajectory has the strips alone, each a little too short."""
    time, there = np.concatenate([TIME[:3000], TIME[4000:]]), np.concatenate([TIME[:3000], TIME[3000:-1000][::-1]])
    path = flown(time, np.where(time < 40, there, 30.0 - (time - 40.0)))
    back = np.where(time[:, None] < 40, path.quaternion, np.sqrt([0.5, 0, 0, 0.5]))
    message = said(CLOUD, dataclasses.replace(path, quaternion=back))
    assert "a gap of 10.010 s, from 29.990 to 40.000 s" in message and "records of this time" in message


def test_a_trajectory_that_begins_late_or_ends_early():
    message = said(CLOUD, flown(TIME[1200:7200]))
    assert "from 10.000 to 80.000 s, and the trajectory, from 12.000 to 71.990 s" in message
    assert "begins 2.000 s later and ends 8.010 s earlier; give the trajectory of the whole flight" in message
    message = said(CLOUD, flown(TIME[:7200]))
    assert message.startswith("laser points of strip 2 were") and "begins" not in message and "UTC" not in message
    # A cloud in GPS time, a trajectory in UTC.
    message = said(CLOUD, flown(TIME - 25.0))
    assert "ends 5.010 s earlier" in message and "and the other GPS time, --trajectory-shift-s -18" in message


@pytest.mark.parametrize(
    ("cloud_s", "trajectory_s", "shift", "words"),
    [
        (3.5e8, (3.5e8 + 1e9) % WEEK, (3.5e8 + 1e9) % WEEK - 3.5e8, ("as in LAS files", "seconds of a GPS week")),
        (-2e8, (1e9 - 2e8) % WEEK, (1e9 - 2e8) % WEEK + 2e8, ("as in LAS files", "seconds of a GPS week")),
        (3.5e8, 1.35e9, 1e9, ("as in LAS files", "full GPS or Unix time")),
        (3e5, 3e5 + 2 * WEEK, 2 * WEEK, ("seconds of a GPS week",)),
        (3e5, 3e5 % DAY, 3e5 % DAY - 3e5, ("seconds of a GPS week", "seconds of a day")),
    ],
)
@pytest.mark.parametrize("given_s", [0.0, 1000.0])
def test_other_clocks_and_the_shift_that_joins_them(cloud_s, trajectory_s, shift, words, given_s):
    cloud = dataclasses.replace(CLOUD, time=CLOUD.time + cloud_s)
    # What has been given already was taken off the trajectory.
    message = said(cloud, flown(TIME + trajectory_s - given_s), given_s)
    assert message.startswith("laser points were measured where the trajectory has no records: the cloud's clock shows")
    assert f"give --trajectory-shift-s {shift:.15g}, which brings all" in message, message
    assert "18 s more if the cloud's clock is UTC" in message
    for word in (*words, f"{trajectory_s:.3f} to "):
        assert word in message


def test_a_shift_that_is_none():
    assert "leave --trajectory-shift-s out" in said(CLOUD, flown(TIME - 1000.0), 1000.0)


def test_in_a_long_flight_the_likely_difference_is_taken():
    """Seconds of a week and those of LAS files differ by 6400 s of a day: within five hours both would fit."""
    week = 3 * DAY
    assert shift_that_fits(np.array([3.5e8, 3.5e8 + 600]), week, week + 1.8e4) % DAY == (1e9 % DAY)
    assert shift_that_fits(np.array([3e5, 3e5 + 600]), 3e5 + WEEK - 9e3, 3e5 + WEEK + 9e3) == WEEK


def test_a_difference_of_any_whole_second_where_no_other_fits():
    assert shift_that_fits(np.array([0.0, 60.0]), 299_999.7, 300_060.2) == 300_000
    assert shift_that_fits(np.array([0.0, 60.0]), 299_998.7, 300_060.2) is None
    assert shift_that_fits(np.array([0.0, 60.0]), 299_999.2, 300_059.7) is None


def test_two_flight_lines_of_one_name():
    path = flown(np.delete(TIME, range(3100, 4900)))
    twice = dataclasses.replace(CLOUD, strip=np.zeros(400, int), strips=("7",))
    message = said(twice, path)
    assert "strip 7 has laser points from 10.000 to 30.000 s and from 50.000 to 80.000 s" in message
    assert "two flight lines with one point source ID" in message


def test_times_that_are_all_the_same():
    zero = dataclasses.replace(CLOUD, time=np.zeros(400))
    with pytest.raises(InputError, match=r"^all laser points have one time, 0\.000 s.*take a cloud with the GPS time"):
        check_covered(zero, flown(TIME + 5))
    one = dataclasses.replace(CLOUD, time=np.where(CLOUD.strip == 1, 60.0, CLOUD.time))
    with pytest.raises(InputError, match=r"^all laser points of strip 2 have one time, 60\.000 s"):
        check_covered(one, flown(TIME))


def test_parts_say_what_the_whole_says():
    path = flown(np.delete(TIME, range(6001, 6300)))
    parts = CoveredTimes(path)
    for first in range(0, 400, 70):
        parts.add(CLOUD.take(np.arange(first, min(first + 70, 400))))
    with pytest.raises(BlockError) as caught:
        parts.check()
    assert str(caught.value) == said(CLOUD, path)


@pytest.mark.parametrize("late", [18.0, -18.0, 5.0, 0.0])
def test_leap_seconds_inside_the_trajectory_are_found_by_where_the_points_lie(late):
    """Lines across the track, 300 m to either side, of a cloud whose clock is `late`."""
    time = np.linspace(20.0, 80.0, 5000)
    across = 300 * np.sin(40 * time)
    cloud = Cloud(np.stack([60 * (time + late), across, 0 * time], axis=1), time=time)
    path = scanner_path(flown(TIME))
    if abs(late) != 18:
        check_measured_from(cloud, path)
        return
    with pytest.raises(BlockError, match=rf"at \{late:+.0f} s, .*--trajectory-shift-s that is greater by {late:.0f} "):
        check_measured_from(cloud, path)
