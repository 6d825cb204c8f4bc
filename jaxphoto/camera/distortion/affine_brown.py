"""Brown's distortion applied after an affinity of the image axes; function of the measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class AffineBrown(AbstractBrown):
    """Affinity and shear, followed by radial and decentring distortion.

        m = (x - b1 x - b2 y, y),   ideal = m - delta(m)
        delta = m (K1 r^2 + K2 r^4 + K3 r^6) + (P1 (r^2 + 2 m_x^2) + 2 P2 m_x m_y, 2 P1 m_x m_y + P2 (r^2 + 2 m_y^2))

    `Brown` evaluates all terms in the same coordinate; the models differ by products of affinity and distortion, which
    matter for close-range cameras. Units: as in `Brown`. Source: the "backward" model 3 of DBAT (Börlin and
    Grussenmeyer).
    """

    name: ClassVar[str] = "affine_brown"
    affinity: ClassVar[Affinity] = "before"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        return self.undistorted(jnp.stack([xy[0] - self.b1 * xy[0] - self.b2 * xy[1], xy[1]]))
