"""Atmospheric refraction and earth curvature as displacements of the object point, for any tilt of the camera.

For a vertical image both are, to first order, the textbook's radial image displacements (docs/conventions.md). A block
enables them; curvature applies only to map-grid coordinates.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.short_repr import pretty_repr

EARTH_RADIUS_M = 6_371_000.0


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Corrections:
    """Enabled corrections. `sea_level_m` is the Z of the sea: refraction needs heights above it."""

    refraction: bool = False
    curvature: bool = False
    sea_level_m: float = 0.0


NO_CORRECTIONS = Corrections()


def apparent_point(
    position: Float[Array, "3 *many"], point: Float[Array, "3 *many"], corrections: Corrections
) -> Float[Array, "3 *many"]:
    """Return the point at which a straight ray must aim to meet the image of `point` (m); of many with a last axis.

    Curvature lowers the point by d^2 / 2R, with d its horizontal distance. Refraction rotates the ray outward by K
    tan(a), a its angle from the nadir: the point moves by K d (1 + tan(a)^2).
    """
    if not (corrections.refraction or corrections.curvature):
        return point
    east, north, up = point - position
    square = east * east + north * north
    if corrections.curvature:
        up = up - square / (2 * EARTH_RADIUS_M)
    if corrections.refraction:
        k = refraction_constant(position[2] - corrections.sea_level_m, point[2] - corrections.sea_level_m)
        stretch = 1 + k * (1 + square / (up * up))
        east, north = east * stretch, north * stretch
    return position + jnp.stack([east, north, up])


def refraction_constant(
    camera_height: Float[Array, "*many"], point_height: Float[Array, "*many"]
) -> Float[Array, "*many"]:
    """Return K (rad) of the standard atmosphere for heights above the sea in m: the image moves by K r (1 + r^2/c^2).

    K = 0.00241 [Z0 / (Z0^2 - 6 Z0 + 250) - Z^2 / (Z0 (Z^2 - 6 Z + 250))] heights in km
    """
    z0, z = camera_height / 1000, point_height / 1000
    return 0.00241 * (z0 / (z0 * z0 - 6 * z0 + 250) - z * z / (z0 * (z * z - 6 * z + 250)))
