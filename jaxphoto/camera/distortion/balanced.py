"""Balanced radial model of close-range metrology: function of the ideal coordinate, added."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Affinity, Term, decentring, radial_powers


class Balanced(AbstractDistortion):
    """Radial A1-A3 balanced at R0, decentring B1, B2, affinity C1 and shear C2; `measured = ideal + delta(ideal)`.

        delta_x = x dr + B1 (r^2 + 2 x^2) + 2 B2 x y + C1 x + C2 y
        delta_y = y dr + B2 (r^2 + 2 y^2) + 2 B1 x y
        dr = A1 (r^2 - R0^2) + A2 (r^4 - R0^4) + A3 (r^6 - R0^6)

    Units: A1 mm^-2, A2 mm^-4, A3 mm^-6, B1 and B2 mm^-1, C1 and C2 dimensionless, R0 mm (a constant of the model).
    Source: AICON / JAG3D bundle adjustment; the tests reproduce its report.
    """

    a1: Float[Array, ""] | float = 0.0
    a2: Float[Array, ""] | float = 0.0
    a3: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0
    c1: Float[Array, ""] | float = 0.0
    c2: Float[Array, ""] | float = 0.0
    r0: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "balanced"
    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"
    coefficients: ClassVar[tuple[str, ...]] = ("a1", "a2", "a3", "b1", "b2", "c1", "c2")
    powers: ClassVar[Mapping[str, int]] = {**radial_powers("a", 3), "b1": -1, "b2": -1, "c1": 0, "c2": 0}
    constants: ClassVar[Mapping[str, str]] = {"r0_mm": "r0"}
    rare: ClassVar[tuple[str, ...]] = ("c1", "c2")
    terms: ClassVar[Mapping[str, Term] | None] = {
        **{f"k{i}": Term(f"a{i}", 1.0, 2 * i) for i in (1, 2, 3)},
        **{f"p{i}": Term(f"b{i}", 1.0, 1) for i in (1, 2)},
        **{f"b{i}": Term(f"c{i}") for i in (1, 2)},
    }
    affinity: ClassVar[Affinity] = "added"

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map an ideal to the measured coordinate (mm), both reduced to the principal point."""
        x, y = xy
        r2, s2 = x * x + y * y, self.r0 * self.r0
        dr = self.a1 * (r2 - s2) + self.a2 * (r2**2 - s2**2) + self.a3 * (r2**3 - s2**3)
        affine = jnp.stack([self.c1 * x + self.c2 * y, jnp.zeros_like(y)])
        return xy + xy * dr + decentring(self.b1, self.b2, xy) + affine
