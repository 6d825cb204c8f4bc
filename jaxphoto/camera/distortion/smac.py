"""SMAC, the USGS Simultaneous Multi-frame Analytical Calibration model: function of the measured coordinate."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import equinox as eqx
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, decentring, radial_powers, same_terms


class Smac(AbstractDistortion):
    """Complete SMAC model; `ideal = measured - delta` (sign "subtract", paper 002) or `+ delta` ("add", USGS).

        delta = (x, y) q + (1 + P3 r^2 + P4 r^4) (P1 (r^2 + 2 x^2) + 2 P2 x y, 2 P1 x y + P2 (r^2 + 2 y^2))
        q = K0 + K1 (r^2 - R0^2) + K2 (r^4 - R0^4) + K3 (r^6 - R0^6) + K4 (r^8 - R0^8)

    Units: K0 dimensionless, Ki mm^-2i, P1 and P2 mm^-1, P3 mm^-2, P4 mm^-4, R0 mm (a constant of the model). K0, R0 and
    the principal distance all change the image scale: K0 and c cannot be estimated together (docs/models.md).
    Source: paper 002, equations (1)-(3); K0, K4, P3, P4 and the sign "add" from USGS report OSL/2985.
    """

    k0: Float[Array, ""] | float = 0.0
    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    k4: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    p3: Float[Array, ""] | float = 0.0
    p4: Float[Array, ""] | float = 0.0
    r0: Float[Array, ""] | float = 0.0
    sign: Literal["subtract", "add"] = eqx.field(static=True, default="subtract")

    name: ClassVar[str] = "smac"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    scales: ClassVar[tuple[str, ...]] = ("k0",)
    coefficients: ClassVar[tuple[str, ...]] = ("k0", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    powers: ClassVar[Mapping[str, int]] = {"k0": 0, **radial_powers("k", 4), "p1": -1, "p2": -1, "p3": -2, "p4": -4}
    constants: ClassVar[Mapping[str, str]] = {"r0_mm": "r0"}
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {"sign": ("subtract", "add")}
    rare: ClassVar[tuple[str, ...]] = ("k4", "p3", "p4")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

    def __check_init__(self) -> None:
        if self.sign not in ("subtract", "add"):
            raise ValueError(f'the sign of SMAC must be "subtract" or "add", got {self.sign!r}')

    @property
    def signum(self) -> float:
        """Return -1 if the distortion is subtracted, +1 if it is added."""
        return -1.0 if self.sign == "subtract" else 1.0

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = xy
        r2, s2 = x * x + y * y, self.r0 * self.r0
        k1, k2, k3, k4 = self.k1, self.k2, self.k3, self.k4
        q = self.k0 + k1 * (r2 - s2) + k2 * (r2**2 - s2**2) + k3 * (r2**3 - s2**3) + k4 * (r2**4 - s2**4)
        tangential = (1 + r2 * (self.p3 + r2 * self.p4)) * decentring(self.p1, self.p2, xy)
        return xy + self.signum * (xy * q + tangential)
