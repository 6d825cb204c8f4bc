"""Brown's distortion applied before an affinity of the image axes; function of the measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class BrownAffine(AbstractBrown):
    """Radial and decentring distortion, followed by affinity and shear.

        m = x - delta(x),   ideal = (m_x - b1 m_x - b2 m_y, m_y)

    with delta of `AffineBrown` evaluated at x. Source: the "backward" model 4 of DBAT (Börlin and Grussenmeyer).
    """

    name: ClassVar[str] = "brown_affine"
    affinity: ClassVar[Affinity] = "after"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = self.undistorted(xy)
        return jnp.stack([x - self.b1 * x - self.b2 * y, y])
