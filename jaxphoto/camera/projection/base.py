"""Base class of projections: mappings between directions in the camera frame and the ideal image.

A camera looks along -w of its frame (u right, v up, w out of its back; docs/conventions.md); theta is the angle of a
direction from that axis. A projection that is symmetric about the axis is

    (x, y) = c f(theta) (u, v) / |(u, v)|,    f(theta) = theta + ...

c is therefore the scale at the image centre, in mm per radian, for every projection. Distortions and principal points
refer to this ideal image plane and do not depend on the projection.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from jaxphoto.camera.declared import Declared
from jaxphoto.short_repr import pretty_repr

Component = Any
"""Component of a direction or an image coordinate: a scalar, or a NumPy or JAX array."""


@pretty_repr
class AbstractProjection(Declared):
    """Base class of projections, declared as in `Declared`; most projections have no parameters.

    Both mappings act on components and are differentiable wherever they are defined, including on the axis.
    """

    widest_deg: eqx.AbstractClassVar[float]
    """Maximum angle from the axis (degrees): directions beyond it have no image, for any format."""
    coefficients: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def ideal_from_direction(self, c, u: Component, v: Component, w: Component) -> tuple[Component, Component]:
        """Convert a direction or point (u, v, w) to the ideal image coordinate (mm, from the principal point).

        The value is meaningless where `sees` is False.
        """

    @abc.abstractmethod
    def direction_from_ideal(self, c, x: Component, y: Component) -> tuple[Component, Component, Component]:
        """Convert an ideal image coordinate (mm) to a direction (u, v, w) of arbitrary length; NaN if there is none."""

    def sees(self, u: Component, v: Component, w: Component) -> Any:
        """Return True if a direction (u, v, w) of any length has an image."""
        if self.widest_deg == 90.0:
            return w < 0
        return -w > jnp.cos(jnp.deg2rad(self.widest_deg)) * jnp.sqrt(u * u + v * v + w * w)
