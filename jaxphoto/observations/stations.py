"""Camera stations: GNSS observations at the exposures."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import sensor_position
from jaxphoto.observations.base import AXES, AbstractCoordinates, ImageState, index_of


def station_of(image: ImageState) -> Float[Array, "3"]:
    """Predict the GNSS observation (m) at the exposure of an image; see `georeferencing.sensor_position`."""
    if not image.parameters:
        # Without mounts and strips, the station is the projection centre.
        return image.position
    at = sensor_position(image.position, image.camera_from_object, image.mount, image.strip, image.exposure)
    for own in image.parameters.values():
        at = own.station(at, image.exposure)
    return at


class CameraPositions(AbstractCoordinates):
    """Observed GNSS/IMU coordinates at the exposure of image `who`: `axis` (0, 1, 2), `value` and `sigma` (m)."""

    group = "stations"
    unit = "m"
    columns = {"who": "image"}  # noqa: RUF012

    who: Int[np.ndarray, "n"] = index_of("image")
    axis: Int[np.ndarray, "n"]
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, image: ImageState) -> Float[ArrayLike, ""]:
        """Return observed minus computed (m)."""
        return self.value - station_of(image)[self.axis]

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "station of image 12 in Z"."""
        rows = zip(self.who, self.axis, strict=True)
        return np.array([f"station of image {images[i]} in {AXES[a]}" for i, a in rows], object)
