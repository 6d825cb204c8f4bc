"""Brown's distortion between a stretch and a shear of the image axes, in the measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class StretchedBrown(AbstractBrown):
    """A stretch of the x axis first, then radial and decentring distortion, then a shear of what they leave.

        s = (x - b1 x, y),   m = s - delta(s),   ideal = (m_x - b2 m_y, m_y)

    with delta as in `AffineBrown`, of s. Source: the "backward" model 5 of DBAT (Börlin and Grussenmeyer).
    """

    name: ClassVar[str] = "stretched_brown"
    affinity: ClassVar[Affinity] = "around"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate (mm) of a measured one, both reduced to the principal point."""
        x, y = self.undistorted(jnp.stack([xy[0] - self.b1 * xy[0], xy[1]]))
        return jnp.stack([x - self.b2 * y, y])
