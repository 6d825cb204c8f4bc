"""Brown's distortion applied between a stretch and a shear of the image axes; measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class StretchedBrown(AbstractBrown):
    """Stretch of the x axis, followed by radial and decentring distortion, followed by shear.

        s = (x - b1 x, y),   m = s - delta(s),   ideal = (m_x - b2 m_y, m_y)

    with delta of `AffineBrown` evaluated at s. Source: the "backward" model 5 of DBAT (Börlin and Grussenmeyer).
    """

    name: ClassVar[str] = "stretched_brown"
    affinity: ClassVar[Affinity] = "around"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = self.undistorted(jnp.stack([xy[0] - self.b1 * xy[0], xy[1]]))
        return jnp.stack([x - self.b2 * y, y])
