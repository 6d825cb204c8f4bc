"""Intersection of image rays with a cloud: visible surface, and its laser points.

Functions of one ray, for `vmap`. `q` is the horizontal offset (m) of a laser point from the ray, at the height of the
point: a point with q = 0 has the image position of the feature.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.lidar.grid import Grid

# Minimum gap between the heights of two levels: in standard deviations of one point, and of the points of either level.
_GAP_NOISE = 6.0
_GAP_SPREAD = 3.0
# Maximum distance of the centroid from the centre, in radii; a half disc has 0.42.
_BALANCED = 0.35
_EMPTY = 1e-4
# Maximum reach of the window for a cloud of uneven density (cells).
_FARTHEST = 4


class Skyline(NamedTuple):
    """Highest point of every grid cell (m), and the range of heights."""

    tops: Float[np.ndarray, "cells"]
    """Heights in the order of `Grid.start`; pits narrower than three cells are filled; -inf without points."""
    low: Float[np.ndarray, ""]
    high: Float[np.ndarray, ""]


def skyline(grid: Grid) -> Skyline:
    """Compute the highest points of the cells of `grid`."""
    rows, columns = (int(v) for v in grid.shape)
    start, z = np.asarray(grid.start[: rows * columns + 1]), np.asarray(grid.xyz[: len(grid), 2])
    some = np.flatnonzero(np.diff(start))
    tops = np.full(len(grid.start), -np.inf)
    tops[some] = np.maximum.reduceat(z, start[some])
    inside = tops[: rows * columns].reshape(rows, columns)
    inside[...] = scipy.ndimage.grey_closing(inside, 3, mode="nearest")
    return Skyline(tops, z.min(), z.max())


def window_reach(grid: Grid, wanted: int) -> int:
    """Return the reach of a window (see `around`) that contains `wanted` points around 90 % of the nonempty cells."""
    rows, columns = (int(v) for v in grid.shape)
    count = np.diff(np.asarray(grid.start[: rows * columns + 1])).reshape(rows, columns)
    for reach in range(1, _FARTHEST):
        size = 2 * reach + 1
        inside = scipy.ndimage.uniform_filter(count.astype(float), size, mode="constant") * size**2
        if np.mean(inside[count > 0] < wanted - 0.5) < 0.1:
            return reach
    return _FARTHEST


def first_met(
    origin: Float[Array, "3"], direction: Float[Array, "3"], sky: Skyline, grid: Grid
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Return X and Y (m) where the ray, from the camera downwards, first meets a cell of its height; True if any.

    The step is half a cell in plan, so the mean error is a quarter of a cell. A ray that does not descend has no
    intersection.
    """
    down = direction[2] < 0
    run = direction[:2] / jnp.where(down, direction[2], -1.0)
    step = 0.5 * grid.cell_m / jnp.maximum(jnp.hypot(run[0], run[1]), 1e-9)
    step = jnp.minimum(step, 1 + sky.high - sky.low)

    def top(z):
        column, row = jnp.floor((origin[:2] + run * (z - origin[2]) - grid.corner) / grid.cell_m)
        inside = (row >= 0) & (column >= 0) & (row < grid.shape[0]) & (column < grid.shape[1])
        cell = jnp.where(inside, row * grid.shape[1] + column, 0).astype(int)
        return jnp.where(inside, jnp.asarray(sky.tops)[cell], -jnp.inf)

    high = jnp.minimum(sky.high, origin[2])
    z = jax.lax.while_loop(lambda z: (z > sky.low) & (top(z) < z), lambda z: z - step, jnp.where(down, high, sky.low))
    # Subtract the mean overshoot of half a step.
    return origin[:2] + run * (jnp.minimum(z + step / 2, high) - origin[2]), down & (top(z) >= z)


def levels(
    q: Float[Array, "m 2"],
    z: Float[Array, "m"],
    there: Bool[Array, "m"],
    run: Float[Array, "2"],
    neighbours: int,
    sigma_z: Float[Array, ""],
) -> tuple[Bool[Array, "m"], Bool[Array, ""]]:
    """Select the laser points nearest to a ray, at heights `z` (m), that the image shows; nearest first.

    The second value is True if the feature is so close to a height discontinuity that its level is ambiguous.

    The heights are divided at their largest gap, if noise and slope cannot explain it. The upper level hides the lower
    one wherever it surrounds the feature. The feature is at the discontinuity between both if neither surrounds it, or
    if the ray is so steep (`run` is d(X, Y)/dZ) that the lower level does not appear *behind* the upper one.
    """
    # Gap from each point to the next higher one. Comparing all pairs (few) compiles faster than a sort.
    higher = jnp.min(jnp.where(there & (z > z[:, None]), z, jnp.inf), axis=1)
    gaps = jnp.where(there & jnp.isfinite(higher), higher - z, 0)
    widest = jnp.argmax(gaps)
    upper = there & (z > z[widest])
    lower = there & ~upper
    spread = jnp.sqrt((_squares(z, upper) + _squares(z, lower)) / jnp.maximum(there.sum(), 1))
    two = gaps[widest] > jnp.maximum(_GAP_NOISE * sigma_z, _GAP_SPREAD * spread)

    balanced, above, reach_above = _around(q, upper, neighbours)
    below_balanced, below, reach_below = _around(q, lower, neighbours)
    reach = jnp.sqrt(jnp.max(jnp.where(there, jnp.sum(q**2, axis=1), 0)))
    behind = jnp.hypot(run[0], run[1]) * gaps[widest] > reach
    on_upper = balanced & (behind | (below > reach_above))
    on_lower = ~balanced & below_balanced & (above > reach_below)
    seen = jnp.where(two, jnp.where(balanced, upper, lower), there)
    return seen, two & ~(on_upper | on_lower)


def surrounded(q: Float[ArrayLike, "m 2"], which: Bool[ArrayLike, "m"]) -> Bool[Array, ""]:
    """Return True if the points `which` surround q = 0: adjacent directions differ by less than 180 degrees.

    Points at q = 0 are ignored.
    """
    x, y = q[:, 0], q[:, 1]
    which = which & ((x != 0) | (y != 0))
    to_the_left = which & (x[:, None] * y - y[:, None] * x > 0)
    return jnp.all(~which | to_the_left.any(axis=1)) & jnp.any(which)


def empty_about(distance: Float[ArrayLike, "m"], which: Bool[ArrayLike, "m"]) -> Bool[Array, ""]:
    """Return True if no point is close enough: at uniform density the probability of such an empty circle is 1e-4.

    The nearest of n points in a circle is beyond a fraction x of its area with probability (1 - x)^(n-1).
    """
    near, far = jnp.min(jnp.where(which, distance, jnp.inf)), jnp.max(jnp.where(which, distance, 0))
    return (near / jnp.where(far > 0, far, 1)) ** 2 > 1 - _EMPTY ** (1 / jnp.maximum(which.sum() - 1, 1))


def _around(
    q: Float[Array, "m 2"], which: Bool[Array, "m"], neighbours: int
) -> tuple[Bool[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Return True if the points `which` are balanced about the feature; their nearest and farthest distance."""
    distance = jnp.hypot(q[:, 0], q[:, 1])
    count = which.sum()
    mean = jnp.sum(jnp.where(which[:, None], q, 0), axis=0) / jnp.maximum(count, 1)
    farthest = jnp.max(jnp.where(which, distance, 0))
    balanced = (count >= 3) & (jnp.hypot(mean[0], mean[1]) < _BALANCED * farthest)
    near = which & (jnp.cumsum(which) <= neighbours)
    reach = jnp.where(count < neighbours, jnp.inf, jnp.max(jnp.where(near, distance, 0)))
    return balanced, jnp.min(jnp.where(which, distance, jnp.inf)), reach


def _squares(z: Float[Array, "m"], which: Bool[Array, "m"]) -> Float[Array, ""]:
    mean = jnp.sum(jnp.where(which, z, 0)) / jnp.maximum(which.sum(), 1)
    return jnp.sum(jnp.where(which, (z - mean) ** 2, 0))
