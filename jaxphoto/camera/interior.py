"""Interior orientation: principal distance, principal point, projection and distortion."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.argument_checks import single
from jaxphoto.camera.declared import Declared
from jaxphoto.camera.distortion import AbstractDistortion, Brown, invert
from jaxphoto.camera.projection import AbstractProjection, Perspective
from jaxphoto.camera.rolling_shutter import RowMotion
from jaxphoto.errors import InputError
from jaxphoto.parameters import unit_of
from jaxphoto.short_repr import html_of, number_word

Part = TypeVar("Part", bound=Declared)


class InteriorOrientation(eqx.Module):
    """Principal distance c > 0, principal point (x_p, y_p) and distortion, all in mm on the image, and projection.

    `projection` maps directions in the camera frame to the ideal image and back; perspective by default. `ideal =
    distortion.ideal_from_measured(measured - (x_p, y_p))`; for a `normalised` distortion both are divided by c
    (docs/conventions.md).

    `residuals` selects the image to which residuals refer: "measured", which contains the noise, or "model", the image
    in which the distortion has a closed form. The two differ where the distortion stretches the image.
    """

    c: Float[Array, ""] | float
    xp: Float[Array, ""] | float = 0.0
    yp: Float[Array, ""] | float = 0.0
    distortion: AbstractDistortion = dataclasses.field(default_factory=Brown)
    residuals: Literal["model", "measured"] = eqx.field(static=True, default="measured")
    projection: AbstractProjection = dataclasses.field(default_factory=Perspective)
    rows: RowMotion | None = None
    """Motion of the camera during the exposure of the rows; only set within an adjustment with `RollingShutter`."""

    def __check_init__(self) -> None:
        if both := set(self.projection.coefficients) & set(self.distortion.coefficients):
            raise InputError(
                f"{', '.join(sorted(both))} is a coefficient of both the projection {self.projection.name} and the "
                f"distortion {self.distortion.name}: rename it in one of them"
            )

    def ideal_from_measured(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Convert a measured (mm, from the centre) to an ideal image coordinate (mm, from the principal point)."""
        return self._in_mm(self.distortion.ideal_from_measured, single("xy", xy, 2) - self.principal_point)

    def measured_from_ideal(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Convert an ideal (mm, from the principal point) to a measured image coordinate (mm, from the centre)."""
        return self._in_mm(self.distortion.measured_from_ideal, single("xy", xy, 2)) + self.principal_point

    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Apply the distortion in its closed-form direction (`domain`) to a coordinate (mm, reduced to x_p, y_p)."""
        return self._in_mm(self.distortion.closed_form, xy)

    def valid(self, xy: Float[Array, "2"]) -> Bool[Array, ""]:
        """Return True if the distortion is invertible at the ideal coordinate `xy`."""
        if self.distortion.domain == "ideal":
            return jnp.array(True)
        return invert(self.distortion, xy / self.c if self.distortion.normalised else xy)[1]

    def invertible(self, xy: Float[Array, "2"]) -> Bool[Array, ""]:
        """Return `valid`, also for distortions of the ideal coordinate: they are not invertible far off the axis."""
        if self.distortion.domain == "measured":
            return self.valid(xy)
        there = xy / self.c if self.distortion.normalised else xy
        back, sure = invert(self.distortion, self.distortion.closed_form(there))
        return sure & (jnp.abs(back - there).max() < 1e-9 * (1 + jnp.abs(there).max()))

    def direction_from_ideal(self, xy: Float[Array, "2"]) -> tuple[Array, Array, Array]:
        """Convert an ideal coordinate (mm) to a direction (u, v, w) of arbitrary length in the camera frame."""
        u, v, w = self.projection.direction_from_ideal(jnp.asarray(self.c, xy.dtype), xy[0], xy[1])
        return u, v, w

    def ideal_from_direction(self, u: Array, v: Array, w: Array) -> Float[Array, "2"]:
        """Convert a direction or point in the camera frame to the ideal coordinate (mm, from the principal point)."""
        return jnp.stack(self.projection.ideal_from_direction(self.c, u, v, w))

    @property
    def _words(self) -> dict[str, str]:
        numbers = (*parameter_names(self), *constant_names(self))
        return model_keys(self) | {name: number_word(get_parameter(self, name)) for name in numbers}

    def __repr__(self) -> str:
        return f"InteriorOrientation({', '.join(f'{name} {word}' for name, word in self._words.items())})"

    def _repr_html_(self) -> str:
        return html_of("InteriorOrientation", self._words)

    @property
    def principal_point(self) -> Float[Array, "2"]:
        """Return (x_p, y_p) in mm."""
        return jnp.stack([jnp.asarray(self.xp), jnp.asarray(self.yp)])

    def _in_mm(self, of_model: Callable, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Convert a mapping of the distortion from its own unit to millimetres."""
        if not self.distortion.normalised:
            return of_model(xy)
        x, y = of_model(jnp.stack([xy[0] / self.c, xy[1] / self.c]))
        return jnp.stack([self.c * x, self.c * y])


def parameter_names(interior: InteriorOrientation) -> tuple[str, ...]:
    """Return the names of the estimable parameters in the order of the model: c_mm, xp_mm, yp_mm and the coefficients.

    `block.toml` and all tables use these names (docs/block_folder.md).
    """
    return (*_FIELDS, *interior.distortion.coefficients, *interior.projection.coefficients)


def constant_names(interior: InteriorOrientation) -> tuple[str, ...]:
    """Return the names of the constants of its models, as in files (`r0_mm`)."""
    return (*interior.distortion.constants, *interior.projection.constants)


def parameter_unit(interior: InteriorOrientation, name: str) -> str:
    """Return the unit of a parameter or constant: mm, 1/mm^2; "1" if dimensionless, "" if unknown."""
    for part in (interior.distortion, interior.projection):
        if name in part.coefficients:
            power = part.power(name)
            return "" if power is None else power_of_mm(power)
    return unit_of(name)


def power_of_mm(power: int) -> str:
    """Format a power of mm: mm, 1, 1/mm, 1/mm^2 ..."""
    words = {1: "mm", 0: "1", -1: "1/mm"}
    return words.get(power, f"1/mm^{-power}" if power < 0 else f"mm^{power}")


def model_keys(interior: InteriorOrientation) -> dict[str, str]:
    """Return the keys of the models of a camera in files: distortion, projection (if not perspective), choices."""
    keys = {"distortion": interior.distortion.name}
    if type(interior.projection) is not Perspective:
        keys["projection"] = interior.projection.name
    return keys | {
        key: getattr(part, key) for part in (interior.distortion, interior.projection) for key in part.choices
    }


def empty_camera(told: Mapping[str, Any], constant: float = 1.0) -> InteriorOrientation:
    """Return a camera with the models in `model_keys`, zero parameters, and all constants equal to `constant`.

    Raises InputError for unknown models, KeyError if the distortion is missing.
    """
    distortion = _empty(AbstractDistortion.called(told["distortion"]), told, constant)
    projection = _empty(AbstractProjection.called(told.get("projection", Perspective.name)), told, constant)
    return InteriorOrientation(1.0, 0.0, 0.0, distortion, projection=projection)


def _empty(kind: type[Part], told: Mapping[str, Any], constant: float) -> Part:
    chosen = {key: told[key] for key in kind.choices if key in told}
    return kind(**dict.fromkeys(kind.constants.values(), constant), **chosen)


def get_parameter(interior: InteriorOrientation, name: str):
    """Return the value (or, in a tree of priors, the prior) of the parameter or constant `name`.

    Raises InputError for a name that the camera does not have.
    """
    return getattr(*_place(interior, name))


def set_parameter(interior: InteriorOrientation, name: str, value) -> InteriorOrientation:
    """Return a copy of `interior` with the parameter `name` set to `value`. Raises InputError for an unknown name."""

    def where(tree):
        return getattr(*_place(tree, name))

    return eqx.tree_at(where, interior, value)


_FIELDS = {"c_mm": "c", "xp_mm": "xp", "yp_mm": "yp"}
_TABLE_NAMES = {field: name for name, field in _FIELDS.items()} | {"x_p": "xp_mm", "y_p": "yp_mm"}


def table_name(name: str) -> str:
    """Return the name of a parameter in files and tables: c_mm for c, xp_mm for xp; other names are unchanged.

    Also accepts a path, such as `interior[kodak].c`.
    """
    path, dot, last = name.rpartition("].")
    return path + dot + _TABLE_NAMES.get(last, last)


def _place(interior: InteriorOrientation, name: str) -> tuple[object, str]:
    name = table_name(name)
    if name in _FIELDS:
        return interior, _FIELDS[name]
    for part in (interior.distortion, interior.projection):
        if name in part.coefficients:
            return part, name
        if name in part.constants:
            return part, part.constants[name]
    known = ", ".join((*parameter_names(interior), *constant_names(interior)))
    raise InputError(
        f"a camera with the distortion {interior.distortion.name} has no parameter {name!r}; it has {known}"
    )
