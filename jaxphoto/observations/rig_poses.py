"""Rigidity of a rig: observations that constrain the cameras at each exposure (`georeferencing.RigCamera`).

A row refers to a photograph and to the photograph of the reference camera at the same event. Both poses are unknown;
the camera's pose in the rig can be unknown too. A rig connects its photographs without GNSS and IMU; if the reference
camera has a trajectory, the other cameras do not need one.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import RigCamera, reference_later, rig_place, turn_off
from jaxphoto.observations.base import AXES, AbstractObservations, ImageState, index_of


class AbstractRigRows(AbstractObservations):
    """Deviation of a photograph from its pose in the rig, observed as zero with `sigma`."""

    observed = "off"
    columns = {"off": ()}  # noqa: RUF012

    reference: Int[np.ndarray, "n"] = index_of("image")
    image: Int[np.ndarray, "n"] = index_of("image")
    off: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for photographs paired with themselves."""
        for row in np.flatnonzero(self.reference == self.image):
            yield int(row), "the image is its own reference; name that of the reference camera of the same event"


class RigPlaces(AbstractRigRows):
    """Positions of cameras in their rigs (m), in the axes of the reference camera."""

    group = "rig_places"
    unit = "m"
    axes = tuple(axis.lower() for axis in AXES)

    def residual(self, reference: ImageState, image: ImageState) -> Float[ArrayLike, "3"]:
        """Return observed minus computed (m)."""
        own = _camera_of(image)
        return self.off - (rig_place(*_reference_for(reference, own), image.position) - own.place)


class RigTurns(AbstractRigRows):
    """Rotations of cameras in their rigs (rad), about the axes of the camera."""

    group = "rig_turns"
    unit = "rad"
    rigid_invariant = True
    axes = ("rx", "ry", "rz")

    def residual(self, reference: ImageState, image: ImageState) -> Float[ArrayLike, "3"]:
        """Return observed minus computed (rad)."""
        own = _camera_of(image)
        _, turned = _reference_for(reference, own)
        return self.off - turn_off(turned, image.camera_from_object, own.turn)


def _reference_for(reference: ImageState, own: RigCamera) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return position and orientation of the reference camera at the exposure of the other camera."""
    at = reference.position, reference.camera_from_object
    return reference_later(own.delay, *at, reference.mount, reference.exposure)


def _camera_of(image: ImageState) -> RigCamera:
    if RigCamera.kind not in image.parameters:
        raise BlockError(
            "rig observations need a camera of the block that belongs to a rig: give "
            f"[unknowns.{RigCamera.kind}.CAMERA]"
        )
    found: RigCamera = image.parameters[RigCamera.kind]
    return found
