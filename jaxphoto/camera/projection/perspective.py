"""Perspective projection, on which collinearity is based."""

from typing import ClassVar

from jaxphoto.camera.projection.base import AbstractProjection, Component


class Perspective(AbstractProjection):
    """f = tan theta: x = -c u / w, y = -c v / w. Straight lines remain straight; 90 degrees is at infinity."""

    name: ClassVar[str] = "perspective"
    widest_deg: ClassVar[float] = 90.0

    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Return x = -c u / w, y = -c v / w."""
        scale = -c / w
        return u * scale, v * scale

    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Return (x, y, -c)."""
        return x, y, -c
