"""Exact conversions between distortion models that are the same polynomial with different names, signs, units or scale.

Most models are one of two polynomials (D: Brown's decentring distortion, y up):

    measured    ideal = x - x q - t D(P1, P2) - affinity(b1, b2),             x measured, in mm
    ideal       measured = c (p + p q + t D(P1, P2) + affinity(b1, b2)),      p = ideal / c

with q = K1 r^2 + K2 r^4 + ... and t = 1 + P3 r^2 + P4 r^4. A camera with one of these models converts exactly to every
model of the same direction that has the required terms, for any R0. Each model declares its terms
(`AbstractDistortion.terms`).
"""

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxphoto.camera.distortion import AbstractDistortion, Balanced, PpsRadial, Smac
from jaxphoto.camera.interior import InteriorOrientation
from jaxphoto.camera.smac_balance_radius import rebalance


def exact(interior: InteriorOrientation, target: type[AbstractDistortion]) -> InteriorOrientation | None:
    """Convert to the model `target` with the same rays (SMAC: subtracted; R0 = 0); None if not exactly possible."""
    d = interior.distortion
    if type(d) is target:
        return interior
    if target.terms is None or d.terms is None or (isinstance(d, PpsRadial) and np.any(d.symmetry_point != 0)):
        return None
    c, terms = _common(interior)
    affine = {"b1", "b2"} & set(terms)
    mixed = bool(affine) and len(terms) > len(affine)
    if terms and (
        d.domain != target.domain or not set(terms) <= set(target.terms) or (mixed and d.affinity != target.affinity)
    ):
        return None
    own = dict.fromkeys(target.coefficients, 0.0)
    for name, value in terms.items():
        term = target.terms[name]
        own[term.field] = value * term.sign / c**term.power
    distortion = target(**{name: jnp.asarray(value) for name, value in own.items()})
    return dataclasses.replace(interior, c=jnp.asarray(c), distortion=distortion)


def with_sign(interior: InteriorOrientation, sign: Literal["subtract", "add"]) -> InteriorOrientation:
    """Convert SMAC to the sign "subtract" (paper 002) or "add" (reports of the USGS).

    K0 to K4, P1 and P2 change sign. Raises ValueError for a distortion other than SMAC.
    """
    d = interior.distortion
    if not isinstance(d, Smac):
        raise ValueError(f"only SMAC has a sign; this camera has {type(d).__name__}")
    if d.sign == sign:
        return interior
    turned = {name: -jnp.asarray(getattr(d, name)) for name in ("k0", "k1", "k2", "k3", "k4", "p1", "p2")}
    smac = Smac(**turned, p3=d.p3, p4=d.p4, r0=d.r0, sign=sign)
    return dataclasses.replace(interior, distortion=smac)


def _common(interior: InteriorOrientation) -> tuple[float, dict[str, float]]:
    """Return c and the nonzero terms of one of the two polynomials."""
    scale = 1.0
    if isinstance(interior.distortion, Smac):
        interior = with_sign(rebalance(interior, 0.0), "subtract")
    d, c = interior.distortion, float(interior.c)
    if isinstance(d, Balanced):
        scale = 1.0 - sum(float(a) * float(d.r0) ** (2 * i) for i, a in enumerate((d.a1, d.a2, d.a3), start=1))
    own = d.terms or {}
    terms = {n: t.sign * float(getattr(d, t.field)) * c**t.power / scale for n, t in own.items()}
    return c * scale, {name: value for name, value in terms.items() if value != 0}
