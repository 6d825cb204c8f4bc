"""Radial distortion of Bundler, OpenCV and COLMAP: normalised polynomial from ideal to measured coordinates."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.camera.distortion.base import AbstractDistortion, Term, radial, same_terms


class BundlerRadial(AbstractDistortion):
    """Two radial terms of the normalised ideal coordinate p; `measured = c p (1 + k1 |p|^2 + k2 |p|^4)`.

    p = ideal / c = -(U, V) / W. k1 and k2 are dimensionless; k1 < 0 is barrel distortion. The model equals `Balanced`
    with R0 = 0, A1 = k1 / c^2 and A2 = k2 / c^4.

    Source: Snavely, Seitz and Szeliski (2006), Photo tourism, the camera of Bundler, and Agarwal and others (2010),
    Bundle adjustment in the large (BAL). k1 and k2 have the same values in OpenCV (fx = fy, all other coefficients 0)
    and in COLMAP's RADIAL; their axes y down and z forward do not affect radial terms.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0

    name: ClassVar[str] = "bundler_radial"
    domain: ClassVar[Literal["measured", "ideal"]] = "ideal"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms(*coefficients)
    normalised: ClassVar[bool] = True

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map an ideal to the measured coordinate, both reduced to the principal point and divided by c."""
        x, y = xy
        stretch = 1 + radial(x * x + y * y, self.k1, self.k2)
        return jnp.stack([x * stretch, y * stretch])
