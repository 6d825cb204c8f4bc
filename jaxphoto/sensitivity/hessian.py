"""Second derivatives of half the weighted square sum at an optimum, with the points eliminated.

With r the weighted residuals, y the increments and v any number that r depends on, half the square sum has

    H = J'J + sum_r r d2r/dy2           the normal matrix and the residuals' curvature
    B = J' dr/dv + sum_r r d2r/dy dv    what a change of v does to the gradient J'r

and the optimum answers dv with dy = -H^-1 B dv. Without the terms that carry r, this is the classical first-order
matrix -N^-1 J' dr/dv. Every image row touches one image, one point and one camera, so H has the blocks of the normal
matrix (see adjustment/solver/normal.py) and its points are eliminated alike, by V = L L' and F = [W; Ws'; D_p] L^-T.
Some rows, and the datum, couple points: D (what such a row touches, then the constraints) has the weight C, and
mu = C D x is carried by more unknowns. With S, G, K what is left of H, D and 0 without the points,

    M = [ S     G'      ]
        [ C G   C K - I ]
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, Linearised, Met, PaddedStructure
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.arrays import Numbers
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.sensitivity.curvature import coupling_rows, other_second, points_second, rows_second
from jaxphoto.sensitivity.image_rows import ListedRows, RowProducts, row_products
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten

# An index that no array has: what is added there is dropped.
NOWHERE = int(np.iinfo(np.int32).max)
# Reduced unknowns whose dense matrix is inverted within seconds.
_MOST_UNKNOWNS = 6000


class Eliminated(NamedTuple):
    """M, and what takes vectors down to it and back to the points."""

    m: Float[Array, "n_and_k n_and_k"]
    c: Float[Array, "k k"]
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V."""
    rays: Float[Array, "rays 3 e"]
    """F of each ray, by the unknowns of its image,"""
    border: Float[Array, "points 3 c"]
    """and of each point, by what else it meets."""
    point: Int[Array, "rays"]
    """The point of each ray."""
    of_rays: Int[Array, "rays e"]
    """The unknowns of M that the columns of `rays` belong to, behind the last where they are none;"""
    of_border: Int[Array, "points c"]
    """and those of `border`."""
    measured: Float[Array, "rows 2 touched"]
    """-B of each image row by its measured x and y (mm): of eop (6), point (3), colours."""


def check_optimum(adjusted: Adjustment) -> None:
    """Raise InputError where there is no optimum, and where M is too large to hold."""
    if not bool(adjusted.converged):
        raise InputError(
            "the adjustment has not converged, and only an optimum has a sensitivity: adjust until it converges"
        )
    s = adjusted.padded.structure
    unknowns = 6 * s.n_images + s.n_shared
    if unknowns > _MOST_UNKNOWNS:
        raise InputError(
            f"sensitivity inverts a dense matrix of {unknowns} unknowns, {_MOST_UNKNOWNS} at most: take a smaller "
            "block, or one derivative at a time by jax.jvp through adjust"
        )


def eliminated(at: Linearised, rows: ListedRows, curved: Float[Numbers, ""]) -> Eliminated:
    """Of H where `curved` is 1, of N where it is 0, in scaled increments; what is held fixed has a unit diagonal."""
    values, scale, s = at.values, at.scale, at.structure
    second = rows_second(at, curved)
    d_e, d_p, c = coupling_rows(second, at)
    k, n = len(c), 6 * s.n_images + s.n_shared
    at_points = points_second(second, at)
    h = row_products(values, scale, rows, curved, s)
    column = image_columns(s)[:, 6:][jnp.asarray(rows.image)] - 6 * s.n_images
    places = Met.of(s, k)
    v, interior = _by_point(h.by_point[6:], rows.point, column, places.interior, s)
    v = v + at_points.v
    added = jnp.where(jnp.einsum("iip->ip", v) == 0, 1.0, 0.0)
    l = cholesky_3x3(v + added[:, None] * jnp.eye(3)[:, :, None])  # noqa: E741
    # No right-hand side is taken down.
    met = jnp.concatenate([interior, d_p, jnp.zeros((1, *d_p.shape[1:])), at_points.w])
    border = jnp.stack(whiten(met.transpose(1, 0, 2), l)).transpose(2, 0, 1)
    w, point = h.by_point[:6], jnp.asarray(rows.point)
    if places.of_images.shape[1] > 6:
        w = jnp.concatenate([w, h.by_point[9:]])
    of_rows = jnp.stack(whiten(w.swapaxes(0, 1), l[:, point][:, None])).transpose(2, 0, 1)
    f = of_rows[jnp.asarray(rows.of_slot)]
    m = jnp.zeros((n + k, n + k)).at[:n, :n].set(other_second(second, s) + _by_unknown(h, s))
    m = m.at[n:, :n].set(d_e).at[:n, n:].set(d_e.T) - Met.products(f, border, s, k)
    fixed = jnp.where(jnp.diagonal(m) == 0, 1.0, 0.0)
    m = m.at[n:].set(c @ m[n:]) + jnp.diag(jnp.where(jnp.arange(n + k) < n, fixed, -1.0))
    return Eliminated(
        m, c, l, of_rows, border, point, places.of_images[jnp.asarray(rows.image)], places.of_points, h.measured
    )


def _by_point(
    met: Float[Array, "touched 3 rows"], point: Numbers, column: Int[Array, "rows colours"], i: int, s: PaddedStructure
) -> tuple[Float[Array, "3 3 points"], Float[Array, "interior 3 points"]]:
    """Sums over the rows of each point, of what it meets of itself and of interior unknowns."""
    n = s.n_points
    v = jax.ops.segment_sum(met[:3].reshape(9, -1).T, jnp.asarray(point), n).T.reshape(3, 3, n)
    at = jnp.asarray(point)[:, None], jnp.minimum(column, i)
    w = jnp.zeros((n, i + 1, 3)).at[at].add(met[3:].transpose(2, 0, 1) if i else 0.0)
    return v, w[:, :i].transpose(1, 2, 0)


def _by_unknown(h: RowProducts, s: PaddedStructure) -> Float[Array, "n n"]:
    """Sums by image, at the unknowns of the image and of its colours."""
    n_eop, columns = 6 * s.n_images, image_columns(s)
    each, n = jnp.arange(s.n_images), n_eop + s.n_shared
    eop = 0.5 * (h.eop + h.eop.transpose(0, 2, 1))
    own = jnp.zeros((s.n_images, 6, s.n_images, 6)).at[each, :, each].set(eop)
    m = jnp.zeros((n, n)).at[:n_eop, :n_eop].set(own.reshape(n_eop, n_eop))
    of_eop, of_shared = columns[:, :6], columns[:, 6:]
    m = m.at[of_shared[:, :, None], of_eop[:, None]].add(h.shared_eop, mode="drop")
    m = m.at[of_eop[:, :, None], of_shared[:, None]].add(h.shared_eop.transpose(0, 2, 1), mode="drop")
    return m.at[of_shared[:, :, None], of_shared[:, None]].add(h.shared, mode="drop")


def image_columns(s: PaddedStructure) -> Int[Array, "images e_and_colours"]:
    """Reduced unknowns of each image: exterior orientation, then those of its camera's colours."""
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.where(column < s.n_shared, 6 * s.n_images + column, NOWHERE)
    return jnp.concatenate([6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), shared], axis=1)


def solve_eliminated(h: Eliminated, b: Increments, s: PaddedStructure) -> Increments:
    """x of H x = b."""
    n_eop, n, size = 6 * s.n_images, 6 * s.n_images + s.n_shared, len(h.m)
    z = jnp.stack(whiten(b.points, h.l))
    right = jnp.concatenate([b.eop.T.reshape(-1), b.shared, jnp.zeros(size - n)])
    right = right.at[h.of_rays].add(-jnp.einsum("rae,ar->re", h.rays, z[:, h.point]), mode="drop")
    right = right.at[h.of_border].add(-jnp.einsum("pac,ap->pc", h.border, z), mode="drop")
    x = solve(h.m, jnp.concatenate([right[:n], h.c @ right[n:]]))
    met = lambda places: x.at[places].get(mode="fill", fill_value=0.0)  # noqa: E731
    z = z.T - jnp.einsum("pac,pc->pa", h.border, met(h.of_border))
    z = z.at[h.point].add(-jnp.einsum("rae,re->ra", h.rays, met(h.of_rays)))
    return Increments(x[:n_eop].reshape(-1, 6).T, x[n_eop:n], jnp.stack(unwhiten(z.T, h.l)))
