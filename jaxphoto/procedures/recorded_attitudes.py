"""Rotation of a network by recorded attitudes, and attitudes as observations.

Each photograph gives the rotation from network to map: the product of its recorded and its oriented attitude. The
average determines the rotation about the line of a single strip, which positions do not determine. It contains the
common error of all attitudes (zero of a gimbal, mounting). As observations, attitudes therefore have a boresight with a
prior of that size.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block
from jaxphoto.compiling import jit_quickly
from jaxphoto.georeferencing import Mount
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.initial.quaternions import average_rotation
from jaxphoto.observations import Attitudes
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.unknowns import FIXED, Weighted

BORESIGHT_DEG = (2.0, 2.0, 2.0)
"""Standard deviations (degrees) of the common error of the attitudes of a flight, about the camera's axes: gimbal or
mounting, and declination of a compass.
"""
# Maximum ratio of a deviation to the median deviation; minimum of this limit (degrees).
_BEYOND, _LEAST_DEG = 4.0, 5.0
# Median deviation (degrees) above which attitudes are contradictory.
_CONTRADICT_DEG = 15.0
# Minimum cosine between directions in the rotated network and of positions; pictures that software rotated by 90
# degrees contradict the attitudes of the sensor.
_OTHER_LINE = 0.5
# Maximum median relative error of distances for positions to determine directions; number of positions below which only
# distant pairs are used; minimum distance of these in standard deviations.
_TELLING, _FEW, _APART = 0.1, 6, 3.0
# Maximum number of photographs compared pairwise, as memory increases with its square.
_MOST = 500
# Name of the mount that a block folder applies to all cameras.
_MOUNT = "default"


class RecordedRotation(NamedTuple):
    """Rotation of a network by recorded attitudes."""

    image: np.ndarray
    """Images of the block whose attitudes agree."""
    local_from_camera: Float[np.ndarray, "n 3 3"]
    sigma_rad: Float[np.ndarray, "n 3"]
    """Standard deviations of roll, pitch, yaw."""
    turn: Float[np.ndarray, "3 3"]
    """Rotation from the network frame to the local frame."""
    turn_sigma_rad: float
    """Standard deviation of the rotation about a horizontal axis, including the boresight."""
    scatter_rad: float
    """RMS deviation of single attitudes from `turn`."""
    left_out: tuple[str, ...]


def recorded_rotation(
    block: Block,
    attitudes: Mapping[str, CameraAttitude | None],
    places: Mapping[str, Float[np.ndarray, "3"]],
    sigma_m: Mapping[str, Float[np.ndarray, "3"]],
    frame: MapFrame,
) -> RecordedRotation | str | None:
    """Estimate the rotation from the `attitudes` of images that also have `places` (longitude, latitude, height, +-
    `sigma_m`).

    Return None without attitudes, and a message if they contradict each other or the positions.
    """
    usable = [(k, name, a) for k, name in enumerate(block.images) if name in places and (a := attitudes.get(name))]
    if not usable:
        return None
    local = frame.local_from_place(np.array([places[name] for _, name, _ in usable], float))
    attitude = frame.local_from_level(local) @ np.array([a.level_from_camera for _, _, a in usable])
    network = np.asarray(block.start.unknowns.exterior.position, float)[[k for k, _, _ in usable]]
    sigma = np.linalg.norm([sigma_m[name] for _, name, _ in usable], axis=1)
    first = _rotation_of(block, usable, attitude)
    along = _cosine(network, local, sigma, first)
    if isinstance(first, RecordedRotation) and (along is None or along > _OTHER_LINE):
        return first
    if along is None:
        return first
    apart_deg = np.rad2deg(np.arccos(np.clip(along, -1, 1)))
    return (
        f"the attitudes of the files contradict the positions by {apart_deg:.0f} degrees (pictures rotated by a "
        "program?): not used"
    )


def _rotation_of(
    block: Block, usable: list[tuple[int, str, CameraAttitude]], attitude: Float[np.ndarray, "n 3 3"]
) -> RecordedRotation | str:
    """Return the rotation by attitudes (local from camera) of the `usable` images; a message if they contradict."""
    image = np.array([k for k, _, _ in usable])
    rotations = attitude @ np.asarray(block.start.unknowns.exterior.camera_from_object, float)[image]
    sigma = np.deg2rad([a.sigma_deg for _, _, a in usable])
    inlier, deviation = np.ones(len(rotations), bool), np.zeros(len(rotations))
    # Start at the rotation with the smallest median distance to all others, then average the rotations near it.
    some = rotations[_subset(len(rotations))]
    apart = _angles(np.einsum("nji,mjk->nmik", some, some))
    turn = some[np.argmin(np.median(apart, axis=1))]
    for _ in range(5):
        deviation = _angles(rotations @ turn.T)
        inlier = deviation <= max(_BEYOND * float(np.median(deviation)), np.deg2rad(_LEAST_DEG))
        turn, _ = average_rotation(rotations[inlier])
    apart_deg = np.rad2deg(np.median(deviation))
    if apart_deg > _CONTRADICT_DEG:
        return f"the attitudes of the files contradict the photographs by {apart_deg:.0f} degrees: not used"
    scatter = float(np.sqrt(np.mean(_angles(rotations[inlier] @ turn.T) ** 2)))
    level = np.sqrt(np.mean(sigma[inlier, :2] ** 2) / inlier.sum() + np.deg2rad(max(BORESIGHT_DEG[:2])) ** 2)
    lost = tuple(name for (_, name, _), good in zip(usable, inlier, strict=True) if not good)
    return RecordedRotation(image[inlier], attitude[inlier], sigma[inlier], turn, float(level), scatter, lost)


def _subset(n: int) -> Int[np.ndarray, "m"]:
    """Return evenly spaced indices of at most `_MOST` photographs."""
    return np.linspace(0, n - 1, min(n, _MOST)).astype(int)


def _cosine(
    network: Float[np.ndarray, "n 3"],
    local: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n"],
    recorded: RecordedRotation | str,
) -> float | None:
    """Return the median cosine between directions in the rotated network and on the ground; None if undetermined."""
    some = _subset(len(local))
    one, other = (some[k] for k in np.triu_indices(len(some), 1))
    if isinstance(recorded, str) or not len(one):
        return None
    a, b = ((v[one] - v[other]) for v in (network @ recorded.turn.T, local))
    there, here = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    far = (here >= np.median(here)) & (there > 0) & (here > 0)
    if len(local) < _FEW:
        far &= here > _APART * np.hypot(sigma[one], sigma[other])
    if not far.any():
        return None
    ratio = here[far] / there[far]
    if np.median(np.abs(ratio / np.median(ratio) - 1)) > _TELLING:
        return None
    return float(np.median(np.sum(a[far] * b[far], axis=1) / (there[far] * here[far])))


def with_attitudes(block: Block, recorded: RecordedRotation) -> Block:
    """Observe the attitudes, of a nadir camera with the top of its pictures forward."""
    angles = _roll_pitch_yaw(recorded.local_from_camera)
    zero = np.zeros(3)
    mount = Mount(as_jax_array(zero), as_jax_array(zero), as_jax_array(0.0), "right")  # type: ignore[arg-type]
    boresight = Weighted(zero, np.deg2rad(BORESIGHT_DEG))
    prior = Mount(FIXED, boresight, FIXED, "right")  # type: ignore[arg-type]
    unknowns = dataclasses.replace(block.start.unknowns, mounts={_MOUNT: mount})
    return dataclasses.replace(
        block,
        attitudes=Attitudes(recorded.image, as_jax_array(np.asarray(angles)), as_jax_array(recorded.sigma_rad)),
        image_mount=(_MOUNT,) * len(block.images),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, mounts={_MOUNT: prior}),
    )


def _angles(matrices: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Return rotation angles (rad), from the chord, which is accurate for small angles."""
    chord = np.linalg.norm(matrices - np.eye(3), axis=(-2, -1))
    return 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))


_roll_pitch_yaw = jit_quickly(jax.vmap(roll_pitch_yaw_from_matrix))
