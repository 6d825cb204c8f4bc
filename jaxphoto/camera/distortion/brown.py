"""Brown's distortion with affinity and shear: function of the measured coordinate, subtracted."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractBrown, Affinity


class Brown(AbstractBrown):
    """Radial K1-K3, decentring P1, P2, affinity b1 and shear b2; `ideal = measured - delta(measured)`.

        delta_x = x (K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 x^2) + 2 P2 x y + b1 x + b2 y
        delta_y = y (K1 r^2 + K2 r^4 + K3 r^6) + 2 P1 x y + P2 (r^2 + 2 y^2)

    Units: K1 mm^-2, K2 mm^-4, K3 mm^-6, P1 and P2 mm^-1, b1 and b2 dimensionless. K1 < 0 is barrel distortion.
    Source: Brown (1971); signs as in papers 000, 002 and 004. Fraser (1997) adds the correction instead: change the
    sign of all his coefficients.
    """

    name: ClassVar[str] = "brown"
    affinity: ClassVar[Affinity] = "added"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = self.undistorted(xy)
        return jnp.stack([x - (self.b1 * xy[0] + self.b2 * xy[1]), y])
