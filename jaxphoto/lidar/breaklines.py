"""Detection of two surfaces around a place: both sides of a wall, a ridge, a kerb."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.lidar.local_surface import Neighbours

_DIRECTIONS = np.pi * np.arange(12) / 12
# Positions of the dividing line, in units of the farthest point.
_OFFSETS = np.array([-0.45, -0.3, -0.15, 0.0, 0.15, 0.3, 0.45])
# Minimum number of points on each side: two more than a plane has coefficients.
_FEWEST = 5
# Determinant of a side's normal matrix relative to that of surrounding points: less is a line.
_LINE = 1e-4
# Two planes must leave less than this fraction of the variance of one surface: divided by a line; and by height, which
# leaves a quarter for any points.
_BY_LINE, _BY_HEIGHT = 0.4, 0.1


@eqx.filter_jit
def lie_on_two_planes(near: Neighbours, variance: Float[Array, "places"]) -> Bool[Array, "places"]:
    """Return True where two planes leave far less than the `variance` (m^2) of one surface.

    For a dividing line, of 12 directions and 7 distances from the place, less than 0.4 of it; for the points above and
    below the largest gap between heights, as at a wall, less than 0.1.
    """
    return jax.vmap(_two_planes)(near, variance)


def _two_planes(near: Neighbours, variance: Float[Array, ""]) -> Bool[Array, ""]:
    xy = near.xy / jnp.max(jnp.where(near.there, near.distance, 0.0))
    along = xy @ jnp.stack([jnp.cos(_DIRECTIONS), jnp.sin(_DIRECTIONS)])
    lower = (along[:, :, None] < _OFFSETS).reshape(len(xy), -1)
    first = jnp.concatenate([lower, (near.z < _gap(near))[:, None]], axis=1) & near.there[:, None]
    sides = jnp.stack([first, near.there[:, None] & ~first])
    rows = jnp.concatenate([jnp.ones_like(xy[:, :1]), xy, near.z[:, None]], axis=1)
    # Sums over each side of all products of 1, x, y, z.
    sums = jnp.einsum("spl,pi,pj->slij", 1.0 * sides, rows, rows)
    left = jnp.sum(_left_by_plane(sums), axis=0) / (jnp.sum(near.there) - 7)
    return (jnp.min(left[:-1]) < _BY_LINE * variance) | (left[-1] < _BY_HEIGHT * variance)


def _gap(near: Neighbours) -> Float[Array, ""]:
    """Return the middle of the largest gap between heights."""
    z = jnp.sort(jnp.where(near.there, near.z, jnp.inf))
    gap = jnp.where(jnp.isfinite(z[1:]), z[1:] - z[:-1], 0.0)
    k = jnp.argmax(gap)
    return z[k] + gap[k] / 2


def _left_by_plane(sums: Float[Array, "2 lines 4 4"]) -> Float[Array, "2 lines"]:
    """Return residual sums of squares of planes; infinite for too few points, or collinear points.

    About the mean, z'z - r' C^-1 r with C the sums of products of x and y, and r those with z.
    """
    n = jnp.maximum(sums[..., 0, 0], 1.0)
    mean = sums[..., 0, 1:] / n[..., None]
    about = sums[..., 1:, 1:] - n[..., None, None] * mean[..., :, None] * mean[..., None, :]
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (jnp.moveaxis(about[..., k, :], -1, 0) for k in range(3))
    determinant = xx * yy - xy**2
    fit = (n >= _FEWEST) & (determinant > _LINE * n**2)
    explained = (yy * xz**2 - 2 * xy * xz * yz + xx * yz**2) / jnp.where(fit, determinant, 1.0)
    return jnp.where(fit, jnp.maximum(zz - explained, 0.0), jnp.inf)
