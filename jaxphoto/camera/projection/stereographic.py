"""Stereographic projection: conformal."""

from typing import ClassVar

import jax.numpy as jnp

from jaxphoto.camera.projection.base import AbstractProjection, Component


class Stereographic(AbstractProjection):
    """f = 2 tan(theta / 2): small figures retain their shape; the direction opposite to the axis is at infinity.

    Source: Kannala and Brandt (2006), equation (2).
    """

    name: ClassVar[str] = "stereographic"
    widest_deg: ClassVar[float] = 180.0

    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Return (x, y) = 2 c (u, v) / (n - w), n = |(u, v, w)|."""
        scale = 2 * c / (jnp.sqrt(u * u + v * v + w * w) - w)
        return u * scale, v * scale

    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Return (x, y, -c (1 - t2)), t2 = tan(theta / 2)^2 = |(x, y)|^2 / (2 c)^2."""
        return x, y, -c * (1 - (x * x + y * y) / (4 * c * c))
