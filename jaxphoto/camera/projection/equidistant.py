"""Equidistant projection; most fisheye lenses approximate it."""

import math
from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp

from jaxphoto.camera.projection.base import AbstractProjection, Component

# Maximum square of an angle or its tangent for which series are used: on the axis the closed forms are 0 / 0, and close
# to it their second derivatives lose half of their digits. Ten terms leave an error of 1e-21.
_NEAR = 1e-2
_TERMS = 10


class Equidistant(AbstractProjection):
    """f = theta: the distance from the principal point is c times the angle from the axis, up to 180 degrees.

    With the distortion `OpenCvFisheye`, it is the fisheye model of OpenCV (cv2.fisheye) and COLMAP.
    Source: Kannala and Brandt (2006), A generic camera model and calibration method for conventional, wide-angle, and
    fish-eye lenses, equation (3).
    """

    name: ClassVar[str] = "equidistant"
    widest_deg: ClassVar[float] = 180.0

    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Return (x, y) = c theta (u, v) / rho, rho = |(u, v)|, theta = atan2(rho, -w)."""
        rho2 = u * u + v * v
        near = (rho2 < _NEAR * w * w) & (w < 0)
        # Use two `where`, because derivatives of the branch not taken must be finite too.
        rho = jnp.sqrt(jnp.where(near, 1.0, rho2))
        far_away = jnp.arctan2(rho, -w) / rho
        depth = jnp.where(near, -w, 1.0)
        tangent2 = jnp.where(near, rho2, 0.0) / (depth * depth)
        close = _series(tangent2, lambda k: (-1) ** k / (2 * k + 1)) / depth
        scale = c * jnp.where(near, close, far_away)
        return u * scale, v * scale

    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Return (x sin(theta) / theta, y sin(theta) / theta, -c cos(theta)), theta = |(x, y)| / c."""
        theta2 = (x * x + y * y) / (c * c)
        near = theta2 < _NEAR
        theta = jnp.sqrt(jnp.where(near, 1.0, theta2))
        small = jnp.where(near, theta2, 0.0)
        sine = jnp.where(near, _series(small, lambda k: (-1) ** k / math.factorial(2 * k + 1)), jnp.sin(theta) / theta)
        cosine = jnp.where(near, _series(small, lambda k: (-1) ** k / math.factorial(2 * k)), jnp.cos(theta))
        sine = jnp.where(theta2 < jnp.pi**2, sine, jnp.nan)
        return x * sine, y * sine, -c * cosine


def _series(square: Component, coefficient: Callable[[int], float]) -> Component:
    """Evaluate the power series with the coefficients 0, 1, 2, ... by Horner's scheme."""
    total = jnp.zeros_like(square)
    for k in reversed(range(_TERMS)):
        total = coefficient(k) + square * total
    return total
