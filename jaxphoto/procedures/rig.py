"""Photographs of one event as those of a rig: which belong together, and where its cameras are, roughly."""

import dataclasses
import warnings
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import as_jax_array, to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import RigCamera, rig_turn
from jaxphoto.observations import RigPlaces, RigTurns
from jaxphoto.unknowns import FIXED, FREE

EVENT = "event"
"""The partition of the block that says which photographs were exposed together."""


def with_rig(block: Block, reference: str, place_m: float, turn_rad: float) -> Block:
    """The block with its cameras in a rig beside the camera `reference`.

    `Block.partitions["event"]` (a column of images.csv) says which photographs belong together. The rig is rigid to
    `place_m` and `turn_rad` from one event to the next. Relative orientations start at the medians of those of the
    approximate orientations, and are free: `block.fix("place")`, `block.weigh("place", 0.005)`. All cameras are taken
    to expose at once; `block.free("delay")` of a block that knows how it moved finds out when they do. The place that
    it starts with holds what was flown in the meantime: weigh one that was measured, by its value.

    Raises InputError where nothing says what belongs together, none of it is of the camera `reference`, or of a camera
    no orientation is known beside it. A UserWarning tells of photographs that are in no event of it.
    """
    if EVENT not in block.partitions:
        raise InputError(
            f"the block has no partition {EVENT}; add the column {EVENT} to images.csv, and to the top of block.toml "
            f'partitions = ["{EVENT}"]'
        )
    cameras, events = np.array(block.image_camera), np.array(block.partitions[EVENT])
    own = np.flatnonzero((cameras == reference) & (events != ""))
    if not len(own):
        raise InputError(f"no image of camera {reference} is in an event, so no rig has it; name another camera")
    first = {event: int(i) for i, event in zip(own[::-1], events[own[::-1]], strict=True)}
    image = np.array([i for i, event in enumerate(events) if cameras[i] != reference and event in first], int)
    if not len(image):
        raise InputError(
            f"no image of another camera is in an event of camera {reference}; correct the column {EVENT}, in which "
            "photographs that were exposed together have the same word"
        )
    _tell_left_out(block, image, own, len(first))
    at = np.array([first[event] for event in events[image]], int)
    none, each = np.zeros((len(image), 3)), np.ones((len(image), 3))
    rows = RigPlaces(at, image, none, place_m * each), RigTurns(at, image, none, turn_rad * each)
    known = block.start.image_known[at] & block.start.image_known[image]
    start: dict[str, Any] = {}
    for camera in dict.fromkeys(cameras[image].tolist()):
        mine = (cameras[image] == camera) & known
        if not mine.any():
            raise InputError(
                f"no images of cameras {camera} and {reference} in one event have approximate orientations, so nothing "
                f"says where {camera} is in the rig; orient the block first"
            )
        start[camera] = RigCamera(*map(as_jax_array, _middle(block, at[mine], image[mine])))
    free: Any = {camera: RigCamera(FREE, FREE, FIXED) for camera in start}  # type: ignore[arg-type]
    unknowns = dataclasses.replace(block.start.unknowns, more=block.start.unknowns.more | {RigCamera.kind: start})
    return dataclasses.replace(
        block,
        more=(*block.more, *rows),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, more=block.priors.more | {RigCamera.kind: free}),
    )


def _tell_left_out(block: Block, image: Int[np.ndarray, "n"], own: Int[np.ndarray, "m"], n_events: int) -> None:
    """A UserWarning of photographs that the rig does not hold."""
    alone = len(block.images) - len(image) - len(own)
    if alone:
        warnings.warn(f"{alone} photographs are in no event of the rig and stand by themselves", stacklevel=3)
    if len(own) > n_events:
        warnings.warn(
            f"{len(own) - n_events} events have a second photograph of the reference camera, which stands by itself",
            stacklevel=3,
        )


def _middle(
    block: Block, reference: Int[np.ndarray, "n"], image: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The median place (m) and turn (rad) of images beside those of their reference, as they start.

    Turns are median matrices made orthogonal again: rotation vectors of half a turn may have either sign.
    """
    exterior = block.start.unknowns.exterior
    position, rotation = to_numpy(exterior.position), to_numpy(exterior.camera_from_object)
    place = np.einsum("nij,nj->ni", rotation[reference], position[image] - position[reference])
    u, _, v = np.linalg.svd(np.median(rotation[image] @ rotation[reference].transpose(0, 2, 1), axis=0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.median(place, axis=0), np.asarray(rig_turn(np.eye(3), turn))  # type: ignore[arg-type]
