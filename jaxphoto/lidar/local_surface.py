"""Local least-squares surface through the points around a place.

With x, y the offsets of a point from the place (m), and its height Z over some reference,

    Z = h + g_x x + g_y y + (h_xx x^2 + 2 h_xy x y + h_yy y^2) / 2

is a quadratic; without its last term, a plane. The fit is linear in the heights: `coefficients = rows @ z`, so every
standard deviation follows from `rows`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import ArrayLike

# Ratio of a pivot to its diagonal element: points collinear to 1e-4 of their distances.
_SINGULAR = 1e-8


class Neighbours(NamedTuple):
    """Points nearest to one place, nearest first; padded with points that are not `there`."""

    xy: Float[ArrayLike, "points 2"]
    """Offsets from the place (m)."""
    z: Float[ArrayLike, "points"]
    """Heights over that of the nearest point (m)."""
    distance: Float[ArrayLike, "points"]
    there: Bool[ArrayLike, "points"]


class LocalFit(NamedTuple):
    """Fitted surface."""

    coefficients: Float[Array, "6"]
    """h (m), g_x, g_y, h_xx, h_xy, h_yy (1/m)."""
    rows: Float[Array, "6 points"]
    variance: Float[Array, ""]
    """Residual sum of squares over the degrees of freedom (m^2)."""
    freedom: Float[Array, ""]
    """Number of points minus number of coefficients."""
    determined: Bool[Array, ""]
    """True if there are more points than coefficients, and they do not lie on a line or conic."""

    @property
    def interpolates(self) -> Bool[Array, ""]:
        """Return True if the height at the place is better than a single point: otherwise it is extrapolated."""
        return self.determined & (jnp.sum(self.rows[0] ** 2) <= 1)


def terms(xy: Float[ArrayLike, "points 2"]) -> Float[Array, "points 6"]:
    """Return the monomials of the coefficients."""
    x, y = xy[:, 0], xy[:, 1]
    return jnp.stack([jnp.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=1)


def fit_surface(near: Neighbours, weight: Float[ArrayLike, "points"], quadratic: bool) -> LocalFit:
    """Fit by weighted least squares; the weights of missing points are zero.

    The residual variance is that of the points of positive weight, each counted once.
    """
    weight = jnp.where(near.there, weight, 0.0)
    used = weight > 0
    n_used = jnp.sum(used)
    # Centred and in units of the farthest point, for the best condition of the normal matrix.
    middle = jnp.sum(jnp.where(used[:, None], near.xy, 0.0), axis=0) / jnp.maximum(n_used, 1)
    offset = jnp.where(used[:, None], near.xy - middle, 0.0)
    unit = jnp.sqrt(jnp.max(jnp.sum(offset**2, axis=1)))
    unit = jnp.where(unit > 0, unit, 1.0)
    n = 6 if quadratic else 3
    basis = jnp.where(used[:, None], terms(offset / unit)[:, :n], 0.0)
    rows, regular = _solve(basis.T @ (weight[:, None] * basis), (weight[:, None] * basis).T)
    determined = regular & (n_used > n)
    rows = jnp.where(determined, rows, 0.0)
    z = jnp.where(used, near.z, 0.0)
    residual = z - basis @ (rows @ z)
    rows = _seen_from_place(-middle / unit, unit)[:, :n] @ rows
    freedom = n_used - n
    return LocalFit(
        rows @ z,
        rows,
        jnp.sum(residual**2) / jnp.maximum(freedom, 1),
        freedom.astype(float),
        determined,
    )


def _seen_from_place(at: Float[Array, "2"], unit: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Transform coefficients about the centre (per unit) to those about the place (per m), which is at `at`."""
    x, y = at
    zero, one = jnp.zeros(()), jnp.ones(())
    by_x, by_y = jnp.stack([zero, one, zero, x, y, zero]), jnp.stack([zero, zero, one, zero, x, y])
    moved = jnp.concatenate([terms(at[None]), by_x[None], by_y[None], jnp.eye(6)[3:]])
    return moved * unit ** -jnp.array([0.0, 1, 1, 2, 2, 2])[:, None]


def _solve(
    normal: Float[Array, "n n"], right: Float[Array, "n points"]
) -> tuple[Float[Array, "n points"], Bool[Array, ""]]:
    """Solve by Cholesky factorisation; False if a pivot is close to zero.

    Written out: for many places each step is one operation on long vectors, while LAPACK is called once per place.
    """
    n = len(normal)
    factor: list[list[Array]] = [[] for _ in range(n)]
    solved: list[Array] = []
    regular = jnp.array(True)
    for i in range(n):
        for j in range(i):
            inner = sum((factor[i][k] * factor[j][k] for k in range(j)), jnp.zeros(()))
            factor[i].append((normal[i, j] - inner) / factor[j][j])
        pivot = normal[i, i] - sum((v**2 for v in factor[i]), jnp.zeros(()))
        positive = pivot > _SINGULAR * normal[i, i]
        regular &= positive
        factor[i].append(jnp.sqrt(jnp.where(positive, pivot, 1.0)))
        solved.append((right[i] - sum((factor[i][k] * solved[k] for k in range(i)), jnp.zeros(()))) / factor[i][i])
    for i in reversed(range(n)):
        above = sum((factor[k][i] * solved[k] for k in range(i + 1, n)), jnp.zeros(()))
        solved[i] = (solved[i] - above) / factor[i][i]
    return jnp.stack(solved), regular
