"""What every projection is: a map from directions in the camera's frame to the ideal image, and back.

A camera looks along -w of its frame (u right, v up, w out of its back; docs/conventions.md); theta is the angle of a
direction from that axis. A projection that is symmetric about the axis is a function of it,

    (x, y) = c f(theta) (u, v) / |(u, v)|,    f(theta) = theta + ...

so that c is the scale in the middle of the image, in mm per radian, whatever the projection. Distortions act in this
ideal image plane, principal points lie in it: neither knows what projection it is of.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxphoto.camera.declared import Declared
from jaxphoto.short_repr import shown

Component = Any
"""One component of a direction or an image coordinate: a number, or NumPy's or JAX's array of many places at once."""


@shown
class AbstractProjection(Declared):
    """A projection; what it is called and made of is declared as in `Declared`. Most have no parameters at all.

    Both maps are written by component, without a vector in between, and can be differentiated everywhere they mean
    something, on the axis too.
    """

    widest_deg: eqx.AbstractClassVar[float]
    """Directions farther from the axis than this have no image, whatever the format."""
    coefficients: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Ideal image coordinate (mm, from the principal point) of a direction, or point, (u, v, w) of any length.

        Where `sees` is False the value is meaningless.
        """

    @abc.abstractmethod
    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """The direction (u, v, w), of any length, that has this ideal image coordinate (mm); NaN where none has."""

    def sees(self, u: Component, v: Component, w: Component) -> Any:
        """Whether a direction (u, v, w) of any length has an image."""
        if self.widest_deg == 90.0:
            return w < 0
        return -w > jnp.cos(jnp.deg2rad(self.widest_deg)) * jnp.sqrt(u * u + v * v + w * w)
