"""Looks of a scanner: forward and backward returns of a strip.

A line scanner measures an area once per strip. A circular scanner measures it ahead and, seconds later, behind: at
other angles, at another time of the trajectory. Planes from the two looks of one strip are compared like planes of two
strips.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Block, empty_block
from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError, InputError
from jaxphoto.georeferencing import (
    Pattern,
    Scanner,
    ScannerCalibration,
    StripErrors,
    StripSpline,
    Trajectory,
    TrajectoryKnot,
    knot_name,
)
from jaxphoto.georeferencing.time_scales import looks_like, shift_that_fits
from jaxphoto.lidar.correction import (
    PORTION,
    ScannerPath,
    corrected_strip,
    covers,
    in_portions,
    scanner_motions,
    scanner_path,
    scanner_poses,
)
from jaxphoto.lidar.strip_planes import PlanePairs, StripPatches, StripSettings, steep
from jaxphoto.observations import (
    Attitudes,
    AttitudeSteps,
    CameraPositions,
    PositionSteps,
    StripPlanes,
    TrajectoryAttitudes,
    TrajectoryStations,
)
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.procedures.lidar.iterate_to_convergence import at_result, check_without_surfaces
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted


class Look(NamedTuple):
    """Forward, backward or all returns of one strip."""

    strip: int
    name: str
    returns: Int[np.ndarray, "n"]
    """Indices in the cloud."""


def looks_of(cloud: Cloud, path: ScannerPath | None, pattern: Pattern) -> list[Look]:
    """Return one look per strip; for a circular scanner two, "1 ahead" and "1 behind" of strip 1."""
    looks = []
    for k, name in enumerate(cloud.strips):
        returns_of_strip = np.flatnonzero(cloud.strip == k)
        if pattern == "line" or path is None:
            looks.append(Look(k, name, returns_of_strip))
            continue
        ahead = aside(cloud, returns_of_strip, path)[:, 1] > 0
        sides = (f"{name} ahead", returns_of_strip[ahead]), (f"{name} behind", returns_of_strip[~ahead])
        looks += [Look(k, side, returns) for side, returns in sides if len(returns)]
    return looks


def aside(cloud: Cloud, which: Int[np.ndarray, "n"], path: ScannerPath) -> Float[np.ndarray, "n 2"]:
    """Return tangents of the angles of returns to the right and ahead, relative to the body's nadir."""
    parts = [np.zeros((0, 2))]
    for first in range(0, len(which), PORTION):
        portion = which[first : first + PORTION]
        poses = scanner_poses(path, cloud.time[portion])  # type: ignore[index]
        shot = np.einsum("nji,nj->ni", poses.object_from_body, cloud.xyz[portion] - poses.position)
        parts.append(shot[:, :2] / np.maximum(-shot[:, 2:], 1e-9))
    return np.concatenate(parts)


def check_measured_from(cloud: Cloud, path: ScannerPath, pattern: Pattern | None = None) -> None:
    """Raise BlockError if the points of `cloud` cannot have been measured from this trajectory, or by this pattern.

    In the body frame, a scanner's points are in the same region along the whole flight. If the trajectory is in another
    system, in feet, on another clock or has another yaw, they are not, and an adjustment is meaningless.
    """
    some = np.linspace(0, len(cloud) - 1, min(_PROBED, len(cloud))).astype(int)
    time = cloud.time[some]  # type: ignore[index]
    away = float(np.median(np.linalg.norm(cloud.xyz[some] - scanner_poses(path, time).position, axis=1)))
    cure = "bring cloud and trajectory into one coordinate system, in metres, and onto one clock, angles in degrees"
    if away > _FARTHEST_M:
        raise BlockError(f"the laser points are {away / 1000:.0f} km from the scanner's trajectory: {cure}")
    second = np.floor(time - time.min()).astype(np.int64)
    order = np.argsort(second, kind="stable")
    _, first, number = np.unique(second[order], return_index=True, return_counts=True)
    tangents = aside(cloud, some, path)
    parts = [tangents[order[k : k + n]] for k, n in zip(first, number, strict=True) if n >= _FEWEST_A_SECOND]
    if not parts:
        return
    # Use the first and last decile: a return above the scanner may be arbitrarily far across.
    low, middle, high = np.stack([np.quantile(part, (0.1, 0.5, 0.9), axis=0) for part in parts], axis=1)
    right, ahead = np.median((high - low) / 2, axis=0)
    half = max(right, ahead)
    if half < _NARROW:
        return
    moves = np.subtract(*np.quantile(middle, (0.9, 0.1), axis=0)) / 2
    if max(moves) > _WANDERS * half or np.abs(np.median(middle, axis=0)).max() > _ASIDE:
        raise BlockError(
            f"laser points of one second scatter about the scanner, up to {np.abs(middle).max():.1f} flying heights to "
            f"one side, but the swath is {2 * half:.2f} flying heights wide: {cure}"
        )
    spread = f"laser points of one second spread to the side by {right:.2f} of the height and ahead by {ahead:.2f}"
    if pattern is not None and right < _ALIKE * ahead:
        raise BlockError(
            f"{spread}: the scan is not across the x axis. Correct the trajectory's yaw, or rotate it to the scanner "
            "axes"
        )
    scanned: Pattern = "circle" if ahead > _ALIKE * right else "line"
    if pattern is not None and scanned != pattern:
        raise BlockError(f"{spread}, as for a {scanned} scan: give its pattern (--pattern {scanned})")


# Maximum range of an airborne laser scanner (m); number of points examined; minimum number of points per second.
_FARTHEST_M, _PROBED, _FEWEST_A_SECOND = 10_000.0, 50_000, 20
# Maximum drift of the one-second median, in half swath widths (allows gaps over water); maximum of its median over the
# flight, as a tangent.
_WANDERS, _ASIDE = 1.5, 3.0
# Ratio of the spreads ahead and across above which the pattern is circular, below which it consists of lines; minimum
# half swath width, relative to the height, for this test.
_ALIKE, _NARROW = 0.5, 0.02


_ZERO = np.zeros(3)
NO_CALIBRATION = ScannerCalibration(_ZERO, *[np.zeros(())] * 3, np.zeros(2), np.zeros(()))  # type: ignore[arg-type, call-arg]
"""Scanner without errors."""


class KnotSigmas(NamedTuple):
    """Standard deviations of the trajectory errors at each knot of all strips."""

    position: Float[np.ndarray, "knots 3"]
    """Standard deviations along X, Y and Z (m)."""
    attitude: Float[np.ndarray, "knots 3"]
    """Standard deviations about right, forward and up (rad)."""


def knot_sigmas(splines: Sequence[StripSpline], trajectory: Trajectory | None, settings: StripSettings) -> KnotSigmas:
    """Return the trajectory's standard deviations at the knots, or the values of the settings if it has none (zero)."""
    times = np.concatenate([spline.times for spline in splines])
    position = np.full((len(times), 3), settings.sigma_position_m)
    attitude = np.tile(settings.sigma_attitude, (len(times), 1))
    if trajectory is None:
        return KnotSigmas(position, attitude)
    # Order roll, pitch and yaw as rotations about right, forward and up.
    stated = np.asarray(trajectory.sigma_position), np.asarray(trajectory.sigma_attitude)[:, [1, 0, 2]]
    for sigma_of_knots, sigmas in zip((position, attitude), stated, strict=True):
        for axis, column in enumerate(sigmas.T):
            if (column > 0).all():
                sigma_of_knots[:, axis] = np.interp(times, np.asarray(trajectory.time), column)
    return KnotSigmas(position, attitude)


class ScannerPriors(NamedTuple):
    """Priors of the scanner, each FREE, FIXED or Weighted."""

    boresight: Any = FREE
    calibration: ScannerCalibration = ScannerCalibration(*[FIXED] * len(dynamic_fields(ScannerCalibration)))  # type: ignore[arg-type]

    @property
    def right(self) -> bool:
        """Return True if no parameter of the scanner is estimated."""
        calibration = (getattr(self.calibration, name) for name in dynamic_fields(ScannerCalibration))
        return all(prior == FIXED for prior in (self.boresight, *calibration))


def strip_block(
    names: Sequence[str],
    splines: Sequence[StripSpline],
    held: Collection[str],
    sigmas: KnotSigmas,
    priors: ScannerPriors | None,
    photographs: Block | None = None,
) -> Block:
    """Create a block with the unknowns of strips, all zero, added to `photographs` if given.

    The first knot of each strip has the trajectory's sigma as prior. Without `priors` strips have only a shift, which
    is free. The trajectory of strips in `held` is fixed.
    """
    knots: dict[str, AbstractParameters] = {}
    knot_priors: dict[str, AbstractParameters] = {}
    later = TrajectoryKnot(FREE, FREE)  # type: ignore[arg-type]
    shift, right = TrajectoryKnot(FREE, FIXED), TrajectoryKnot(FIXED, FIXED)  # type: ignore[arg-type]
    for name, spline in zip(names, splines, strict=True):
        first = TrajectoryKnot(*(Weighted(_ZERO, of[spline.first]) for of in sigmas))  # type: ignore[arg-type]
        for k, time in enumerate(spline.times):
            owner = name if priors is None else knot_name(name, time)
            knots[owner] = TrajectoryKnot(_ZERO, _ZERO)  # type: ignore[arg-type]
            knot_priors[owner] = right if name in held else shift if priors is None else later if k else first
    block = empty_block("strips of a laser scanner") if photographs is None else photographs
    start, prior = block.start.unknowns, block.priors
    start = dataclasses.replace(start, more=start.more | {TrajectoryKnot.kind: knots})
    prior = dataclasses.replace(prior, more=prior.more | {TrajectoryKnot.kind: knot_priors})
    if priors is not None:
        of_scanner, calibration = ScannerCalibration.kind, priors.calibration
        right_scanner = Scanner(_ZERO, {})  # type: ignore[arg-type]
        none = dataclasses.replace(NO_CALIBRATION, pattern=calibration.pattern)
        start = dataclasses.replace(start, scanner=right_scanner, more=start.more | {of_scanner: {"": none}})
        prior = dataclasses.replace(
            prior, scanner=Scanner(priors.boresight, {}), more=prior.more | {of_scanner: {"": calibration}}
        )
    return dataclasses.replace(at_result(block, start), priors=prior)


def errors_of(unknowns: Unknowns, splines: tuple[StripSpline, ...]) -> StripErrors:
    """Return the strip errors for the unknowns of `strip_block`."""
    knots = unknowns.more[TrajectoryKnot.kind].values()
    position, attitude = (np.array([getattr(k, name) for k in knots], float) for name in ("position", "attitude"))
    calibration: Any = unknowns.more.get(ScannerCalibration.kind, {"": NO_CALIBRATION})[""]
    boresight = _ZERO if unknowns.scanner is None else np.asarray(unknowns.scanner.boresight)
    return StripErrors(splines, position, attitude, boresight, calibration)


# Number of iterations from a corrected point to the measured one: each multiplies the error by the relative size of the
# corrections.
_STEPS = 2
# Odd multiplier (Knuth) that scatters neighbouring integers over 64 bits.
_SCATTER = np.uint64(0x9E3779B97F4A7C15)


class Side(NamedTuple):
    """Observations of one strip: knots (n, 4), weights (n, 4), all others (n, 3)."""

    knots: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    scanner: np.ndarray
    roll_pitch_yaw: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray


def side_of(
    patches: StripPatches,
    which: Int[np.ndarray, "n"],
    foot: Float[np.ndarray, "n 3"],
    strip: int,
    errors: StripErrors,
    path: ScannerPath | None,
) -> Side:
    """Return the measured positions of the corrected points `foot` (m) on patches, and the scanner poses."""
    time = patches.time[which]
    knots, weights = errors.splines[strip].weights(time)
    point = foot + patches.measured[which] - patches.mean[which]
    for _ in range(_STEPS):
        point = point - (corrected_strip(point, time, strip, errors, path) - foot)
    if path is None or not len(time):
        # Assume vertical shots: nothing that rotates the shot is estimated.
        none = np.zeros_like(point)
        return Side(knots, weights, point, point + np.array([0.0, 0.0, 1.0]), none, none, none)
    poses = scanner_poses(path, time)
    angles = in_portions(_angles, (poses.object_from_body,))
    return Side(knots, weights, point, poses.position, angles, *scanner_motions(path, time))


def plane_rows(pairs: PlanePairs, a: Side, b: Side) -> StripPlanes:
    """Return planes common to two strips as observations."""
    of_a = {f"{name}_a": v for name, v in a._asdict().items()}
    of_b = {f"{name}_b": v for name, v in b._asdict().items()}
    return StripPlanes(**of_a, **of_b, normal=pairs.normal, sigma=pairs.sigma, gap=np.zeros(len(pairs.gap)))


def thinned(normal: Float[np.ndarray, "n 3"], cell: Int[np.ndarray, "n"], most: int) -> np.ndarray:
    """Select at most `most` planes: half of them steep if possible, otherwise at random.

    Randomness depends on the cell, so nearly equal planes give the same selection.
    """
    tells = steep(normal)
    order = np.argsort(cell.astype(np.uint64) * _SCATTER, kind="stable")
    parts = order[tells[order]], order[~tells[order]]
    first = min(len(parts[0]), max(most // 2, most - len(parts[1])))
    return np.sort(np.concatenate([parts[0][:first], parts[1][: most - first]]))


def step_rows(
    splines: tuple[StripSpline, ...], sigmas: KnotSigmas, settings: StripSettings
) -> tuple[PositionSteps, AttitudeSteps]:
    """Return the difference observations of successive knots, which give every knot its a priori standard deviation."""
    start = np.concatenate([s.first + np.arange(s.size - 1) for s in splines])
    interval = np.concatenate([np.full(s.size - 1, s.interval) for s in splines])
    decay = np.exp(-interval / settings.correlation_s)
    part, none = decay[:, None] ** 2, np.zeros((len(start), 3))

    def new(sigma: Float[np.ndarray, "knots 3"]) -> Float[np.ndarray, "steps 3"]:
        # Limit from below: the variance of a step must remain positive if the sigmas decrease faster than the
        # correlation decays.
        before, after = sigma[start] ** 2, sigma[start + 1] ** 2
        return np.sqrt(np.maximum(after - part * before, (1 - part) * np.minimum(before, after)))

    return (
        PositionSteps(start, start + 1, decay, new(sigmas.position), none),
        AttitudeSteps(start, start + 1, decay, new(sigmas.attitude), none),
    )


_angles = eqx.filter_jit(jax.vmap(roll_pitch_yaw_from_matrix))


# Photographs of the same flight as laser strips: their exposures lie on the trajectory of the scanner.

# Maximum distance (m) of stations from the trajectory; larger ones belong to another trajectory or time.
_FAR_M = 10.0


class Photographs(NamedTuple):
    """Block of images, and the exposure times on the clock of the cloud and its trajectory."""

    block: Block
    """Block whose stations and attitudes come from the trajectory."""
    time: Float[np.ndarray, "images"]
    """Exposure times in seconds."""


def check_photographs(photographs: Photographs, trajectory: Trajectory | None) -> None:
    """Raise InputError or BlockError for photographs that do not match the trajectory."""
    block, time = photographs.block, photographs.time
    if trajectory is None:
        raise InputError(
            "photographs and strips need their common trajectory: give it (--trajectory), or adjust the strips alone"
        )
    if any(isinstance(rows, StripPlanes) for rows in block.more):
        raise BlockError(
            "the block is the result of a joint adjustment (planes in strip_planes.csv): adjust it by jaxphoto "
            "adjust, or give the original block"
        )
    check_without_surfaces(block)
    unknown = np.flatnonzero(~np.isfinite(time))
    if len(unknown):
        raise InputError(
            f"image {block.images[unknown[0]]} has no time_s, so its position on the trajectory is unknown: give the "
            "times of all exposures in images.csv"
        )
    if not len(block.stations):
        raise InputError("the block has no stations: add [trajectory] to block.toml, or stations.csv")
    times = np.asarray(trajectory.time)
    for k in np.flatnonzero(~covers(trajectory, time))[:1]:
        shift = shift_that_fits(time, times[0], times[-1])
        clock = "on its clock" if shift is None else f"{shift:+.15g} s later, all within the trajectory"
        raise BlockError(
            f"image {block.images[k]} was exposed at {time[k]:.3f} s, where the trajectory has no records: the "
            f"exposures are at {looks_like(time)}, the trajectory at {looks_like(times)}; give the trajectory of the "
            f"whole flight, or the exposures {clock} (--exposure-shift-s)"
        )
    rows = block.stations
    at = scanner_poses(scanner_path(trajectory), time[rows.who]).position
    offset = np.asarray(rows.value) - at[np.arange(len(rows)), rows.axis]
    apart = float(np.median(np.sqrt(np.bincount(rows.who, offset**2)[np.unique(rows.who)])))
    if apart > _FAR_M:
        raise BlockError(
            f"the stations of the block are {apart:.0f} m from the trajectory at their times: bring both onto one "
            "clock (--exposure-shift-s) and into one coordinate system"
        )


def spans_with(
    time: Float[np.ndarray, "images"], spans: Float[np.ndarray, "strips 2"]
) -> Float[np.ndarray, "strips 2"]:
    """Return first and last times of strips (s), extended to the exposures on their trajectories."""
    strip = _strip_of(time, spans)
    times_of_strip = [np.append(time[strip == k], span) for k, span in enumerate(spans)]
    return np.array([(t.min(), t.max()) for t in times_of_strip])


def on_trajectory(
    photographs: Photographs,
    splines: Sequence[StripSpline],
    spans: Float[np.ndarray, "strips 2"],
    settings: StripSettings,
) -> Block:
    """Return the block with stations and attitudes of a trajectory with errors `splines` over `spans`.

    They replace the block's observations, which come from the same instruments and would be used twice.
    """
    block, time = photographs.block, photographs.time
    strip, knots, weights = _strip_of(time, spans), np.zeros((len(time), 4), int), np.zeros((len(time), 4))
    for k, spline in enumerate(splines):
        in_strip = strip == k
        knots[in_strip], weights[in_strip] = spline.weights(time[in_strip])
    s, a = block.stations, block.attitudes
    sigma, turn = np.full(len(s), settings.sigma_exposure_m), np.deg2rad(settings.sigma_exposure_deg)
    position = TrajectoryStations(s.who, knots[s.who], weights[s.who], s.axis, np.asarray(s.value), sigma)
    angles = np.asarray(a.roll_pitch_yaw)
    attitude = TrajectoryAttitudes(a.image, knots[a.image], weights[a.image], angles, np.full(angles.shape, turn))
    more = (*block.more, position, *([attitude] if len(attitude) else []))
    return dataclasses.replace(block, stations=CameraPositions.none(), attitudes=Attitudes.none(), more=more)


def _strip_of(time: Float[np.ndarray, "images"], spans: Float[np.ndarray, "strips 2"]) -> Int[np.ndarray, "images"]:
    """Return the laser strip of each exposure: the nearest in time."""
    away = np.maximum(spans[:, :1] - time, time - spans[:, 1:])
    return np.argmin(np.maximum(away, 0.0), axis=0)
