"""Clouds that do not match their trajectory: messages with cause and remedy."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.georeferencing import Trajectory, covered
from jaxphoto.georeferencing.time_scales import shift_that_fits
from jaxphoto.lidar.correction import check_covered, covers, longest_interval

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


def said(cloud: Cloud, trajectory: Trajectory) -> str:
    with pytest.raises(JaxphotoError) as caught:
        check_covered(cloud, trajectory)
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
    np.testing.assert_array_equal(covers(path, times), asked)


def test_a_gap_inside_a_strip():
    message = said(CLOUD, flown(np.delete(TIME, range(6001, 6300))))
    assert "laser points of strip 2 were measured where the trajectory has no records, first at 60.1" in message


def test_a_trajectory_that_begins_late_or_ends_early():
    message = said(CLOUD, flown(TIME[1200:7200]))
    assert message.startswith("laser points of strip 1 were") and "12.000 to 71.990 s" in message
    assert said(CLOUD, flown(TIME[:7200])).startswith("laser points of strip 2 were")
    # A cloud in GPS time, a trajectory in UTC.
    assert "--trajectory-shift-s -18)" in said(CLOUD, flown(TIME - 25.0))


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
def test_other_clocks_and_the_shift_that_joins_them(cloud_s, trajectory_s, shift, words):
    cloud = dataclasses.replace(CLOUD, time=CLOUD.time + cloud_s)
    message = said(cloud, flown(TIME + trajectory_s))
    assert f"(--trajectory-shift-s {shift:+.15g})" in message, message
    for word in (*words, f"{trajectory_s:.3f} to "):
        assert word in message


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
    assert "two flight lines with one point source ID" in message and "at 30.990 s" in message


def test_times_that_are_all_the_same():
    zero = dataclasses.replace(CLOUD, time=np.zeros(400))
    with pytest.raises(InputError, match=r"^all laser points of strip 1 have one time, 0\.000 s"):
        check_covered(zero, flown(TIME + 5))
    one = dataclasses.replace(CLOUD, time=np.where(CLOUD.strip == 1, 60.0, CLOUD.time))
    with pytest.raises(InputError, match=r"^all laser points of strip 2 have one time, 60\.000 s"):
        check_covered(one, flown(TIME))
