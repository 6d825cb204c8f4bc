"""Sums of outer products over the rows of a block, by image, by point and by pair of images."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.structure import Structure


def products(rows: Float[Array, "m c n"], owner, n_owners: int, is_sorted: bool = False):
    """Sum over rows and components of the outer products of `rows`, by owner: (owners, m, m)."""
    product = jnp.einsum("aon,bon->nab", rows, rows)
    m = len(rows)
    sums = jax.ops.segment_sum(product.reshape(-1, m * m), owner, n_owners, indices_are_sorted=is_sorted)
    return sums.reshape(n_owners, m, m)


def _take_rows(table, index):
    return table.at[index].get(mode="promise_in_bounds")


def with_zero_row(m: Float[Array, "m c n"]) -> Float[Array, "n+1 c*m"]:
    """Row by row, components before columns, and a row of zeros for padding."""
    flat = m.transpose(2, 1, 0).reshape(m.shape[2], -1)
    return jnp.concatenate([flat, jnp.zeros((1, flat.shape[1]))])


# So many numbers, at most, are gathered at a time: they stay in the cache of a core, and memory stays small.
_PIECE = 1 << 20


def _piecewise(function, lists, numbers: int):
    """`function` of each entry of `lists`, as many at a time as the cache holds, `numbers` gathered by each."""
    size = min(len(jax.tree.leaves(lists)[0]), max(1, _PIECE // max(numbers, 1)))
    return jax.lax.map(function, lists, batch_size=size)


def image_products(rows: Float[Array, "m c n"], s: Structure) -> Float[Array, "images m m"]:
    """Sum of the outer products of image rows, by image: one product of matrices each."""
    table, m = with_zero_row(rows), len(rows)

    def one(index):
        own = _take_rows(table, index).reshape(-1, m)
        return own.T @ own

    return _piecewise(one, s.image_rows, s.image_rows.shape[1] * table.shape[1])


def met_by_image(rows, across: Float[Array, "c 3 points"], s: Structure) -> Float[Array, "images 6 c"]:
    """Sum of Y across' over the points of an image."""
    c = len(across)
    if not c:
        return jnp.zeros((s.n_images, 6, 0))
    table = across.transpose(2, 1, 0).reshape(-1, 3 * c)

    def one(index):
        return _take_rows(rows, index[0]).reshape(-1, 6).T @ _take_rows(table, index[1]).reshape(-1, c)

    return _piecewise(one, (s.image_rows, s.image_points), s.image_rows.shape[1] * 3 * (6 + c))


def pair_sums(rows: Float[Array, "n+1 18"], s: Structure) -> Float[Array, "blocks 6 6"]:
    """Sum over common points of Y_a Y_b', by pair of images: products of chunks of points, then their sum."""

    def one(index):
        return _take_rows(rows, index[0]).reshape(-1, 6).T @ _take_rows(rows, index[1]).reshape(-1, 6)

    products = _piecewise(one, (s.chunk_a, s.chunk_b), 36 * s.chunk_a.shape[1]).reshape(-1, 36)
    sums = jax.ops.segment_sum(
        products, s.chunk_block, len(s.block_row), indices_are_sorted=True, mode="promise_in_bounds"
    )
    return sums.reshape(-1, 6, 6)


def shared_sums(m: Float[Array, "images m m"], s: Structure):
    """Per-image sums by colour, brought to the columns of the shared unknowns (a dummy column is cut off)."""
    q, n = s.n_colours, s.n_shared
    each = jnp.arange(s.n_images)
    us = jnp.zeros((s.n_images, 6, n + 1)).at[each[:, None], :, s.column].add(m[:, :6, 6 : 6 + q].transpose(0, 2, 1))
    uss = jnp.zeros((n + 1, n + 1)).at[s.column[:, :, None], s.column[:, None, :]].add(m[:, 6 : 6 + q, 6 : 6 + q])
    b_s = jnp.zeros(n + 1).at[s.column].add(m[:, 6 : 6 + q, -1])
    return us[:, :, :n], uss[:n, :n], b_s[:n]


def shared_point_sums(product: Float[Array, "rows colours 3"], s: Structure) -> Float[Array, "shared 3 points"]:
    """Products of image rows' shared columns with their points, brought to the shared unknowns and summed by point."""
    q, n = s.n_image_colours, s.n_shared
    if not q:
        return jnp.zeros((n, 3, s.n_points))
    if len(s.groups) == 1 and len(s.groups[0].names) == 1:
        # One camera: a colour means the same unknown in every image, so a sorted sum over points will do.
        sums = jax.ops.segment_sum(product.reshape(-1, 3 * q), s.point, s.n_points, indices_are_sorted=True)
        sums = sums.reshape(s.n_points, q, 3).transpose(1, 2, 0)
        return jnp.concatenate([sums, jnp.zeros((n - q, 3, s.n_points))])
    columns = s.column[s.image][:, :q]
    sums = jnp.zeros((n + 1, s.n_points, 3)).at[columns, s.point[:, None]].add(product)
    return sums[:n].transpose(0, 2, 1)
