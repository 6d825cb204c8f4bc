"""Gruen's forty-four additional parameters: function of the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, check_positive
from jaxphoto.camera.sensor import Sensor


class Gruen(AbstractDistortion):
    """44 parameters orthogonal on the 5 x 5 points {-b, -b/2, 0, b/2, b}^2; `ideal = measured - delta(measured)`.

        delta_x = f(y)' A f(x),   delta_y = f(y)' B f(x)
        f(u) = (1, u, u^2 - b^2 / 2, u (u^2 - 17 b^2 / 20), u^2 (u^2 - 31 b^2 / 28) + 9 b^4 / 70)

            [  0   a12  -10/7 b22  a14  a15 ]        [     0       a21  b13  b14  b15 ]
            [ a21  a22     a23     a24  a25 ]        [   -a12      b22  b23  b24  b25 ]
        A = [ a31  a32     a33     a34  a35 ],   B = [ -10/7 a22   b32  b33  b34  b35 ]
            [ a41  a42     a43     a44  a45 ]        [    b41      b42  b43  b44  b45 ]
            [ a51  a52     a53     a54  a55 ]        [    b51      b52  b53  b54  b55 ]

    f contains the orthogonal polynomials of five equidistant points. Units: mm^(3-i-j) for aij and bij; b in mm (a
    required constant of the model). The remaining six terms correspond to x_p, y_p, c, kappa and the two tilts. All 44
    parameters are orthogonal to them on these points and can therefore be free together with c, x_p and y_p. They model
    the remaining distortion of a calibrated camera.

    Source: Gruen (1978), Progress in photogrammetric point determination by compensation of systematic errors and
    detection of gross errors. The original was not available: the tests verify the orthogonality and the completeness
    of the 50 functions, but the numbering of the parameters may differ from the original.
    """

    b: Float[Array, ""] | float
    a12: Float[Array, ""] | float = 0.0
    a14: Float[Array, ""] | float = 0.0
    a15: Float[Array, ""] | float = 0.0
    a21: Float[Array, ""] | float = 0.0
    a22: Float[Array, ""] | float = 0.0
    a23: Float[Array, ""] | float = 0.0
    a24: Float[Array, ""] | float = 0.0
    a25: Float[Array, ""] | float = 0.0
    a31: Float[Array, ""] | float = 0.0
    a32: Float[Array, ""] | float = 0.0
    a33: Float[Array, ""] | float = 0.0
    a34: Float[Array, ""] | float = 0.0
    a35: Float[Array, ""] | float = 0.0
    a41: Float[Array, ""] | float = 0.0
    a42: Float[Array, ""] | float = 0.0
    a43: Float[Array, ""] | float = 0.0
    a44: Float[Array, ""] | float = 0.0
    a45: Float[Array, ""] | float = 0.0
    a51: Float[Array, ""] | float = 0.0
    a52: Float[Array, ""] | float = 0.0
    a53: Float[Array, ""] | float = 0.0
    a54: Float[Array, ""] | float = 0.0
    a55: Float[Array, ""] | float = 0.0
    b13: Float[Array, ""] | float = 0.0
    b14: Float[Array, ""] | float = 0.0
    b15: Float[Array, ""] | float = 0.0
    b22: Float[Array, ""] | float = 0.0
    b23: Float[Array, ""] | float = 0.0
    b24: Float[Array, ""] | float = 0.0
    b25: Float[Array, ""] | float = 0.0
    b32: Float[Array, ""] | float = 0.0
    b33: Float[Array, ""] | float = 0.0
    b34: Float[Array, ""] | float = 0.0
    b35: Float[Array, ""] | float = 0.0
    b41: Float[Array, ""] | float = 0.0
    b42: Float[Array, ""] | float = 0.0
    b43: Float[Array, ""] | float = 0.0
    b44: Float[Array, ""] | float = 0.0
    b45: Float[Array, ""] | float = 0.0
    b51: Float[Array, ""] | float = 0.0
    b52: Float[Array, ""] | float = 0.0
    b53: Float[Array, ""] | float = 0.0
    b54: Float[Array, ""] | float = 0.0
    b55: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "gruen"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    # fmt: off
    coefficients: ClassVar[tuple[str, ...]] = (
        "a12", "a14", "a15",
        "a21", "a22", "a23", "a24", "a25",
        "a31", "a32", "a33", "a34", "a35",
        "a41", "a42", "a43", "a44", "a45",
        "a51", "a52", "a53", "a54", "a55",
        "b13", "b14", "b15",
        "b22", "b23", "b24", "b25",
        "b32", "b33", "b34", "b35",
        "b41", "b42", "b43", "b44", "b45",
        "b51", "b52", "b53", "b54", "b55",
    )
    # fmt: on
    powers: ClassVar[Mapping[str, int]] = {n: 3 - int(n[1]) - int(n[2]) for n in coefficients}
    constants: ClassVar[Mapping[str, str]] = {"b_mm": "b"}
    # Terms beyond the third degree: with all 44 parameters, the model would fit individual targets.
    rare: ClassVar[tuple[str, ...]] = tuple(n for n in coefficients if int(n[1]) + int(n[2]) - 2 > 3)

    @classmethod
    def plain(cls, sensor: Sensor) -> "Gruen":
        """Return the model with zero coefficients; the 5 x 5 points span the longer side of the format."""
        return cls(b=max(sensor.width_mm, sensor.height_mm) / 2)

    def __check_init__(self) -> None:
        check_positive(self, "b", "twice the spacing of its points")

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        a = jnp.asarray(
            [
                [0.0, self.a12, -10 / 7 * self.b22, self.a14, self.a15],
                [self.a21, self.a22, self.a23, self.a24, self.a25],
                [self.a31, self.a32, self.a33, self.a34, self.a35],
                [self.a41, self.a42, self.a43, self.a44, self.a45],
                [self.a51, self.a52, self.a53, self.a54, self.a55],
            ]
        )
        b = jnp.asarray(
            [
                [0.0, self.a21, self.b13, self.b14, self.b15],
                [-self.a12, self.b22, self.b23, self.b24, self.b25],
                [-10 / 7 * self.a22, self.b32, self.b33, self.b34, self.b35],
                [self.b41, self.b42, self.b43, self.b44, self.b45],
                [self.b51, self.b52, self.b53, self.b54, self.b55],
            ]
        )
        of_x, of_y = self._polynomials(xy[0]), self._polynomials(xy[1])
        return xy - jnp.stack([of_y @ a @ of_x, of_y @ b @ of_x])

    def _polynomials(self, u: Float[Array, ""]) -> Float[Array, "5"]:
        uu, bb = u * u, self.b * self.b
        cubic = u * (uu - 17 / 20 * bb)
        quartic = uu * (uu - 31 / 28 * bb) + 9 / 70 * bb * bb
        return jnp.stack([jnp.ones_like(u), u, uu - bb / 2, cubic, quartic])
