"""Brown's fourteen additional parameters for aerial cameras: function of the measured coordinate, subtracted."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, check_positive
from jaxphoto.camera.sensor import Sensor


class Brown14(AbstractDistortion):
    """Film deformation, platen and one radial term; `ideal = measured - delta(measured)`.

        delta_x = a1 x + a2 y + a3 x y + a4 y^2 + a5 x^2 y + a6 x y^2 + a7 x^2 y^2 + x q
        delta_y = a8 x y + a9 x^2 + a10 x^2 y + a11 x y^2 + a12 x^2 y^2 + y q
        q = a13 x^2 y^2 / F + a14 r^2

    Units: a1 and a2 dimensionless, a3, a4, a8, a9 mm^-1, a5, a6, a10, a11, a14 mm^-2, a7, a12, a13 mm^-3; F in mm,
    about the principal distance (a required constant of the model that only sets the unit of a13). a14 is K1 of
    `Brown`. No parameter is equivalent to c, x_p, y_p or a rotation: a1 and a2 affect only x (c absorbs the scale,
    kappa the rotation), and x^2 in x and y^2 in y are omitted because the two tilts absorb them.

    Source: Brown (1976), The bundle adjustment - progress and prospects; formula of MicMac (DCBrown), which adds the
    correction.
    """

    f: Float[Array, ""] | float
    a1: Float[Array, ""] | float = 0.0
    a2: Float[Array, ""] | float = 0.0
    a3: Float[Array, ""] | float = 0.0
    a4: Float[Array, ""] | float = 0.0
    a5: Float[Array, ""] | float = 0.0
    a6: Float[Array, ""] | float = 0.0
    a7: Float[Array, ""] | float = 0.0
    a8: Float[Array, ""] | float = 0.0
    a9: Float[Array, ""] | float = 0.0
    a10: Float[Array, ""] | float = 0.0
    a11: Float[Array, ""] | float = 0.0
    a12: Float[Array, ""] | float = 0.0
    a13: Float[Array, ""] | float = 0.0
    a14: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "brown14"
    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = tuple(f"a{i}" for i in range(1, 15))
    powers: ClassVar[Mapping[str, int]] = dict(
        zip(coefficients, (0, 0, -1, -1, -2, -2, -3, -1, -1, -2, -2, -3, -3, -2), strict=True)
    )
    constants: ClassVar[Mapping[str, str]] = {"f_mm": "f"}

    @classmethod
    def plain(cls, sensor: Sensor) -> "Brown14":
        """Return the model with zero coefficients; F is the longer side, close to most principal distances."""
        return cls(f=max(sensor.width_mm, sensor.height_mm))

    def __check_init__(self) -> None:
        check_positive(self, "f", "the scale of a13")

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map a measured to the ideal coordinate (mm), both reduced to the principal point."""
        x, y = xy
        xx, x_y, yy = x * x, x * y, y * y
        in_x = self.a1 * x + self.a2 * y + self.a3 * x_y + self.a4 * yy
        in_x += self.a5 * xx * y + self.a6 * x * yy + self.a7 * xx * yy
        in_y = self.a8 * x_y + self.a9 * xx + self.a10 * xx * y + self.a11 * x * yy + self.a12 * xx * yy
        outwards = self.a13 * xx * yy / self.f + self.a14 * (xx + yy)
        return xy - jnp.stack([in_x, in_y]) - xy * outwards
