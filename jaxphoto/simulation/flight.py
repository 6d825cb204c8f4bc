"""Flight as flown: true camera positions, and error-free records of GNSS and IMU."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.block import Motion
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import (
    NOMINAL,
    Exposure,
    Mount,
    StripBias,
    body_from_camera,
    recorded_attitude,
    sensor_position,
)
from jaxphoto.rotation import (
    matrix_from_roll_pitch_yaw,
    omega_phi_kappa_from_matrix,
    roll_pitch_yaw_from_matrix,
    small_rotation,
)
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight_plan import FlightPlan
from jaxphoto.simulation.recipe import Recipe, triple
from jaxphoto.simulation.streams import stream

NO_BIAS = StripBias(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
NO_MOUNT = Mount(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
"""For strips and cameras that have none."""
_CHUNK = 64


class Flight(NamedTuple):
    """One entry per image, in order of flight; `time` in seconds from the mean time of the strip.

    Images that belong to no strip have the strip "".
    """

    images: tuple[str, ...]
    cameras: tuple[str, ...]
    strips: tuple[str, ...]
    time: Float[np.ndarray, "images"]
    exterior: ExteriorOrientation
    motion: Motion


def fly(recipe: Recipe, plan: FlightPlan, mean_height: float, seed: int, purpose: str = "flight") -> Flight:
    """Fly `plan` at `mean_height` (m) above zero, with the recipe's jitter, drawn for this `purpose` (`stream`).

    Every exposure deviates normally from its plan. The body's attitude is roll, pitch, yaw = heading + crab; the camera
    follows it through the true mount.
    """
    strips = plan.strips
    of = np.repeat(np.arange(len(strips)), [s.images for s in strips])
    heading = np.deg2rad([strips[k].heading_deg for k in of])
    cameras = tuple(strips[k].camera for k in of)
    position = np.vstack([np.column_stack([s.exposures, np.full(s.images, mean_height + s.height_m)]) for s in strips])
    jitter, rng, n = recipe.jitter, stream(seed, purpose), len(of)
    position = position + rng.standard_normal((n, 3)) * triple(jitter.position_m)
    deviation = np.deg2rad([jitter.angle_deg, jitter.angle_deg, jitter.crab_deg])
    attitude = rng.standard_normal((n, 3)) * deviation + np.column_stack([0 * heading, 0 * heading, heading])
    rate = np.deg2rad(jitter.rate_deg_per_s) * rng.standard_normal((n, 3))
    speed = plan.speed_m_per_s
    velocity = speed * np.column_stack([np.sin(heading), np.cos(heading), 0 * heading])
    mounts = [recipe.mounts[m].truth if (m := recipe.mount_of(c)) else None for c in cameras]
    boresight = np.stack([np.zeros(3) if m is None else np.asarray(m.boresight) for m in mounts])
    nominal = np.stack([NOMINAL["forward"] if m is None else m.nominal for m in mounts])
    return Flight(
        tuple(f"{s.name}_{k + 1:02d}" for s in strips for k in range(s.images)),
        cameras,
        tuple(strips[k].name for k in of),
        np.concatenate([s.along / speed for s in strips]),
        ExteriorOrientation(position, in_chunks(_camera_from_object, _CHUNK, attitude, boresight, nominal)),
        Motion(velocity, rate),
    )


def record(flight: Flight, mounts: list[Mount], biases: list[StripBias]) -> tuple[np.ndarray, np.ndarray]:
    """Return GNSS position (images, 3) in m and roll, pitch, yaw (images, 3) in rad at the recorded times, without
    noise.

    `mounts` and `biases` are those of each image.
    """
    nominal = np.stack([m.nominal for m in mounts])
    exposure = Exposure(flight.time, flight.motion.velocity, flight.motion.rate, nominal)  # type: ignore[arg-type]
    bare = [Mount(m.lever_arm, m.boresight, m.time_offset) for m in mounts]
    mount, bias = (jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *t) for t in (bare, biases))
    exterior = flight.exterior
    return in_chunks(_recorded_of_many, _CHUNK, exterior.position, exterior.camera_from_object, mount, bias, exposure)


def recorded(position, camera_from_object, mount: Mount, bias: StripBias, exposure: Exposure) -> tuple[Array, Array]:
    """Return GNSS position (m) and roll, pitch, yaw (rad) of one image at its recorded time."""
    body = recorded_attitude(camera_from_object, mount, exposure)
    return sensor_position(position, camera_from_object, mount, bias, exposure), roll_pitch_yaw_from_matrix(body)


_recorded_of_many = jax.jit(jax.vmap(recorded))


def turned(exterior: ExteriorOrientation, theta: Float[np.ndarray, "images 3"]) -> Float[np.ndarray, "images 3 3"]:
    """Rotate `camera_from_object` by small rotations `theta` (rad) about the camera's axes."""
    return in_chunks(_turned, _CHUNK, exterior.camera_from_object, theta)


def omega_phi_kappa(exterior: ExteriorOrientation) -> Float[np.ndarray, "images 3"]:
    """Return (omega, phi, kappa) of every image, in rad."""
    return in_chunks(_omega_phi_kappa, _CHUNK, exterior.camera_from_object)


_omega_phi_kappa = jax.jit(jax.vmap(omega_phi_kappa_from_matrix))


@jax.jit
@jax.vmap
def _turned(camera_from_object, theta):
    return small_rotation(theta) @ camera_from_object


@jax.jit
@jax.vmap
def _camera_from_object(roll_pitch_yaw, boresight, nominal):
    return (matrix_from_roll_pitch_yaw(roll_pitch_yaw) @ body_from_camera(boresight, nominal)).T
