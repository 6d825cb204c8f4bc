"""Forward intersection from fixed images with the covariance of the points, including common errors.

The residual r (mm) of a ray depends on its point X, on its individual errors e (image noise, orientation of its image)
and on errors m common to many rays (mount, camera). With weights from the image sigmas, as in an adjustment with fixed
images,

    dX = - sum J r,    J = (sum A' P A)^-1 A' P,    A = dr / dX
    Q  = sum J (dr/de Q_e dr/de') J' + (sum J dr/dm) Q_m (sum J dr/dm)'

`ray_partials` takes one image and one point; the other functions take all rows and sum over the rows of each point.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxphoto.camera import InteriorOrientation, parameter_names
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS, Corrections, apparent_point
from jaxphoto.georeferencing.ground import moved_exterior, moved_interior
from jaxphoto.linear_algebra import inverse


class RayPartials(NamedTuple):
    """Residual (mm) of one ray, as in an adjustment, and its derivatives; arrays of rays have a leading axis."""

    residual: Float[Array, "*rows 2"]
    point: Float[Array, "*rows 2 3"]
    exterior: Float[Array, "*rows 2 6"]
    """Derivatives with respect to X, Y, Z (m) and a small rotation in the camera frame (rad)."""
    interior: Float[Array, "*rows 2 k"]
    """Derivatives with respect to the interior orientation, in the order of `camera.parameter_names`."""


def ray_partials(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    point: Float[Array, "3"],
    xy: Float[Array, "2"],
    corrections: Corrections = NO_CORRECTIONS,
) -> RayPartials:
    """Evaluate and differentiate the residual of the measured image coordinate `xy` (mm) of `point` (m)."""

    def residual(d_point, d_exterior, d_interior):
        image = moved_exterior(exterior, d_exterior)
        aim = apparent_point(image.position, point + d_point, corrections)
        value = image_residual(moved_interior(interior, d_interior), image, aim, xy)
        return value, value

    zeros = (jnp.zeros(3), jnp.zeros(6), jnp.zeros(len(parameter_names(interior))))
    by, value = jax.jacfwd(residual, argnums=(0, 1, 2), has_aux=True)(*zeros)
    return RayPartials(value, *by)


def intersection_gain(
    by_point: Float[Array, "rows 2 3"], sigma: Float[Array, "rows 2"], point: Int[Array, "rows"], n_points: int
) -> Float[Array, "rows 3 2"]:
    """Return J of every row: a point moves by -sum J r.

    `sigma` (mm): standard deviations of the image coordinates. `point`: index of the point of each row. J is NaN or
    very large if the rays of a point are parallel.
    """
    weighted = by_point.transpose(0, 2, 1) / sigma[:, None, :] ** 2
    normal = jax.ops.segment_sum(weighted @ by_point, point, n_points)
    # The normal matrix of a point without rows is singular, but no row uses its inverse.
    return jax.vmap(inverse)(normal)[point] @ weighted


def intersection_step(
    gain: Float[Array, "rows 3 2"], residual: Float[Array, "rows 2"], point: Int[Array, "rows"], n_points: int
) -> Float[Array, "points 3"]:
    """Return the Gauss-Newton step (m) of every point."""
    return -jax.ops.segment_sum(jnp.einsum("nij,nj->ni", gain, residual), point, n_points)


def own_covariance(
    gain: Float[Array, "rows 3 2"], own: Float[Array, "rows 2 2"], point: Int[Array, "rows"], n_points: int
) -> Float[Array, "points 3 3"]:
    """Propagate independent errors of the rays to the points (m^2); `own` is the covariance of each residual (mm^2)."""
    return jax.ops.segment_sum(gain @ own @ gain.transpose(0, 2, 1), point, n_points)


def shared_covariance(
    gain: Float[Array, "rows 3 2"],
    by_shared: Float[Array, "rows 2 m"],
    covariance: Float[Array, "m m"],
    point: Int[Array, "rows"],
    n_points: int,
) -> Float[Array, "points 3 3"]:
    """Propagate common errors of the given `covariance` to the points (m^2).

    `by_shared` is dr/dm; zeros for rays without the error.
    """
    by = jax.ops.segment_sum(gain @ by_shared, point, n_points)
    return by @ covariance @ by.transpose(0, 2, 1)
