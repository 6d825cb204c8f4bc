"""Agisoft's frame camera: normalised polynomial from ideal to measured coordinates, with affinity and skew."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, decentring, radial, same_terms
from jaxphoto.camera.distortion.open_cv import affine_up


class Agisoft(AbstractDistortion):
    """K1-K4, P1-P4 of Metashape and PhotoScan and their affinity; `measured = c (u + b1 u + b2 v, v)`.

        u = x q + t (P1 (r^2 + 2 x^2) + 2 P2 x y),   v = y q + t (2 P1 x y + P2 (r^2 + 2 y^2))
        q = 1 + K1 r^2 + K2 r^4 + K3 r^6 + K4 r^8,   t = 1 + P3 r^2 + P4 r^4

    (x, y) is the ideal coordinate divided by c, and in these formulas y points *down*, as in Agisoft's; `closed_form`
    converts coordinates with y up, as everywhere in jaxphoto. c is Agisoft's f; all coefficients have Agisoft's values,
    without unit, except b1 = B1 / f and b2 = B2 / f, because B1 and B2 are in pixels. P3 and P4 exist only in PhotoScan
    1.2 to 1.4.
    Source: Agisoft PhotoScan and Metashape, user manual, appendix "Camera models".
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    k4: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    p3: Float[Array, ""] | float = 0.0
    p4: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "agisoft"
    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("k4", "p3", "p4", "b1", "b2")
    # y points down: terms odd in y change sign.
    terms: ClassVar[Mapping[str, Term] | None] = {
        **same_terms("k1", "k2", "k3", "k4", "p1", "p3", "p4", "b1"),
        **{"p2": Term("p2", -1.0), "b2": Term("b2", -1.0)},
    }
    normalised: ClassVar[bool] = True

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map an ideal to the measured coordinate, both reduced to the principal point and divided by c, y up."""
        x, y = xy[0], -xy[1]
        r2 = x * x + y * y
        q = 1 + radial(r2, self.k1, self.k2, self.k3, self.k4)
        t, (dx, dy) = 1 + radial(r2, self.p3, self.p4), decentring(self.p1, self.p2, (x, y))
        return affine_up(x * q + t * dx, y * q + t * dy, self.b1, self.b2)
