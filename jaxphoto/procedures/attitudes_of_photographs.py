"""Attitudes that photographs record, against a network's: how it is turned, and as observations where that helps.

Each photograph says how the network is turned to the map: the product of its recorded and its oriented attitude. Their
average is what a single strip does not tell by positions, the turn about its line. What all attitudes have in common
of an error, the zero of a gimbal or a mounting, stays in it; as observations they have a boresight with a prior of
that size, so that a strip is not given a turn that is surer.

Pictures that a program has turned by quarters lie otherwise in their files than attitudes, which are of the sensor,
say. Positions show it: with the attitudes as they are, the network would run across its own line of flight, or back.
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
"""Of what attitudes of one flight have in common, about the camera's axes: a gimbal hung or a camera mounted by hand,
and the declination where a compass is read."""
# Attitudes farther from most are wrong by more than noise: of the median, but this at least.
_BEYOND, _LEAST_DEG = 4.0, 5.0
# Attitudes that are apart by more (median) tell nothing.
_CONTRADICT_DEG = 15.0
# Cosines between directions in the turned network and those of positions: one line, to 20 degrees; others, by 60.
_SAME_LINE, _OTHER_LINE = 0.94, 0.5
# Positions whose distances are off by less than this part (median) tell directions; of fewer than so many, for which
# that may be chance, those that are apart by so many standard deviations.
_TELLING, _FEW, _APART = 0.1, 6, 3.0
# Photographs that are compared with one another, which takes memory by the square of their number.
_MOST = 500
# Of mounts: the name by which a block folder finds it for every camera.
_MOUNT = "default"


class RecordedTurn(NamedTuple):
    """How recorded attitudes say that a network is turned."""

    image: np.ndarray
    """Of the block, those that agree."""
    local_from_camera: Float[np.ndarray, "n 3 3"]
    sigma_rad: Float[np.ndarray, "n 3"]
    """Of roll, pitch, yaw."""
    turn: Float[np.ndarray, "3 3"]
    """From the network's axes to those of the local frame."""
    turn_sigma_rad: float
    """Of a turn about a level axis, the boresight included."""
    scatter_rad: float
    """Root mean square of single ones about `turn`."""
    left_out: tuple[str, ...]
    quarters: int = 0
    """By how many the pictures are turned clockwise against the attitudes of their files; those here are, too."""


def recorded_turn(
    block: Block,
    attitudes: Mapping[str, CameraAttitude | None],
    places: Mapping[str, Float[np.ndarray, "3"]],
    sigma_m: Mapping[str, Float[np.ndarray, "3"]],
    frame: MapFrame,
) -> RecordedTurn | str | None:
    """The turn by the `attitudes` of images that have `places` (longitude, latitude, height, +- `sigma_m`) too.

    None where there are none; a sentence where they contradict one another, or the places.
    """
    known = [(k, name, a) for k, name in enumerate(block.images) if name in places and (a := attitudes.get(name))]
    if not known:
        return None
    local = frame.local_from_place(np.array([places[name] for _, name, _ in known], float))
    own = frame.local_from_level(local) @ np.array([a.level_from_camera for _, _, a in known])
    network = np.asarray(block.start.unknowns.exterior.position, float)[[k for k, _, _ in known]]
    sigma = np.linalg.norm([sigma_m[name] for _, name, _ in known], axis=1)
    first = _turn_of(block, known, own)
    along = _cosine(network, local, sigma, first)
    if isinstance(first, RecordedTurn) and (along is None or along > _OTHER_LINE):
        return first
    for quarters in (1, 2, 3):
        found = _turn_of(block, known, own @ _clockwise(quarters))
        if isinstance(found, RecordedTurn) and (_cosine(network, local, sigma, found) or 0.0) > _SAME_LINE:
            return found._replace(quarters=quarters)
    if along is None:
        return first
    apart_deg = np.rad2deg(np.arccos(np.clip(along, -1, 1)))
    return f"the attitudes of the files contradict the positions, by {apart_deg:.0f} degrees: they are not used"


def _turn_of(
    block: Block, known: list[tuple[int, str, CameraAttitude]], own: Float[np.ndarray, "n 3 3"]
) -> RecordedTurn | str:
    """The turn by attitudes `own` (local from camera) of the images `known`; a sentence where they contradict it."""
    image = np.array([k for k, _, _ in known])
    said = own @ np.asarray(block.start.unknowns.exterior.camera_from_object, float)[image]
    sigma = np.deg2rad([a.sigma_deg for _, _, a in known])
    kept, off = np.ones(len(said), bool), np.zeros(len(said))
    # The one that most are nearest to, then the average of those near it.
    some = said[_some(len(said))]
    apart = _angles(np.einsum("nji,mjk->nmik", some, some))
    turn = some[np.argmin(np.median(apart, axis=1))]
    for _ in range(5):
        off = _angles(said @ turn.T)
        kept = off <= max(_BEYOND * float(np.median(off)), np.deg2rad(_LEAST_DEG))
        turn, _ = average_rotation(said[kept])
    apart_deg = np.rad2deg(np.median(off))
    if apart_deg > _CONTRADICT_DEG:
        return f"the attitudes of the files contradict the photographs, by {apart_deg:.0f} degrees: they are not used"
    scatter = float(np.sqrt(np.mean(_angles(said[kept] @ turn.T) ** 2)))
    level = np.sqrt(np.mean(sigma[kept, :2] ** 2) / kept.sum() + np.deg2rad(max(BORESIGHT_DEG[:2])) ** 2)
    lost = tuple(name for (_, name, _), good in zip(known, kept, strict=True) if not good)
    return RecordedTurn(image[kept], own[kept], sigma[kept], turn, float(level), scatter, lost)


def _some(n: int) -> Int[np.ndarray, "m"]:
    """As many of `n` as are compared with one another, from the first to the last."""
    return np.linspace(0, n - 1, min(n, _MOST)).astype(int)


def _clockwise(quarters: int) -> Float[np.ndarray, "3 3"]:
    """From the axes of a picture that is turned clockwise to those of the sensor."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarters)


def _cosine(
    network: Float[np.ndarray, "n 3"],
    local: Float[np.ndarray, "n 3"],
    sigma: Float[np.ndarray, "n"],
    recorded: RecordedTurn | str,
) -> float | None:
    """Between directions from place to place in the turned network and on the ground; None where these tell nothing."""
    some = _some(len(local))
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


def with_attitudes(block: Block, recorded: RecordedTurn) -> Block:
    """`block` with the attitudes observed, of a camera that looks down with the top of its pictures forward."""
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
    """How far rotations turn (rad), from the chord, which has all digits of small ones."""
    chord = np.linalg.norm(matrices - np.eye(3), axis=(-2, -1))
    return 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))


_roll_pitch_yaw = jit_quickly(jax.vmap(roll_pitch_yaw_from_matrix))
