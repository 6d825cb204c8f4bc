"""Orthographic projection: parallel projection of the hemisphere of directions."""

from typing import ClassVar

import jax.numpy as jnp

from jaxphoto.camera.projection.base import AbstractProjection, Component


class Orthographic(AbstractProjection):
    """f = sin theta: the image ends at 90 degrees, at the distance c from the principal point.

    Source: Kannala and Brandt (2006), equation (5).
    """

    name: ClassVar[str] = "orthographic"
    widest_deg: ClassVar[float] = 90.0

    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Return (x, y) = c (u, v) / n, n = |(u, v, w)|."""
        scale = c / jnp.sqrt(u * u + v * v + w * w)
        return u * scale, v * scale

    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Return (x, y, -sqrt(c^2 - |(x, y)|^2))."""
        return x, y, -jnp.sqrt(c * c - (x * x + y * y))
