"""Distortion models that are the same polynomial in other names, signs, units or scale: exact conversions, usual terms.

Most models are one of two polynomials, D being Brown's decentring and (x, y) with y up:

    measured    ideal = x - x q - t D(P1, P2) - affinity(b1, b2),             x measured, in mm
    ideal       measured = c (p + p q + t D(P1, P2) + affinity(b1, b2)),      p = ideal / c

with q = K1 r^2 + K2 r^4 + ... and t = 1 + P3 r^2 + P4 r^4. A camera of one of them converts exactly to every model of
the same direction that has the terms it needs, whatever its R0.
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxphoto.camera.balance import rebalance
from jaxphoto.camera.distortion import (
    AbstractDistortion,
    AffineBrown,
    Agisoft,
    Balanced,
    Brown,
    BundlerRadial,
    Gruen,
    OpenCv,
    PpsRadial,
    RadialPolynomial,
    Smac,
)
from jaxphoto.camera.interior import InteriorOrientation


def exact(interior: InteriorOrientation, target: type[AbstractDistortion]) -> InteriorOrientation | None:
    """The same bundle of rays with the model `target` (SMAC: subtracted; R0 = 0), None where no exact one is known."""
    d = interior.distortion
    if type(d) is target:
        return interior
    if target not in _TERMS or type(d) not in _TERMS or (isinstance(d, PpsRadial) and np.any(d.symmetry_point != 0)):
        return None
    c, terms = _common(interior)
    affine = {"b1", "b2"} & set(terms)
    mixed = bool(affine) and len(terms) > len(affine)
    if terms and (
        d.domain != target.domain
        or not set(terms) <= set(_TERMS[target])
        or (mixed and (type(d) in _AFFINITY_ADDED) != (target in _AFFINITY_ADDED))
    ):
        return None
    own = dict.fromkeys(target.coefficients, 0.0)
    for name, value in terms.items():
        term = _TERMS[target][name]
        own[term.field] = value * term.sign / c**term.power
    distortion = target(**{name: jnp.asarray(value) for name, value in own.items()})
    return InteriorOrientation(jnp.asarray(c), interior.x_p, interior.y_p, distortion, interior.residuals)


def usual_coefficients(distortion: type[AbstractDistortion]) -> tuple[str, ...]:
    """The coefficients of a model that most cameras need: without affinity, rational and highest terms, and scales."""
    rare = (*_RARE.get(distortion, ()), *distortion.scales)
    return tuple(name for name in distortion.coefficients if name not in rare)


def with_sign(interior: InteriorOrientation, sign: Literal["subtract", "add"]) -> InteriorOrientation:
    """The same camera with a SMAC that is subtracted, as in paper 002, or added, as in reports of the USGS.

    K0 to K4, P1 and P2 change their sign. Raises ValueError for a distortion other than SMAC.
    """
    d = interior.distortion
    if not isinstance(d, Smac):
        raise ValueError(f"only SMAC can be added or subtracted, this camera has {type(d).__name__}")
    if d.sign == sign:
        return interior
    turned = {name: -jnp.asarray(getattr(d, name)) for name in ("k0", "k1", "k2", "k3", "k4", "p1", "p2")}
    smac = Smac(**turned, p3=d.p3, p4=d.p4, r0=d.r0, sign=sign)
    return InteriorOrientation(interior.c, interior.x_p, interior.y_p, smac, interior.residuals)


class _Term(NamedTuple):
    """A coefficient of a model: the common term is `sign * coefficient * c^power`."""

    field: str
    sign: float = 1.0
    power: int = 0


def _same(*names: str) -> dict[str, _Term]:
    return {name: _Term(name) for name in names}


_RADIAL = _same("k1", "k2", "k3")
# OpenCV's and Agisoft's y runs down: what is odd in y changes its sign.
_TERMS: dict[type[AbstractDistortion], dict[str, _Term]] = {
    Brown: _same(*Brown.coefficients),
    AffineBrown: _same(*AffineBrown.coefficients),
    Smac: _same("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"),
    RadialPolynomial: {name: _Term(name, -1.0) for name in _RADIAL},
    PpsRadial: _RADIAL,
    BundlerRadial: _same("k1", "k2"),
    Balanced: {
        **{f"k{i}": _Term(f"a{i}", 1.0, 2 * i) for i in (1, 2, 3)},
        **{f"p{i}": _Term(f"b{i}", 1.0, 1) for i in (1, 2)},
        **{f"b{i}": _Term(f"c{i}") for i in (1, 2)},
    },
    OpenCv: {
        **_RADIAL,
        **{f"q{i}": _Term(f"k{i + 3}") for i in (1, 2, 3)},
        **{"p1": _Term("p2"), "p2": _Term("p1", -1.0), "b1": _Term("b1"), "b2": _Term("b2", -1.0)},
    },
    Agisoft: {
        **_same("k1", "k2", "k3", "k4", "p1", "p3", "p4", "b1"),
        **{"p2": _Term("p2", -1.0), "b2": _Term("b2", -1.0)},
    },
}
"""The models that are one of the two polynomials of this module: its terms as their coefficients."""

# What a model has beyond the terms that most cameras need; scales (K0) stand beside c and are never fitted.
_RARE: dict[type[AbstractDistortion], tuple[str, ...]] = {
    OpenCv: ("k4", "k5", "k6", "b1", "b2"),
    Agisoft: ("k4", "p3", "p4", "b1", "b2"),
    Brown: ("b1", "b2"),
    AffineBrown: ("b1", "b2"),
    Balanced: ("c1", "c2"),
    Smac: ("k4", "p3", "p4"),
    # Up to the third degree: with all 44, neighbouring targets would be fitted one by one.
    Gruen: tuple(name for name in Gruen.coefficients if int(name[1]) + int(name[2]) - 2 > 3),
}

_AFFINITY_ADDED = (Brown, Balanced)
"""Models whose affinity acts on the coordinate that the other terms see; in the others it acts before or after them."""


def _common(interior: InteriorOrientation) -> tuple[float, dict[str, float]]:
    """c and the terms other than 0 of one of the two polynomials."""
    scale = 1.0
    if isinstance(interior.distortion, Smac):
        interior = with_sign(rebalance(interior, 0.0), "subtract")
    d, c = interior.distortion, float(interior.c)
    if isinstance(d, Balanced):
        scale = 1.0 - sum(float(a) * float(d.r0) ** (2 * i) for i, a in enumerate((d.a1, d.a2, d.a3), start=1))
    terms = {n: t.sign * float(getattr(d, t.field)) * c**t.power / scale for n, t in _TERMS[type(d)].items()}
    return c * scale, {name: value for name, value in terms.items() if value != 0}
