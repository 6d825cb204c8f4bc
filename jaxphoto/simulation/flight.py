"""Simulated flight: true camera positions, and error-free GNSS and IMU records."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.block import Motion
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import (
    NOMINAL,
    Exposure,
    Mount,
    RigCamera,
    StripBias,
    body_from_camera,
    in_rig,
    recorded_attitude,
    reference_later,
    sensor_position,
)
from jaxphoto.observations import RelativeAttitudes, RelativePositions, RigPlaces, RigTurns
from jaxphoto.rotation import (
    matrix_from_roll_pitch_yaw,
    omega_phi_kappa_from_matrix,
    roll_pitch_yaw_from_matrix,
    small_rotation,
)
from jaxphoto.simulation.plans import ConvergentPlan, FlightPlan
from jaxphoto.simulation.recipe import Jitter, Recipe, SimulatedChange, triple
from jaxphoto.simulation.sampling import in_chunks, stream
from jaxphoto.unknowns import FIXED

NO_BIAS = StripBias(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
NO_MOUNT = Mount(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
"""For strips and cameras that have none."""
_CHUNK = 64


class Flight(NamedTuple):
    """Images in order of flight; `time` in seconds from the mean time of the strip.

    The strip of an image outside all strips is "".
    """

    images: tuple[str, ...]
    cameras: tuple[str, ...]
    strips: tuple[str, ...]
    time: Float[np.ndarray, "images"]
    exterior: ExteriorOrientation
    motion: Motion


def fly(recipe: Recipe, plan: FlightPlan, mean_height: float, seed: int) -> Flight:
    """Fly `plan` at `mean_height` (m) above zero, with the recipe's jitter.

    Every exposure deviates normally from its plan. The body's attitude is roll, pitch, yaw = heading + crab; the true
    mount gives the attitude of the camera.
    """
    strips = plan.strips
    of = np.repeat(np.arange(len(strips)), [s.images for s in strips])
    heading = np.deg2rad([strips[k].heading_deg for k in of])
    cameras = tuple(strips[k].camera for k in of)
    position = np.vstack([np.column_stack([s.exposures, np.full(s.images, mean_height + s.height_m)]) for s in strips])
    jitter, rng, n = recipe.jitter, stream(seed, "flight"), len(of)
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
    """Return error-free GNSS positions (images, 3) in m and roll, pitch, yaw (images, 3) in rad at the recorded times.

    `mounts` and `biases` have one entry per image.
    """
    nominal = np.stack([m.nominal for m in mounts])
    exposure = Exposure(flight.time, flight.motion.velocity, flight.motion.rate, nominal)  # type: ignore[arg-type]
    bare = [Mount(m.lever_arm, m.boresight, m.time_offset) for m in mounts]
    mount, bias = (jax.tree.map(lambda *v: np.stack([np.asarray(x, float) for x in v]), *t) for t in (bare, biases))
    exterior = flight.exterior
    return in_chunks(_sensor_records, _CHUNK, exterior.position, exterior.camera_from_object, mount, bias, exposure)


def sensor_record(
    position, camera_from_object, mount: Mount, bias: StripBias, exposure: Exposure
) -> tuple[Array, Array]:
    """Return GNSS position (m) and roll, pitch, yaw (rad) of one image at its recorded time."""
    body = recorded_attitude(camera_from_object, mount, exposure)
    return sensor_position(position, camera_from_object, mount, bias, exposure), roll_pitch_yaw_from_matrix(body)


_sensor_records = jax.jit(jax.vmap(sensor_record))


def rotate_cameras(
    exterior: ExteriorOrientation, theta: Float[np.ndarray, "images 3"]
) -> Float[np.ndarray, "images 3 3"]:
    """Rotate `camera_from_object` by small rotations `theta` (rad) about the camera's axes."""
    return in_chunks(_rotated, _CHUNK, exterior.camera_from_object, theta)


def omega_phi_kappa(exterior: ExteriorOrientation) -> Float[np.ndarray, "images 3"]:
    """Return (omega, phi, kappa) of every image, in rad."""
    return in_chunks(_omega_phi_kappa, _CHUNK, exterior.camera_from_object)


_omega_phi_kappa = jax.jit(jax.vmap(omega_phi_kappa_from_matrix))


@jax.jit
@jax.vmap
def _rotated(camera_from_object, theta):
    return small_rotation(theta) @ camera_from_object


@jax.jit
@jax.vmap
def _camera_from_object(roll_pitch_yaw, boresight, nominal):
    return (matrix_from_roll_pitch_yaw(roll_pitch_yaw) @ body_from_camera(boresight, nominal)).T


def take_images(plan: ConvergentPlan, jitter: Jitter, mean_height: float, seed: int) -> Flight:
    """Take the images of a convergent `plan`, with jitter; the centre of the field has the height `mean_height` (m)."""
    stations, rng = plan.stations, stream(seed, "flight")
    n = len(stations)
    middle = np.array([0.0, 0.0, mean_height])
    position = middle + np.stack([s.position for s in stations])
    position = position + rng.standard_normal((n, 3)) * triple(jitter.position_m)
    deviation = np.deg2rad([jitter.angle_deg, jitter.angle_deg, jitter.crab_deg])
    planned = ExteriorOrientation(position, np.stack([s.camera_from_object for s in stations]))  # type: ignore[arg-type]
    return Flight(
        tuple(s.name for s in stations),
        tuple(s.camera for s in stations),
        ("",) * n,
        np.zeros(n),
        ExteriorOrientation(position, rotate_cameras(planned, rng.standard_normal((n, 3)) * deviation)),  # type: ignore[arg-type]
        Motion(np.zeros((n, 3)), np.deg2rad(jitter.rate_deg_per_s) * rng.standard_normal((n, 3))),
    )


def add_rig_images(
    recipe: Recipe, flight: Flight, cameras: Mapping[str, SimulatedChange], seed: int
) -> tuple[Flight, Int[np.ndarray, "images"]]:
    """Insert the images of the other rig cameras after each reference image; return also the exposure index of each
    image.

    The recipe's noise deforms the rig independently in every exposure.
    """
    if not cameras:
        return flight, np.arange(len(flight.images))
    n, m = len(flight.images), len(cameras) + 1
    exterior, bent = flight.exterior, stream(seed, "bending of the rig").standard_normal((n, m - 1, 2, 3))
    noise = np.array([triple(recipe.noise.rig_place_m), np.deg2rad(triple(recipe.noise.rig_turn_deg))])  # type: ignore[arg-type]
    truths: list[Any] = [own.truth for own in cameras.values()]
    place = np.array([own.place for own in truths]) + noise[0] * bent[:, :, 0]
    # The rotation is about the camera's position in the rig.
    turn, flexure = np.broadcast_to([own.turn for own in truths], place.shape), noise[1] * bent[:, :, 1]
    at = np.repeat(np.arange(n), m - 1)
    reference = np.asarray(exterior.position)[at], np.asarray(exterior.camera_from_object)[at]
    mounts = [recipe.mounts[name].truth if (name := recipe.mount_of(c)) else NO_MOUNT for c in flight.cameras]
    arm, boresight, nominal = (
        np.array([getattr(m, name) for m in mounts])[at] for name in ("lever_arm", "boresight", "nominal")
    )
    motion = flight.motion.velocity[at], flight.motion.rate[at]
    delay = np.tile([float(own.delay) for own in truths], n)
    rigid = (v.reshape(-1, 3) for v in (place, turn, flexure))
    there = in_chunks(_rig_exterior, _CHUNK, *reference, *motion, arm, boresight, nominal, delay, *rigid)
    position, rotation = (
        _after_each(np.asarray(own), new)
        for own, new in zip((exterior.position, exterior.camera_from_object), there, strict=True)
    )
    event = np.repeat(np.arange(n), m)
    return (
        Flight(
            tuple(f"{image}{end}" for image in flight.images for end in ("", *(f"_{camera}" for camera in cameras))),
            tuple(name for camera in flight.cameras for name in (camera, *cameras)),
            tuple(flight.strips[k] for k in event),
            flight.time[event],
            ExteriorOrientation(position, rotation),  # type: ignore[arg-type]
            Motion(flight.motion.velocity[event], flight.motion.rate[event]),
        ),
        event,
    )


def _after_each(reference: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Interleave the values of the reference camera and of the other cameras, by exposure."""
    n, shape = len(reference), reference.shape[1:]
    return np.concatenate([reference[:, None], new.reshape(n, -1, *shape)], axis=1).reshape(-1, *shape)


def rig_rows(recipe: Recipe, flight: Flight) -> tuple[RigPlaces | RigTurns, ...]:
    """Return the rig observations for images of the cameras that the block models in the rig."""
    modelled = [name for name, own in recipe.rig.items() if own.model]
    m, image = len(recipe.rig) + 1, np.flatnonzero(np.isin(flight.cameras, modelled))
    if not len(image):
        return ()
    reference, none = image // m * m, np.zeros((len(image), 3))
    sigma = [triple(recipe.stated.rig_place_m), np.deg2rad(triple(recipe.stated.rig_turn_deg))]  # type: ignore[arg-type]
    return (
        RigPlaces(reference, image, none, np.tile(sigma[0], (len(image), 1))),
        RigTurns(reference, image, none, np.tile(sigma[1], (len(image), 1))),
    )


def has_delay(cameras: Mapping[str, SimulatedChange]) -> bool:
    """Return True if a rig camera may expose late: the block then needs the motion."""
    modelled: list[Any] = [own.model for own in cameras.values() if own.model]
    delays = [own.truth.delay for own in cameras.values()] + [start.delay for start, _ in modelled]  # type: ignore[attr-defined]
    return any(float(delay) != 0 for delay in delays) or any(prior.delay != FIXED for _, prior in modelled)


def gnss_images(recipe: Recipe, flight: Flight) -> Int[np.ndarray, "n"]:
    """Return the images with observed stations and attitudes: all, or the images of a rig's reference camera."""
    return np.arange(0, len(flight.images), len(recipe.rig) + 1)


@jax.jit
@jax.vmap
def _rig_exterior(position, camera_from_object, velocity, rate, arm, boresight, nominal, delay, place, turn, flexure):
    mount, exposure = Mount(arm, boresight), Exposure(0.0, velocity, rate, nominal)
    then = reference_later(delay, position, camera_from_object, mount, exposure)
    there, rotation = in_rig(*then, RigCamera(place, turn))
    return there, small_rotation(flexure) @ rotation


def relative_rows(
    recipe: Recipe, flight: Flight, mounts: list[Mount], seed: int
) -> tuple[RelativePositions | RelativeAttitudes, ...]:
    """Return relative positions (carrier phases) and attitudes (gyros) of successive exposures of each strip.

    They have only their own noise, not the biases of strips or trajectory errors.
    """
    stated, noise = recipe.stated, recipe.noise
    if stated.relative_position_m is None and stated.relative_attitude_deg is None:
        return ()
    position, angles = record(flight, mounts, [NO_BIAS] * len(mounts))
    of, strip = gnss_images(recipe, flight), np.array(flight.strips)
    together = strip[of[:-1]] == strip[of[1:]]
    pair = of[:-1][together], of[1:][together]
    if not (n := len(pair[0])):
        return ()
    rows: list[Any] = []
    if stated.relative_position_m is not None:
        error = stream(seed, "noise of relative positions").standard_normal((n, 3))
        error *= triple(noise.relative_position_m)  # type: ignore[arg-type]
        sigma = np.tile(triple(stated.relative_position_m), (n, 1))
        rows.append(RelativePositions(*pair, position[pair[1]] - position[pair[0]] + error, sigma))
    if stated.relative_attitude_deg is not None:
        turn = in_chunks(_relative_angles, _CHUNK, angles[pair[0]], angles[pair[1]])
        error = stream(seed, "noise of relative attitudes").standard_normal((n, 3))
        error *= triple(noise.relative_attitude_deg)  # type: ignore[arg-type]
        sigma = np.tile(np.deg2rad(triple(stated.relative_attitude_deg)), (n, 1))
        rows.append(RelativeAttitudes(*pair, turn + np.deg2rad(error), sigma))
    return tuple(rows)


@jax.jit
@jax.vmap
def _relative_angles(first, second):
    """Return roll, pitch and yaw of the second body relative to the first."""
    return roll_pitch_yaw_from_matrix(matrix_from_roll_pitch_yaw(first).T @ matrix_from_roll_pitch_yaw(second))
