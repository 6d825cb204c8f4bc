"""Brown's distortion before an affinity of the image axes, in the measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class BrownAffine(AbstractBrown):
    """Radial and decentring distortion first, then affinity and shear of the result.

        m = x - delta(x),   ideal = (m_x - b1 m_x - b2 m_y, m_y)

    with delta as in `AffineBrown`, of x. Source: the "backward" model 4 of DBAT (Börlin and Grussenmeyer).
    """

    name: ClassVar[str] = "brown_affine"
    affinity: ClassVar[Affinity] = "after"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate (mm) of a measured one, both reduced to the principal point."""
        x, y = self.undistorted(xy)
        return jnp.stack([x - self.b1 * x - self.b2 * y, y])
