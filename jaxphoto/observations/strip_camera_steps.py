"""Constraints on the camera from strip to strip: a random walk of its interior orientation.

In the time h between the middles of two strips, a random walk of q (mm^2/h) changes by zero with the standard deviation
sqrt(q h). Source: Gelb (1974), Applied optimal estimation.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.camera import StripCamera
from jaxphoto.observations.base import AbstractObservations, index_of


class StripCameraSteps(AbstractObservations):
    """Changes of c, x_p and y_p from strip `start` to strip `end` (mm)."""

    group = "strip_camera_steps"
    unit = "mm"
    axes = ("c", "xp", "yp")

    start: Int[np.ndarray, "n"] = index_of(StripCamera.kind)
    end: Int[np.ndarray, "n"] = index_of(StripCamera.kind)
    value: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, start: StripCamera, end: StripCamera) -> Float[ArrayLike, "3"]:
        """Return observed minus computed step (mm)."""
        steps = (end.c_more - start.c_more, end.xp_more - start.xp_more, end.yp_more - start.yp_more)
        return self.value - jnp.stack([jnp.asarray(step) for step in steps])
