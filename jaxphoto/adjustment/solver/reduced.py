"""The sums behind the reduced normal matrix: tile by tile as products of small dense matrices, then into the band.

In a tile, all of Y and of what else meets its points (interior unknowns, constraints, the right-hand side) are the rows
of one matrix F, three columns a point, and F F' holds every sum over the tile's points at once. See `normal` for the
symbols.
"""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.tiled import TiledStructure
from jaxphoto.adjustment.model.image_orientations import of_images, orientation_derivatives, orientations_of
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.band import Band, diagonal_of
from jaxphoto.adjustment.solver.non_image_rows import (
    NonImageRows,
    NormalSums,
    add_blocks,
    add_non_image_rows,
    non_image_rows,
    sum_by,
)
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, ResidualRows
from jaxphoto.adjustment.solver.tile_rows import Pair, TileJacobian, seen_in, tile_jacobian
from jaxphoto.arrays import added
from jaxphoto.compiling import once
from jaxphoto.linear_algebra import solve
from jaxphoto.small_matrices import cholesky_3x3, whiten


class RightSide(NamedTuple):
    """A right-hand side: whole (b = J'r), and taken down to the reduced unknowns and to mu."""

    b: Increments
    reduced: Float[Array, "reduced"]
    d: Float[Array, "constraints"]


class TileParts(NamedTuple):
    """What a tile's sums are made of."""

    columns: tuple[TileJacobian, TileJacobian]
    f: Float[Array, "f 3p"]
    """F: images, interior unknowns, what else the tile's points meet, constraints; last the right-hand side."""
    l: Float[Array, "6 p"]  # noqa: E741
    b: Float[Array, "3 p"]
    diagonal: Float[Array, "3 p"]
    """That of V, without damping."""
    met: Float[Array, "b b+1"]
    """Of rows at points, J_s' J_s and J_s' r of what else the tile's points meet."""


def reduce_normal(
    at: Linearised, damping, rows: ResidualRows | None = None, less: Increments | None = None
) -> tuple[Band, Reduced, RightSide]:
    """Eliminate the points of N + damping diag(N): A, what goes with it, and the right-hand side.

    That is J'r - `less` for the residuals r there, or for those in `rows`. Unknowns held fixed (zero columns) get a
    unit diagonal.
    """
    s, tiles = at.structure, at.structure.tiles
    rest = non_image_rows(at, rows.others if rows else None)
    if less is not None:
        rest = rest._replace(b=rest.b - less.points)
    coupled = rest.coupled
    parts_of = tile_parts(at, damping, coupled)
    n, q, k, i, b = s.n_images, s.n_image_colours, len(coupled), s.n_interior, tiles.met.shape[2]
    c, n_shared = i + k + 1, s.n_shared
    _, chunk, m = tiles.image.shape
    width, inner = n // tiles.columns, tiles.columns - 1

    def in_all(v: Array, axis: int) -> Array:
        """Of the border, what all tiles have: not what only some of them meet."""
        own, _, rest = jnp.split(v, [i, i + b], axis)
        return jnp.concatenate([own, rest], axis)

    def tile(numbers):
        *numbers, residual = numbers
        p = parts_of(numbers, residual)
        whole = [jnp.concatenate([j.eop, j.shared, j.residual[None]]).transpose(1, 0, 2) for j in p.columns]
        j = jnp.concatenate(whole, axis=2)
        gram = p.f @ p.f.T
        of_images = gram[: 6 * m, : 6 * m] if tiles.free_points else gram[:0, :0]
        across, border = gram[: 6 * m, 6 * m :].reshape(m, 6, -1), gram[6 * m :, 6 * m :]
        square = jnp.einsum("maj,mbj->mab", j, j).reshape(m, -1)
        own = jnp.concatenate([square, in_all(across, 2).reshape(m, -1)], axis=1)
        f = p.f if tiles.few else None
        met = across[:, :, i : i + b].transpose(0, 2, 1), border[i : i + b], p.met
        return of_images, own, in_all(in_all(border, 0), 1), met, f, p.l, p.b, p.diagonal

    def add_chunk(sums, numbers):
        (pair_tile, pair_images, pair_block, block, which), batches, of_tiles = numbers
        grams, own, border, met, *kept = tiles.each_of_chunk(tile, of_tiles, batches)
        own = sum_by(own.reshape(chunk * m, -1), of_tiles[0].reshape(-1), n)
        of_met = _add_met(sums[3], met, which, of_tiles[0], i) if b else sums[3]
        if not tiles.free_points:
            return (sums[0], sums[1] + own, sums[2], of_met), kept
        grams = grams.reshape(chunk, m, 6, m, 6)[pair_tile, pair_images[:, 0], :, pair_images[:, 1]]
        grams = jax.ops.segment_sum(grams, pair_block, len(block), indices_are_sorted=True)
        band = add_blocks(sums[0], -grams, block, distinct=True)
        return (band, sums[1] + own, sums[2] + border.sum(0), of_met), kept

    zero = (
        (jnp.zeros((inner, 2 * width, 6, width, 6)), jnp.zeros((width, 6, width, 6))),
        jnp.zeros((n, (7 + q) ** 2 + 6 * c)),
        jnp.zeros((c, c)),
        _Met.none(n, n_shared, i, k) if b else None,
    )
    lists = (tiles.pair_tile, tiles.pair_images, tiles.pair_block, tiles.block, tiles.met)
    of_tiles = (*tile_numbers(at, rest), rows.image if rows else None)
    sums, (f, *of_points) = jax.lax.scan(add_chunk, zero, (lists, tiles.batches, of_tiles))
    (columns, last), own, border, of_met = total(sums, s)
    l, b_points, v = map(s.by_point, of_points)  # noqa: E741
    # Tiles that are padding were not computed: their points are each by itself.
    l = jnp.where(l[0] == 0, jnp.array([1.0, 0, 1, 0, 0, 1])[:, None], l)  # noqa: E741

    m_images = own[:, : (7 + q) ** 2].reshape(n, 7 + q, 7 + q)
    met = own[:, (7 + q) ** 2 :].reshape(n, 6, c)
    us, uss, b_s = _by_unknown(m_images, s)
    images = NormalSums((columns, last), m_images[:, :6, :6], us, uss, b_s, m_images[:, :6, -1])
    (columns, last), u, us, uss, b_s, b_e = add_non_image_rows(images, rest, s)
    weight = Increments(jnp.einsum("nii->in", u), jnp.diagonal(uss), v)
    if of_met is not None:
        weight, b_s = weight._replace(shared=weight.shared + of_met.rows[:-1, 0]), b_s + of_met.rows[:-1, 1]
    added = damping * weight.eop.T + jnp.where(weight.eop.T == 0, 1.0, 0.0)
    u = u + added[:, :, None] * jnp.eye(6)
    each, of_inner = jnp.arange(n), inner * width
    columns = columns.at[each[:of_inner] // width, each[:of_inner] % width, :, each[:of_inner] % width].add(
        u[:of_inner], unique_indices=True
    )
    last = last.at[each[:width], :, each[:width]].add(u[of_inner:], unique_indices=True)

    us = us.at[:, :, :i].add(-met[:, :, :i])
    uss = (uss + damping * jnp.diag(weight.shared)).at[:i, :i].add(-border[:i, :i])
    ge = rest.rows_e.transpose(1, 2, 0) - met[:, :, i : i + k]
    gs = rest.rows_s.T.at[:i].add(-border[:i, i : i + k])
    if of_met is not None:
        us = us - of_met.images[:, :, :-1]
        # Of what is met with interior unknowns, both halves.
        uss = (uss - of_met.shared[:-1, :-1]).at[:, :i].add(-of_met.interior[:-1])
        uss = uss.at[:i].add(-of_met.interior[:-1].T)
        gs = gs - of_met.constraints[:-1, :-1]
    us = us.transpose(2, 0, 1).reshape(n_shared, 6 * n)
    g = jnp.concatenate([ge.reshape(6 * n, k), gs])
    kk = jnp.eye(k) + border[i : i + k, i : i + k]
    # Put together by parts that are written whole: `block` would be computed number by number.
    end = jnp.zeros((6 * width + n_shared,) * 2).at[: 6 * width, : 6 * width].set(last.reshape(6 * width, -1))
    end = end.at[6 * width :, : 6 * width].set(us[:, 6 * of_inner :]).at[6 * width :, 6 * width :].set(uss)
    if k:
        # A = S + g K^-1 g' joins all images: the band has one full column block.
        end = end + g @ solve(kk, g.T)
    a = Band(columns.reshape(inner, 12 * width, 6 * width), us[:, : 6 * of_inner], end)

    b_e, b_s = b_e + jnp.einsum("cna,c->na", rest.rows_e, coupled), b_s + rest.rows_s.T @ coupled
    if less is not None:
        b_e, b_s = b_e - less.eop.T, b_s - less.shared
    right_s = b_s.at[:i].add(-border[:i, -1])
    if of_met is not None:
        right_s = right_s - of_met.constraints[:-1, -1]
    right = jnp.concatenate([(b_e - met[:, :, -1]).reshape(-1), right_s])
    reduced = Reduced(diagonal_of(a), g, kk, f, l, weight, jnp.asarray(damping, float))
    return a, reduced, RightSide(Increments(b_e.T, b_s, b_points), right, border[i : i + k, -1])


class _Met(NamedTuple):
    """Sums for shared unknowns that only some points meet, in the order of all of them and one that means none."""

    images: Float[Array, "images 6 shared+1"]
    interior: Float[Array, "shared+1 interior"]
    shared: Float[Array, "shared+1 shared+1"]
    """F F' of two of them, less the J_s' J_s of their rows."""
    constraints: Float[Array, "shared+1 k+1"]
    rows: Float[Array, "shared+1 2"]
    """The diagonal of J_s' J_s, and J_s' r."""

    @classmethod
    def none(cls, images: int, shared: int, interior: int, k: int) -> "_Met":
        n = shared + 1
        return cls(*map(jnp.zeros, ((images, 6, n), (n, interior), (n, n), (n, k + 1), (n, 2))))


def _add_met(sums: _Met, of_tiles: tuple[Array, Array, Array], which: Array, image: Array, i: int) -> _Met:
    """The sums with those of a chunk: of images, of the border and of rows, by what each tile meets (tiles, b)."""
    images, border, rows = of_tiles
    b = which.shape[1]
    interior, shared, rest = jnp.split(border, [i, i + b], axis=2)
    diagonal = jnp.diagonal(rows, axis1=1, axis2=2)
    return _Met(
        sums.images.at[image[:, :, None], :, which[:, None, :]].add(images),
        sums.interior.at[which].add(interior),
        sums.shared.at[which[:, :, None], which[:, None, :]].add(shared - rows[:, :, :b]),
        sums.constraints.at[which].add(rest),
        sums.rows.at[which].add(jnp.stack([diagonal, rows[:, :, b]], axis=2)),
    )


def tile_numbers(at: Linearised, rest: NonImageRows):
    """What `tile_parts` wants of each tile, chunks and tiles first."""
    increments, scale, values, s = at
    tiles = s.tiles
    points = values.points + increments.points * scale.points
    of_points = (points, scale.points, rest.v, rest.b, rest.at_points, rest.rows_p)
    return (tiles.image, values.xy, values.sigma_xy, *jax.tree.map(s.by_tile, of_points))


def tile_columns(at: Linearised):
    """A function from a tile's images, measurements and points to its residuals and Jacobian."""
    s = at.structure
    scene = orientations_of(at.state, at.values, s)
    slopes = once(lambda: orientation_derivatives(at.increments, at.scale, at.values, s), s.eop_free)

    def columns_of(numbers) -> tuple[TileJacobian, TileJacobian]:
        image, xy, sigma, points, scale = numbers
        seen = seen_in(xy, sigma, image, s)
        own = of_images(scene, image, s), of_images(slopes, image, s)
        return once(partial(tile_jacobian, s=s), s.eop_free, *own, points, scale, seen)

    return columns_of


def tile_parts(at: Linearised, damping, coupled: Float[Array, "constraints"]):
    """A function from one tile's numbers, and other residuals than its own, to its `TileParts`."""
    s, columns_of = at.structure, tile_columns(at)

    def parts(numbers, residual: Pair | None = None) -> TileParts:
        *measured, own_v, own_b, at_points, rows_p = numbers
        j = columns_of(measured)
        if residual is not None:
            j = j[0]._replace(residual=residual[0]), j[1]._replace(residual=residual[1])
        image, (m, p), n_met = measured[0], j[0].residual.shape, s.tiles.met.shape[2]
        own_w, met = jnp.zeros((n_met, 3, p)), jnp.zeros((n_met, n_met + 1))
        for rows in at_points:
            by_met = rows.of_tile(n_met)
            own_w = own_w + jnp.einsum("brpc,ckrp->bkp", by_met, rows.points)
            square = jnp.einsum("arpc,brpc->ab", by_met, by_met)
            met = met + jnp.column_stack([square, jnp.einsum("brpc,crp->b", by_met, rows.residual)])
        if not s.tiles.free_points:
            f = jnp.zeros((6 * m + s.n_interior + n_met + len(coupled) + 1, 0))
            unit, nothing = jnp.array([1.0, 0, 1, 0, 0, 1])[:, None], jnp.zeros((3, p))
            return TileParts(j, f, jnp.broadcast_to(unit, (6, p)), nothing, nothing, met)
        v, b = _met([c.point for c in j], j), _met([c.residual[None] for c in j], j)[0]
        ws = jnp.concatenate([_by_interior(j, image, s), own_w])
        v, b = v + own_v, b + own_b
        diagonal = jnp.einsum("iip->ip", v)
        added = damping * diagonal + jnp.where(diagonal == 0, 1.0, 0.0)
        v = v + added[:, None] * jnp.eye(3)[:, :, None]
        b = b + jnp.einsum("ckp,c->kp", rows_p, coupled)
        l = once(cholesky_3x3, s.eop_free, v)  # noqa: E741
        border = jnp.concatenate([ws, rows_p, b[None]])
        border = jnp.stack(whiten(border.transpose(1, 0, 2), l), axis=1)
        z = once(
            lambda factors, *points: tuple(jnp.stack(whiten(w, factors)) for w in points),
            s.eop_free,
            l,
            *(c.point for c in j),
        )
        f = jnp.concatenate([once(_whitened_eop, s.eop_free, j, z).reshape(6 * m, 3 * p), border.reshape(-1, 3 * p)])
        return TileParts(j, f, l, b, diagonal, met)

    return parts


def _whitened_eop(j: Iterable[TileJacobian], z: Iterable[Array]) -> Float[Array, "m 6 3 p"]:
    """Y of a tile."""
    both = ((c.eop.transpose(1, 0, 2), w.transpose(1, 0, 2)) for c, w in zip(j, z, strict=True))
    return added(eop[:, :, None] * w[:, None] for eop, w in both)


def _met(of: Iterable[Float[Array, "a m p"]], j: Iterable[TileJacobian]) -> Float[Array, "a 3 p"]:
    """Sums over a point's rows, term by term: XLA's products of matrices this small take five times as long."""
    each = zip(of, j, strict=True)
    return added(a[:, None, k] * c.point[:, k] for a, c in each for k in range(a.shape[1]))


def _by_interior(j: tuple[TileJacobian, TileJacobian], image: Array, s: TiledStructure) -> Float[Array, "interior 3 p"]:
    """Ws of a tile."""
    i, q = s.n_interior, s.n_image_colours
    if i == q:
        # One camera: its colours are its unknowns.
        return _met([c.shared for c in j], j)
    met = added(c.shared[:, :, None] * c.point.transpose(1, 0, 2) for c in j)
    column = jnp.asarray(s.column)[image, :q].T.reshape(-1)
    pick = (column == jnp.arange(i)[:, None]).astype(float)
    return (pick @ met.reshape(q * len(image), -1)).reshape(i, 3, -1)


def _by_unknown(m: Float[Array, "images c c"], s: TiledStructure):
    """Per-image sums by colour, brought to the columns of the shared unknowns; the last column is a dummy."""
    q, n = s.n_image_colours, s.n_shared
    each, column = jnp.arange(s.n_images), jnp.asarray(s.column)[:, : s.n_image_colours]
    us = jnp.zeros((s.n_images, 6, n + 1)).at[each[:, None], :, column].add(m[:, :6, 6 : 6 + q].transpose(0, 2, 1))
    uss = jnp.zeros((n + 1, n + 1)).at[column[:, :, None], column[:, None, :]].add(m[:, 6 : 6 + q, 6 : 6 + q])
    b_s = jnp.zeros(n + 1).at[column].add(m[:, 6 : 6 + q, -1])
    return us, uss, b_s
