"""Relative control: changes of position and attitude of the GNSS/IMU between exposures.

Carrier phases determine the motion of an antenna between two exposures to millimetres, and gyros the rotation of the
body, although positions and attitudes drift. With the sensor's position P = X + R l - v tau
(`georeferencing.sensor_position`) and the attitude B of the body (from body to object),

    d = P_2 - P_1,    A = B_1' B_2

Shift and drift of strips and flight are errors of the positions and do not affect d: errors common to all positions of
a strip cancel. Sources: Skaloud, Rehak and Lichti (2014), Mapping with MAV: experimental study on the contribution of
absolute and relative aerial position control; Cucci, Rehak and Skaloud (2017), Bundle adjustment with raw inertial
observations in UAV applications.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import StripBias, attitude_residual, recorded_attitude, sensor_position
from jaxphoto.observations.attitudes import ATTITUDE_AXES
from jaxphoto.observations.base import AXES, AbstractObservations, ImageState, index_of
from jaxphoto.rotation import matrix_from_roll_pitch_yaw

_NO_BIAS = StripBias(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]


class AbstractRelativeRows(AbstractObservations):
    """Pose of the GNSS/IMU at `image_2` relative to its pose at `image_1`."""

    unique = True

    image_1: Int[np.ndarray, "n"] = index_of("image")
    image_2: Int[np.ndarray, "n"] = index_of("image")

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for images paired with themselves."""
        for row in np.flatnonzero(self.image_1 == self.image_2):
            yield int(row), "image_1 and image_2 are the same; name two exposures"

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "relative position of images 12 and 13 in Z"."""
        thing, along = self.group.replace("_", " ").removesuffix("s"), "in" if self.axes == AXES else "about"
        pairs = [f"images {images[a]} and {images[b]}" for a, b in zip(self.image_1, self.image_2, strict=True)]
        return np.array([[f"{thing} of {pair} {along} {axis}" for pair in pairs] for axis in self.axes], object)


class RelativePositions(AbstractRelativeRows):
    """Motion of the GNSS antenna from `image_1` to `image_2` (m, object frame), lever arms included."""

    group = "relative_positions"
    unit = "m"
    axes = AXES
    columns = {"value": tuple(f"d{axis}_m" for axis in AXES)}  # noqa: RUF012

    value: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, image_1: ImageState, image_2: ImageState) -> Float[ArrayLike, "3"]:
        """Return observed minus computed (m)."""
        return self.value - (_antenna(image_2) - _antenna(image_1))


class RelativeAttitudes(AbstractRelativeRows):
    """Rotation of the body from `image_1` to `image_2`: roll, pitch and yaw (rad) of body 2 relative to body 1.

    The angles are roll, pitch and yaw of B_1' B_2, with right, forward and up of body 1 in place of east, north and up.
    Residual and sigmas refer to a small rotation about forward, right and down of body 2.
    """

    group = "relative_attitudes"
    unit = "rad"
    axes = ATTITUDE_AXES
    observed = "roll_pitch_yaw"
    rigid_invariant = True
    columns = {"roll_pitch_yaw": tuple(f"{axis}_deg" for axis in ATTITUDE_AXES)}  # noqa: RUF012

    roll_pitch_yaw: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, image_1: ImageState, image_2: ImageState) -> Float[Array, "3"]:
        """Return observed minus computed as a small rotation (rad); see `georeferencing.attitude_residual`."""
        observed = matrix_from_roll_pitch_yaw(jnp.asarray(self.roll_pitch_yaw))
        return attitude_residual(observed, _body(image_1).T @ _body(image_2))


def _antenna(image: ImageState) -> Float[Array, "3"]:
    return sensor_position(image.position, image.camera_from_object, image.mount, _NO_BIAS, image.exposure)


def _body(image: ImageState) -> Float[Array, "3 3"]:
    return recorded_attitude(image.camera_from_object, image.mount, image.exposure)
