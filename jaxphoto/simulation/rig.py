"""Simulation of a rig: every exposure of the reference camera is one of all cameras of the rig."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxphoto.block import Motion
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Exposure, Mount, RigCamera, in_rig, reference_later
from jaxphoto.observations import RigPlaces, RigTurns
from jaxphoto.rotation import small_rotation
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import NO_MOUNT, Flight
from jaxphoto.simulation.recipe import Recipe, SimulatedChange, triple
from jaxphoto.simulation.streams import stream
from jaxphoto.unknowns import FIXED

_CHUNK = 64


def rigged(
    recipe: Recipe, flight: Flight, cameras: Mapping[str, SimulatedChange], seed: int
) -> tuple[Flight, Int[np.ndarray, "images"]]:
    """Add the photographs of the other cameras after each of the reference; returns the exposure of each image.

    The rig is deformed by the noise of the recipe, independently in every exposure.
    """
    if not cameras:
        return flight, np.arange(len(flight.images))
    n, m = len(flight.images), len(cameras) + 1
    exterior, bent = flight.exterior, stream(seed, "bending of the rig").standard_normal((n, m - 1, 2, 3))
    noise = np.array([triple(recipe.noise.rig_place_m), np.deg2rad(triple(recipe.noise.rig_turn_deg))])  # type: ignore[arg-type]
    truths: list[Any] = [own.truth for own in cameras.values()]
    place = np.array([own.place for own in truths]) + noise[0] * bent[:, :, 0]
    # Rotated from its place in the rig.
    turn, off = np.broadcast_to([own.turn for own in truths], place.shape), noise[1] * bent[:, :, 1]
    at = np.repeat(np.arange(n), m - 1)
    reference = np.asarray(exterior.position)[at], np.asarray(exterior.camera_from_object)[at]
    mounts = [recipe.mounts[name].truth if (name := recipe.mount_of(c)) else NO_MOUNT for c in flight.cameras]
    arm, boresight, nominal = (
        np.array([getattr(m, name) for m in mounts])[at] for name in ("lever_arm", "boresight", "nominal")
    )
    motion = flight.motion.velocity[at], flight.motion.rate[at]
    delay = np.tile([float(own.delay) for own in truths], n)
    rigid = (v.reshape(-1, 3) for v in (place, turn, off))
    there = in_chunks(_placed, _CHUNK, *reference, *motion, arm, boresight, nominal, delay, *rigid)
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


def _after_each(own: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Interleave the values of each exposure and those of the other cameras in it."""
    n, shape = len(own), own.shape[1:]
    return np.concatenate([own[:, None], new.reshape(n, -1, *shape)], axis=1).reshape(-1, *shape)


def rig_rows(recipe: Recipe, flight: Flight) -> tuple[RigPlaces | RigTurns, ...]:
    """Return the block's rig observations of photographs whose cameras it models in the rig."""
    known = [name for name, own in recipe.rig.items() if own.model]
    m, image = len(recipe.rig) + 1, np.flatnonzero(np.isin(flight.cameras, known))
    if not len(image):
        return ()
    reference, none = image // m * m, np.zeros((len(image), 3))
    sigma = [triple(recipe.stated.rig_place_m), np.deg2rad(triple(recipe.stated.rig_turn_deg))]  # type: ignore[arg-type]
    return (
        RigPlaces(reference, image, none, np.tile(sigma[0], (len(image), 1))),
        RigTurns(reference, image, none, np.tile(sigma[1], (len(image), 1))),
    )


def runs_late(cameras: Mapping[str, SimulatedChange]) -> bool:
    """Return True if a camera of the rig may expose late: the block then needs its motion."""
    known: list[Any] = [own.model for own in cameras.values() if own.model]
    delays = [own.truth.delay for own in cameras.values()] + [start.delay for start, _ in known]  # type: ignore[attr-defined]
    return any(float(delay) != 0 for delay in delays) or any(prior.delay != FIXED for _, prior in known)


def with_gnss(recipe: Recipe, flight: Flight) -> Int[np.ndarray, "n"]:
    """Return the images with observed stations and attitudes: all, or those of the reference camera of a rig."""
    return np.arange(0, len(flight.images), len(recipe.rig) + 1)


@jax.jit
@jax.vmap
def _placed(position, camera_from_object, velocity, rate, arm, boresight, nominal, delay, place, turn, off):
    mount, exposure = Mount(arm, boresight), Exposure(0.0, velocity, rate, nominal)
    then = reference_later(delay, position, camera_from_object, mount, exposure)
    there, turned = in_rig(*then, RigCamera(place, turn))
    return there, small_rotation(off) @ turned
