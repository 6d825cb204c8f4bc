"""Coverage of laser points by a trajectory; where incomplete, a message with the likely cause."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError, few
from jaxphoto.georeferencing import Trajectory
from jaxphoto.georeferencing.time_scales import DAY, LAS_OFFSET, LEAP_SECONDS, looks_like, shift_that_fits

# An interval is a gap from this multiple of the usual interval on: one record may be lost.
_GAP = 2.5
# Below this speed (m/s) a clock jump cannot be distinguished from lost records.
_FLYING = 1.0
# Number of records on either side of a gap from which the speed is estimated.
_BESIDE = 20
# Cosine of half the angle (30 degrees) by which an aircraft may turn between records at a clock jump.
_STRAIGHT = 0.966
_START = "a start of their own"


def longest_interval(trajectory: Trajectory) -> float:
    """Longest interval between two records (s) that is not a gap."""
    return _GAP * float(np.median(np.diff(np.asarray(trajectory.time))))


class CoveredTimes:
    """Times of laser points, received in parts and by strip, relative to the contiguous pieces of a trajectory."""

    def __init__(self, trajectory: Trajectory) -> None:
        time = np.asarray(trajectory.time)
        self._trajectory = trajectory
        self._gaps = np.flatnonzero(np.diff(time) > longest_interval(trajectory))
        self._begins, self._ends = time[np.r_[0, self._gaps + 1]], time[np.r_[self._gaps, len(time) - 1]]
        # For each strip, counts by place: 0 before the trajectory, odd in a piece, even in the gap after it or beyond
        # the end.
        self._first: dict[str, np.ndarray] = {}
        self._last: dict[str, np.ndarray] = {}
        self._several: dict[str, bool] = {}

    def covers(self, time: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Return True for times (s) within the trajectory and outside its gaps."""
        return self._place(time) % 2 == 1

    def add(self, part: Cloud) -> None:
        """Add laser points; those without times are ignored."""
        if part.time is None or not len(part):
            return
        if part.strip is None:
            self.add_times(part.time)
            return
        for k in np.flatnonzero(np.bincount(part.strip)):
            self.add_times(part.time[part.strip == k], part.strips[k])

    def add_times(self, time: Float[np.ndarray, "n"], strip: str = "") -> None:
        """Add times (s) of points of a strip, or of a cloud without strips."""
        empty = np.full(2 * len(self._begins) + 1, np.inf)
        first = self._first.setdefault(strip, empty)
        last = self._last.setdefault(strip, -empty)
        self._several[strip] = len(time) > 1 or self._several.get(strip, False)
        ends = np.array([time.min(), time.max()])
        place = self._place(ends)
        if place[0] != place[1]:
            # Only here every time must be examined.
            ends, place = time, self._place(time)
        np.minimum.at(first, place, ends)
        np.maximum.at(last, place, ends)

    def check(self, shift_s: float = 0.0) -> None:
        """Raise InputError or BlockError if cloud and trajectory do not match.

        `shift_s` has been subtracted from the given times of the trajectory.
        """
        error = self._of_one_time() or self.uncovered(shift_s) or self._of_two_lines()
        if error is not None:
            raise error

    def uncovered(self, shift_s: float = 0.0) -> BlockError | None:
        """Return an error about points before, after or in a gap of the trajectory; None if there are none."""
        return self._outside(shift_s) or self._in_a_gap()

    def _place(self, time: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        piece = np.searchsorted(self._begins, time, side="right")
        # An isolated record between two gaps gives no information about its time.
        within = (time <= self._ends[piece - 1]) & (self._begins[piece - 1] < self._ends[piece - 1])
        return 2 * piece - ((piece > 0) & within)

    def _of_one_time(self) -> InputError | None:
        one = [s for s, first in self._first.items() if self._several[s] and first.min() == self._last[s].max()]
        if not one:
            return None
        every = len({float(first.min()) for first in self._first.values()}) == 1 and len(one) == len(self._first)
        of = "" if every else f" of strip {one[0]}"
        return InputError(
            f"all laser points{of} have one time, {self._first[one[0]].min():.3f} s, so that nothing says where on "
            "the trajectory they were measured: take a cloud with the GPS time of each point, or leave the trajectory "
            "out"
        )

    def _outside(self, shift_s: float) -> BlockError | None:
        start, end = float(self._begins[0]), float(self._ends[-1])
        spans = {s: (float(first.min()), float(self._last[s].max())) for s, first in self._first.items()}
        outside = [s for s, (first, last) in spans.items() if not (first >= start and last <= end)]
        if not outside:
            return None
        first, last = min(first for first, _ in spans.values()), max(last for _, last in spans.values())
        shift = shift_that_fits(np.array([first, last]), start + shift_s, end + shift_s)
        option, leap = f"--trajectory-shift-s {shift or 0.0:.15g}", LEAP_SECONDS[0]
        if last < start or first > end or (shift is not None and abs(shift - shift_s) > leap):
            advice = "give the trajectory of this flight, or the difference of the clocks (--trajectory-shift-s)"
            if start + shift_s <= first and last <= end + shift_s:
                advice = "leave --trajectory-shift-s out, without which all of them lie in it"
            elif shift is not None:
                advice = f"give {option}, which brings all of them into it"
                if shift % DAY in (0.0, LAS_OFFSET % DAY, -LAS_OFFSET % DAY):
                    advice += f" ({leap} s more if the cloud's clock is UTC, {leap} s less if the trajectory's is)"
            cloud, trajectory = np.array([first, last]), np.array([start, end]) + shift_s
            return BlockError(
                f"{self._measured(outside)}: the cloud's clock shows {looks_like(cloud, _START)}, the trajectory's "
                f"{looks_like(trajectory, _START)}; {advice}"
            )
        gaps = [f"begins {start - first:.3f} s later"] if first < start else []
        gaps += [f"ends {last - end:.3f} s earlier"] if last > end else []
        advice = "give the trajectory of the whole flight, or the cloud without these points"
        if shift is not None:
            advice += f", or, if one clock is UTC and the other GPS time, {option}"
        return BlockError(
            f"{self._measured(outside)}: the cloud goes from {first:.3f} to {last:.3f} s, and the trajectory, from "
            f"{start:.3f} to {end:.3f} s, {' and '.join(gaps)}; {advice}"
        )

    def _in_a_gap(self) -> BlockError | None:
        for k, record in enumerate(self._gaps):
            inside = [s for s, first in self._first.items() if np.isfinite(first[2 * k + 2])]
            if not inside:
                continue
            begin, end = float(self._ends[k]), float(self._begins[k + 1])
            gap = (
                f"{self._measured(inside)}: it has a gap of {end - begin:.3f} s, from {begin:.3f} to {end:.3f} s of "
                "the cloud's clock"
            )
            jump = self._jump(int(record))
            if jump is None:
                return BlockError(
                    f"{gap}; give the trajectory with the records of this time, or the cloud without the points "
                    "measured then"
                )
            return BlockError(
                f"{gap}, which the scanner crosses as quickly as from one record to the next, so that the trajectory's "
                f"clock jumps: take {jump:.3f} s off its times from then on, or export it again"
            )
        return None

    def _measured(self, strips: Sequence[str]) -> str:
        of = "" if len(strips) == len(self._first) > 1 else _strips(strips)
        return f"laser points{of and f' of {of}'} were measured where the trajectory has no records"

    def _jump(self, record: int) -> float | None:
        """Return the clock jump (s) in the gap after a record; None if records are lost."""
        time, position = np.asarray(self._trajectory.time), np.asarray(self._trajectory.position)
        before, after = np.asarray(self._trajectory.quaternion)[record : record + 2]
        if abs(before @ after) < _STRAIGHT:
            # The aircraft turned, and is back at the end of the last strip.
            return None
        near = slice(max(record - _BESIDE, 0), record + _BESIDE + 2)
        lasts = np.diff(time[near])
        moves = np.linalg.norm(np.diff(position[near], axis=0), axis=1)
        usual = lasts <= longest_interval(self._trajectory)
        if not usual.any():
            return None
        speed = float(np.median(moves[usual] / lasts[usual]))
        index = record - near.start
        needed = moves[index] / speed if speed > _FLYING else np.inf
        return lasts[index] - needed if needed < longest_interval(self._trajectory) else None

    def _of_two_lines(self) -> BlockError | None:
        for strip, first in self._first.items():
            there = 2 * np.flatnonzero(np.isfinite(first[1::2])) + 1
            if len(there) > 1:
                last, (a, b) = self._last[strip], there[:2]
                return BlockError(
                    f"{_strips([strip]) or 'the cloud'} has laser points from {first[a]:.3f} to {last[a]:.3f} s and "
                    f"from {first[b]:.3f} to {last[b]:.3f} s, and the trajectory has a gap between, as of two flight "
                    "lines with one point source ID: give each line its own, or the trajectory without the gap"
                )
        return None


def check_covered(cloud: Cloud, trajectory: Trajectory, shift_s: float = 0.0) -> None:
    """Apply `CoveredTimes.check` to a whole cloud."""
    coverage = CoveredTimes(trajectory)
    coverage.add(cloud)
    coverage.check(shift_s)


def not_covered(trajectory: Trajectory, time: Float[np.ndarray, "n"]) -> BlockError:
    """Return the error about times (s) of laser points that the trajectory does not cover."""
    coverage = CoveredTimes(trajectory)
    coverage.add_times(time)
    error = coverage.uncovered()
    assert error is not None
    return error


def _strips(names: Sequence[str]) -> str:
    """Return the names of strips; nothing for points of a cloud without strips."""
    if not any(names):
        return ""
    return f"strip {names[0]}" if len(names) == 1 else f"strips {few(names)}"
