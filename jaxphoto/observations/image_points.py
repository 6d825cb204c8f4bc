"""Image points, the main observations of an adjustment; evaluated by `adjustment.solver.ray_rows`."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.observations.base import AbstractObservations, ImageState, index_of


class ImagePoints(AbstractObservations):
    """Measured image coordinates (mm, from the image centre) of `point` in `image`, sorted by point."""

    group = "image_points"
    unit = "mm"
    axes = ("x", "y")
    observed = "xy"
    uses_interior = True
    columns = {"xy": ("x_mm", "y_mm")}  # noqa: RUF012

    image: Int[np.ndarray, "n"] = index_of("image")
    point: Int[np.ndarray, "n"] = index_of("point")
    xy: Float[ArrayLike, "n 2"]
    sigma: Float[ArrayLike, "n 2"]

    def residual(self, image: ImageState, point: Float[Array, "3"]) -> Float[ArrayLike, "2"]:
        """Return observed minus computed (mm), without refraction and curvature; see `collinearity.image_residual`."""
        exterior = ExteriorOrientation(image.position, image.camera_from_object)
        return image_residual(image.interior, exterior, point, jnp.asarray(self.xy))

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "point 7 in image 12", equal for both coordinates because a blunder affects both."""
        names = [f"point {points[p]} in image {images[i]}" for i, p in zip(self.image, self.point, strict=True)]
        return np.broadcast_to(np.array(names, object), (2, len(names)))
