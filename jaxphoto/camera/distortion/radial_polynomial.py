"""Radial polynomial of odd degree: function of the measured coordinate, added."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, radial, radial_powers


class RadialPolynomial(AbstractDistortion):
    """Radial correction with odd powers of the radius; `ideal = measured (1 + dr / r)`.

        dr = k1 r^3 + k2 r^5 (+ k3 r^7)

    The correction is *added*: k1 > 0 is barrel distortion, and k1, k2, k3 are K1, K2, K3 of `Brown` with opposite sign.
    At r = 0 the factor is 1. For the fifth degree, fix k3 at 0. Units: k1 mm^-2, k2 mm^-4, k3 mm^-6.

    Source: paper 001 (after Chikatsu), which specifies only "radial polynomial 5th degree". An odd polynomial of the
    measured coordinate, added, is the usual interpretation.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "radial"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3")
    powers: ClassVar[Mapping[str, int]] = radial_powers("k", 3)
    terms: ClassVar[Mapping[str, Term] | None] = {name: Term(name, -1.0) for name in ("k1", "k2", "k3")}

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = xy
        stretch = 1 + radial(x * x + y * y, self.k1, self.k2, self.k3)
        return jnp.stack([x * stretch, y * stretch])
