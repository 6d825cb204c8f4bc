"""Brown's distortion before an affinity of the image axes, in the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Affinity, Term, decentring, radial, same_terms


class BrownAffine(AbstractDistortion):
    """Radial and decentring distortion first, then affinity and shear of what they leave.

        m = x - delta(x),   ideal = (m_x - b1 m_x - b2 m_y, m_y)

    with delta as in `AffineBrown`, of x. Source: the "backward" model 4 of DBAT (Börlin and Grussenmeyer).
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "brown_affine"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("b1", "b2")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms(*coefficients)
    affinity: ClassVar[Affinity] = "after"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate (mm) of a measured one, both reduced to the principal point."""
        dr = radial(jnp.sum(xy**2), self.k1, self.k2, self.k3)
        x, y = xy - xy * dr - decentring(self.p1, self.p2, xy)
        return jnp.stack([x - self.b1 * x - self.b2 * y, y])
