"""Attitudes: roll, pitch and yaw observed by an IMU at the exposures."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import attitude_residual, recorded_attitude
from jaxphoto.observations.base import AbstractObservations, ImageState, index_of
from jaxphoto.rotation import matrix_from_roll_pitch_yaw

ATTITUDE_AXES = ("roll", "pitch", "yaw")


class Attitudes(AbstractObservations):
    """Observed roll, pitch and yaw (rad) of `image` with their sigmas (rad)."""

    group = "attitudes"
    unit = "rad"
    axes = ATTITUDE_AXES
    observed = "roll_pitch_yaw"
    columns = {  # noqa: RUF012
        "roll_pitch_yaw": tuple(f"{axis}_deg" for axis in ATTITUDE_AXES),
        "sigma": tuple(f"sigma_{axis}_deg" for axis in ATTITUDE_AXES),
    }

    image: Int[np.ndarray, "n"] = index_of("image")
    roll_pitch_yaw: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, image: ImageState) -> Float[ArrayLike, "3"]:
        """Return observed minus computed as a small rotation (rad); see `georeferencing.attitude_residual`."""
        computed = recorded_attitude(image.camera_from_object, image.mount, image.exposure)
        return attitude_residual(matrix_from_roll_pitch_yaw(jnp.asarray(self.roll_pitch_yaw)), computed)

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "roll of image 12"."""
        return np.array([[f"{axis} of image {images[i]}" for i in self.image] for axis in self.axes], object)
