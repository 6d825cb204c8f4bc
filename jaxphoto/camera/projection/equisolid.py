"""Equisolid projection: equal solid angles have equal image areas."""

from typing import ClassVar

import jax.numpy as jnp

from jaxphoto.camera.projection.base import AbstractProjection, Component


class Equisolid(AbstractProjection):
    """f = 2 sin(theta / 2): a solid angle has the same image area everywhere, up to 180 degrees off the axis.

    Design projection of many fisheye lenses. Source: Miyamoto (1964), Fish eye lens; Kannala and Brandt (2006),
    equation (4).
    """

    name: ClassVar[str] = "equisolid"
    widest_deg: ClassVar[float] = 180.0

    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Return (x, y) = c (u, v) sqrt(2 / (n (n - w))), n = |(u, v, w)|; singular only opposite to the axis."""
        n = jnp.sqrt(u * u + v * v + w * w)
        scale = c * jnp.sqrt(2 / (n * (n - w)))
        return u * scale, v * scale

    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Return (x sqrt(1 - h2), y sqrt(1 - h2), -c (1 - 2 h2)), h2 = sin(theta / 2)^2 = |(x, y)|^2 / (2 c)^2."""
        h2 = (x * x + y * y) / (4 * c * c)
        across = jnp.sqrt(1 - h2)
        return x * across, y * across, -c * (1 - 2 * h2)
