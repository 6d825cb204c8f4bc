"""Ebner's twelve additional parameters: function of the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, check_positive
from jaxphoto.camera.sensor import Sensor


class Ebner(AbstractDistortion):
    """Twelve parameters orthogonal on the 3 x 3 points {-b, 0, b}^2; `ideal = measured - delta(measured)`.

        delta_x =  b1 x + b2 y - 2 b3 k + b4 x y + b5 l + b7 x l + b9 y k + b11 k l
        delta_y = -b1 y + b2 x + b3 x y - 2 b4 l + b6 k + b8 y k + b10 x l + b12 k l
        k = x^2 - 2 b^2 / 3,   l = y^2 - 2 b^2 / 3

    Units: b1 and b2 dimensionless, b3 to b6 mm^-1, b7 to b10 mm^-2, b11 and b12 mm^-3; b, the spacing of the 3 x 3
    points, in mm (a required constant of the model). On these points the parameters are also orthogonal to c, x_p, y_p
    and the three rotations of the image: b1 and b2 are the affinity and shear that c (scale) and kappa (rotation) do
    not absorb, b3 to b6 the quadratic terms that the two tilts do not absorb. All can therefore be free together with
    c, x_p and y_p. They model the remaining distortion of a calibrated camera: without x^3 and y^3 they cannot
    represent the radial distortion of an ordinary lens.

    Source: Ebner (1976), Self calibrating block adjustment; formula of MicMac, which adds the correction.
    """

    b: Float[Array, ""] | float
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0
    b3: Float[Array, ""] | float = 0.0
    b4: Float[Array, ""] | float = 0.0
    b5: Float[Array, ""] | float = 0.0
    b6: Float[Array, ""] | float = 0.0
    b7: Float[Array, ""] | float = 0.0
    b8: Float[Array, ""] | float = 0.0
    b9: Float[Array, ""] | float = 0.0
    b10: Float[Array, ""] | float = 0.0
    b11: Float[Array, ""] | float = 0.0
    b12: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "ebner"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = tuple(f"b{i}" for i in range(1, 13))
    powers: ClassVar[Mapping[str, int]] = dict(
        zip(coefficients, (0,) * 2 + (-1,) * 4 + (-2,) * 4 + (-3,) * 2, strict=True)
    )
    constants: ClassVar[Mapping[str, str]] = {"b_mm": "b"}

    @classmethod
    def plain(cls, sensor: Sensor) -> "Ebner":
        """Return the model with zero coefficients; the 3 x 3 points span the longer side of the format."""
        return cls(b=max(sensor.width_mm, sensor.height_mm) / 2)

    def __check_init__(self) -> None:
        check_positive(self, "b", "the spacing of its points")

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = xy
        k, l = x * x - 2 * self.b**2 / 3, y * y - 2 * self.b**2 / 3  # noqa: E741
        linear = jnp.stack([self.b1 * x + self.b2 * y, self.b2 * x - self.b1 * y])
        quadratic = jnp.stack(
            [
                -2 * self.b3 * k + self.b4 * x * y + self.b5 * l,
                -2 * self.b4 * l + self.b3 * x * y + self.b6 * k,
            ]
        )
        higher = jnp.stack(
            [
                self.b7 * x * l + self.b9 * y * k + self.b11 * k * l,
                self.b8 * y * k + self.b10 * x * l + self.b12 * k * l,
            ]
        )
        return xy - linear - quadratic - higher
