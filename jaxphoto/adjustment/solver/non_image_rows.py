"""Contributions of all rows except image rows to the normal equations, by group; see `model.observed_groups`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment.layout.padded import PaddedStructure
from jaxphoto.adjustment.model.numbers import NonImageResiduals, datum_residuals
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.row_functions import RowJacobian, in_portions, row_jacobian, rows_at_once
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.compiling import once


class RowsOfPoints(NamedTuple):
    """Rows that involve a point and shared unknowns: residuals, and derivatives with respect to both."""

    residual: Float[Array, "c rows points"]
    shared: Float[Array, "c l rows points"]
    points: Float[Array, "c 3 rows points"]
    slot: Int[Array, "l rows points"]
    """Slots of these unknowns in the list of the point's group."""

    def of_group(self, size: int) -> Float[Array, "size rows points c"]:
        """Return derivatives with respect to all `size` shared unknowns of a group of points."""
        _, rows, points = self.slot.shape
        at = self.slot, jnp.arange(rows)[:, None], jnp.arange(points)
        zero = jnp.zeros((size, rows, points, len(self.residual)))
        return zero.at[at].add(jnp.moveaxis(self.shared, 0, -1), mode="drop")


class NonImageRows(NamedTuple):
    """Derivatives and residuals of all rows except image rows."""

    jacobians: tuple[RowJacobian, ...]
    residuals: NonImageResiduals
    v: Float[Array, "3 3 points"]
    """Sums of J_p' J_p over the rows at each point."""
    b: Float[Array, "3 points"]
    """Sums of J_p' r over the rows at each point."""
    at_points: tuple["RowsOfPoints", ...]
    """Rows that also involve shared unknowns (`AbstractStructure.with_shared`)."""
    rows_e: Float[Array, "constraints images 6"]
    """Coupled rows: observations, then datum constraints."""
    rows_s: Float[Array, "constraints shared"]
    rows_p: Float[Array, "constraints 3 points"]
    coupled: Float[Array, "constraints"]
    """Residuals of the coupled rows."""


class NormalSums(NamedTuple):
    """Sums of the normal equations of images and shared unknowns (see `normal`), before points are eliminated.

    Shared unknowns have one extra column, for rows that involve none.
    """

    band: tuple[Float[Array, "inner 2w 6 w 6"], Float[Array, "w 6 w 6"]]
    """Pairs of two different images, by column block; products of an image with itself are in `u`."""
    u: Float[Array, "images 6 6"]
    us: Float[Array, "images 6 shared+1"]
    uss: Float[Array, "shared+1 shared+1"]
    b_s: Float[Array, "shared+1"]
    b_e: Float[Array, "images 6"]


def non_image_rows(at: Linearised, residuals: NonImageResiduals | None = None) -> NonImageRows:
    """Evaluate derivatives and residuals at `at` (or use `residuals`), and their sums by point."""
    increments, scale, values, s = at
    n = increments.points.shape[1]
    jacobians = tuple(
        row_jacobian(g, numbers, increments, scale, values, s)
        for g, numbers in zip(s.observed, values.groups, strict=True)
    )
    if residuals is None:
        own, names = tuple(j.residual for j in jacobians), tuple(g.name for g in s.observed)
        residuals = NonImageResiduals(own, datum_residuals(increments, scale, values, s), names)
    jacobians = tuple(j._replace(residual=jnp.asarray(r)) for j, r in zip(jacobians, residuals.others, strict=True))
    v, b = jnp.zeros((3, 3, n)), jnp.zeros((3, n))
    at_points: list[RowsOfPoints] = []
    coupling: list[tuple[Array, Array, Array]] = []
    coupled = []
    for g, j in zip(s.observed, jacobians, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            # Expand the sums by element and by pair of rows: they are few, each as long as the number of points.
            flat = j.points.reshape(-1, 3, *j.points.shape[3:])
            flat = jnp.moveaxis(flat, 2, 1).reshape(-1, 3, n)
            r = j.residual.reshape(-1, n)
            v, b = v + jnp.einsum("rap,rbp->abp", flat, flat), b + jnp.einsum("rap,rp->ap", flat, r)
            if g.place:
                at_points.append(RowsOfPoints(j.residual, j.shared, j.points[:, 0], jnp.asarray(g.slot)))
        elif g.elimination == "coupled":
            coupling.append(_coupled(g, j, s, n))
            coupled.append(j.residual.reshape(-1))
    constraints = at.constraints()
    datum = (
        constraints.eop.transpose(0, 2, 1),
        constraints.shared,
        constraints.points,
    )
    e, of_s, p = (jnp.concatenate(of) for of in zip(*coupling, datum, strict=True))
    coupled_rows = jnp.concatenate([*coupled, residuals.datum])
    return NonImageRows(jacobians, residuals, v, b, tuple(at_points), e, of_s, p, coupled_rows)


def _coupled(g: ObservedGroup, j: RowJacobian, s: PaddedStructure, n_points: int) -> tuple[Array, Array, Array]:
    """Return dense rows of a group, by images, shared unknowns and points."""
    c, each = g.components, jnp.arange(g.n_rows)
    e = jnp.zeros((c, g.n_rows, s.n_images, 6))
    for k, image in enumerate(g.image):
        e = e.at[:, each, image].add(j.eop[:, k].transpose(0, 2, 1))
    of_s = jnp.zeros((c, g.n_rows, s.n_shared + 1))
    for k, column in enumerate(g.column):
        of_s = of_s.at[:, each, column].add(j.shared[:, k])
    p = jnp.zeros((c, g.n_rows, 3, n_points))
    for k, point in enumerate(g.point):
        p = p.at[:, each, :, point].add(j.points[:, k].transpose(2, 0, 1))
    flat = lambda v: v.reshape(-1, *v.shape[2:])  # noqa: E731
    return flat(e), flat(of_s)[:, :-1], flat(p)


def add_non_image_rows(sums: NormalSums, rest: NonImageRows, s: PaddedStructure) -> NormalSums:
    """Add the sums of all rows that involve images and shared unknowns."""
    for g, j in zip(s.observed, rest.jacobians, strict=True):
        if g.elimination == "reduced":
            sums = _add_reduced(sums, g, j, s)
    return sums._replace(us=sums.us[:, :, :-1], uss=sums.uss[:-1, :-1], b_s=sums.b_s[:-1])


def _add_reduced(sums: NormalSums, g: ObservedGroup, j: RowJacobian, s: PaddedStructure) -> NormalSums:
    band, u, us, uss, b_s, b_e = sums
    pair = 0
    for a, image in enumerate(g.image):
        own = j.eop[:, a]
        square = once(lambda own, r: _products(own, jnp.concatenate([own, r[:, None]], 1)), s.eop_free, own, j.residual)
        by_image = sum_by(square.reshape(-1, 42), image, s.n_images).reshape(-1, 6, 7)
        u, b_e = u + by_image[:, :, :6], b_e + by_image[:, :, 6]
        for other in range(a):
            across = _products(own, j.eop[:, other])
            which, row, column, turned = jnp.asarray(g.pair[pair]).T
            pair += 1
            same = (jnp.asarray(g.image[other]) == image)[:, None, None]
            # A row that involves an image twice: both halves of the product belong to that image.
            both = jnp.where(same, across + across.transpose(0, 2, 1), 0.0)
            u = u + sum_by(both.reshape(-1, 36), image, s.n_images).reshape(-1, 6, 6)
            across = jnp.where(turned[:, None, None] > 0, across.transpose(0, 2, 1), across)
            band = add_blocks(band, jnp.where(same, 0.0, across), jnp.stack([which, row, column], 1))
        if len(g.place):
            met = _products(own, j.shared)
            us = us.at[jnp.asarray(image)[:, None], :, jnp.asarray(g.column).T].add(met.transpose(0, 2, 1))
    if len(g.place):
        column = jnp.asarray(g.column)
        uss = _add_products(uss, column, j.shared)
        b_s = b_s.at[column.T].add(jnp.einsum("cln,cn->nl", j.shared, j.residual))
    return NormalSums(band, u, us, uss, b_s, b_e)


def _add_products(
    uss: Float[Array, "size size"], column: Int[Array, "l rows"], shared: Float[Array, "c l rows"]
) -> Float[Array, "size size"]:
    """Add the products of each row's derivatives."""
    length, n = column.shape
    size = rows_at_once(length**2)

    def added(uss: Array, rows: tuple[Array, Array]) -> tuple[Array, None]:
        own = rows[0].T
        return uss.at[own[:, :, None], own[:, None]].add(_products(rows[1], rows[1])), None

    if n <= size:
        return added(uss, (column, shared))[0]
    # Padding of the last portion has zero derivatives.
    shared = jnp.pad(shared, ((0, 0), (0, 0), (0, -n % size)))
    return jax.lax.scan(added, uss, (in_portions(column, size), in_portions(shared, size)))[0]


def _products(a: Float[Array, "c a rows"], b: Float[Array, "c b rows"]) -> Float[Array, "rows a b"]:
    return jnp.einsum("can,cbn->nab", a, b)


def add_blocks(
    band: tuple[Array, Array], blocks: Float[Array, "blocks 6 6"], place: Array, distinct: bool = False
) -> tuple[Array, Array]:
    """Add blocks of pairs of images to the inner column blocks or to the last (see `RayLists.block`).

    Blocks outside both are dropped. `distinct` asserts that no two blocks have the same position, which is faster.
    """
    columns, last = band
    which, row, column = place.T
    width, inner = len(last), len(columns)
    if inner:
        columns = columns.at[which, row, :, column].add(blocks, mode="drop", unique_indices=distinct)
    row = jnp.where(which == inner, row, width)
    return columns, last.at[row, :, column].add(blocks, mode="drop")


# XLA compiles the loop over the rows of a scatter as one function if rows are short, otherwise as several calls per
# row.
_PIECE = 36


def sum_by(rows: Float[Array, "rows c"], which: Array | np.ndarray | Any, n: int) -> Float[Array, "n c"]:
    """Sum rows by an index from 0 to n - 1."""
    pieces = -(-rows.shape[1] // _PIECE)
    size = -(-rows.shape[1] // pieces)
    split = jnp.pad(rows, ((0, 0), (0, pieces * size - rows.shape[1]))).reshape(-1, size)
    at = (which[:, None] * pieces + jnp.arange(pieces)).reshape(-1)
    return jax.ops.segment_sum(split, at, n * pieces).reshape(n, -1)[:, : rows.shape[1]]
