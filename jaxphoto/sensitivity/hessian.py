"""Second derivatives of half the weighted sum of squares at an optimum, with the points eliminated.

With r the weighted residuals, y the increments and v any value that r depends on, half the sum of squares has

    H = J'J + sum_r r d2r/dy2           the normal matrix and the curvature of the residuals
    B = J' dr/dv + sum_r r d2r/dy dv    the change of the gradient J'r with v

and the optimum changes with dv by dy = -H^-1 B dv. Without the terms in r (`curved` 0 instead of 1), this is the
classical first-order matrix -N^-1 J' dr/dv. Derivatives are exact, by automatic differentiation, and stored by the
unknowns of each row, not as dense matrices.

Every image row involves one image, one point and one camera, so H has the blocks of the normal matrix (see
adjustment/solver/normal.py). Its points are eliminated in the same way, by V = L L' and F = [W; Ws'; D_p] L^-T. Some
rows, and the datum, couple points: D (the variables of such a row, then the constraints) has the weight C, and
mu = C D x are additional unknowns. With S, G, K the parts of H, D and 0 without the points,

    M = [ S     G'      ]
        [ C G   C K - I ]
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, CoupledUnknowns, Linearised, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.row_functions import (
    RowInputs,
    RowVariables,
    each_row,
    gathered_rows,
    reduced_places,
    row_function,
)
from jaxphoto.arrays import ArrayLike
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.sensitivity.image_rows import ListedRows, RowProducts, row_products
from jaxphoto.small_matrices import cholesky_3x3, unwhiten, whiten


class RowSecond(NamedTuple):
    """Second derivatives of half the squared residuals of each row of a group; the row axis is last.

    The variables z of a row are the increments of its images, its shared unknowns and the increments of its points.
    """

    h: Float[Array, "z z rows"]
    b: Float[Array, "z o rows"]
    """Second derivatives by z and by the observations."""


def mixed_second(at: Linearised, direction: PaddedValues, curved: Float[ArrayLike, ""]) -> Increments:
    """Compute B dv over all rows, for a direction dv of the values; leaves that are None do not change."""

    def gradient(changed):
        values = eqx.combine(changed, at.values)
        residuals, vjp = jax.vjp(lambda y: Linearised(y, at.scale, values, at.structure).residuals(), at.increments)
        weighted = jax.tree.map(lambda r: r - (1 - curved) * jax.lax.stop_gradient(r), residuals)
        return vjp(weighted)[0]

    varying = jax.tree.map(lambda d: d is not None, direction, is_leaf=lambda d: d is None)
    return jax.jvp(gradient, (eqx.filter(at.values, varying),), (direction,))[1]


def row_second(group: ObservedGroup, numbers: Any, at: Linearised, curved: Float[ArrayLike, ""]) -> RowSecond:
    """Compute H and B of every row of a group."""
    function = row_function(group, at.structure)

    def second(z: RowVariables, inputs: RowInputs) -> RowSecond:
        flat, unravel = ravel_pytree(z)
        observed = inputs.row.observation

        def half_square(flat: Array, observed: Array) -> Float[Array, ""]:
            r = function(unravel(flat), inputs._replace(row=inputs.row.with_observation(observed)))
            # The second derivative of this is J'J + curved r d2r.
            return jnp.sum(0.5 * r * r - (1 - curved) * jax.lax.stop_gradient(r) * r)

        slope = jax.grad(half_square)
        h, b = jax.jacfwd(slope, (0, 1))(flat, observed)
        return RowSecond(h, b.reshape(len(flat), -1))

    inputs = gathered_rows(group, numbers, at.increments, at.scale, at.values)
    return each_row(second, group, *inputs)


def rows_second(at: Linearised, curved: Float[ArrayLike, ""]) -> tuple[RowSecond, ...]:
    """Apply `row_second` to all groups."""
    s = at.structure
    return tuple(row_second(g, numbers, at, curved) for g, numbers in zip(s.observed, at.values.groups, strict=True))


class AtPointsSecond(NamedTuple):
    """Sums over the rows that are eliminated with their points (see `NonImageRows`)."""

    v: Float[Array, "3 3 points"]
    w: Float[Array, "b 3 points"]
    """Mixed derivatives by the other unknowns of these groups, `RayLists.met`."""


def points_second(second: tuple[RowSecond, ...], at: Linearised) -> AtPointsSecond:
    """Compute H of these rows: by the points, and by the points and shared unknowns."""
    s, n = at.structure, at.increments.points.shape[1]
    v, w = jnp.zeros((3, 3, n)), jnp.zeros((s.rays.met.shape[1], n, 3))
    for g, of_group in zip(s.observed, second, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            k = len(g.place)
            v = v + jnp.sum(of_group.h[k:, k:], axis=2)
            w = w.at[jnp.asarray(g.slot), jnp.arange(n)].add(jnp.moveaxis(of_group.h[:k, k:], 1, -1), mode="drop")
    return AtPointsSecond(v, jnp.moveaxis(w, 2, 1))


def coupling_rows(second: tuple[RowSecond, ...], at: Linearised) -> tuple[Array, Array, Array]:
    """Return D by the reduced unknowns (k, n) and by the points (k, 3, points), and its weight C.

    For a row that couples points, the rows of D select its variables one by one, and C is its H.
    """
    values, scale, s = at.values, at.scale, at.structure
    n, n_points, fixed = 6 * s.n_images + s.n_shared, scale.points.shape[1], values.datum_eop.shape[0]
    d_e: list[Array] = []
    d_p: list[Array] = []
    blocks: list[Array] = []
    for g, of_group in zip(s.observed, second, strict=True):
        if g.elimination == "coupled":
            places = reduced_places(g, s.n_images).T
            reduced, z = places.shape[1], len(of_group.h)
            rows = jnp.arange(g.n_rows)[:, None]
            e = jnp.zeros((g.n_rows, z, n)).at[rows, jnp.arange(reduced), places].set(1.0, mode="drop")
            p = jnp.zeros((g.n_rows, z, 3, n_points))
            for k, point in enumerate(g.point):
                axis = jnp.arange(3)
                p = p.at[rows, reduced + 3 * k + axis, axis, jnp.asarray(point)[:, None]].set(1.0)
            d_e, d_p = [*d_e, e.reshape(-1, n)], [*d_p, p.reshape(-1, 3, n_points)]
            blocks += list(jnp.moveaxis(of_group.h, 2, 0))
    datum = at.constraints()
    d_e.append(jnp.concatenate([datum.eop.transpose(0, 2, 1).reshape(fixed, 6 * s.n_images), datum.shared], axis=1))
    d_p.append(datum.points)
    return jnp.concatenate(d_e), jnp.concatenate(d_p), _block_diagonal([*blocks, jnp.eye(fixed)])


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(b) for b in blocks)
    result, first = jnp.zeros((size, size)), 0
    for b in blocks:
        result = result.at[first : first + len(b), first : first + len(b)].set(b)
        first += len(b)
    return result


def other_second(second: tuple[RowSecond, ...], s: PaddedStructure) -> Float[Array, "n n"]:
    """Compute H of the non-image rows in the reduced unknowns, except rows that couple points."""
    n = 6 * s.n_images + s.n_shared
    h = jnp.zeros((n, n))
    for g, of_group in zip(s.observed, second, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            k, rows = len(g.place), math.prod(of_group.h.shape[2:])
            place = 6 * s.n_images + jnp.asarray(g.column).reshape(k, rows)
            h_rows = of_group.h[:k, :k].reshape(k, k, rows)
        elif g.elimination == "reduced":
            place, h_rows = reduced_places(g, s.n_images), of_group.h
        else:
            continue
        # Indices beyond the last unknown are padding.
        h = h.at[place.T[:, :, None], place.T[:, None]].add(jnp.moveaxis(h_rows, 2, 0), mode="drop")
    return h


# Index outside every array: additions with this index are dropped.
NOWHERE = int(np.iinfo(np.int32).max)
# Maximum number of reduced unknowns; a dense matrix of this size is inverted within seconds.
_MAX_UNKNOWNS = 6000


class ReducedHessian(NamedTuple):
    """M, and the factors for elimination and back substitution of the points."""

    m: Float[Array, "n_and_k n_and_k"]
    c: Float[Array, "k k"]
    l: Float[Array, "6 points"]  # noqa: E741
    """Cholesky factors of V."""
    rays: Float[Array, "rays 3 e"]
    """F of each ray by the unknowns of its image."""
    border: Float[Array, "points 3 c"]
    """F of each point by its other unknowns."""
    point: Int[Array, "rays"]
    """Point index of each ray."""
    ray_index: Int[Array, "rays e"]
    """Indices in M of the columns of `rays`; beyond the last unknown for padding."""
    border_index: Int[Array, "points c"]
    """Indices in M of the columns of `border`; beyond the last unknown for padding."""
    measured: Float[Array, "rows 2 touched"]
    """-B of each image row by its measured x and y (mm): exterior orientation (6), point (3), camera unknowns."""


def check_optimum(adjusted: Adjustment) -> None:
    """Raise InputError if the adjustment has not converged or M is too large."""
    if not bool(adjusted.converged):
        raise InputError("sensitivity needs a converged adjustment: adjust until it converges")
    s = adjusted.padded.structure
    unknowns = 6 * s.n_images + s.n_shared
    if unknowns > _MAX_UNKNOWNS:
        raise InputError(
            f"sensitivity inverts a dense matrix of {unknowns} unknowns, more than {_MAX_UNKNOWNS}: use a smaller "
            "block, or one derivative at a time by jax.jvp through adjust"
        )


def reduce_hessian(at: Linearised, rows: ListedRows, curved: Float[ArrayLike, ""]) -> ReducedHessian:
    """Eliminate the points from H (`curved` 1) or N (0), in scaled increments; fixed unknowns get a unit diagonal."""
    values, scale, s = at.values, at.scale, at.structure
    second = rows_second(at, curved)
    d_e, d_p, c = coupling_rows(second, at)
    k, n = len(c), 6 * s.n_images + s.n_shared
    at_points = points_second(second, at)
    h = row_products(values, scale, rows, curved, s)
    column = image_columns(s)[:, 6:][jnp.asarray(rows.image)] - 6 * s.n_images
    places = CoupledUnknowns.of(s, k)
    v, interior = _by_point(h.by_point[6:], rows.point, column, places.interior, s)
    v = v + at_points.v
    unit = jnp.where(jnp.einsum("iip->ip", v) == 0, 1.0, 0.0)
    l = cholesky_3x3(v + unit[:, None] * jnp.eye(3)[:, :, None])  # noqa: E741
    # Drop the column of the right-hand side: it is zero.
    met = jnp.concatenate([interior, d_p, jnp.zeros((1, *d_p.shape[1:])), at_points.w])
    border = jnp.stack(whiten(met.transpose(1, 0, 2), l)).transpose(2, 0, 1)
    w, point = h.by_point[:6], jnp.asarray(rows.point)
    if places.of_images.shape[1] > 6:
        w = jnp.concatenate([w, h.by_point[9:]])
    ray_factors = jnp.stack(whiten(w.swapaxes(0, 1), l[:, point][:, None])).transpose(2, 0, 1)
    f = ray_factors[jnp.asarray(rows.of_slot)]
    m = jnp.zeros((n + k, n + k)).at[:n, :n].set(other_second(second, s) + _by_unknown(h, s))
    m = m.at[n:, :n].set(d_e).at[:n, n:].set(d_e.T) - CoupledUnknowns.products(f, border, s, k)
    fixed = jnp.where(jnp.diagonal(m) == 0, 1.0, 0.0)
    m = m.at[n:].set(c @ m[n:]) + jnp.diag(jnp.where(jnp.arange(n + k) < n, fixed, -1.0))
    return ReducedHessian(
        m, c, l, ray_factors, border, point, places.of_images[jnp.asarray(rows.image)], places.of_points, h.measured
    )


def _by_point(
    met: Float[Array, "touched 3 rows"],
    point: ArrayLike,
    column: Int[Array, "rows colours"],
    i: int,
    s: PaddedStructure,
) -> tuple[Float[Array, "3 3 points"], Float[Array, "interior 3 points"]]:
    """Sum over the rows of each point: by the point, and by the point and camera unknowns."""
    n = s.n_points
    v = jax.ops.segment_sum(met[:3].reshape(9, -1).T, jnp.asarray(point), n).T.reshape(3, 3, n)
    at = jnp.asarray(point)[:, None], jnp.minimum(column, i)
    w = jnp.zeros((n, i + 1, 3)).at[at].add(met[3:].transpose(2, 0, 1) if i else 0.0)
    return v, w[:, :i].transpose(1, 2, 0)


def _by_unknown(h: RowProducts, s: PaddedStructure) -> Float[Array, "n n"]:
    """Assemble the sums by image into a matrix of the exterior orientations and camera unknowns."""
    n_eop, columns = 6 * s.n_images, image_columns(s)
    images, n = jnp.arange(s.n_images), n_eop + s.n_shared
    eop = 0.5 * (h.eop + h.eop.transpose(0, 2, 1))
    diagonal = jnp.zeros((s.n_images, 6, s.n_images, 6)).at[images, :, images].set(eop)
    m = jnp.zeros((n, n)).at[:n_eop, :n_eop].set(diagonal.reshape(n_eop, n_eop))
    of_eop, of_shared = columns[:, :6], columns[:, 6:]
    m = m.at[of_shared[:, :, None], of_eop[:, None]].add(h.shared_eop, mode="drop")
    m = m.at[of_eop[:, :, None], of_shared[:, None]].add(h.shared_eop.transpose(0, 2, 1), mode="drop")
    return m.at[of_shared[:, :, None], of_shared[:, None]].add(h.shared, mode="drop")


def image_columns(s: PaddedStructure) -> Int[Array, "images e_and_colours"]:
    """Return the reduced unknowns of each image: exterior orientation, then the camera unknowns of its camera."""
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.where(column < s.n_shared, 6 * s.n_images + column, NOWHERE)
    return jnp.concatenate([6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), shared], axis=1)


def solve_hessian(h: ReducedHessian, b: Increments, s: PaddedStructure) -> Increments:
    """Solve H x = b."""
    n_eop, n, size = 6 * s.n_images, 6 * s.n_images + s.n_shared, len(h.m)
    z = jnp.stack(whiten(b.points, h.l))
    right = jnp.concatenate([b.eop.T.reshape(-1), b.shared, jnp.zeros(size - n)])
    right = right.at[h.ray_index].add(-jnp.einsum("rae,ar->re", h.rays, z[:, h.point]), mode="drop")
    right = right.at[h.border_index].add(-jnp.einsum("pac,ap->pc", h.border, z), mode="drop")
    x = solve(h.m, jnp.concatenate([right[:n], h.c @ right[n:]]))
    x_at = lambda index: x.at[index].get(mode="fill", fill_value=0.0)  # noqa: E731
    z = z.T - jnp.einsum("pac,pc->pa", h.border, x_at(h.border_index))
    z = z.at[h.point].add(-jnp.einsum("rae,re->ra", h.rays, x_at(h.ray_index)))
    return Increments(x[:n_eop].reshape(-1, 6).T, x[n_eop:n], jnp.stack(unwhiten(z.T, h.l)))
