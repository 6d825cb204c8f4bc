"""Exposures found again by time: gaps, surplus, clocks apart, and rows that could be shifted."""

import numpy as np
import pytest

from jaxphoto.georeferencing.exposure_times import Ambiguous, Matched, clock_words, match_times


def flight(rng, n=60):
    """Exposures of strips (s, m): equal intervals along, longer ones in the turns."""
    gaps = np.where(np.arange(1, n) % 12 == 0, 17.0, 2.0) + rng.normal(0, 0.05, n - 1)
    time = 4e8 + np.concatenate([[0], np.cumsum(gaps)])
    strip, along = np.divmod(np.arange(n), 12)
    at = np.stack([strip * 40.0, np.where(strip % 2, 11 - along, along) * 20.0, 0 * along], axis=1)
    return time, at


@pytest.mark.parametrize("offset", [0.0, -18.0, 7 * 3600 - 18.0, 12345.6])
@pytest.mark.parametrize("fine", [False, True])
def test_gaps_and_surplus_on_either_side_move_nothing_else(offset, fine):
    rng = np.random.default_rng(1)
    time, _ = flight(rng)
    # Exposures 5 and 30 are missing in the file, photographs 0, 17 and 41 in the folder; in any order.
    events = np.delete(np.arange(60), [5, 30])
    pictures = rng.permutation(np.delete(np.arange(60), [0, 17, 41]))
    clock = time[pictures] + offset
    clock = np.round(clock, 3) if fine else np.floor(clock)
    found = match_times(clock, time[events], 0.2 if fine else 0.6)
    assert isinstance(found, Matched)
    assert np.where(found.exposure >= 0, events[found.exposure], -1).tolist() == [
        -1 if p in (5, 30) else p for p in pictures
    ]
    assert found.offset_s == pytest.approx(offset if fine else offset - 0.5, abs=0.01 if fine else 0.35)


def test_a_row_that_could_be_shifted_is_told_by_positions_or_not_at_all():
    rng = np.random.default_rng(2)
    time = 1000 + 2.0 * np.arange(20)
    at = np.stack([15.0 * np.arange(20), np.zeros(20), np.zeros(20)], axis=1)
    clock = np.floor(time[1:] + 3600)
    found = match_times(clock, time, 0.6)
    assert isinstance(found, Ambiguous) and found.fitted == 19
    own = at[1:] + rng.normal(0, 2, (19, 3)) + [3.0, -2.0, 0.0]
    found = match_times(clock, time, 0.6, own, at)
    assert isinstance(found, Matched) and found.exposure.tolist() == list(range(1, 20))


def test_times_of_another_day_or_without_a_common_constant_join_nothing():
    rng = np.random.default_rng(3)
    assert match_times(np.array([np.nan, 5.0]), np.arange(9.0), 0.6) is None
    alone = match_times(np.array([0.0, 1.37]), np.array([0.0, 10.0, 30.0]), 0.2)
    assert alone is None
    time, _ = flight(rng)
    found = match_times(np.full(60, np.nan), time, 0.6)
    assert found is None


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        (8 * 3600 - 18.0, "+8 h (time zone), -18 s (leap seconds: GPS time against UTC)"),
        (-3.5 * 3600, "-3.5 h (time zone)"),
        (0.27, "+0.27 s"),
        (18.0, "+18 s (leap seconds: GPS time against UTC)"),
        (86400 * 300.0, "more than any time zone"),
    ],
)
def test_what_a_difference_of_clocks_is_made_of(offset, words):
    assert words in clock_words(offset)
