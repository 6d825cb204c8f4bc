"""Coverage of a cloud by a trajectory, and correction of both with the estimated scanner parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.cloud import Cloud
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import (
    Scanner,
    StripErrors,
    Trajectory,
    TrajectorySpline,
    corrected_point,
    corrected_return,
    spline_through,
)
from jaxphoto.georeferencing.time_scales import looks_like, shift_that_fits
from jaxphoto.rotation import matrix_from_quaternion, quaternion_from_matrix, small_rotation

PORTION = 1 << 17
"""Number of laser points processed at a time, fitting the CPU cache; smaller portions are padded to a power of two."""
# Minimum portion size: smaller ones take no time to compute, but each size would be compiled separately.
_FEW = 1 << 11
# Ratio of a record interval to the median interval above which it is a gap; one record may be missing.
_GAP = 2.5


def longest_interval(trajectory: Trajectory) -> float:
    """Return the longest interval between two records (s) that is not a gap."""
    return _GAP * float(np.median(np.diff(np.asarray(trajectory.time))))


def covers(trajectory: Trajectory, time: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return True for times (s) within the trajectory and outside its gaps."""
    record = np.asarray(trajectory.time)
    short = np.diff(record) <= longest_interval(trajectory)
    # A record belongs to the intervals before and after it.
    before, after = (
        np.clip(np.searchsorted(record, time, side) - 1, 0, len(short) - 1)  # type: ignore[call-overload]
        for side in ("left", "right")
    )
    return (time >= record[0]) & (time <= record[-1]) & (short[before] | short[after])


def check_covered(cloud: Cloud, trajectory: Trajectory) -> None:
    """Raise InputError or BlockError for laser points where `trajectory` has no records, or that have all one time."""
    if cloud.time is None:
        return
    strip = np.zeros(len(cloud), int) if cloud.strip is None else cloud.strip
    for k in np.unique(strip):
        time, name = cloud.time[strip == k], f" of strip {cloud.strips[k]}" if len(cloud.strips) > 1 else ""
        if len(time) > 1 and time.min() == time.max():
            raise InputError(
                f"all laser points{name} have one time, {time[0]:.3f} s, so their positions on the trajectory are "
                "unknown: use a cloud with the GPS time of each point, or omit the trajectory"
            )
        if not covers(trajectory, time).all():
            raise not_covered(trajectory, time, name)
        # A strip with records missing in its middle consists of two flight lines.
        inside = np.asarray(trajectory.time)
        gap = np.flatnonzero(np.diff(inside) > longest_interval(trajectory))
        split = gap[(inside[gap] > time.min()) & (inside[gap + 1] < time.max())]
        for at in inside[split[:1]]:
            raise BlockError(
                f"laser points{name} lie before and after a gap of the trajectory at {at:.3f} s, as for two flight "
                "lines with one point source ID: give each line its own ID, or use a trajectory without the gap"
            )


def not_covered(trajectory: Trajectory, time: Float[np.ndarray, "n"], of: str = "") -> BlockError:
    """Return the error for times (s) of laser points outside the trajectory."""
    record = np.asarray(trajectory.time)
    shift = shift_that_fits(time, record[0], record[-1])
    cure = f", or shift its clock (--trajectory-shift-s {shift:+.15g})" if shift is not None else ""
    first = time[~covers(trajectory, time)].min()
    clocks = (looks_like(times, "a start of its own") for times in (time, record))
    return BlockError(
        f"laser points{of} were measured where the trajectory has no records, first at {first:.3f} s: the cloud's "
        f"clock shows {next(clocks)}, the trajectory's {next(clocks)}; "
        f"give the trajectory of the whole flight, or the cloud without these points{cure}"
    )


class ScannerPoses(eqx.Module):
    """Poses of the scanner at the times of laser points: one entry per point."""

    position: Float[np.ndarray, "n 3"]
    """Position (m) in the object frame."""
    object_from_body: Float[np.ndarray, "n 3 3"]


class ScannerPath(eqx.Module):
    """Trajectory of a scanner, prepared for the poses of millions of laser points."""

    trajectory: Trajectory
    spline: TrajectorySpline


def scanner_path(trajectory: Trajectory) -> ScannerPath:
    """Fit a spline to `trajectory`, whose clock must be the clock of the laser points."""
    max_gap = np.array(longest_interval(trajectory))
    return ScannerPath(trajectory, call_compiled(_spline, trajectory, max_gap))


def scanner_poses(path: ScannerPath, time: Float[np.ndarray, "n"]) -> ScannerPoses:
    """Interpolate poses at the times of laser points (s)."""
    if not len(time):
        return ScannerPoses(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    position, turn, known = _along(_poses, path, time)
    if not known.all():
        raise not_covered(path.trajectory, time)
    return ScannerPoses(position, turn)


def scanner_motions(path: ScannerPath, time: Float[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity (m/s) and rotation rate (rad/s), (n, 3) each, at one or more covered times (s)."""
    velocity, rate = _along(_motions, path, time)
    return velocity, rate


def corrected_xyz(
    xyz: Float[np.ndarray, "n 3"],
    poses: ScannerPoses | None,
    boresight: Float[ArrayLike, "3"],
    shift: Float[ArrayLike, "3"],
) -> Float[np.ndarray, "n 3"]:
    """Apply `georeferencing.corrected_point` to many points; without poses the boresight is ignored."""
    shift = np.asarray(shift)
    if poses is None or not np.any(np.asarray(boresight)):
        return xyz - shift
    return in_portions(_corrected, (xyz, poses.position, poses.object_from_body), np.asarray(boresight), shift)


def correct_cloud(cloud: Cloud, scanner: Scanner, path: ScannerPath | None) -> Cloud:
    """Correct a cloud for the boresight of its scanner and the shifts of its strips.

    A strip without a shift is corrected for boresight only. Raises the errors of `scanner_poses`.
    """
    xyz = np.array(cloud.xyz)
    turned = path is not None and bool(np.any(np.asarray(scanner.boresight)))
    for strip, shift in _strips(cloud, scanner):
        for first in range(0, len(strip), PORTION):
            portion = strip[first : first + PORTION]
            poses = scanner_poses(path, cloud.time[portion]) if turned and cloud.time is not None else None  # type: ignore[arg-type]
            xyz[portion] = corrected_xyz(cloud.xyz[portion], poses, scanner.boresight, shift)
    return dataclasses.replace(cloud, xyz=xyz)


def correct_trajectory(trajectory: Trajectory, cloud: Cloud, scanner: Scanner) -> Trajectory:
    """Subtract from the trajectory the shift of the strip flown at that time; between strips, the shift of the closer
    strip.
    """
    if cloud.time is None:
        return trajectory
    time = np.asarray(trajectory.time)
    away, shifts = [], []
    for of_strip, shift in _strips(cloud, scanner):
        times = cloud.time[of_strip]
        if len(times):
            away.append(np.maximum(times.min() - time, time - times.max()))
            shifts.append(np.asarray(shift))
    nearest = np.argmin(np.maximum(np.stack(away), 0.0), axis=0)
    return dataclasses.replace(
        trajectory, position=jnp.asarray(np.asarray(trajectory.position) - np.stack(shifts)[nearest])
    )


def _strips(cloud: Cloud, scanner: Scanner) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the points and the shift of each strip of a cloud."""
    names = cloud.strips or tuple(scanner.shifts)
    strip = cloud.strip if cloud.strip is not None else np.zeros(len(cloud), int)
    return [
        (np.flatnonzero(strip == k), np.asarray(scanner.shifts.get(name, np.zeros(3)))) for k, name in enumerate(names)
    ]


def in_portions(
    function: Callable, points: tuple[Float[np.ndarray, "n ..."], ...], *common: Any
) -> Float[np.ndarray, "n 3"]:
    """Apply a jitted `function` to the rows of `points` in portions; `common` is passed unchanged."""
    result = np.empty((len(points[0]), 3))
    for first in range(0, len(result), PORTION):
        portion = slice(first, first + PORTION)
        some = [v[portion] for v in points]
        n = len(some[0])
        padded = (np.concatenate([v, np.broadcast_to(v[:1], (padded_size(n) - n, *v.shape[1:]))]) for v in some)
        # Slicing a JAX array would compile a program for each length.
        result[portion] = np.asarray(call_compiled(function, *padded, *common))[:n]
    return result


def _along(function: Callable, path: ScannerPath, time: Float[np.ndarray, "n"]) -> list[np.ndarray]:
    """Evaluate a jitted `function` of the spline at one or more times, in portions."""
    parts = []
    for first in range(0, len(time), PORTION):
        some = np.asarray(time[first : first + PORTION], float)
        padded = np.concatenate([some, np.full(padded_size(len(some)) - len(some), some[0])])
        parts.append([np.asarray(v)[: len(some)] for v in call_compiled(function, path.spline, padded)])
    return [np.concatenate(v) for v in zip(*parts, strict=True)]


def padded_size(n: int) -> int:
    """Round up the number of laser points to a compiled portion size."""
    return max(_FEW, min(1 << max(n - 1, 0).bit_length(), PORTION))


@eqx.filter_jit
def _spline(trajectory: Trajectory, max_gap: Float[Array, ""]) -> TrajectorySpline:
    return spline_through(jax.tree.map(jnp.asarray, trajectory), max_gap)


@eqx.filter_jit
def _poses(
    spline: TrajectorySpline, time: Float[Array, "n"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"], Bool[Array, "n"]]:
    return spline.poses(time)


@eqx.filter_jit
def _motions(spline: TrajectorySpline, time: Float[Array, "n"]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    return spline.motions(time)


@eqx.filter_jit
def _corrected(xyz, position, object_from_body, boresight, shift) -> Float[Array, "n 3"]:
    return jax.vmap(corrected_point, (0, 0, 0, None, None))(xyz, position, object_from_body, boresight, shift)


def corrected_strip(
    xyz: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    strip: int,
    errors: StripErrors,
    path: ScannerPath | None,
) -> Float[np.ndarray, "n 3"]:
    """Apply `georeferencing.corrected_return` to returns of one strip; without a path, only its constant shift."""
    if path is None:
        return xyz - errors.at(strip, time)[0]
    common = path.spline, errors.of_strip(strip), errors.boresight, errors.calibration
    result = in_portions(_corrected_returns, (xyz, time), *common)
    if np.isnan(result[:, 0]).any():
        raise not_covered(path.trajectory, time)
    return result


def correct_strips(cloud: Cloud, errors: StripErrors, path: ScannerPath | None) -> Cloud:
    """Correct the coordinates of a cloud for strip errors; all other fields are unchanged."""
    xyz = np.array(cloud.xyz)
    for k in range(len(errors.splines)):
        of_strip = np.flatnonzero(cloud.strip == k) if cloud.strip is not None else np.arange(len(cloud))
        if len(of_strip):
            xyz[of_strip] = corrected_strip(cloud.xyz[of_strip], times_of(cloud)[of_strip], k, errors, path)
    return dataclasses.replace(cloud, xyz=xyz)


def correct_flight(trajectory: Trajectory, errors: StripErrors) -> Trajectory:
    """Correct a trajectory for strip errors; between strips, by the errors at the closer strip end."""
    time = np.asarray(trajectory.time)
    ends = np.array([(s.start, s.start + s.interval * max(s.size - 3, 0)) for s in errors.splines])
    away = np.maximum(ends[:, :1] - time, time - ends[:, 1:])
    nearest = np.argmin(np.maximum(away, 0.0), axis=0)
    offset, turn = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    for k in range(len(ends)):
        closest = nearest == k
        offset[closest], turn[closest] = errors.at(k, time[closest])
    quaternion = call_compiled(_turned, np.asarray(trajectory.quaternion), turn)
    return dataclasses.replace(
        trajectory, position=jnp.asarray(np.asarray(trajectory.position) - offset), quaternion=quaternion
    )


def times_of(cloud: Cloud) -> Float[np.ndarray, "n"]:
    """Return the times of the points (s); zero if the cloud has no times (sufficient for a constant shift)."""
    return np.zeros(len(cloud)) if cloud.time is None else cloud.time


@eqx.filter_jit
def _corrected_returns(point, time, spline, errors, boresight, calibration) -> Float[Array, "n 3"]:
    """Return corrected points; NaN where the trajectory has no records."""
    position, object_from_body, known = spline.poses(time)
    off, each = errors.at(time), (0, 0, 0, 0, 0, 0, 0, None, None)
    points = point, position, object_from_body, *spline.motions(time), off[:, :3], off[:, 3:], boresight, calibration
    return jnp.where(known[:, None], jax.vmap(corrected_return, each)(*points), jnp.nan)


@eqx.filter_jit
@jax.vmap
def _turned(quaternion: Float[Array, "4"], turn: Float[Array, "3"]) -> Float[Array, "4"]:
    turned = quaternion_from_matrix(jnp.matmul(matrix_from_quaternion(quaternion), small_rotation(turn)))
    return jnp.where(jnp.sum(turned * quaternion) < 0, -turned, turned)
