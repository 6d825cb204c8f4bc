"""Simulated laser scan of ground, buildings and trees, with trajectory and true errors.

Every pulse travels from the scanner along a ray fixed in the body frame. It ends at a roof or on the ground, whichever
comes first. A hit on a wall gives no return, so buildings cast shadows. Hits of leaves on the way give further returns.
"""

from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxphoto.cloud import Cloud
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import (
    Mount,
    Scanner,
    ScannerCalibration,
    StripErrors,
    StripSpline,
    Trajectory,
    corrected_shot,
)
from jaxphoto.rotation import (
    matrix_from_quaternion,
    matrix_from_roll_pitch_yaw,
    quaternion_from_matrix,
    roll_pitch_yaw_from_matrix,
    small_rotation,
)
from jaxphoto.simulation.flight import NO_BIAS, NO_MOUNT, Flight, record
from jaxphoto.simulation.plans import FlightPlan, ScanPlan, strip_value
from jaxphoto.simulation.recipe import Recipe
from jaxphoto.simulation.sampling import in_chunks, stream
from jaxphoto.simulation.scene import Terrain, entry_distances, intersect_crowns, pairs_along, solids

_CHUNK_EXPOSURES, _CHUNK_POINTS = 64, 65_536
# Time between the end of a strip and the beginning of the next.
_GAP_S = 60.0


class Path(NamedTuple):
    """True path of the scanner during one strip."""

    strip: str
    height_m: float
    """Planned height above the mean terrain."""
    length_m: float
    """Planned length over ground."""
    node: Float[np.ndarray, "nodes"]
    """Times from the beginning to the end of the strip (s)."""
    position: Float[np.ndarray, "nodes 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    """Position (m) and velocity (m/s)."""
    quaternion: Float[np.ndarray, "nodes 4"]
    turn: Float[np.ndarray, "nodes 4"]
    """`object_from_body` as quaternion (w, x, y, z) with continuous signs, and its derivative (1/s)."""

    def pose(self, time: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
        """Return positions (m) and unit quaternions of `object_from_body` at times (s)."""
        quaternion = _hermite(self.node, self.quaternion, self.turn, time)
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        return _hermite(self.node, self.position, self.velocity, time), quaternion / length


_matrices_from_quaternions = jax.jit(jax.vmap(matrix_from_quaternion))


def paths(recipe: Recipe, plan: ScanPlan, flight: Flight) -> list[Path]:
    """Compute the path of the scanner in every strip of `flight`, consecutively from time zero.

    If exposures lie on the scanner's trajectory, time zero is their mean.

    The scanner is at the reference point of GNSS and IMU, at their true positions. Positions and quaternions are cubic
    Hermite splines through each exposure with its velocity and rotation rate. The path is extended straight beyond the
    first and last exposure by half their footprint.
    """
    flown = cast(FlightPlan, recipe.plan)
    names = [recipe.mount_of(camera) for camera in flight.cameras]
    true = [recipe.mounts[name].truth if name else NO_MOUNT for name in names]
    # Use the true time of the exposure: time offsets of the camera do not apply.
    mounts = [Mount(m.lever_arm, m.boresight, 0.0, m.image_x) for m in true]
    position, attitude = record(flight, mounts, [NO_BIAS] * len(mounts))
    quaternion = in_chunks(_quaternions_from_angles, _CHUNK_EXPOSURES, attitude)
    turn = _turn(quaternion, np.asarray(flight.motion.rate))
    motion = (flight.time, position, np.asarray(flight.motion.velocity), quaternion, turn)
    result, begin, of = [], 0.0, np.array(flight.strips)
    for strip in flown.strips:
        lead = strip.footprint.along / 2 / flown.speed_m_per_s
        time, *nodes = _led(lead, *(a[of == strip.name] for a in motion))
        length = (time[-1] - time[0]) * flown.speed_m_per_s
        result.append(Path(strip.name, strip.height_m, length, time - time[0] + begin, *nodes))
        begin = result[-1].node[-1] + _GAP_S
    if plan.same_trajectory:
        middle = np.mean(np.concatenate([path.node[1:-1] for path in result]))
        result = [path._replace(node=path.node - middle) for path in result]
    return result


def _led(lead: float, time, position, velocity, quaternion, turn) -> tuple[np.ndarray, ...]:
    """Add a node `lead` seconds before and after the nodes of one strip; make the signs of quaternions continuous.

    Velocity and attitude there are equal to the first and the last exposure, without rotation.
    """
    turned = np.einsum("ni,ni->n", quaternion[1:], quaternion[:-1]) < 0
    sign = np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))])[:, None]
    quaternion, turn = quaternion * sign, turn * sign
    if lead:
        time = np.concatenate([[time[0] - lead], time, [time[-1] + lead]])
        position = np.vstack([position[0] - lead * velocity[0], position, position[-1] + lead * velocity[-1]])
        velocity, quaternion = (np.vstack([a[:1], a, a[-1:]]) for a in (velocity, quaternion))
        turn = np.vstack([np.zeros(4), turn, np.zeros(4)])
    return time, position, velocity, quaternion, turn


def _turn(quaternion: Float[np.ndarray, "n 4"], rate: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """Return the derivative of the quaternion, q (0, rate / 2); `rate` is about the body's axes (rad/s)."""
    (w, v), half = (quaternion[:, :1], quaternion[:, 1:]), rate / 2
    return np.hstack([-np.sum(v * half, axis=1, keepdims=True), w * half + np.cross(v, half)])


@jax.jit
@jax.vmap
def _quaternions_from_angles(roll_pitch_yaw):
    return quaternion_from_matrix(matrix_from_roll_pitch_yaw(roll_pitch_yaw))


def _hermite(
    node: Float[np.ndarray, "k"], value: Float[np.ndarray, "k m"], slope: Float[np.ndarray, "k m"], at: np.ndarray
) -> Float[np.ndarray, "n m"]:
    """Evaluate cubic Hermite splines with `value` and `slope` at every node."""
    i = np.clip(np.searchsorted(node, at, side="right") - 1, 0, len(node) - 2)
    step = (node[i + 1] - node[i])[:, None]
    u = (at - node[i])[:, None] / step
    ends = value[i] * (1 + 2 * u) * (1 - u) ** 2 + value[i + 1] * (3 - 2 * u) * u**2
    return ends + step * u * (1 - u) * (slope[i] * (1 - u) - slope[i + 1] * u)


# Iterations from a corrected to the measured shot; each multiplies the error by the order of the scanner's errors.
_STEPS = 3


def draw_errors(plan: ScanPlan, paths: list[Path], seed: int) -> StripErrors:
    """Draw the errors of the scanner of `plan`, and of its trajectory: shifts, and drifts about them.

    Random drifts are Gauss-Markov processes (`observations.knot_steps`) between knots.
    """
    splines: list[StripSpline] = []
    position, attitude = [], []
    for path in paths:
        first = sum(s.size for s in splines)
        splines.append(StripSpline.over(first, float(path.node[0]), float(path.node[-1]), plan.knots_s))
        drift = _drift(splines[-1], plan.correlation_s, stream(seed, f"drift of lidar strip {path.strip}"))
        # Coefficients linear in their times give a spline linear in time.
        gone = (splines[-1].times - np.mean(path.node[[0, -1]]))[:, None]
        shift = draw_shift(plan, path.strip, seed) + gone * strip_value(plan.drift_m_per_s, path.strip)
        turn = strip_value(plan.attitude_deg, path.strip) + gone * strip_value(
            plan.attitude_drift_deg_per_s, path.strip
        )
        position.append(shift + np.array(plan.drift_sigma_m) * drift[:, :3])
        attitude.append(np.deg2rad(turn + np.array(plan.drift_sigma_deg) * drift[:, 3:]))
    scales = (np.array(v) for v in (plan.range_offset_m, plan.range_scale_ppm, plan.angle_scale_ppm))
    numbers: Any = (
        np.array(plan.lever_arm_m),
        *scales,
        np.deg2rad(plan.eccentricity_deg),
        np.array(plan.time_offset_s),
    )
    calibration = ScannerCalibration(*numbers, plan.pattern)  # type: ignore[call-arg]
    boresight = np.deg2rad(plan.boresight_deg)
    return StripErrors(tuple(splines), np.concatenate(position), np.concatenate(attitude), boresight, calibration)


def draw_shift(plan: ScanPlan, strip: str, seed: int) -> Float[np.ndarray, "3"]:
    """Draw the shift of a strip (m); drifts are added to it."""
    drawn = stream(seed, f"shift of lidar strip {strip}").standard_normal(3)
    return strip_value(plan.shift_m, strip) + np.array(plan.shift_sigma_m) * drawn


def rotate_body(
    object_from_body: Float[np.ndarray, "n 3 3"], attitude: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Apply the attitude error `attitude` (rad) of a trajectory to its rotation matrices."""
    return object_from_body @ in_chunks(_rotations, _CHUNK_POINTS, -attitude) if np.any(attitude) else object_from_body


def _drift(spline: StripSpline, correlation_s: float, rng: np.random.Generator) -> Float[np.ndarray, "knots 6"]:
    """Draw six Gauss-Markov processes of standard deviation 1."""
    noise = rng.standard_normal((spline.size, 6))
    memory = np.exp(-spline.interval / correlation_s)
    for k in range(1, spline.size):
        noise[k] = memory * noise[k - 1] + np.sqrt(1 - memory**2) * noise[k]
    return noise


_rotations = jax.jit(jax.vmap(small_rotation))


@jax.jit
def _corrected(shot: Float[Array, "n 3"], calibration: ScannerCalibration) -> Float[Array, "n 3"]:
    return jax.vmap(corrected_shot, (0, None))(shot, calibration)


GROUND, VEGETATION, ROOF = 2, 5, 6
"""LAS classes (ASPRS): ground, high vegetation, building."""
_RATE_HZ = 100.0
# Frequencies of the two prisms, whose pattern does not repeat within a strip.
_PRISMS_HZ = (121.7, -77.3)
# Tolerance (m) of the intersection with the ground; the iteration does not converge on steeper ground.
_ENOUGH_M = 1e-7
_ROUNDS = 60
# Number of pulses processed at a time; limits memory.
_PULSES_AT_ONCE = 500_000
# Maximum number of pulses of a cloud; limits memory.
_PULSES = 1e8


def scan(
    plan: ScanPlan, paths: list[Path], terrain: Terrain, noise_m: Float[np.ndarray, "3"], seed: int
) -> tuple[Cloud, Trajectory, Scanner, StripErrors]:
    """Scan `terrain` (drawn and settled) from the path of every strip; strips are named 1, 2, ... in order.

    Returns the measured cloud, the recorded trajectory, the true boresight and shifts of the strips without their
    drifts, and all true errors, drifts included.

    The trajectory has the shift and drift errors of its strip; the shots have boresight and calibration errors.
    `corrected_return` with these errors gives the point that was hit plus normal noise of `noise_m` (X, Y, Z). Raises
    BlockError without returns, and if the scan exceeds the memory limits.
    """
    errors = draw_errors(plan, paths, seed)
    leaves, noise = stream(seed, "laser returns from crowns"), stream(seed, "noise of laser points")
    parts = []
    pulses_of = _pulses(plan, paths)
    for number, path in enumerate(paths):
        n = round(pulses_of[number])
        for begin in range(0, n, _PULSES_AT_ONCE):
            pulses = np.arange(begin, min(begin + _PULSES_AT_ONCE, n))
            time, aside = _pattern(plan, path, pulses, n)
            parts.append(_measured(path, time, aside, terrain, errors, number, noise_m, leaves, noise))
            parts[-1]["strip"] = np.full(len(parts[-1]["time"]), number)
    if not sum(len(part["time"]) for part in parts):
        raise BlockError("no laser pulse reaches the ground; raise density_per_m2, or scan longer strips over it")
    of_points = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    # Use integers, as required by cloud files.
    names = tuple(f"{number + 1}" for number in range(len(paths)))
    shifts = [draw_shift(plan, path.strip, seed) for path in paths]
    truth = Scanner(errors.boresight, dict(zip(names, shifts, strict=True)))  # type: ignore[arg-type]
    return Cloud(**of_points, strips=names), _trajectory(paths, errors), truth, errors


def _pulses(plan: ScanPlan, paths: list[Path]) -> list[float]:
    """Return the number of pulses of every path. Raises BlockError for too many pulses."""
    pulses_of = [plan.density_per_m2 * 2 * plan.half_width * path.height_m * path.length_m for path in paths]
    if not sum(pulses_of) <= _PULSES:
        raise BlockError(
            f"the scanner would send {sum(pulses_of):.3g} pulses, the limit is {_PULSES:g}; lower density_per_m2"
        )
    return pulses_of


def _pattern(
    plan: ScanPlan, path: Path, pulses: Int[np.ndarray, "n"], of: int
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Return the times (s) of pulses, and the tangents of their angles to the right and ahead."""
    # True and recorded time must both lie on the path.
    begin, end = path.node[[0, -1]] + np.clip(plan.time_offset_s, (0.0, -np.inf), (np.inf, 0.0))
    time = begin + (pulses + 0.5) / of * (end - begin)
    if plan.pattern == "circle":
        # One rotating vector per prism, added to first order.
        angles = 2 * np.pi * np.outer(time, _PRISMS_HZ)
        return time, plan.half_width / 2 * np.column_stack([np.sin(angles).sum(1), np.cos(angles).sum(1)])
    # On level ground, line spacing equals the pulse spacing.
    per_line = max(1, round(2 * plan.half_width * path.height_m * np.sqrt(plan.density_per_m2)))
    across = plan.half_width * (2 * ((pulses + 0.5) / per_line % 1) - 1)
    return time, np.column_stack([across, np.zeros(len(across))])


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
    """Return the cloud fields of some pulses, sorted by time and return."""
    position, quaternion = path.pose(time)
    object_from_body = believed_turn = in_chunks(_matrices_from_quaternions, _CHUNK_POINTS, quaternion)
    recorded, believed_position = time - errors.calibration.time_offset, position
    if errors.calibration.time_offset:
        believed_position, quaternion = path.pose(recorded)
        believed_turn = in_chunks(_matrices_from_quaternions, _CHUNK_POINTS, quaternion)
    origin = position - object_from_body @ errors.calibration.lever_arm
    body_from_scanner = np.asarray(_small_rotation(errors.boresight))
    # The recorded ray assumes that the scanner axes are the body axes.
    believed = np.column_stack([aside, -np.ones(len(aside))])
    believed /= np.linalg.norm(believed, axis=1, keepdims=True)
    ray = _rotated(object_from_body, believed @ body_from_scanner.T)
    pulse, at, by = _returned(origin, ray, terrain, leaves)
    order = np.lexsort((at, pulse))
    pulse, at, by = pulse[order], at[order], by[order]
    _, first, of_pulse, count = np.unique(pulse, return_index=True, return_inverse=True, return_counts=True)
    number = np.arange(len(pulse)) - first[of_pulse] + 1
    # Solve `corrected_return` for the recorded point; the noise applies to the corrected point.
    hit = ray[pulse] * at[:, None] + origin[pulse] - position[pulse] + noise.standard_normal((len(pulse), 3)) * noise_m
    in_body = _rotated(object_from_body[pulse].transpose(0, 2, 1), hit)
    true = shot = (in_body + errors.calibration.lever_arm) @ body_from_scanner
    if any(np.any(of) for of in jax.tree.leaves(errors.calibration)):
        for _ in range(_STEPS):
            shot = shot + true - in_chunks(lambda s: _corrected(s, errors.calibration), _CHUNK_POINTS, shot)
    shift, turn = errors.at(strip, recorded[pulse])
    return {
        "xyz": believed_position[pulse] + shift + _rotated(rotate_body(believed_turn[pulse], turn), shot),
        "classification": by,
        "returns": np.column_stack([number, count[of_pulse]]).astype(np.uint8),
        "time": recorded[pulse],
    }


def _returned(
    origin: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"], terrain: Terrain, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "returns"], Float[np.ndarray, "returns"], UInt8[np.ndarray, "returns"]]:
    """Return the pulse of each return, the distance along its ray (m), and its class."""
    ground = _ground(origin, ray, terrain)
    roof = wall = np.full(len(ray), np.inf)
    if terrain.buildings:
        roof, wall = _built(origin, ray, ground, terrain)
    end = np.minimum(np.minimum(ground, roof), wall)
    hits = np.isfinite(ground)
    leaves = intersect_crowns(terrain.trees, origin, ray, np.where(hits, end, 0.0), rng)
    last = np.flatnonzero(hits & (wall > end) & ~leaves.stopped)
    by_last = np.where(roof[last] <= ground[last], ROOF, GROUND)
    by = np.concatenate([np.full(len(leaves.pulse), VEGETATION), by_last]).astype(np.uint8)
    return np.concatenate([leaves.pulse, last]), np.concatenate([leaves.at, end[last]]), by


def _ground(origin: np.ndarray, ray: np.ndarray, terrain: Terrain) -> Float[np.ndarray, "n"]:
    """Return the distance of the ground along each ray by fixed-point iteration; infinity without convergence."""
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
    """Return the distances at which each ray first enters a building through a roof, and through a wall."""
    planes = solids(terrain.buildings)
    hits = np.flatnonzero(np.isfinite(ground))
    hit = origin[hits] + ground[hits, None] * ray[hits]
    which, place = pairs_along(hit, ray[hits], planes.centre, planes.radius, planes.top)
    pulse = hits[place]
    by_roof, by_wall = entry_distances(planes, which, origin[pulse], ray[pulse])
    roof, wall = (np.full(len(ray), np.inf) for _ in range(2))
    np.minimum.at(roof, pulse, by_roof)
    np.minimum.at(wall, pulse, by_wall)
    return roof, wall


def _trajectory(paths: list[Path], errors: StripErrors) -> Trajectory:
    """Return the recorded trajectory: `_RATE_HZ` records per second of every path, with the errors of its strip."""
    ends = [(path.node[0], path.node[-1]) for path in paths]
    times = [np.linspace(begin, end, int(np.ceil((end - begin) * _RATE_HZ)) + 1) for begin, end in ends]
    poses = [path.pose(time) for path, time in zip(paths, times, strict=True)]
    errors_at = [errors.at(k, time) for k, time in enumerate(times)]
    position = np.vstack([x + shift for (shift, _), (x, _) in zip(errors_at, poses, strict=True)])
    exact = np.zeros((len(position), 3))
    quaternion, turn = np.vstack([q for _, q in poses]), np.vstack([turn for _, turn in errors_at])
    if np.any(turn):
        quaternion = in_chunks(
            _quaternions,
            _CHUNK_POINTS,
            rotate_body(in_chunks(_matrices_from_quaternions, _CHUNK_POINTS, quaternion), turn),
        )
    return Trajectory(np.concatenate(times), position, quaternion, exact, exact)  # type: ignore[arg-type]


def _rotated(matrix: Float[np.ndarray, "n 3 3"], vector: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", matrix, vector)


_small_rotation = jax.jit(small_rotation)
_quaternions = jax.jit(jax.vmap(quaternion_from_matrix))


def exposure_times(paths: list[Path], flight: Flight) -> Float[np.ndarray, "images"]:
    """Return the times (s) of all images, on the clock of the paths."""
    time, of = np.zeros(len(flight.images)), np.array(flight.strips)
    for path in paths:
        # The first and last node of a path are not exposures.
        time[of == path.strip] = path.node[1:-1]
    return time


def recorded_on_path(
    position: Float[np.ndarray, "images 3"],
    roll_pitch_yaw: Float[np.ndarray, "images 3"],
    time: Float[np.ndarray, "images"],
    paths: list[Path],
    flight: Flight,
    errors: StripErrors,
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3"]]:
    """Add the trajectory errors at the exposure times to positions (m) and angles (rad)."""
    offset, turn, of = np.zeros_like(position), np.zeros_like(position), np.array(flight.strips)
    for k, path in enumerate(paths):
        on_path = of == path.strip
        offset[on_path], turn[on_path] = errors.at(k, time[on_path])
    turned = rotate_body(in_chunks(_matrices_from_angles, _CHUNK_EXPOSURES, roll_pitch_yaw), turn)
    return position + offset, in_chunks(_angles, _CHUNK_EXPOSURES, turned)


_matrices_from_angles = jax.jit(jax.vmap(matrix_from_roll_pitch_yaw))
_angles = jax.jit(jax.vmap(roll_pitch_yaw_from_matrix))
