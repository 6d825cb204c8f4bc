"""Covariance of a planned network, differentiable in its layout, and criteria for network design.

The normal matrix is computed from the layout without residuals. In the notation of adjustment/solver/normal.py,

    S = U - sum_p Y_p Y_p',    Y_p = W_p L_p^-T,    V_p = L_p L_p'
    Q = S^-1,    Q_pp = L_p^-T (I + Y_p' Q Y_p) L_p^-1

S is dense, for layouts of some tens of images and hundreds of points. Every pair of image and point contributes. Its
weight is the weight of the image times a window that decreases from one to zero across the edge of the format
(`Layout.edge_mm`), so a point enters an image without a discontinuity. If no point lies in the edge, the result equals
`jaxphoto.covariance` with sigma naught 1.

A criterion is any differentiable function from a `NetworkCovariance` to a scalar, such as
`functools.partial(sigma_of, name="c_mm")`. A maximum has kinks; `power` p replaces it by the p-norm, which is smooth
and larger by at most the factor n^(1/p) for n values. Use `power` in the search, and report the value without it.

Source of the criteria A, D and E: Pukelsheim, Optimal Design of Experiments (1993); for networks, Grafarend and Sanso
(1985).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import to_numpy
from jaxphoto.camera import InteriorOrientation, get_parameter, set_parameter, table_name
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, image_residual, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import cholesky, eigh, solve_lower, solve_lower_transposed
from jaxphoto.rotation import omega_phi_kappa_from_matrix, rotate, small_rotation
from jaxphoto.sensitivity.network.layout import Layout
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten
from jaxphoto.statistics import EOP_NAMES

# Prior weight of every point, relative to the weight of the best-determined point (10^6 times its sigma). It makes V
# invertible for points with fewer than two rays. Sigmas of all other points change by less than 1e-7.
_POINT_PRIOR = 1e-12
EXTERIOR = EOP_NAMES["omega_phi_kappa"]


class NetworkCovariance(eqx.Module):
    """A priori covariances of a layout (sigma naught 1), in metres, radians, mm and the coefficients' own units.

    `matrix` is the covariance of X, Y, Z, omega, phi, kappa of every image, followed by the free interior parameters.
    """

    matrix: Float[Array, "unknowns unknowns"]
    points: Float[Array, "points 3 3"]
    rays: Float[Array, "points"]
    """Number of images of each point. An image with the point in the edge of its format counts by its weight."""
    corner: Float[Array, "free"]
    """Displacement (mm) of an image point at the corner of the format per unit of each interior parameter."""
    free: tuple[str, ...] = eqx.field(static=True)

    @property
    def n_images(self) -> int:
        """Number of images."""
        return (len(self.matrix) - len(self.free)) // 6

    @property
    def sigma(self) -> Float[Array, "unknowns"]:
        """Standard deviations of the unknowns, in the order of `matrix`."""
        return jnp.sqrt(jnp.diagonal(self.matrix))

    @property
    def interior(self) -> Float[Array, "free free"]:
        """Covariance of the free interior parameters."""
        n = 6 * self.n_images
        return self.matrix[n:, n:]

    @property
    def interior_at_corner(self) -> Float[Array, "free free"]:
        """Covariance of the free interior parameters, scaled to displacements at the corner of the format (mm^2).

        All parameters then have the same unit, as a trace requires.
        """
        return self.interior * self.corner[:, None] * self.corner[None, :]

    @property
    def correlation(self) -> Float[Array, "images 6 free"]:
        """Correlations of X, Y, Z, omega, phi, kappa of each image with the free interior parameters."""
        n = 6 * self.n_images
        rho = self.matrix[:n, n:] / (self.sigma[:n, None] * self.sigma[n:])
        return rho.reshape(-1, 6, len(self.free))

    def column(self, name: str) -> int:
        """Return the index of the interior parameter `name` in `free`. Raises InputError if it is fixed."""
        name = table_name(name)
        if name not in self.free:
            free = ", ".join(self.free) or "none"
            raise InputError(
                f"a criterion needs the covariance of {name}, which is fixed: choose a free parameter of the layout "
                f"({free}), or free it"
            )
        return self.free.index(name)


def design_covariance(layout: Layout) -> NetworkCovariance:
    """Compute the covariance of `layout`, differentiable; NaN with a rank defect.

    `check_layout` reports the reason of a rank defect.
    """
    # Pass an array: a Python number would be a compile-time constant, and each value would be compiled separately.
    return call_compiled(_design_covariance, jax.tree.map(to_numpy, layout))


@eqx.filter_jit
def _design_covariance(layout: Layout) -> NetworkCovariance:
    eop, shared, point, weight = _pairs(layout)
    image_weight, station, attitude = layout.by_image
    n, k, m = len(station), len(layout.free), len(layout.points)
    weighted = weight[:, :, None, None]
    # Shapes (images, 6, 6), (images, 6, free), (free, free).
    u = jnp.einsum("ipca,ipcb->iab", weighted * eop, eop)
    u = u + jax.vmap(jnp.diag)(jnp.concatenate([station, attitude], axis=1))
    us = jnp.einsum("ipca,ipcb->iab", weighted * eop, shared).reshape(6 * n, k)
    uss = jnp.einsum("ipca,ipcb->ab", weighted * shared, shared)
    normal = jnp.block([[_block_diagonal(u), us], [us.T, uss]])
    # Shape (3, unknowns, points). Sum two products each: a batch of small matrices would be slow.
    products = lambda a: sum(  # noqa: E731
        (weighted * a)[:, :, c, :, None] * point[:, :, c, None, :] for c in range(2)
    )
    w = jnp.concatenate(
        [products(eop).transpose(3, 0, 2, 1).reshape(3, 6 * n, m), products(shared).sum(axis=0).transpose(2, 1, 0)],
        axis=1,
    )
    v = products(point).sum(axis=0).transpose(1, 2, 0)
    floor = _POINT_PRIOR * jnp.max(jnp.trace(v))
    v = v + jax.vmap(jnp.diag, out_axes=2)(layout.by_point + floor)
    l = cholesky_3x3(v)  # noqa: E741
    y = jnp.stack(whiten(w, l), axis=1)
    flat = y.reshape(len(normal), -1)
    # Scale to a unit diagonal before elimination.
    scale = jax.lax.stop_gradient(1 / jnp.sqrt(jnp.diagonal(normal)))
    q = _inverse((normal - flat @ flat.T) * scale[:, None] * scale) * scale[:, None] * scale
    inner = jnp.eye(3)[:, :, None] + jnp.einsum("acp,adp->cdp", y, (q @ flat).reshape(y.shape))
    half = jnp.stack(unwhiten(inner, l))
    points = jnp.stack(unwhiten(half.transpose(1, 0, 2), l)).transpose(2, 0, 1)
    jacobians = jax.vmap(_angle_jacobian)(layout.exterior.camera_from_object)
    to_angles = jnp.eye(len(normal)).at[: 6 * n, : 6 * n].set(_block_diagonal(jacobians))
    measures = image_weight > 0
    fractions = weight / jnp.where(measures, image_weight, 1.0)[:, None]
    rays = jnp.sum(jnp.where(measures[:, None], fractions, 0.0), axis=0)
    return NetworkCovariance(to_angles @ q @ to_angles.T, points, rays, _corner(layout), layout.free)


class _Pairs(NamedTuple):
    """Derivatives of the image residual (mm) of every pair of image and point, and the weight of the pair."""

    eop: Float[Array, "images points 2 6"]
    """Derivatives by X, Y, Z and a small rotation about the camera axes."""
    shared: Float[Array, "images points 2 free"]
    point: Float[Array, "images points 2 3"]
    weight: Float[Array, "images points"]


def _pairs(layout: Layout) -> _Pairs:
    interior, half = layout.interior, jnp.asarray(_half(layout))
    reach = _reach(layout)

    def pair(image: ExteriorOrientation, point, weight):
        x, y, z = camera_coordinates(image, point)
        depth = jnp.where(z < 0, -z, 1.0)
        ideal = interior.c * jnp.stack([x, y]) / depth
        visible = (z < 0) & jnp.all(jnp.abs(ideal) < reach)
        # Apply `where` twice: far outside the format use a point on the axis, so that no derivative is NaN.
        axis = image.position + rotate(image.camera_from_object.T, jnp.array([0.0, 0.0, -1.0]))
        aim = jnp.where(visible, point, axis)
        xy = project(interior, image, aim)
        window = jnp.prod(_smooth_step(0.5 + (half - jnp.abs(xy)) / layout.edge_mm))

        def residual(eop, shared, step):
            rotation = small_rotation(eop[3:]) @ image.camera_from_object
            exterior = ExteriorOrientation(image.position + eop[:3], rotation)
            return image_residual(_changed(interior, layout.free, shared), exterior, aim + step, xy)

        zero = jnp.zeros(6), jnp.zeros(len(layout.free)), jnp.zeros(3)
        by_eop, by_shared, by_point = jax.jacfwd(residual, argnums=(0, 1, 2))(*zero)
        return _Pairs(by_eop, by_shared, by_point, jnp.where(visible, weight * window, 0.0))

    pairs = jax.vmap(jax.vmap(pair, in_axes=(None, 0, None)), in_axes=(0, None, 0))
    return pairs(layout.exterior, layout.points, layout.by_image[0])


def _changed(interior: InteriorOrientation, names: tuple[str, ...], change) -> InteriorOrientation:
    for k, name in enumerate(names):
        interior = set_parameter(interior, name, get_parameter(interior, name) + change[k])
    return interior


def _half(layout: Layout) -> Float[np.ndarray, "2"]:
    return np.array([layout.sensor.width_mm, layout.sensor.height_mm]) / 2


def _reach(layout: Layout) -> Float[Array, "2"]:
    """Return the bounds of |ideal coordinates| on the format and its edge: pairs outside have zero weight."""
    signs = np.array([[a, b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    ideal = jax.vmap(layout.interior.ideal_from_measured)(jnp.asarray(signs * (_half(layout) + layout.edge_mm / 2)))
    return 1.02 * jnp.max(jnp.abs(jax.lax.stop_gradient(ideal)), axis=0)


def _smooth_step(t: Float[Array, "2"]) -> Float[Array, "2"]:
    """Return 0 below zero, 1 above one, and the quintic smoothstep (two continuous derivatives) in between."""
    t = jnp.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


@jax.custom_jvp
def _inverse(s: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return S^-1 by Cholesky."""
    lower = cholesky(s)
    return solve_lower_transposed(lower, solve_lower(lower, jnp.eye(len(s))))


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    """Differentiate by -S^-1 dS S^-1: several times faster than JAX's derivatives of the triangular solves."""
    q = _inverse(*primals)
    return q, -q @ tangents[0] @ q


def _block_diagonal(blocks: Float[Array, "n c c"]) -> Float[Array, "nc nc"]:
    n, c, _ = blocks.shape
    return (blocks[:, :, None, :] * jnp.eye(n)[:, None, :, None]).reshape(n * c, n * c)


def _angle_jacobian(camera_from_object: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    """Return the derivatives of X, Y, Z, omega, phi, kappa by X, Y, Z and a small rotation about the camera axes."""
    angles = lambda theta: omega_phi_kappa_from_matrix(small_rotation(theta) @ camera_from_object)  # noqa: E731
    return jnp.eye(6).at[3:, 3:].set(jax.jacfwd(angles)(jnp.zeros(3)))


def _corner(layout: Layout) -> Float[Array, "free"]:
    interior, half = layout.interior, jnp.asarray(_half(layout))
    aim = jnp.append(interior.ideal_from_measured(half) / interior.c, -1.0)
    centre = ExteriorOrientation(jnp.zeros(3), jnp.eye(3))
    residual = lambda change: image_residual(_changed(interior, layout.free, change), centre, aim, half)  # noqa: E731
    return jnp.sqrt(jnp.sum(jax.jacfwd(residual)(jnp.zeros(len(layout.free))) ** 2, axis=0))


def a_criterion(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return the A-criterion: mean variance trace(Q) / n of the covariance matrix of unknowns of one unit."""
    return jnp.trace(matrix) / len(matrix)


def d_criterion(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return the D-criterion det(Q)^(1/n): mean size of the error ellipsoid. Units of the unknowns only scale it."""
    scale = jnp.sqrt(jnp.diagonal(matrix))
    log = 2 * jnp.sum(jnp.log(jnp.diagonal(cholesky(matrix / scale[:, None] / scale))))
    return jnp.exp((log + 2 * jnp.sum(jnp.log(scale))) / len(matrix))


def e_criterion(matrix: Float[Array, "n n"], power: float | None = None) -> Float[Array, ""]:
    """Return the E-criterion: largest eigenvalue of Q, the variance of the worst-determined direction.

    The unknowns must have one unit.
    """
    return _largest(eigh(matrix)[0], power)


def sigma_of(covariance: NetworkCovariance, name: str) -> Float[Array, ""]:
    """Return the standard deviation of the interior parameter `name` in its own unit. Raises InputError if fixed."""
    k = covariance.column(name)
    return jnp.sqrt(covariance.interior[k, k])


def point_rmse(covariance: NetworkCovariance, points: Sequence[int] | slice = slice(None)) -> Float[Array, ""]:
    """Return the expected RMSE (m) of a coordinate of `points`: square root of the mean variance over points and axes.

    It predicts the RMSE at error-free check points. A point with fewer than two images makes it very large.
    """
    index = points if isinstance(points, slice) else np.asarray(points)
    return jnp.sqrt(jnp.mean(jnp.diagonal(covariance.points[index], axis1=1, axis2=2)))


def largest_correlation(
    covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str], power: float | None = None
) -> Float[Array, ""]:
    """Return the maximum |rho| over all images of `exterior` (X, Y, Z, omega, phi, kappa) with `interior` parameters.

    Raises InputError for a parameter that is fixed or does not exist.
    """
    return _largest(jnp.abs(_chosen(covariance, exterior, interior)).reshape(-1), power)


def mean_correlation(
    covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str]
) -> Float[Array, ""]:
    """Return the mean |rho| over all images of `exterior` with `interior` parameters (paper 000, Table 4)."""
    return jnp.mean(jnp.abs(_chosen(covariance, exterior, interior)))


def _chosen(covariance: NetworkCovariance, exterior: Sequence[str], interior: Sequence[str]) -> Array:
    if unknown := [name for name in exterior if name not in EXTERIOR]:
        raise InputError(f"unknown exterior parameter {unknown[0]} in a criterion: choose among {', '.join(EXTERIOR)}")
    rows, columns = [EXTERIOR.index(name) for name in exterior], [covariance.column(name) for name in interior]
    return covariance.correlation[:, rows][:, :, columns]


def _largest(values: Float[Array, "n"], power: float | None) -> Float[Array, ""]:
    largest = jnp.max(values)
    if power is None:
        return largest
    # Divide by the largest value, so that no power overflows.
    return largest * jnp.sum((values / largest) ** power) ** (1 / power)
