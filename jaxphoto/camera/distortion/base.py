"""Base class of lens distortions: one polynomial map between measured and ideal image coordinates.

Coordinates are reduced to the principal point, in millimetres or, for a `normalised` model, in units of the principal
distance. A model implements one direction in closed form and declares it by `domain`; `invert` computes the other
direction. Direction, sign and units of a distortion are therefore part of its type (docs/conventions.md);
`InteriorOrientation` converts from and to millimetres.
"""

import abc
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.camera.declared import Declared
from jaxphoto.camera.sensor import Sensor
from jaxphoto.errors import InputError
from jaxphoto.short_repr import pretty_repr

# Maximum number of Newton iterations; 4 to 8 suffice within the monotone range.
_STEPS = 50
# Number of points along the ray from the principal point at which the sign of the Jacobian determinant is checked.
_PROBES = 64


class Term(NamedTuple):
    """Coefficient of a model as a common term, `sign * coefficient * c^power` (see `AbstractDistortion.terms`)."""

    field: str
    sign: float = 1.0
    power: int = 0


def same_terms(*names: str) -> dict[str, Term]:
    """Return the terms of coefficients whose name, sign and unit equal the common term."""
    return {name: Term(name) for name in names}


def radial_powers(letter: str, n: int) -> dict[str, int]:
    """Return the units of the first `n` radial coefficients as powers of mm: k1 in mm^-2, k2 in mm^-4 ..."""
    return {f"{letter}{i}": -2 * i for i in range(1, n + 1)}


_Domain = Literal["measured", "ideal"]
Affinity = Literal["added", "before", "after", "around"]


@pretty_repr
class AbstractDistortion(Declared):
    """Base class of lens distortions; fields are scalars, `domain` declares the direction of the polynomial.

    `domain == "measured"`: `closed_form` maps measured to ideal coordinates (usual in photogrammetry). `domain ==
    "ideal"`: it maps ideal to measured coordinates, and residuals refer to measured coordinates. `normalised`:
    coordinates are divided by the principal distance (tangents of the field angle), as in computer vision; coefficients
    have no unit.

    The class is the only declaration of a model (docs/extending.md). `name`, `coefficients`, `constants` and `choices`:
    see `Declared`. `rare`: coefficients that most cameras do not need (affinity, rational and highest-order terms).
    `scales`: coefficients that change the image scale like the principal distance; they and c cannot both be free.

    `terms`: the coefficients as terms of one of the two polynomials of `camera.equivalence`, for exact conversions;
    None if the model is neither. `affinity`: order of the affinity; "added" to the other terms, in the same coordinate;
    applied separately "before" or "after" them; or one part before and one after ("around").
    """

    domain: eqx.AbstractClassVar[_Domain]
    rare: ClassVar[tuple[str, ...]] = ()
    scales: ClassVar[tuple[str, ...]] = ()
    normalised: ClassVar[bool] = False
    terms: ClassVar[Mapping[str, Term] | None] = None
    affinity: ClassVar[Affinity] = "after"

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        if "domain" in cls.__dict__ and cls.domain not in get_args(_Domain):
            raise InputError(f'{cls.__qualname__}: domain {cls.domain!r}; use "measured" or "ideal"')

    @classmethod
    def plain(cls, sensor: Sensor) -> "AbstractDistortion":
        """Return the model without distortion for a camera with the given sensor, which sets the required lengths."""
        return cls()

    @classmethod
    def power(cls, coefficient: str) -> int | None:
        """Return the unit of a coefficient as a power of mm; 0 for normalised coordinates."""
        return 0 if cls.normalised else super().power(coefficient)

    @classmethod
    def usual(cls) -> tuple[str, ...]:
        """Return the commonly needed coefficients: all except `rare` and `scales`."""
        return tuple(name for name in cls.coefficients if name not in (*cls.rare, *cls.scales))

    def check(self, xy: Float[np.ndarray, "points 2"]) -> None:
        """Raise InputError unless `closed_form` maps coordinates to coordinates, with a derivative on the optical axis.

        `xy` are points of the image format, in the model's unit: at none of them the result may be NaN or infinite.
        """
        axis = jnp.zeros(2)
        shape = jax.eval_shape(self.closed_form, axis).shape
        if shape != (2,):
            raise InputError(f"{type(self).__qualname__}.closed_form returns the shape {shape}; it must be (2,)")
        slope, mapped = jax.jit(lambda xy: (jax.jacfwd(self.closed_form)(axis), jax.vmap(self.closed_form)(xy)))(xy)
        if not np.isfinite(slope).all():
            raise InputError(
                f"{type(self).__qualname__}.closed_form has no derivative at (0, 0): replace the square root of "
                "x^2 + y^2 by powers of r^2"
            )
        valid = np.isfinite(mapped).all(axis=1)
        if not valid.all():
            x, y = xy[~valid][0]
            raise InputError(
                f"{type(self).__qualname__}.closed_form is NaN or infinite at ({x:.4g}, {y:.4g}), inside the image "
                "format: check its formula, its coefficients and their units"
            )

    @abc.abstractmethod
    def closed_form(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map one reduced coordinate in the closed-form direction, in the model's unit (mm unless `normalised`)."""

    def ideal_from_measured(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map the measured to the ideal coordinate, both reduced to the principal point, in the model's unit.

        Undefined where the model is not invertible; see the flag of `invert`.
        """
        return self.closed_form(xy) if self.domain == "measured" else invert(self, xy)[0]

    def measured_from_ideal(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Map the ideal to the measured coordinate, both reduced to the principal point, in the model's unit.

        Undefined where the model is not invertible; see the flag of `invert`.
        """
        return invert(self, xy)[0] if self.domain == "measured" else self.closed_form(xy)


def invert(distortion: AbstractDistortion, target: Float[Array, "2"]) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Return the coordinate that `closed_form` maps to `target`, and True if it lies in the monotone range.

    Uses Newton's method from the linear part of the map; differentiable to any order by the implicit function theorem.
    The second value is False if Newton's method does not converge or if the Jacobian determinant of the map changes
    sign between the principal point and the result; the first value is then undefined.
    """

    def error(xy: Float[Array, "2"]) -> Float[Array, "2"]:
        return distortion.closed_form(xy) - target

    def newton(fn, start):
        def unsettled(state):
            xy, step, k = state
            return (k < _STEPS) & (jnp.max(jnp.abs(step)) > 1e-14 * (1 + jnp.max(jnp.abs(xy))))

        def body(state):
            xy, _, k = state
            step = _solve_2x2(jax.jacfwd(fn)(xy), fn(xy))
            return xy - step, step, k + 1

        return jax.lax.while_loop(unsettled, body, (start, jnp.ones(2), 0))[0]

    def tangent(linear, b):
        return _solve_2x2(jax.jacfwd(linear)(jnp.zeros(2)), b)

    zero = jnp.zeros(2)
    start = _solve_2x2(jax.jacfwd(distortion.closed_form)(zero), target - distortion.closed_form(zero))
    xy = jax.lax.custom_root(error, jax.lax.stop_gradient(start), newton, tangent)
    return xy, _monotone(distortion, xy) & (jnp.max(jnp.abs(error(xy))) < 1e-9 * (1 + jnp.max(jnp.abs(target))))


def _monotone(distortion: AbstractDistortion, xy: Float[Array, "2"]) -> Bool[Array, ""]:
    """Return True if the Jacobian determinant keeps its sign along the ray from the principal point to `xy`."""

    def determinant(fraction):
        j = jax.jacfwd(distortion.closed_form)(fraction * xy)
        return j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]

    return jnp.all(jax.vmap(determinant)(jnp.linspace(0.0, 1.0, _PROBES)) > 0)


def _solve_2x2(a: Float[Array, "2 2"], b: Float[Array, "2"]) -> Float[Array, "2"]:
    determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return jnp.stack([a[1, 1] * b[0] - a[0, 1] * b[1], a[0, 0] * b[1] - a[1, 0] * b[0]]) / determinant


def radial(r2: Float[Array, ""], *k) -> Float[Array, ""]:
    """Return K1 r^2 + K2 r^4 + K3 r^6 + ... for the squared radius r^2 and any number of coefficients."""
    if not k:
        return jnp.zeros_like(r2)
    first, *higher = k
    return r2 * (first + radial(r2, *higher)) if higher else r2 * first


def decentring(p1, p2, xy: Float[Array, "2"] | tuple[Array, Array]) -> Float[Array, "2"]:
    """Return the decentring distortion P1 (r^2 + 2 x^2) + 2 P2 x y, 2 P1 x y + P2 (r^2 + 2 y^2)."""
    x, y = xy
    r2, along = x * x + y * y, 2 * (p1 * x + p2 * y)
    return jnp.stack([p1 * r2 + along * x, p2 * r2 + along * y])


def check_positive(distortion: AbstractDistortion, field: str, meaning: str) -> None:
    """Raise ValueError if the constant `field` of a model is not positive; traced values are not checked."""
    value = getattr(distortion, field)
    if not isinstance(value, jax.core.Tracer) and not value > 0:
        raise ValueError(f"{field} of {type(distortion).__name__}, {meaning}, must be positive (mm), got {value}")


class AbstractBrown(AbstractDistortion):
    """Radial K1-K3, decentring P1, P2, affinity b1 and shear b2: functions of the measured coordinate, subtracted.

    Its subclasses differ in the order of affinity and shear.
    """

    k1: Float[Array, ""] | float = 0.0
    k2: Float[Array, ""] | float = 0.0
    k3: Float[Array, ""] | float = 0.0
    p1: Float[Array, ""] | float = 0.0
    p2: Float[Array, ""] | float = 0.0
    b1: Float[Array, ""] | float = 0.0
    b2: Float[Array, ""] | float = 0.0

    domain: ClassVar[Literal["measured", "ideal"]] = "measured"
    coefficients: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
    powers: ClassVar[Mapping[str, int]] = {**radial_powers("k", 3), "p1": -1, "p2": -1, "b1": 0, "b2": 0}
    rare: ClassVar[tuple[str, ...]] = ("b1", "b2")
    terms: ClassVar[Mapping[str, Term] | None] = same_terms(*coefficients)

    def undistorted(self, xy: Float[Array, "2"]) -> Float[Array, "2"]:
        """Remove radial and decentring distortion from a coordinate (mm)."""
        # Combine `decentring` and `radial` by their common factor, because every program contains them several times.
        x, y = xy
        r2 = x * x + y * y
        left = 1 - radial(r2, self.k1, self.k2, self.k3) - 2 * (self.p1 * x + self.p2 * y)
        return jnp.stack([left * x - self.p1 * r2, left * y - self.p2 * r2])
