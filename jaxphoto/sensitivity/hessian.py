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

from jaxphoto.adjustment import Adjustment, Linearised, TiledStructure
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
    """M, and what takes vectors down to it and back to the points; tiles of all chunks are joined."""

    m: Float[Array, "n_and_k n_and_k"]
    c: Float[Array, "k k"]
    gain: Float[Array, "tiles p 3 f"]
    """-V^-1 [W; Ws; D]': what points answer to unknowns of M."""
    l: Float[Array, "tiles 6 p"]  # noqa: E741
    """Cholesky factors of V."""
    touched: Int[Array, "tiles f"]
    """The unknowns of M that the columns of the gain belong to."""
    measured: Float[Array, "rows 2 touched"]
    """-B of each image row by its measured x and y (mm): of eop (6), point (3), colours."""


def check_optimum(adjusted: Adjustment) -> None:
    """Raise InputError where there is no optimum, and where M is too large to hold."""
    if not bool(adjusted.converged):
        raise InputError(
            "the adjustment has not converged, and only an optimum has a sensitivity: adjust until it converges"
        )
    s = adjusted.tiled.structure
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

    def tile(numbers):
        image, slots, own_v, own_w, d_p = numbers
        met = h.by_point.at[:, :, slots].get(mode="promise_in_bounds")
        v = jnp.sum(met[6:9], axis=2) + own_v
        # Of shared unknowns that points meet besides those of cameras, which these follow.
        of_shared = jnp.concatenate([_by_interior(met[9:], image, s), own_w])
        added = jnp.where(jnp.einsum("iip->ip", v) == 0, 1.0, 0.0)
        l = cholesky_3x3(v + added[:, None] * jnp.eye(3)[:, :, None])  # noqa: E741
        by_image = met[:6].transpose(2, 0, 1, 3).reshape(-1, 3, slots.shape[1])
        w = jnp.concatenate([by_image, of_shared, d_p])
        f = jnp.stack(whiten(w.transpose(1, 0, 2), l), axis=1)
        gain = -jnp.stack(unwhiten(f.transpose(1, 0, 2), l))
        flat = f.reshape(len(f), -1)
        return gain.transpose(2, 0, 1), l, flat @ flat.T

    of_points = (s.by_tile(v) for v in (*at_points, d_p))
    *found, gram = s.each_tile(tile, (rows.of_slot, *of_points))
    gain, l = (v.reshape(-1, *v.shape[2:]) for v in found)  # noqa: E741
    # Tiles that are padding were not computed: their points are each by itself.
    l = jnp.where(l[:, :1] == 0, jnp.array([1.0, 0, 1, 0, 0, 1])[:, None], l)  # noqa: E741

    image = jnp.asarray(s.tiles.image).reshape(len(l), -1)
    met = jnp.asarray(s.tiles.met).reshape(len(l), -1)
    # What means no unknown has no products, and its place is as good as any.
    met = jnp.where(met < s.n_shared, 6 * s.n_images + met, 0)
    all_meet = lambda v: jnp.broadcast_to(v, (len(l), len(v)))  # noqa: E731
    interior = all_meet(6 * s.n_images + jnp.arange(s.n_interior))
    border = jnp.concatenate([interior, met, all_meet(n + jnp.arange(k))], axis=1)
    m = jnp.zeros((n + k, n + k)).at[:n, :n].set(other_second(second, s) + _by_unknown(h, s))
    m = m.at[n:, :n].set(d_e).at[:n, n:].set(d_e.T) - _products(gram, border, n + k, s)
    fixed = jnp.where(jnp.diagonal(m) == 0, 1.0, 0.0)
    m = m.at[n:].set(c @ m[n:]) + jnp.diag(jnp.where(jnp.arange(n + k) < n, fixed, -1.0))
    by_eop = (6 * image[:, :, None] + jnp.arange(6)).reshape(len(l), -1)
    touched = jnp.concatenate([by_eop, border], axis=1)
    return Eliminated(m, c, gain, l, touched, h.measured)


def _by_unknown(h: RowProducts, s: TiledStructure) -> Float[Array, "n n"]:
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


def _products(
    gram: Float[Array, "chunks tiles f f"], border: Int[Array, "all_tiles b"], size: int, s: TiledStructure
) -> Float[Array, "size size"]:
    """F F' of all tiles at their unknowns: pairs of images by the lists of `Tiles`, the border by what it means."""
    tiles, n = s.tiles, s.n_images
    m, width = tiles.image.shape[2], n // tiles.columns

    def blocks(numbers):
        gram, pair_tile, pair, pair_block, block = numbers
        of_pairs = gram[:, : 6 * m, : 6 * m].reshape(-1, m, 6, m, 6)[pair_tile, pair[:, 0], :, pair[:, 1]]
        return jax.ops.segment_sum(of_pairs, pair_block, len(block), indices_are_sorted=True)

    lists = (tiles.pair_tile, tiles.pair_images, tiles.pair_block, tiles.block)
    found = jax.lax.map(blocks, (gram, *lists)).reshape(-1, 6, 6)
    which, row, column = jnp.asarray(tiles.block).reshape(-1, 3).T
    row, column = which * width + row, which * width + column
    # Blocks that are none lie behind the last column block; what is added there is dropped.
    row, mirrored = (
        jnp.where(which < tiles.columns, row, n),
        jnp.where((which < tiles.columns) & (row > column), row, n),
    )
    eop = jnp.zeros((n, 6, n, 6)).at[row, :, column].add(found, mode="drop")
    eop = eop.at[column, :, mirrored].add(found.transpose(0, 2, 1), mode="drop").reshape(6 * n, 6 * n)
    image, gram = jnp.asarray(tiles.image).reshape(len(border), m), gram.reshape(len(border), *gram.shape[2:])
    met = gram[:, : 6 * m, 6 * m :].reshape(len(border), m, 6, -1).transpose(0, 1, 3, 2)
    across = jnp.zeros((n, 6, size)).at[image[:, :, None], :, border[:, None]].add(met).reshape(6 * n, -1)
    result = jnp.zeros((size, size)).at[: 6 * n, : 6 * n].set(eop)
    result = result.at[: 6 * n].add(across).at[:, : 6 * n].add(across.T)
    return result.at[border[:, :, None], border[:, None]].add(gram[:, 6 * m :, 6 * m :])


def image_columns(s: TiledStructure) -> Int[Array, "images e_and_colours"]:
    """Reduced unknowns of each image: exterior orientation, then those of its camera's colours."""
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.where(column < s.n_shared, 6 * s.n_images + column, NOWHERE)
    return jnp.concatenate([6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), shared], axis=1)


def solve_eliminated(h: Eliminated, b: Increments, s: TiledStructure) -> Increments:
    """x of H x = b."""
    n_eop, n = 6 * s.n_images, 6 * s.n_images + s.n_shared
    of_points = b.points.reshape(3, len(h.l), -1)
    right = jnp.concatenate([b.eop.T.reshape(-1), b.shared, jnp.zeros(len(h.c))])
    right = right.at[h.touched].add(jnp.einsum("tpkf,ktp->tf", h.gain, of_points))
    x = solve(h.m, jnp.concatenate([right[:n], h.c @ right[n:]]))
    l = h.l.transpose(1, 0, 2)  # noqa: E741
    points = jnp.stack(unwhiten(whiten(of_points, l), l)) + jnp.einsum("tpkf,tf->ktp", h.gain, x[h.touched])
    return Increments(x[:n_eop].reshape(-1, 6).T, x[n_eop:n], points.reshape(3, -1))


def _by_interior(w: Float[Array, "q 3 m p"], image: Array, s: TiledStructure) -> Float[Array, "interior 3 p"]:
    """Ws of a tile: what its colours mean, added up over its images."""
    if not s.n_interior:
        return jnp.zeros((0, 3, w.shape[3]))
    column = jnp.asarray(s.column)[image, : s.n_image_colours].T
    pick = (column == jnp.arange(s.n_interior)[:, None, None]).astype(float)
    return jnp.einsum("iqm,qkmp->ikp", pick, w)
