"""Add a rig of cameras to a block with synchronous photographs."""

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
"""Partition of the block whose images were exposed together."""


def with_rig(block: Block, reference: str, place_m: float, turn_rad: float) -> Block:
    """Add a rig of the block's cameras relative to the camera `reference`.

    `Block.partitions["event"]` (a column of images.csv) groups the photographs. The rig is constant between events to
    `place_m` and `turn_rad` (standard deviations). Relative orientations start at the medians of the approximate
    values, and are free: `block.fix("place")`, `block.weigh("place", 0.005)`. Exposures are assumed simultaneous;
    `block.free("delay")` estimates delays if the motion is known. The initial relative position then contains the
    distance flown during the delay: for a measured position, pass its value to `weigh`.

    Raises InputError without events, if no event has an image of `reference`, or if a camera has no approximate
    orientation relative to it. Issues a UserWarning about photographs without event.
    """
    if EVENT not in block.partitions:
        raise InputError(
            f"the block has no partition {EVENT}; add the column {EVENT} to images.csv, and "
            f'partitions = ["{EVENT}"] to the top of block.toml'
        )
    cameras, events = np.array(block.image_camera), np.array(block.partitions[EVENT])
    references = np.flatnonzero((cameras == reference) & (events != ""))
    if not len(references):
        raise InputError(f"no image of camera {reference} is in an event; choose another reference camera")
    first = {event: int(i) for i, event in zip(references[::-1], events[references[::-1]], strict=True)}
    image = np.array([i for i, event in enumerate(events) if cameras[i] != reference and event in first], int)
    if not len(image):
        raise InputError(
            f"no image of another camera is in an event of camera {reference}; give photographs exposed together the "
            f"same value in the column {EVENT}"
        )
    if alone := len(block.images) - len(image) - len(references):
        warnings.warn(f"{alone} photographs are in no event of the rig and are not constrained by it", stacklevel=2)
    if more := len(references) - len(first):
        warnings.warn(
            f"{more} events have a second photograph of the reference camera, not constrained by the rig", stacklevel=2
        )
    at = np.array([first[event] for event in events[image]], int)
    none, each = np.zeros((len(image), 3)), np.ones((len(image), 3))
    rows = RigPlaces(at, image, none, place_m * each), RigTurns(at, image, none, turn_rad * each)
    oriented = block.start.image_known[at] & block.start.image_known[image]
    start: dict[str, Any] = {}
    for camera in dict.fromkeys(cameras[image].tolist()):
        pairs = (cameras[image] == camera) & oriented
        if not pairs.any():
            raise InputError(
                f"no images of cameras {camera} and {reference} in one event have approximate orientations, which "
                f"locate {camera} in the rig; orient the block first"
            )
        start[camera] = RigCamera(*map(as_jax_array, _median_pose(block, at[pairs], image[pairs])))
    free: Any = {camera: RigCamera(FREE, FREE, FIXED) for camera in start}  # type: ignore[arg-type]
    unknowns = dataclasses.replace(block.start.unknowns, more=block.start.unknowns.more | {RigCamera.kind: start})
    return dataclasses.replace(
        block,
        more=(*block.more, *rows),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, more=block.priors.more | {RigCamera.kind: free}),
    )


def _median_pose(
    block: Block, reference: Int[np.ndarray, "n"], image: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the median position (m) and rotation vector (rad) of images relative to their reference image.

    Rotations are median matrices, orthogonalised: rotation vectors near pi may have either sign.
    """
    exterior = block.start.unknowns.exterior
    position, rotation = to_numpy(exterior.position), to_numpy(exterior.camera_from_object)
    place = np.einsum("nij,nj->ni", rotation[reference], position[image] - position[reference])
    u, _, v = np.linalg.svd(np.median(rotation[image] @ rotation[reference].transpose(0, 2, 1), axis=0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return np.median(place, axis=0), np.asarray(rig_turn(np.eye(3), turn))  # type: ignore[arg-type]
