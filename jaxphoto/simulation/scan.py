"""Simulation of a laser scan of ground, buildings and trees, with its trajectory and truth.

Every pulse travels from the scanner along a ray fixed in the aircraft. It ends at a roof or on the ground, whichever
comes first; a hit on a wall gives no return, so buildings cast shadows. On its way it may hit leaves.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import PATTERN_OF, Scanner, StripErrors, Trajectory
from jaxphoto.rotation import quaternion_from_matrix, small_rotation
from jaxphoto.simulation.buildings import entered, solids
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.nearby import pairs_along
from jaxphoto.simulation.platform_path import Path, matrices
from jaxphoto.simulation.scan_errors import drawn_errors, drawn_shift, measured_shot, turned_by
from jaxphoto.simulation.scan_plan import ScanPlan
from jaxphoto.simulation.streams import stream
from jaxphoto.simulation.terrain import Terrain
from jaxphoto.simulation.trees import met_leaves

GROUND, VEGETATION, ROOF = 2, 5, 6
"""LAS classes (ASPRS): ground, high vegetation, building."""
_RATE_HZ = 100.0
# Frequencies of the two prisms, whose pattern does not repeat within a strip; a nutating mirror has only the first.
_PRISMS_HZ = (121.7, -77.3)
# Tolerance (m) of the intersection with the ground; steeper ground is not hit.
_ENOUGH_M = 1e-7
_ROUNDS = 60
# Pulses processed at a time: bounds the memory.
_CHUNK = 500_000
_CHUNK_RECORDS = 65_536
# Limits of the memory of a cloud, and of a trajectory.
_PULSES, _RECORDS = 1e8, 2e7


class Scan(NamedTuple):
    """Measured cloud, trajectory of GNSS and IMU, and the errors of both."""

    cloud: Cloud
    trajectory: Trajectory
    scanner: Scanner
    """Boresight and the shifts of the strips, without their drifts."""
    errors: StripErrors
    """All errors."""


class _Returns(NamedTuple):
    """Reflections: index of the pulse, distance along the ray (m), class."""

    pulse: Int[np.ndarray, "returns"]
    at: Float[np.ndarray, "returns"]
    by: UInt8[np.ndarray, "returns"]


def scan(
    plan: ScanPlan,
    paths: list[Path],
    terrain: Terrain,
    noise_m: Float[np.ndarray, "3"],
    seed: int,
) -> Scan:
    """Scan `terrain`, which is drawn and settled, from the path of every strip; strips are called 1, 2 ... in turn.

    The trajectory has shift and drift errors by strip, the shots those of boresight and calibration: with these,
    `corrected_return` of every point is the point that was hit plus normal noise of `noise_m` (X, Y, Z). Raises
    BlockError without returns, and with more than memory can hold.
    """
    errors = drawn_errors(plan, paths, seed)
    leaves, noise = stream(seed, "laser returns from crowns"), stream(seed, "noise of laser points")
    parts = []
    pulses_of = _pulses(plan, paths)
    for number, path in enumerate(paths):
        n = round(pulses_of[number])
        for begin in range(0, n, _CHUNK):
            pulses = np.arange(begin, min(begin + _CHUNK, n))
            time, aside = _pattern(plan, path, pulses, n)
            parts.append(_measured(path, time, aside, terrain, errors, number, noise_m, leaves, noise))
            parts[-1]["strip"] = np.full(len(parts[-1]["time"]), number)
    if not sum(len(part["time"]) for part in parts):
        raise BlockError("no laser pulse reaches the ground; raise density_per_m2, or scan longer strips over it")
    of_points = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    # Integers, as cloud files require.
    names = tuple(f"{number + 1}" for number in range(len(paths)))
    shifts = [drawn_shift(plan, path.strip, seed) for path in paths]
    truth = Scanner(errors.boresight, dict(zip(names, shifts, strict=True)))  # type: ignore[arg-type]
    return Scan(Cloud(**of_points, strips=names), _trajectory(paths, errors), truth, errors)


def _pulses(plan: ScanPlan, paths: list[Path]) -> list[float]:
    """Return the number of pulses of every path. Raises BlockError for too many, and for a strip not flown."""
    pulses_of = [plan.density_per_m2 * 2 * plan.half_width * path.height_m * path.length_m for path in paths]
    if not sum(pulses_of) <= _PULSES:
        raise BlockError(
            f"the scanner would send {sum(pulses_of):.3g} pulses, the most are {_PULSES:g}; lower density_per_m2"
        )
    seconds = sum(path.node[-1] - path.node[0] for path in paths)
    if not seconds * _RATE_HZ <= _RECORDS:
        raise BlockError(
            f"the scanner would fly for {seconds / 3600:.3g} hours; give shorter strips, or a higher speed"
        )
    for path in paths:
        if not abs(plan.time_offset_s) < path.node[-1] - path.node[0]:
            raise BlockError(
                f"strip {path.strip} lasts {path.node[-1] - path.node[0]:.3g} s, and the scanner's clock is off by "
                f"{plan.time_offset_s:g} s; give a smaller time_offset_s"
            )
    return pulses_of


def _pattern(
    plan: ScanPlan, path: Path, pulses: Int[np.ndarray, "n"], of: int
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Return the time (s) of pulses, and the tangents of their angles to the right and ahead."""
    # Both the true time and the recorded one lie on the path.
    begin, end = path.node[[0, -1]] + np.clip(plan.time_offset_s, (0.0, -np.inf), (np.inf, 0.0))
    time = begin + (pulses + 0.5) / of * (end - begin)
    if PATTERN_OF[plan.pattern] == "circle":
        return time, _around(plan, time)
    # On level ground, lines are as far apart as their pulses.
    per_line = max(1, round(2 * plan.half_width * path.height_m * np.sqrt(plan.density_per_m2)))
    across = _across(plan, (pulses + 0.5) / per_line)
    return time, np.column_stack([across, np.zeros(len(across))])


def _across(plan: ScanPlan, line: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return lines: each from left to right at even steps, or oscillating as a sine."""
    if plan.pattern == "oscillating":
        return -np.tan(np.deg2rad(plan.scan_angle_deg) * np.cos(np.pi * line))
    return plan.half_width * (2 * (line % 1) - 1)


def _around(plan: ScanPlan, time: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    """Return circles: a rotating vector; two prisms add, to first order, one each."""
    turning = _PRISMS_HZ[:1] if plan.pattern == "nutating" else _PRISMS_HZ
    angles = 2 * np.pi * np.outer(time, turning)
    return plan.half_width / len(turning) * np.column_stack([np.sin(angles).sum(1), np.cos(angles).sum(1)])


def _measured(
    path: Path,
    time: Float[np.ndarray, "n"],
    aside: Float[np.ndarray, "n 2"],
    terrain: Terrain,
    errors: StripErrors,
    strip: int,
    noise_m: Float[np.ndarray, "3"],
    leaves: np.random.Generator,
    noise: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Return the fields of the cloud of some pulses, sorted by time and return."""
    position, quaternion = path.pose(time)
    object_from_body = believed_turn = matrices(quaternion)
    recorded, believed_position = time - errors.calibration.time_offset, position
    if errors.calibration.time_offset:
        believed_position, quaternion = path.pose(recorded)
        believed_turn = matrices(quaternion)
    origin = position - object_from_body @ errors.calibration.lever_arm
    body_from_scanner = np.asarray(_small_rotation(errors.boresight))
    # The scanner assumes its axes are those of the body.
    believed = np.column_stack([aside, -np.ones(len(aside))])
    believed /= np.linalg.norm(believed, axis=1, keepdims=True)
    ray = _rotated(object_from_body, believed @ body_from_scanner.T)
    returns = _returned(origin, ray, terrain, leaves)
    order = np.lexsort((returns.at, returns.pulse))
    pulse, at, by = (a[order] for a in returns)
    _, first, of_pulse, count = np.unique(pulse, return_index=True, return_inverse=True, return_counts=True)
    number = np.arange(len(pulse)) - first[of_pulse] + 1
    # Solve `corrected_return` for the recorded point; noise is that of the corrected point.
    hit = ray[pulse] * at[:, None] + origin[pulse] - position[pulse] + noise.standard_normal((len(pulse), 3)) * noise_m
    shot = measured_shot(
        _rotated(object_from_body[pulse].transpose(0, 2, 1), hit), errors.boresight, errors.calibration
    )
    shift, turn = errors.at(strip, recorded[pulse])
    return {
        "xyz": believed_position[pulse] + shift + _rotated(turned_by(believed_turn[pulse], turn), shot),
        "classification": by,
        "returns": np.column_stack([number, count[of_pulse]]).astype(np.uint8),
        "time": recorded[pulse],
    }


def _returned(
    origin: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"], terrain: Terrain, rng: np.random.Generator
) -> _Returns:
    ground = _ground(origin, ray, terrain)
    roof = wall = np.full(len(ray), np.inf)
    if terrain.buildings:
        roof, wall = _built(origin, ray, ground, terrain)
    end = np.minimum(np.minimum(ground, roof), wall)
    seen = np.isfinite(ground)
    met = met_leaves(terrain.trees, origin, ray, np.where(seen, end, 0.0), rng)
    last = np.flatnonzero(seen & (wall > end) & ~met.stopped)
    by_last = np.where(roof[last] <= ground[last], ROOF, GROUND)
    by = np.concatenate([np.full(len(met.pulse), VEGETATION), by_last]).astype(np.uint8)
    return _Returns(np.concatenate([met.pulse, last]), np.concatenate([met.at, end[last]]), by)


def _ground(origin: np.ndarray, ray: np.ndarray, terrain: Terrain) -> Float[np.ndarray, "n"]:
    """Return the distance of the ground along each ray by fixed-point iteration; else infinity."""
    at = np.full(len(ray), np.nan)
    z = terrain.height(origin[:, :2])
    left, down = np.arange(len(ray)), -ray[:, 2]
    for _ in range(_ROUNDS):
        way = (origin[left, 2] - z) / down[left]
        now = terrain.height(origin[left, :2] + way[:, None] * ray[left, :2])
        done = np.abs(now - z) < _ENOUGH_M
        at[left[done]] = way[done]
        left, z = left[~done], now[~done]
        if not len(left):
            break
    return np.where(at > 0, at, np.inf)


def _built(
    origin: np.ndarray, ray: np.ndarray, ground: np.ndarray, terrain: Terrain
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the distance at which each ray first enters a building by its roof, and by a wall."""
    planes = solids(terrain.buildings)
    seen = np.flatnonzero(np.isfinite(ground))
    hit = origin[seen] + ground[seen, None] * ray[seen]
    which, place = pairs_along(hit, ray[seen], planes.centre, planes.radius, planes.top)
    pulse = seen[place]
    by_roof, by_wall = entered(planes, which, origin[pulse], ray[pulse])
    roof, wall = (np.full(len(ray), np.inf) for _ in range(2))
    np.minimum.at(roof, pulse, by_roof)
    np.minimum.at(wall, pulse, by_wall)
    return roof, wall


def _trajectory(paths: list[Path], errors: StripErrors) -> Trajectory:
    """Return the recorded trajectory: `_RATE_HZ` records per second of every path, with the errors of its strip."""
    ends = [(path.node[0], path.node[-1]) for path in paths]
    times = [np.linspace(begin, end, int(np.ceil((end - begin) * _RATE_HZ)) + 1) for begin, end in ends]
    poses = [path.pose(time) for path, time in zip(paths, times, strict=True)]
    off = [errors.at(k, time) for k, time in enumerate(times)]
    position = np.vstack([x + shift for (shift, _), (x, _) in zip(off, poses, strict=True)])
    exact = np.zeros((len(position), 3))
    quaternion, turn = np.vstack([q for _, q in poses]), np.vstack([turn for _, turn in off])
    if np.any(turn):
        quaternion = in_chunks(_quaternions, _CHUNK_RECORDS, turned_by(matrices(quaternion), turn))
    return Trajectory(np.concatenate(times), position, quaternion, exact, exact)  # type: ignore[arg-type]


def _rotated(matrix: Float[np.ndarray, "n 3 3"], vector: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", matrix, vector)


_small_rotation = jax.jit(small_rotation)
_quaternions = jax.jit(jax.vmap(quaternion_from_matrix))
