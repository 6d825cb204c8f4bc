"""Consistency of a cloud and a trajectory: positions of the points relative to the scanner.

In the body frame, a scanner's points are in the same region along the whole flight. If the trajectory is in another
system, in feet, on another clock or has another yaw, they are not, and an adjustment is meaningless.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, few
from jaxphoto.georeferencing import Pattern, Trajectory
from jaxphoto.georeferencing.time_scales import LEAP_SECONDS
from jaxphoto.lidar.correction import ScannerPath, scanner_poses
from jaxphoto.lidar.coverage import CoveredTimes, longest_interval
from jaxphoto.procedures.lidar.strip_model import aside

# Maximum range of an airborne laser scanner (m).
_FARTHEST_M = 10_000.0
# Number of points examined; time window (s); minimum number of points per window.
_PROBED, _WINDOW_S, _FEWEST = 50_000, 1.0, 20
# Maximum drift of the one-second median, in half swath widths (allows gaps over water); maximum of its median over the
# flight, as a tangent.
_WANDERS, _ASIDE = 1.5, 3.0
# Ratio of the spreads ahead and across above which the pattern is circular, below which it consists of lines; minimum
# half swath width, relative to the height, for this test.
_ALIKE, _NARROW = 0.5, 0.02
# Minimum median cosine of the angle between yaw and course; crab angles give a larger one.
_FOLLOWS = 0.7
# Minimum speed (m/s) for which the course is determined.
_SLOW = 1.0
# Minimum size of a jump (m); minimum ratio to the median of all records.
_JUMP_M, _TIMES = 0.3, 20.0
# Median tangent of the angle ahead below which clocks are not compared; maximum ratio to this tangent after a correct
# time shift; number of points examined.
_OBLIQUE, _UNDER, _SOME = 0.8, 0.25, 1000


class _FromBody(NamedTuple):
    """Tangents of the angles of points to the right and ahead, relative to the body's nadir."""

    middle: Float[np.ndarray, "seconds 2"]
    """Median of each second."""
    half_width: Float[np.ndarray, "2"]
    """Half width of the points of a second, median of all seconds."""


def check_measured_from(cloud: Cloud, path: ScannerPath, pattern: Pattern | None = None) -> list[str]:
    """Return messages about unusual positions of the points of `cloud` relative to the scanner.

    Raises BlockError if the points cannot have been measured from this trajectory, or correspond to another `pattern`
    than the given one.
    """
    some = _probed(cloud)
    away = np.linalg.norm(cloud.xyz[some] - scanner_poses(path, cloud.time[some]).position, axis=1)  # type: ignore[index]
    if np.median(away) > _FARTHEST_M:
        raise BlockError(
            f"the laser points are {np.median(away) / 1000:.0f} km from the scanner's trajectory: bring cloud and "
            "trajectory into one coordinate system, in metres, and onto one clock"
        )
    _check_leap_seconds(cloud, path)
    messages = [*_odd_yaw(path.trajectory), *_jumps(path.trajectory)]
    positions = _positions_in_body(cloud, path)
    if positions is None:
        return messages
    moves = np.subtract(*np.quantile(positions.middle, (0.9, 0.1), axis=0)) / 2
    looks = np.median(positions.middle, axis=0)
    if max(moves) > _WANDERS * max(positions.half_width) or max(np.abs(looks)) > _ASIDE:
        furthest = np.abs(positions.middle).max()
        if elsewhere := _distant_strips(cloud, path, _WANDERS * max(positions.half_width)):
            raise BlockError(
                f"the laser points of strip {few(elsewhere)} are up to {furthest:.1f} flying heights to one side, "
                "unlike those of the other strips: bring all strips and their trajectory into one coordinate system, "
                "in metres, and onto one clock"
            )
        raise BlockError(
            f"laser points of one second scatter about the scanner, up to {furthest:.1f} flying heights to one side, "
            f"but the swath is {2 * max(positions.half_width):.2f} flying heights wide: bring cloud and trajectory "
            "into one coordinate system, both in metres, and onto one clock, with angles in degrees"
        )
    if pattern is not None:
        _check_pattern(positions, pattern)
    return messages


def _distant_strips(cloud: Cloud, path: ScannerPath, most: float) -> list[str]:
    """Return strips whose median lies farther from the nadir than `most` (a tangent); none if all do."""
    some = _probed(cloud)
    if cloud.strip is None:
        return []
    distance, strip = aside(cloud, some, path), cloud.strip[some]
    numbers = np.flatnonzero(np.bincount(strip))
    far = [k for k in numbers if np.abs(np.median(distance[strip == k], axis=0)).max() > most]
    return [] if len(far) == len(numbers) else [cloud.strips[k] for k in far]


def _check_pattern(positions: _FromBody, pattern: Pattern) -> None:
    """Raise BlockError if the points correspond to another pattern."""
    right, ahead = positions.half_width
    spread = f"to the side by {right:.2f} of the height and ahead by {ahead:.2f}"
    if right < _ALIKE * ahead:
        raise BlockError(
            f"laser points of one second spread {spread}: the scan is not across the x axis. Correct the trajectory's "
            "yaw, or rotate it to the scanner axes"
        )
    around = ahead > _ALIKE * right
    if around and pattern == "line":
        raise BlockError(
            f'laser points of one second spread {spread}, as for a circular scan: give its pattern as "circle" '
            "(--pattern circle)"
        )
    if not around and pattern == "circle":
        raise BlockError(
            f"laser points of one second spread {spread}, as for a line scan across the track: give its pattern as "
            '"line" (--pattern line)'
        )


def _check_leap_seconds(cloud: Cloud, path: ScannerPath) -> None:
    """Raise BlockError if the returns are below the trajectory after a shift of leap seconds, but not before."""
    some = cloud.take(np.linspace(0, len(cloud) - 1, _SOME).astype(int))
    times = np.asarray(some.time)
    covered = CoveredTimes(path.trajectory)

    def ahead(shift: float) -> float:
        """Return the median tangent of the angle ahead; infinite if the trajectory covers few of the shifted times."""
        time = times + shift
        covered_points = np.flatnonzero(covered.covers(time))
        if len(covered_points) < _SOME / 2:
            return np.inf
        return float(np.median(np.abs(aside(dataclasses.replace(some, time=time), covered_points, path)[:, 1])))

    now = ahead(0.0)
    if now < _OBLIQUE:
        return
    far = {sign * leap: ahead(sign * leap) for leap in LEAP_SECONDS for sign in (1, -1)}
    best = min(far, key=lambda shift: far[shift])
    if far[best] < _UNDER * now:
        raise BlockError(
            f"the laser points are {np.rad2deg(np.arctan(now)):.0f} degrees ahead of the scanner or behind it at "
            f"their times, but {np.rad2deg(np.arctan(far[best])):.0f} degrees if their times are shifted by {best:+d} "
            f"s: one clock is UTC and the other GPS time. Increase --trajectory-shift-s by {best} (default 0)"
        )


def _odd_yaw(trajectory: Trajectory) -> list[str]:
    """Return a message if the body does not fly ahead."""
    step = np.diff(np.asarray(trajectory.position), axis=0)[:, :2]
    time, forward = np.diff(np.asarray(trajectory.time)), _forward(np.asarray(trajectory.quaternion))[:-1]
    fast = np.linalg.norm(step, axis=1) > _SLOW * time
    if not fast.any():
        return []
    course, yaw = np.arctan2(*step[fast].T), np.arctan2(*forward[fast].T)
    if np.median(np.cos(yaw - course)) > _FOLLOWS:
        return []
    deviation = np.rad2deg(np.median(np.abs(np.arctan2(np.sin(yaw - course), np.cos(yaw - course)))))
    return [
        f"the yaw of the trajectory is {deviation:.0f} degrees off its course in the median, as in sideways or "
        "backward flight: boresight and lever arm refer to these axes; correct the yaw if it is wrong"
    ]


def _jumps(trajectory: Trajectory) -> list[str]:
    """Return a message about jumps of the positions between records, for example after a re-initialisation of GNSS."""
    time, position = np.asarray(trajectory.time), np.asarray(trajectory.position)
    between = np.diff(time)[:, None]
    speed = np.diff(position, axis=0) / between
    # Compare with the mean velocity of the intervals before and after.
    jump = np.linalg.norm((speed[1:-1] - (speed[:-2] + speed[2:]) / 2) * between[1:-1], axis=1)
    # Ignore gaps, for example turns between strips.
    gap = between[:, 0] > longest_interval(trajectory)
    jump[gap[1:-1] | gap[:-2] | gap[2:]] = 0.0
    k = int(np.argmax(jump))
    if jump[k] < max(_JUMP_M, _TIMES * float(np.median(jump))):
        return []
    return [
        f"the trajectory jumps by {jump[k]:.2g} m at {time[k + 2]:.3f} s from one record to the next: the splines do "
        "not follow it. Reprocess the trajectory, or remove the strip flown then"
    ]


def _forward(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 2"]:
    """Return X and Y of the body's y axis, which points ahead."""
    w, x, y, z = quaternion.T
    return np.column_stack([2 * (x * y - w * z), 1 - 2 * (x**2 + z**2)])


def _probed(cloud: Cloud) -> Int[np.ndarray, "n"]:
    return np.linspace(0, len(cloud) - 1, min(_PROBED, len(cloud))).astype(int)


def _positions_in_body(cloud: Cloud, path: ScannerPath) -> _FromBody | None:
    """Return the positions of the points by second; None for a narrow swath, or for few points."""
    some = _probed(cloud)
    time = cloud.time[some]  # type: ignore[index]
    tangents = aside(cloud, some, path)
    second = np.floor((time - time.min()) / _WINDOW_S).astype(np.int64)
    order = np.argsort(second, kind="stable")
    _, first, number = np.unique(second[order], return_index=True, return_counts=True)
    parts = [tangents[order[k : k + n]] for k, n in zip(first, number, strict=True) if n >= _FEWEST]
    if not parts:
        return None
    # Use the first and last decile: a return above the scanner may be arbitrarily far across.
    low, middle, high = np.stack([np.quantile(part, (0.1, 0.5, 0.9), axis=0) for part in parts], axis=1)
    half_width = np.median((high - low) / 2, axis=0)
    return None if max(half_width) < _NARROW else _FromBody(middle, half_width)
