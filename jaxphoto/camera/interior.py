"""Interior orientation: principal distance, principal point and a distortion."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.camera.distortion import AbstractDistortion, Brown, invert


class InteriorOrientation(eqx.Module):
    """Principal distance c > 0, principal point (x_p, y_p) and distortion, all in mm on the image.

    `ideal = distortion.ideal_from_measured(measured - (x_p, y_p))`; for a `normalised` distortion both are divided by c
    (docs/conventions.md).

    `residuals` says in which image an adjustment measures its residuals: that of the model, where the distortion has a
    closed form, or always the measured one, whose noise it is. They differ where a wide-angle lens stretches the image.
    """

    c: Float[Array, ""] | float
    x_p: Float[Array, ""] | float = 0.0
    y_p: Float[Array, ""] | float = 0.0
    distortion: AbstractDistortion = dataclasses.field(default_factory=Brown)
    residuals: Literal["model", "measured"] = eqx.field(static=True, default="model")

    def ideal_from_measured(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Ideal image coordinate (mm, from the principal point) of a measured one (mm, from the centre)."""
        return self._in_mm(self.distortion.ideal_from_measured, xy - self.principal_point)

    def measured_from_ideal(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Measured image coordinate (mm, from the centre) of an ideal one (mm, from the principal point)."""
        return self._in_mm(self.distortion.measured_from_ideal, xy) + self.principal_point

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """The distortion's own direction (see its `domain`), of one coordinate in mm from the principal point."""
        return self._in_mm(self.distortion.closed_form, xy)

    def valid(self, xy: Float[Array, "2"]) -> Bool[Array, ""]:
        """Whether the ideal coordinate `xy` lies in the range in which the distortion can be inverted."""
        if self.distortion.domain == "ideal":
            return jnp.array(True)
        return invert(self.distortion, xy / self.c if self.distortion.normalised else xy)[1]

    @property
    def principal_point(self) -> Float[Array, "2"]:
        """(x_p, y_p) in mm."""
        return jnp.stack([jnp.asarray(self.x_p), jnp.asarray(self.y_p)])

    def _in_mm(self, of_model: Callable, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """A map of the distortion, which has a unit of its own, as one of millimetres."""
        if not self.distortion.normalised:
            return of_model(xy)
        x, y = of_model(jnp.stack([xy[0] / self.c, xy[1] / self.c]))
        return jnp.stack([self.c * x, self.c * y])


def parameter_names(interior: InteriorOrientation) -> tuple[str, ...]:
    """The estimable parameters in the order of the model: c_mm, xp_mm, yp_mm and the coefficients.

    These are the names of `block.toml` and of every table (docs/block_folder.md).
    """
    return ("c_mm", "xp_mm", "yp_mm", *interior.distortion.coefficients)


def get_parameter(interior: InteriorOrientation, name: str):
    """The value (or, in a tree of priors, the prior) that `name` of `parameter_names` stands for."""
    return getattr(*_place(interior, name))


def set_parameter(interior: InteriorOrientation, name: str, value) -> InteriorOrientation:
    """A copy of `interior` in which the parameter `name` is `value`."""

    def where(tree):
        return getattr(*_place(tree, name))

    return eqx.tree_at(where, interior, value)


_FIELDS = {"c_mm": "c", "xp_mm": "x_p", "yp_mm": "y_p"}
_CONSTANTS = {"r0_mm": "r0", "b_mm": "b", "f_mm": "f"}


def constant_names(distortion: type[AbstractDistortion]) -> dict[str, str]:
    """The constants of a model: name in a file -> field (`r0_mm` -> `r0`)."""
    fields = {f.name for f in dataclasses.fields(distortion)}
    return {name: field for name, field in _CONSTANTS.items() if field in fields}


def needed_constants(distortion: type[AbstractDistortion]) -> dict[str, str]:
    """Those of `constant_names` that have no default: positive lengths without which the model says nothing."""
    needed = {f.name for f in dataclasses.fields(distortion) if f.default is dataclasses.MISSING}
    return {name: field for name, field in constant_names(distortion).items() if field in needed}


def _place(interior: InteriorOrientation, name: str) -> tuple[object, str]:
    if name in _FIELDS:
        return interior, _FIELDS[name]
    return interior.distortion, _CONSTANTS.get(name, name)
