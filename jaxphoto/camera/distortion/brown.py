"""Brown's distortion with affinity and shear, in the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Affinity, Term, decentring, radial, same_terms


class Brown(AbstractDistortion):
    """Radial K1-K3, decentring P1, P2, affinity b1 and shear b2; `ideal = measured - delta(measured)`.

        delta_x = x (K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 x^2) + 2 P2 x y + b1 x + b2 y
        delta_y = y (K1 r^2 + K2 r^4 + K3 r^6) + 2 P1 x y + P2 (r^2 + 2 y^2)

    Units: K1 mm^-2, K2 mm^-4, K3 mm^-6, P1 and P2 mm^-1, b1 and b2 none. K1 < 0 is a barrel.
    Source: Brown (1971); the sense of papers 000, 002 and 004. Fraser (1997) adds the correction that is subtracted
    here: with his coefficients, change every sign.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "brown"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("b1", "b2")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms(*coefficients)
    affinity: ClassVar[Affinity] = "added"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal coordinate (mm) of a measured one, both reduced to the principal point."""
        x, y = xy
        r2 = x * x + y * y
        dr = radial(r2, self.k1, self.k2, self.k3)
        dx, dy = decentring(self.p1, self.p2, xy)
        return jnp.stack([x - x * dr - dx - (self.b1 * x + self.b2 * y), y - y * dr - dy])
