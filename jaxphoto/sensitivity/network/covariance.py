"""The covariance of a network that is only planned, differentiable in every number of its layout.

No residual is needed: the normal matrix is that of the layout itself, in the notation of adjustment/solver/normal.py,

    S = U - sum_p Y_p Y_p',    Y_p = W_p L_p^-T,    V_p = L_p L_p'
    Q = S^-1,    Q_pp = L_p^-T (I + Y_p' Q Y_p) L_p^-1

and dense, for layouts of some tens of images and hundreds of points. Every pair of image and point takes part. Its
weight is that of the image times a window that falls from one to zero across the edge of the format (`Layout.edge_mm`),
so that a point which comes into an image does so without a step. Where no point lies in the edge, this is the
covariance of `jaxphoto.covariance` with sigma naught 1.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import still
from jaxphoto.camera import InteriorOrientation, get_parameter, set_parameter
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, image_residual, project
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import cholesky, solve_lower, solve_lower_transposed
from jaxphoto.rotation import omega_phi_kappa_from_matrix, rotate, small_rotation
from jaxphoto.sensitivity.network.layout import Layout
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten
from jaxphoto.statistics import EOP_NAMES

# Every point is known beforehand with this part of the best point's weight (a million times its sigma): one that fewer
# than two images see then says nothing, and its V can be inverted. Sigmas of all others change by less than 1e-7.
_GROUND = 1e-12
EXTERIOR = EOP_NAMES["omega_phi_kappa"]


class NetworkCovariance(eqx.Module):
    """A priori covariances of a layout (sigma naught 1), in metres, radians, mm and the coefficients' own units.

    `matrix` is of X, Y, Z, omega, phi, kappa of every image, followed by the free interior parameters.
    """

    matrix: Float[Array, "unknowns unknowns"]
    points: Float[Array, "points 3 3"]
    rays: Float[Array, "points"]
    """In how many images a point is seen; one in the edge of the format counts by its weight."""
    corner: Float[Array, "free"]
    """By how much (mm) one unit of each interior parameter moves an image point in the corner of the format."""
    free: tuple[str, ...] = eqx.field(static=True)

    @property
    def n_images(self) -> int:
        """How many images the layout has."""
        return (len(self.matrix) - len(self.free)) // 6

    @property
    def sigma(self) -> Float[Array, "unknowns"]:
        """Standard deviations in the order of `matrix`."""
        return jnp.sqrt(jnp.diagonal(self.matrix))

    @property
    def interior(self) -> Float[Array, "free free"]:
        """Covariance of the free interior parameters."""
        n = 6 * self.n_images
        return self.matrix[n:, n:]

    @property
    def interior_at_corner(self) -> Float[Array, "free free"]:
        """The same in mm^2 at the corner of the format: one unit for all parameters, in which they can be added."""
        return self.interior * self.corner[:, None] * self.corner[None, :]

    @property
    def correlation(self) -> Float[Array, "images 6 free"]:
        """Of X, Y, Z, omega, phi, kappa of each image with the free interior parameters."""
        n = 6 * self.n_images
        rho = self.matrix[:n, n:] / (self.sigma[:n, None] * self.sigma[n:])
        return rho.reshape(-1, 6, len(self.free))

    def column(self, name: str) -> int:
        """Where the interior parameter `name` stands in `free`. Raises InputError where it is held fixed."""
        if name not in self.free:
            free = ", ".join(self.free) or "none"
            raise InputError(
                f"a criterion asks for {name}, which is fixed and has no covariance; name one that is free in the "
                f"layout ({free}), or free it"
            )
        return self.free.index(name)


def design_covariance(layout: Layout) -> NetworkCovariance:
    """The covariance of `layout`, differentiable; NaN where its observations do not determine the unknowns.

    `network.block.check_layout` says why they do not.
    """
    # A plain number would be part of the program, and each value compiled for itself.
    return call_compiled(_design_covariance, jax.tree.map(still, layout))


@eqx.filter_jit
def _design_covariance(layout: Layout) -> NetworkCovariance:
    eop, shared, point, weight = _pairs(layout)
    image_weight, station, attitude = layout.by_image
    n, k, m = len(station), len(layout.free), len(layout.points)
    weighted = weight[:, :, None, None]
    # (images, 6, 6), (images, 6, free), (free, free)
    u = jnp.einsum("ipca,ipcb->iab", weighted * eop, eop)
    u = u + jax.vmap(jnp.diag)(jnp.concatenate([station, attitude], axis=1))
    us = jnp.einsum("ipca,ipcb->iab", weighted * eop, shared).reshape(6 * n, k)
    uss = jnp.einsum("ipca,ipcb->ab", weighted * shared, shared)
    whole = jnp.block([[_block_diagonal(u), us], [us.T, uss]])
    # (3, unknowns, points): sums of two products each, which a batch of small matrices would make slow.
    met = lambda a: sum(  # noqa: E731
        (weighted * a)[:, :, c, :, None] * point[:, :, c, None, :] for c in range(2)
    )
    w = jnp.concatenate(
        [met(eop).transpose(3, 0, 2, 1).reshape(3, 6 * n, m), met(shared).sum(axis=0).transpose(2, 1, 0)], axis=1
    )
    v = met(point).sum(axis=0).transpose(1, 2, 0)
    floor = _GROUND * jnp.max(jnp.trace(v))
    v = v + jax.vmap(jnp.diag, out_axes=2)(layout.by_point + floor)
    l = cholesky_3x3(v)  # noqa: E741
    y = jnp.stack(whiten(w, l), axis=1)
    flat = y.reshape(len(whole), -1)
    # Scaled so that the diagonal before elimination is one.
    scale = jax.lax.stop_gradient(1 / jnp.sqrt(jnp.diagonal(whole)))
    q = _inverse((whole - flat @ flat.T) * scale[:, None] * scale) * scale[:, None] * scale
    inner = jnp.eye(3)[:, :, None] + jnp.einsum("acp,adp->cdp", y, (q @ flat).reshape(y.shape))
    half = jnp.stack(unwhiten(inner, l))
    points = jnp.stack(unwhiten(half.transpose(1, 0, 2), l)).transpose(2, 0, 1)
    turns = jax.vmap(_angles_from_turn)(layout.exterior.camera_from_object)
    to_angles = jnp.eye(len(whole)).at[: 6 * n, : 6 * n].set(_block_diagonal(turns))
    measures = image_weight > 0
    shares = weight / jnp.where(measures, image_weight, 1.0)[:, None]
    rays = jnp.sum(jnp.where(measures[:, None], shares, 0.0), axis=0)
    return NetworkCovariance(to_angles @ q @ to_angles.T, points, rays, _corner(layout), layout.free)


class _Pairs(NamedTuple):
    """Derivatives of the image residual (mm) of every image and point, and its weight."""

    eop: Float[Array, "images points 2 6"]
    """By X, Y, Z and a small rotation about the camera's axes."""
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
        near = (z < 0) & jnp.all(jnp.abs(ideal) < reach)
        # Double where: what is far outside is looked at as if it lay on the axis, and no derivative becomes NaN.
        axis = image.position + rotate(image.camera_from_object.T, jnp.array([0.0, 0.0, -1.0]))
        aim = jnp.where(near, point, axis)
        xy = project(interior, image, aim)
        window = jnp.prod(_step(0.5 + (half - jnp.abs(xy)) / layout.edge_mm))

        def residual(eop, shared, step):
            turned = small_rotation(eop[3:]) @ image.camera_from_object
            moved = ExteriorOrientation(image.position + eop[:3], turned)
            return image_residual(_moved(interior, layout.free, shared), moved, aim + step, xy)

        zero = jnp.zeros(6), jnp.zeros(len(layout.free)), jnp.zeros(3)
        by_eop, by_shared, by_point = jax.jacfwd(residual, argnums=(0, 1, 2))(*zero)
        return _Pairs(by_eop, by_shared, by_point, jnp.where(near, weight * window, 0.0))

    each = jax.vmap(jax.vmap(pair, in_axes=(None, 0, None)), in_axes=(0, None, 0))
    return each(layout.exterior, layout.points, layout.by_image[0])


def _moved(interior: InteriorOrientation, names: tuple[str, ...], by) -> InteriorOrientation:
    for k, name in enumerate(names):
        interior = set_parameter(interior, name, get_parameter(interior, name) + by[k])
    return interior


def _half(layout: Layout) -> Float[np.ndarray, "2"]:
    return np.array([layout.sensor.width_mm, layout.sensor.height_mm]) / 2


def _reach(layout: Layout) -> Float[Array, "2"]:
    """Bounds of |ideal coordinates| on the format and its edge: outside, a pair has no weight."""
    signs = np.array([[a, b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
    ideal = jax.vmap(layout.interior.ideal_from_measured)(jnp.asarray(signs * (_half(layout) + layout.edge_mm / 2)))
    return 1.02 * jnp.max(jnp.abs(jax.lax.stop_gradient(ideal)), axis=0)


def _step(t: Float[Array, "2"]) -> Float[Array, "2"]:
    """0 below zero, 1 above one, between them the polynomial with two continuous derivatives."""
    t = jnp.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


@jax.custom_jvp
def _inverse(s: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """S^-1 by Cholesky."""
    lower = cholesky(s)
    return solve_lower_transposed(lower, solve_lower(lower, jnp.eye(len(s))))


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    """-S^-1 dS S^-1: products instead of the triangular solves that JAX would differentiate, several times faster."""
    q = _inverse(*primals)
    return q, -q @ tangents[0] @ q


def _block_diagonal(blocks: Float[Array, "n c c"]) -> Float[Array, "nc nc"]:
    n, c, _ = blocks.shape
    return (blocks[:, :, None, :] * jnp.eye(n)[:, None, :, None]).reshape(n * c, n * c)


def _angles_from_turn(camera_from_object: Float[Array, "3 3"]) -> Float[Array, "6 6"]:
    """Derivative of X, Y, Z, omega, phi, kappa by X, Y, Z and a small rotation about the camera's axes."""
    angles = lambda theta: omega_phi_kappa_from_matrix(small_rotation(theta) @ camera_from_object)  # noqa: E731
    return jnp.eye(6).at[3:, 3:].set(jax.jacfwd(angles)(jnp.zeros(3)))


def _corner(layout: Layout) -> Float[Array, "free"]:
    interior, half = layout.interior, jnp.asarray(_half(layout))
    aim = jnp.append(interior.ideal_from_measured(half) / interior.c, -1.0)
    centre = ExteriorOrientation(jnp.zeros(3), jnp.eye(3))
    moved = lambda by: image_residual(_moved(interior, layout.free, by), centre, aim, half)  # noqa: E731
    return jnp.sqrt(jnp.sum(jax.jacfwd(moved)(jnp.zeros(len(layout.free))) ** 2, axis=0))
