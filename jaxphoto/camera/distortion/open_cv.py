"""OpenCV's rational lens model with unequal focal lengths and skew: normalised, from ideal to measured coordinates."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, decentring, radial, same_terms


class OpenCv(AbstractDistortion):
    """k1-k6, p1, p2 of OpenCV and the affinity of its camera matrix; `measured = c (u + b1 u + b2 v, v)`.

        u = x q + 2 p1 x y + p2 (r^2 + 2 x^2),   v = y q + p1 (r^2 + 2 y^2) + 2 p2 x y
        q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)

    (x, y) is the ideal coordinate divided by c, and in these formulas y points *down*, as in OpenCV; `closed_form`
    converts coordinates with y up, as everywhere in jaxphoto. All coefficients have OpenCV's values, without unit: p1
    and p2 correspond to -P2 and P1 of the decentring distortion of `Brown`. c is f_y, with b1 = f_x / f_y - 1 and b2 =
    skew / f_y; OpenCV itself has no skew.

    Most blocks do not determine all coefficients: k4 to k6 are strongly correlated with k1 to k3.
    Source: OpenCV, calib3d, "Detailed description"; COLMAP's FULL_OPENCV is the same model; its SIMPLE_PINHOLE,
    PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV are special cases.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    k4: Float[Array, ""] | float = 0.0
    k5: Float[Array, ""] | float = 0.0
    k6: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "opencv"
    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "b1", "b2")
    rare: ClassVar[tuple[str, ...]] = ("k4", "k5", "k6", "b1", "b2")
    # y points down: terms odd in y change sign.
    terms: ClassVar[Mapping[str, Term] | None] = {
        **same_terms("k1", "k2", "k3"),
        **{f"q{i}": Term(f"k{i + 3}") for i in (1, 2, 3)},
        **{"p1": Term("p2"), "p2": Term("p1", -1.0), "b1": Term("b1"), "b2": Term("b2", -1.0)},
    }
    normalised: ClassVar[bool] = True

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map an ideal to the measured coordinate, both reduced to the principal point and divided by c, y up."""
        x, y = xy[0], -xy[1]
        r2 = x * x + y * y
        q = (1 + radial(r2, self.k1, self.k2, self.k3)) / (1 + radial(r2, self.k4, self.k5, self.k6))
        dx, dy = decentring(self.p2, self.p1, (x, y))
        return affine_up(x * q + dx, y * q + dy, self.b1, self.b2)


def affine_up(u: Float[Array, ""], v: Float[Array, ""], b1, b2) -> Float[Array, "2"]:
    """Apply (u + b1 u + b2 v, v), with v down, to a coordinate with y up."""
    return jnp.stack([u + b1 * u + b2 * v, -v])
