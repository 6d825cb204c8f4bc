"""Brown's distortion after an affinity of the image axes, in the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Affinity, Term, decentring, radial, same_terms


class AffineBrown(AbstractDistortion):
    """Affinity and shear first, then radial and decentring distortion of what they leave.

        m = (x - b1 x - b2 y, y),   ideal = m - delta(m)
        delta = m (K1 r^2 + K2 r^4 + K3 r^6) + (P1 (r^2 + 2 m_x^2) + 2 P2 m_x m_y, 2 P1 m_x m_y + P2 (r^2 + 2 m_y^2))

    `Brown` adds all terms in the same coordinate; the two differ by products of the affinity with the distortion, which
    a close-range camera shows. Units as there. Source: the "backward" model 3 of DBAT (Börlin and Grussenmeyer).
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "affine_brown"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("b1", "b2")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms(*coefficients)
    affinity: ClassVar[Affinity] = "before"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate (mm) of a measured one, both reduced to the principal point."""
        x, y = xy[0] - self.b1 * xy[0] - self.b2 * xy[1], xy[1]
        dr = radial(x * x + y * y, self.k1, self.k2, self.k3)
        dx, dy = decentring(self.p1, self.p2, jnp.stack([x, y]))
        return jnp.stack([x - x * dr - dx, y - y * dr - dy])
