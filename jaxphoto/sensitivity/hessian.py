"""Second derivatives of half the weighted square sum at an optimum, with the points eliminated.

With r the weighted residuals, y the increments and v any number that r depends on, half the square sum has

    H = J'J + sum_r r d2r/dy2           the normal matrix and the residuals' curvature
    B = J' dr/dv + sum_r r d2r/dy dv    what a change of v does to the gradient J'r

and the optimum answers dv with dy = -H^-1 B dv. Without the terms that carry r, this is the classical first-order
matrix -N^-1 J' dr/dv. Every image row touches one image, one point and one camera, so H has the blocks of the normal
matrix (see adjustment/normal.py) and its points are eliminated alike, by V = L L' and F = [W; Ws; D] L^-T. Distances
and the datum couple points: their rows D (three components of each distance, then the constraints) have the weight C,
and mu = C D x is carried by more unknowns. With S, G, K what is left of H, D and 0 without the points,

    M = [ S     G'      ]
        [ C G   C K - I ]
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.normal import At, cholesky_3x3, each_tile_of, unwhiten, whiten
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.reduced import other_rows
from jaxphoto.adjustment.residuals import Increments, Values
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure
from jaxphoto.adjustment.tiles import (
    by_tile,
    of_images,
    scene_of,
    seen_in,
    slopes_of,
)
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError
from jaxphoto.sensitivity.curvature import bends_of, by_slot, coupling_rows, other_second

# An index that no array has: what is added there is dropped.
NOWHERE = int(np.iinfo(np.int32).max)
# Reduced unknowns whose dense matrix is inverted within seconds.
_MOST_UNKNOWNS = 6000


class Eliminated(NamedTuple):
    """M, and what takes vectors down to it and back to the points; tiles of all chunks are joined."""

    m: Float[Array, "n+k n+k"]
    c: Float[Array, "k k"]
    f: Float[Array, "tiles f 3 p"]
    l: Float[Array, "tiles 6 p"]  # noqa: E741
    touched: Int[Array, "tiles f"]
    """Unknowns of M that the rows of F belong to."""
    measured: Float[Array, "tiles a 2 m p"]
    """B of each image row by its measured x and y (mm): in eop (6), colours, point (3)."""


def eliminated(adjusted: Adjustment, curvature: bool) -> Eliminated:
    """H (or N, without `curvature`) at the optimum that `adjusted` has found.

    Raises InputError where there is no optimum, and where M is too large to hold.
    """
    if not bool(adjusted.converged):
        raise InputError(
            "the adjustment has not converged, and only an optimum has a sensitivity: adjust until it converges"
        )
    computed = adjusted.computed
    s = on_one_device(computed.structure)
    unknowns = 6 * s.n_images + s.n_shared
    if unknowns > _MOST_UNKNOWNS:
        raise InputError(
            f"sensitivity inverts a dense matrix of {unknowns} unknowns, {_MOST_UNKNOWNS} at most: take a smaller "
            "block, or one derivative at a time by jax.jvp through adjust"
        )
    values, scale = jax.tree.map(still, (computed.values, computed.factored.scale))
    arguments = (values, scale, s, np.array(float(curvature)))
    return run_compiled(_eliminate, arguments, adjusted.seconds, "sensitivity")


@eqx.filter_jit
def _eliminate(values: Values, scale: Increments, s: Structure, curved: Float[Numbers, ""]) -> Eliminated:
    """Of H where `curved` is 1, of N where it is 0, in scaled increments; what is held fixed has a unit diagonal."""
    values = weigh_datum(values, s)
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, values, s)
    d_e, d_p, c = coupling_rows(at, curved)
    k, n, q = len(c), 6 * s.n_images + s.n_shared, s.n_image_colours
    control = other_rows(at).control ** 2
    scene, slopes = scene_of(at.state, s), slopes_of(at.increments, scale, values, s)

    bends = bends_of(scale, values)

    def tile(numbers):
        image, points, step, control, d_p, xy, sigma = numbers
        seen = seen_in(xy, sigma, image, s)
        parts = of_images(scene, image, s), of_images(slopes, image, s), bends[image]
        h, measured = by_slot(*parts, points, step, seen, curved, s)
        v = jnp.sum(h[6 + q :, 6 + q :], axis=2)
        added = control + jnp.where(jnp.einsum("iip->ip", v) + control == 0, 1.0, 0.0)
        l = cholesky_3x3(v + added[:, None] * jnp.eye(3)[:, :, None])  # noqa: E741
        by_image = h[:6, 6 + q :].transpose(2, 0, 1, 3).reshape(-1, 3, step.shape[1])
        met = jnp.concatenate([by_image, _by_interior(h[6 : 6 + q, 6 + q :], image, s), d_p])
        f = jnp.stack(whiten(met.transpose(1, 0, 2), l), axis=1)
        flat = f.reshape(len(f), -1)
        return f, l, measured, jnp.sum(h[: 6 + q, : 6 + q], axis=3).transpose(2, 0, 1), flat @ flat.T

    of_points = tuple(by_tile(v, s.in_tiles) for v in (values.points, scale.points, control, d_p))
    *found, own, gram = each_tile_of(tile, (*of_points, values.xy, values.sigma_xy), s)
    f, l, measured = (v.reshape(-1, *v.shape[2:]) for v in found)  # noqa: E741

    image = jnp.asarray(s.in_tiles.image).reshape(len(f), -1)
    own = jax.ops.segment_sum(own.reshape(-1, 6 + q, 6 + q), image.reshape(-1), s.n_images)
    border = jnp.concatenate([6 * s.n_images + jnp.arange(s.n_interior), n + jnp.arange(k)])
    m = jnp.zeros((n + k, n + k)).at[:n, :n].set(other_second(at, curved) + _by_unknown(own, s))
    m = m.at[n:, :n].set(d_e).at[:n, n:].set(d_e.T) - _products(gram, border, n + k, s)
    fixed = jnp.where(jnp.diagonal(m) == 0, 1.0, 0.0)
    m = m.at[n:].set(c @ m[n:]) + jnp.diag(jnp.where(jnp.arange(n + k) < n, fixed, -1.0))
    by_eop = (6 * image[:, :, None] + jnp.arange(6)).reshape(len(f), -1)
    touched = jnp.concatenate([by_eop, jnp.broadcast_to(border, (len(f), len(border)))], axis=1)
    return Eliminated(m, c, f, l, touched, measured)


def _by_unknown(own: Float[Array, "images 6+q 6+q"], s: Structure) -> Float[Array, "n n"]:
    """Sums by image, at the unknowns of the image and of its colours."""
    each, columns = jnp.arange(s.n_images), image_columns(s)
    n = 6 * s.n_images + s.n_shared
    eop = jnp.zeros((s.n_images, 6, s.n_images, 6)).at[each, :, each].set(own[:, :6, :6]).reshape(6 * s.n_images, -1)
    m = jnp.zeros((n, n)).at[: 6 * s.n_images, : 6 * s.n_images].set(eop)
    shared = columns[:, 6:]
    m = m.at[columns[:, :6, None], shared[:, None]].add(own[:, :6, 6:], mode="drop")
    m = m.at[shared[:, :, None], columns[:, None]].add(own[:, 6:], mode="drop")
    return m


def _products(gram: Float[Array, "chunks tiles f f"], border: Array, size: int, s: Structure) -> Array:
    """F F' of all tiles at their unknowns: pairs of images by the lists of `Tiles`, the border by image."""
    tiles, n = s.in_tiles, s.n_images
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
    met = gram[:, :, : 6 * m, 6 * m :].reshape(tiles.image.size, 6, len(border))
    met = jax.ops.segment_sum(met, tiles.image.reshape(-1), n).reshape(6 * n, len(border))
    result = jnp.zeros((size, size)).at[: 6 * n, : 6 * n].set(eop)
    result = result.at[: 6 * n, border].set(met).at[border, : 6 * n].set(met.T)
    return result.at[border[:, None], border].set(gram[:, :, 6 * m :, 6 * m :].sum((0, 1)))


def image_columns(s: Structure) -> Int[Array, "images 6+colours"]:
    """Reduced unknowns of each image: exterior orientation, then those of its camera's colours."""
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.where(column < s.n_shared, 6 * s.n_images + column, NOWHERE)
    return jnp.concatenate([6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), shared], axis=1)


def solve_eliminated(h: Eliminated, b: Increments, s: Structure) -> Increments:
    """x of H x = b."""
    n_eop, n = 6 * s.n_images, 6 * s.n_images + s.n_shared
    l = h.l.transpose(1, 0, 2)  # noqa: E741
    z = jnp.stack(whiten(b.points.reshape(3, len(h.l), -1), l))
    right = jnp.concatenate([b.eop.T.reshape(-1), b.shared, jnp.zeros(len(h.c))])
    right = right.at[h.touched].add(-jnp.einsum("tfkp,ktp->tf", h.f, z))
    x = jnp.linalg.solve(h.m, jnp.concatenate([right[:n], h.c @ right[n:]]))
    z = z - jnp.einsum("tfkp,tf->ktp", h.f, x[h.touched])
    points = jnp.stack(unwhiten(z, l)).reshape(3, -1)
    return Increments(x[:n_eop].reshape(-1, 6).T, x[n_eop:n], points)


def _by_interior(w: Float[Array, "q 3 m p"], image: Array, s: Structure) -> Float[Array, "interior 3 p"]:
    """Ws of a tile: what its colours mean, added up over its images."""
    if not s.n_interior:
        return jnp.zeros((0, 3, w.shape[3]))
    column = jnp.asarray(s.column)[image, : s.n_image_colours].T
    pick = (column == jnp.arange(s.n_interior)[:, None, None]).astype(float)
    return jnp.einsum("iqm,qkmp->ikp", pick, w)
