"""Path of a laser scanner: interpolated between exposures, or of a flight of its own."""

from typing import NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.georeferencing import Mount
from jaxphoto.rotation import matrix_from_quaternion, matrix_from_roll_pitch_yaw, quaternion_from_matrix
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import NO_BIAS, NO_MOUNT, Flight, fly, record
from jaxphoto.simulation.flight_plan import FlightPlan
from jaxphoto.simulation.recipe import Recipe
from jaxphoto.simulation.scan_plan import ScanPlan

_CHUNK, _MANY = 64, 65_536
# From the end of a strip to the beginning of the next.
_GAP_S = 60.0


class Path(NamedTuple):
    """True path of the scanner during one strip."""

    strip: str
    height_m: float
    """Planned height above the mean terrain."""
    length_m: float
    """Planned length over ground."""
    node: Float[np.ndarray, "nodes"]
    """Times (s), from the beginning to the end of the strip."""
    position: Float[np.ndarray, "nodes 3"]
    velocity: Float[np.ndarray, "nodes 3"]
    """Metres and metres per second."""
    quaternion: Float[np.ndarray, "nodes 4"]
    turn: Float[np.ndarray, "nodes 4"]
    """(w, x, y, z) of `object_from_body`, with continuous signs, and its derivative (1/s)."""

    def pose(self, time: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
        """Return position (m) and unit quaternion of `object_from_body` at times (s)."""
        quaternion = _hermite(self.node, self.quaternion, self.turn, time)
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        return _hermite(self.node, self.position, self.velocity, time), quaternion / length


def matrices(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    """Return rotation matrices of quaternions."""
    return in_chunks(_matrices, _MANY, quaternion)


def paths(recipe: Recipe, plan: ScanPlan, flight: Flight, mean_height: float, seed: int) -> list[Path]:
    """Return the path of every strip of `plan`, consecutively from time zero: of `flight` or of its own.

    If exposures lie on the trajectory of the scanner, time zero is their mean.

    The scanner is at the reference point of GNSS and IMU, at their true positions. Positions and quaternions are cubic
    Hermite splines through each exposure with its velocity and rotation rate. Over the ground of the first and last
    image the path is extended straight beyond their exposures. Nodes of a separate flight deviate from the plan as
    exposures do.
    """
    flown = cast(FlightPlan, recipe.plan)
    if plan.strips:
        flown = FlightPlan(plan.strips, flown.speed_m_per_s)
        flight = fly(recipe, flown, mean_height, seed, "flight of the scanner")
    names = [recipe.mount_of(camera) for camera in flight.cameras]
    true = [recipe.mounts[name].truth if name else NO_MOUNT for name in names]
    # At the true time of the exposure, whatever the camera's clock.
    mounts = [Mount(m.lever_arm, m.boresight, 0.0, m.image_x) for m in true]
    position, attitude = record(flight, mounts, [NO_BIAS] * len(mounts))
    quaternion = in_chunks(_quaternions, _CHUNK, attitude)
    turn = _turn(quaternion, np.asarray(flight.motion.rate))
    motion = (flight.time, position, np.asarray(flight.motion.velocity), quaternion, turn)
    found, begin, of = [], 0.0, np.array(flight.strips)
    for strip in flown.strips:
        lead = strip.footprint.along / 2 / flown.speed_m_per_s
        time, *nodes = _led(lead, *(a[of == strip.name] for a in motion))
        length = (time[-1] - time[0]) * flown.speed_m_per_s
        found.append(Path(strip.name, strip.height_m, length, time - time[0] + begin, *nodes))
        begin = found[-1].node[-1] + _GAP_S
    if plan.same_trajectory:
        middle = np.mean(np.concatenate([path.node[1:-1] for path in found]))
        found = [path._replace(node=path.node - middle) for path in found]
    return found


def _led(lead: float, time, position, velocity, quaternion, turn) -> tuple[np.ndarray, ...]:
    """Return the nodes of one strip and two more, `lead` seconds before and after; signs of quaternions are continuous.

    There the velocity and the attitude are those of the first and the last exposure, without rotation.
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
    """Return the derivative of the quaternion: q (0, rate / 2), the rate about the body's axes (rad/s)."""
    (w, v), half = (quaternion[:, :1], quaternion[:, 1:]), rate / 2
    return np.hstack([-np.sum(v * half, axis=1, keepdims=True), w * half + np.cross(v, half)])


@jax.jit
@jax.vmap
def _quaternions(roll_pitch_yaw):
    return quaternion_from_matrix(matrix_from_roll_pitch_yaw(roll_pitch_yaw))


@jax.jit
@jax.vmap
def _matrices(quaternion):
    return matrix_from_quaternion(quaternion)


def _hermite(
    node: Float[np.ndarray, "k"], value: Float[np.ndarray, "k m"], slope: Float[np.ndarray, "k m"], at: np.ndarray
) -> Float[np.ndarray, "n m"]:
    """Return the cubics with `value` and `slope` at every node."""
    i = np.clip(np.searchsorted(node, at, side="right") - 1, 0, len(node) - 2)
    step = (node[i + 1] - node[i])[:, None]
    u = (at - node[i])[:, None] / step
    ends = value[i] * (1 + 2 * u) * (1 - u) ** 2 + value[i + 1] * (3 - 2 * u) * u**2
    return ends + step * u * (1 - u) * (slope[i] * (1 - u) - slope[i + 1] * u)
