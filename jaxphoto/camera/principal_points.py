"""Principal points of autocollimation (PPA) and of symmetry (PPS), and their equivalence to decentring distortion.

The PPA is the foot of the perpendicular from the projection centre, (x_p, y_p) of every camera in jaxphoto. The PPS is
the centre of the radial distortion, with coordinates S relative to the PPA. With delta_i(x) = x |x|^2i, to first order
in S,

    sum Ki delta_i(x - S) = sum Ki delta_i(x) - K1 (S r^2 + 2 x (x.S)) - K2 r^2 (S r^2 + 4 x (x.S)) - ...

The K1 term is decentring distortion with P = -K1 S, so both models describe the same lens to this order. The terms of
K2, K3 and S^2 do not have this form. Conversions neglect them; `conversion_error` computes their size. Source:
docs/models.md (derivation); paper 003, section 2.4 (the two points).
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera.distortion import Brown, PpsRadial
from jaxphoto.camera.interior import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.camera.sensor import Sensor
from jaxphoto.least_squares import least_squares
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr

# Number of image points along each side of the format, corners included, at which two cameras are compared.
_SIDE = 25


@pretty_repr
class PrincipalPoints(NamedTuple):
    """Both principal points, in mm from the image centre."""

    autocollimation: Float[Array, "2"]
    symmetry: Float[Array, "2"]


@pretty_repr
class ConversionError(NamedTuple):
    """Difference between two cameras: maximum and RMS image displacement over the format, in mm.

    `interior` is the second camera, after the fit if any.
    """

    largest_mm: Float[Array, ""]
    rms_mm: Float[Array, ""]
    interior: InteriorOrientation


def principal_points(interior: InteriorOrientation) -> PrincipalPoints:
    """Return PPA and PPS of a camera with `PpsRadial` (exact) or `Brown` (to first order: S = -P / K1).

    Raises ValueError for other distortions, and an Equinox error for decentring distortion with K1 = 0, which has no
    PPS.
    """
    ppa = interior.principal_point
    d = interior.distortion
    if isinstance(d, PpsRadial):
        return PrincipalPoints(ppa, ppa + d.symmetry_point)
    return PrincipalPoints(ppa, ppa + _symmetry_point(_checked(interior, Brown)))


def symmetry_from_decentring(interior: InteriorOrientation) -> InteriorOrientation:
    """Convert `Brown` to `PpsRadial`: S = -P / K1; c, the PPA and K1 to K3 are unchanged.

    First order in S. Neglects the K2 term -K2 r^2 (S r^2 + 4 x (x.S)), the K3 term, and all terms of order S^2;
    `conversion_error` computes their size. Raises ValueError for a distortion other than Brown, and an Equinox error
    for decentring distortion with K1 = 0 and for affinity or shear, which `PpsRadial` does not have.
    """
    d = _checked(interior, Brown)
    s = _symmetry_point(d)
    affine = (jnp.asarray(d.b1) != 0) | (jnp.asarray(d.b2) != 0)
    s = eqx.error_if(s, affine, "PpsRadial has no affinity and shear: convert a Brown whose b1 and b2 are 0")
    return _with_distortion(interior, PpsRadial(k1=d.k1, k2=d.k2, k3=d.k3, pps_x=s[0], pps_y=s[1]))


def decentring_from_symmetry(interior: InteriorOrientation) -> InteriorOrientation:
    """Convert `PpsRadial` to `Brown`: P = -K1 S; c, the PPA and K1 to K3 are unchanged.

    Inverse of `symmetry_from_decentring`; neglects the same terms. Raises ValueError for a distortion other than
    PpsRadial.
    """
    d = _checked(interior, PpsRadial)
    p1, p2 = -d.k1 * d.symmetry_point
    return _with_distortion(interior, Brown(k1=d.k1, k2=d.k2, k3=d.k3, p1=p1, p2=p2))


def conversion_error(
    before: InteriorOrientation, after: InteriorOrientation, sensor: Sensor, refit: bool = False
) -> ConversionError:
    """Return the maximum and RMS displacement between the ideal coordinates of two cameras for the same image points.

    Uses 25 x 25 points of the format, corners included, at the scale of `before.c`. With `refit`, c, x_p, y_p, all
    coefficients of `after` and a small rotation of the camera are first fitted to `before` by least squares; the
    remaining displacement cannot be absorbed by self-calibration with the model of `after`.
    """
    x, y = (np.linspace(-0.5, 0.5, _SIDE) * side for side in (sensor.width_mm, sensor.height_mm))
    points = jnp.asarray(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    wanted = jax.vmap(before.ideal_from_measured)(points)
    names = parameter_names(after)

    def camera(parameters) -> InteriorOrientation:
        tree = after
        for name, value in zip(names, parameters, strict=True):
            tree = set_parameter(tree, name, value)
        return tree

    def displacement(unknowns):
        theta, interior = unknowns[:3], camera(unknowns[3:])
        rays = jax.vmap(lambda xy: jnp.stack(interior.direction_from_ideal(interior.ideal_from_measured(xy))))(points)
        turned = rays @ small_rotation(theta).T
        return (jax.vmap(before.ideal_from_direction)(*turned.T) - wanted).ravel()

    unknowns = jnp.stack([*jnp.zeros(3), *(jnp.asarray(get_parameter(after, name), float) for name in names)])
    if refit:
        unknowns = least_squares(lambda u, _: displacement(u), unknowns, damping=1e-6).unknowns
    moved = jnp.linalg.norm(displacement(unknowns).reshape(-1, 2), axis=1)
    return ConversionError(jnp.max(moved), jnp.sqrt(jnp.mean(moved**2)), camera(unknowns[3:]))


def _symmetry_point(d: Brown) -> Float[Array, "2"]:
    k1, p = jnp.asarray(d.k1, float), jnp.stack([jnp.asarray(d.p1, float), jnp.asarray(d.p2, float)])
    nowhere = (k1 == 0) & jnp.any(p != 0)
    p = eqx.error_if(p, nowhere, "decentring without K1 has no principal point of symmetry: estimate or give K1")
    return -p / jnp.where(k1 == 0, 1.0, k1)


def _checked(interior: InteriorOrientation, kind):
    if not isinstance(interior.distortion, kind):
        raise ValueError(f"this conversion needs {kind.__name__}; this camera has {type(interior.distortion).__name__}")
    return interior.distortion


def _with_distortion(interior: InteriorOrientation, distortion) -> InteriorOrientation:
    return dataclasses.replace(interior, distortion=distortion)
