"""Radial distortion about a principal point of symmetry that differs from the principal point, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, radial, radial_powers, same_terms


class PpsRadial(AbstractDistortion):
    """Radial K1-K3 about the principal point of symmetry (PPS); `ideal = measured - delta(measured)`.

        delta = (x - S) (K1 |x - S|^2 + K2 |x - S|^4 + K3 |x - S|^6),   S = (pps_x, pps_y)

    x is reduced to (x_p, y_p), the principal point of autocollimation (PPA). S is the PPS *relative to the PPA*: its
    image coordinates are (x_p + pps_x, y_p + pps_y). Units: K1 mm^-2, K2 mm^-4, K3 mm^-6, pps_x and pps_y mm.

    Without radial distortion the PPS is undefined: pps_x and pps_y are determined only if K1 is not zero. To first
    order they are equivalent to decentring distortion with P = -K1 S (`jaxphoto.camera.principal_points`).
    Source: paper 003, section 2.4, for the two points; derivation in docs/models.md.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    pps_x: Float[Array, ""] | float = 0.0
    pps_y: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "pps_radial"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "pps_x", "pps_y")
    powers: ClassVar[Mapping[str, int]] = {**radial_powers("k", 3), "pps_x": 1, "pps_y": 1}
    terms: ClassVar[Mapping[str, Term] | None] = same_terms("k1", "k2", "k3")

    @property
    def symmetry_point(self) -> Float[Array, "2"]:
        """Return the PPS relative to the PPA (mm)."""
        return jnp.stack([jnp.asarray(self.pps_x, float), jnp.asarray(self.pps_y, float)])

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point of autocollimation."""
        x, y = xy[0] - self.pps_x, xy[1] - self.pps_y
        dr = radial(x * x + y * y, self.k1, self.k2, self.k3)
        return jnp.stack([xy[0] - x * dr, xy[1] - y * dr])
