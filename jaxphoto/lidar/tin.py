"""Delaunay triangle over one place, from the surrounding points only.

Lift every point q to |q|^2: the triangulation is the lower hull of the lifted points (Edelsbrunner and Seidel 1986),
and the triangle over the place, taken as origin, is the facet that a vertical line pierces. It is the solution of

    maximise b    subject to    a . q_i + b <= |q_i|^2    for all i

in a (2) and b, found as in the dual simplex method: start with a triangle around the place; while a point lies in its
circumcircle, replace the corner that leaves a triangle around the place by the point deepest under the facet. Three
artificial distant points form the first triangle; if one of them remains, the place is outside all others. The triangle
is that of the whole cloud if its circumcircle lies in the circle within which all points are known.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.lidar.local_surface import Neighbours

_MOST_STEPS = 100
# Corners of the first triangle, in units of the farthest point, and their lift: their facets are vertical.
_FAR = 4 * np.stack([np.cos([0.5, 2.6, 4.7]), np.sin([0.5, 2.6, 4.7])], axis=1)
_LIFT = 1e7
# Relative to the largest lift of a corner: smaller differences are rounding.
_ROUNDING = 1e-14


class Triangle(NamedTuple):
    """Influence of each point on the height of the place: barycentric coordinates of three, zero of the others."""

    weight: Float[Array, "points"]
    inside: Bool[Array, ""]
    """True if there is a triangle over the place."""
    safe: Bool[Array, ""]
    """True if no point farther away than the last one given can lie in its circumcircle."""


def delaunay_triangle(near: Neighbours) -> Triangle:
    """Find the triangle over the place among the neighbours."""
    unit = jnp.max(jnp.where(near.there, near.distance, 0.0))
    unit = jnp.where(unit > 0, unit, 1.0)
    points = jnp.concatenate([jnp.where(near.there[:, None], near.xy / unit, 0.0), _FAR])
    n = len(near.z)
    lifted = jnp.concatenate([jnp.where(near.there, jnp.sum(points[:n] ** 2, axis=1), 2 * _LIFT), jnp.full(3, _LIFT)])

    def deepest(corners):
        """Return the point deepest under the facet, and True if the depth exceeds rounding."""
        at, height = points[corners], lifted[corners]
        slope = _slope(at, height)
        above = lifted - height[0] - (points - at[0]) @ slope
        above = above.at[corners].set(0.0)
        k = jnp.argmin(above)
        return k, above[k] < -_ROUNDING * jnp.max(height)

    def step(state):
        corners, k, _, steps = state
        share, of_new = _barycentric(points[corners], jnp.zeros(2)), _barycentric(points[corners], points[k])
        ratio = jnp.where(of_new > 0, jnp.maximum(share, 0.0) / jnp.where(of_new > 0, of_new, 1.0), jnp.inf)
        corners = corners.at[jnp.argmin(ratio)].set(k)
        return corners, *deepest(corners), steps + 1

    first = jnp.arange(n, n + 3)
    state = (first, *deepest(first), 0)
    corners, _, wrong, _ = jax.lax.while_loop(lambda s: s[2] & (s[3] < _MOST_STEPS), step, state)
    inside = jnp.all(corners < n) & ~wrong
    weight = jnp.zeros(n + 3).at[corners].add(_barycentric(points[corners], jnp.zeros(2)))[:n]
    at = points[corners] - points[corners[0]]
    # The gradient of the lifted facet is twice the circumcentre: grad |c|^2 = 2 c.
    centre = _slope(at, jnp.sum(at**2, axis=1)) / 2
    farthest = jnp.linalg.norm(centre + points[corners[0]]) + jnp.linalg.norm(centre)
    return Triangle(jnp.where(inside, weight, 0.0), inside, inside & (farthest < 1 - 1e-9))


def _slope(at: Float[Array, "3 2"], height: Float[Array, "3"]) -> Float[Array, "2"]:
    """Return the gradient of the plane over three points."""
    (ax, ay), (bx, by) = at[1] - at[0], at[2] - at[0]
    a, b = height[1] - height[0], height[2] - height[0]
    return jnp.stack([a * by - b * ay, b * ax - a * bx]) / (ax * by - bx * ay)


def _barycentric(at: Float[Array, "3 2"], place: Float[Array, "2"]) -> Float[Array, "3"]:
    """Return barycentric coordinates of a place; their sum is 1."""
    (ax, ay), (bx, by), (px, py) = at[1] - at[0], at[2] - at[0], place - at[0]
    double = ax * by - bx * ay
    second, third = (px * by - bx * py) / double, (ax * py - px * ay) / double
    return jnp.stack([1 - second - third, second, third])
