"""The sums behind the reduced normal matrix: tile by tile as products of small dense matrices, then into the band.

In a tile, all of Y and of what else meets its points (interior unknowns, constraints, the right-hand side) are the rows
of one matrix F, three columns a point, and F F' holds every sum over the tile's points at once. See `normal` for the
symbols.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.band import Band
from jaxphoto.adjustment.colouring import Jacobian, jacobian_blocks
from jaxphoto.adjustment.normal import At, Reduced, cholesky_3x3, total, whiten
from jaxphoto.adjustment.residuals import Increments, Residuals, other_residuals
from jaxphoto.adjustment.structure import Structure
from jaxphoto.adjustment.tiles import (
    Columns,
    by_point,
    by_tile,
    columns,
    each_tile,
    of_images,
    scene_of,
    seen_in,
    slopes_of,
)


class Right(NamedTuple):
    """A right-hand side: whole (b = J'r), and taken down to the reduced unknowns and to mu."""

    b: Increments
    reduced: Float[Array, "reduced"]
    d: Float[Array, "constraints"]
    square_sum: Float[Array, ""]
    """r'r, all residuals."""


class OtherRows(NamedTuple):
    """All but the image rows."""

    blocks: Jacobian
    residuals: Residuals
    control: Float[Array, "3 points"]
    """Derivative of each control residual by its own coordinate."""
    rows_e: Float[Array, "constraints images 6"]
    rows_p: Float[Array, "constraints 3 points"]

    @property
    def coupled(self) -> Float[Array, "constraints"]:
        """Residuals of the rows that couple points."""
        return jnp.concatenate([self.residuals.distances, self.residuals.datum])


class TileParts(NamedTuple):
    """What a tile's statistics and sums are made of."""

    columns: Columns
    f: Float[Array, "6m+border 3p"]
    """F: Y, then interior unknowns, constraints, right-hand side."""
    l: Float[Array, "6 p"]  # noqa: E741
    b: Float[Array, "3 p"]
    z: Float[Array, "2 m 3 p"]
    """L^-1 times the columns of the point."""


def reduce_normal(at: At, damping) -> tuple[Reduced, Right]:
    """Eliminate the points of N + damping I. Unknowns held fixed (zero columns) get a unit diagonal."""
    s, tiles = at.structure, at.structure.in_tiles
    rest = other_rows(at)
    blocks, others, coupled = rest.blocks, rest.residuals, rest.coupled
    parts_of = tile_parts(at, damping, coupled)
    n, q, c = s.n_images, s.n_image_colours, s.n_interior + len(coupled) + 1
    _, chunk, m = tiles.image.shape
    width = n // tiles.columns

    def tile(numbers):
        p = parts_of(numbers)
        j = jnp.concatenate([p.columns.eop, p.columns.shared, p.columns.residual[None]])
        j = j.transpose(2, 0, 1, 3).reshape(m, 7 + q, -1)
        gram = p.f @ p.f.T
        across = gram[: 6 * m, 6 * m :].reshape(m, -1)
        own = jnp.concatenate([jnp.einsum("maj,mbj->mab", j, j).reshape(m, -1), across], axis=1)
        return gram[: 6 * m, : 6 * m], own, gram[6 * m :, 6 * m :], p.l, p.b

    def add_chunk(sums, numbers):
        (pair_tile, pair_images, pair_block, block), of_tiles = numbers
        grams, own, border, l, b = each_tile(tile, of_tiles, tiles)  # noqa: E741
        grams = grams.reshape(chunk, m, 6, m, 6)[pair_tile, pair_images[:, 0], :, pair_images[:, 1]]
        grams = jax.ops.segment_sum(grams, pair_block, len(block), indices_are_sorted=True)
        band = sums[0].at[block[:, 0], block[:, 1], :, block[:, 2]].add(-grams, unique_indices=True, mode="drop")
        own = jax.ops.segment_sum(own.reshape(chunk * m, -1), of_tiles[0].reshape(-1), n)
        return (band, sums[1] + own, sums[2] + border.sum(0)), (l, b)

    zero = (
        jnp.zeros((tiles.columns, 2 * width, 6, width, 6)),
        jnp.zeros((n, (7 + q) ** 2 + 6 * c)),
        jnp.zeros((c, c)),
    )
    lists = (tiles.pair_tile, tiles.pair_images, tiles.pair_block, tiles.block)
    sums, (l, b) = jax.lax.scan(add_chunk, zero, (lists, tile_numbers(at, rest)))  # noqa: E741
    band, own, border = total(sums, s)
    l, b_points = by_point(l), by_point(b)  # noqa: E741

    m_images = _with_other_rows(own[:, : (7 + q) ** 2].reshape(n, 7 + q, 7 + q), blocks, others, s)
    met = own[:, (7 + q) ** 2 :].reshape(n, 6, c)
    us, uss, b_s = _by_unknown(m_images, s)
    uss = uss.at[s.weighted, s.weighted].add(blocks.priors**2)
    b_s = b_s.at[s.weighted].add(blocks.priors * others.priors)
    u = m_images[:, :6, :6]
    u = u + (damping + jnp.where(jnp.einsum("nii->ni", u) == 0, 1.0, 0.0))[:, :, None] * jnp.eye(6)
    each = jnp.arange(n)
    band = band.at[each // width, each % width, :, each % width].add(u, unique_indices=True)

    i, k = s.n_interior, len(coupled)
    us = us.at[:, :, :i].add(-met[:, :, :i])
    uss = (uss + damping * jnp.eye(s.n_shared)).at[:i, :i].add(-border[:i, :i])
    ge = rest.rows_e.transpose(1, 2, 0) - met[:, :, i : i + k]
    gs = jnp.zeros((s.n_shared, k)).at[:i].set(-border[:i, i : i + k])
    g = jnp.concatenate([ge.reshape(6 * n, k), gs])
    kk = jnp.eye(k) + border[i : i + k, i : i + k]
    a = Band(band.reshape(tiles.columns, 12 * width, 6 * width), us.transpose(2, 0, 1).reshape(s.n_shared, 6 * n), uss)
    if k:
        a = _with_constraints(a, g, kk)

    b_e = m_images[:, :6, -1] + jnp.einsum("cna,c->na", rest.rows_e, coupled)
    right = jnp.concatenate([(b_e - met[:, :, -1]).reshape(-1), b_s.at[:i].add(-border[:i, -1])])
    reduced = Reduced(a, g, kk, l, rest.rows_e, rest.rows_p)
    # Of the residuals' own square, the sums hold the image rows' part.
    squares = jnp.sum(m_images[:, -1, -1]) + total(jnp.sum(others.control**2), s)
    squares += jnp.sum(coupled**2) + jnp.sum(others.priors**2)
    return reduced, Right(Increments(b_e.T, b_s, b_points), right, border[i : i + k, -1], squares)


def other_rows(at: At) -> OtherRows:
    """Jacobian blocks and residuals of all but the image rows, and the rows that couple points."""
    increments, scale, values, s = at
    others, product = jax.linearize(lambda y: other_residuals(y, scale, values, s), increments)
    zero = jax.tree.map(jnp.zeros_like, increments)
    blocks = jacobian_blocks(product, zero, s)
    # A control residual touches one coordinate only: one seed gives all of them.
    control = product(zero._replace(points=jnp.ones_like(zero.points))).control
    each, n = jnp.arange(len(s.distance_points)), increments.points.shape[1]
    spans = jnp.zeros((len(s.distance_points), 3, n))
    for end in range(2):
        spans = spans.at[each, :, s.distance_points[:, end]].add(blocks.distances[end].T)
    datum_e = (values.datum_eop * scale.eop).transpose(0, 2, 1)
    rows_e = jnp.concatenate([jnp.zeros((len(each), *datum_e.shape[1:])), datum_e])
    rows_p = jnp.concatenate([spans, values.datum_points * scale.points])
    return OtherRows(blocks, others, control, rows_e, rows_p)


def tile_numbers(at: At, rest: OtherRows):
    """What `tile_parts` wants of each tile, chunks and tiles first."""
    increments, scale, values, s = at
    tiles = s.in_tiles
    points = values.points + increments.points * scale.points
    control = jnp.stack([rest.residuals.control, rest.control])
    of_points = (by_tile(v, tiles) for v in (points, scale.points, control, rest.rows_p))
    return (tiles.image, values.xy, values.sigma_xy, *of_points)


def tile_parts(at: At, damping, coupled: Float[Array, "constraints"]):
    """A function from one tile's numbers to its `TileParts`."""
    s = at.structure
    scene = scene_of(at.state, s)
    slopes = slopes_of(at.increments, at.scale, at.values, s)
    i, q = s.n_interior, s.n_image_colours

    def parts(numbers) -> TileParts:
        image, xy, sigma, points, scale, control, rows_p = numbers
        m, p = image.shape[0], points.shape[1]
        j = columns(
            of_images(scene, image, s), of_images(slopes, image, s), points, scale, seen_in(xy, sigma, image, s), s
        )
        # What meets the point in each row: itself, the camera, the residual; summed over rows and brought from colours
        # to unknowns by one product.
        whole = jnp.concatenate([j.point, j.shared, j.residual[None]])
        met = whole[:, None, 0] * j.point[None, :, 0] + whole[:, None, 1] * j.point[None, :, 1]
        column = jnp.asarray(s.column)[image, :q].T
        means = jnp.concatenate(
            [
                jnp.broadcast_to(jnp.arange(3)[:, None], (3, m)),
                jnp.where(column < i, column + 3, -1),
                jnp.full((1, m), 3 + i),
            ]
        )
        pick = (means.reshape(1, -1) == jnp.arange(4 + i)[:, None]).astype(float)
        met = (pick @ met.transpose(0, 2, 1, 3).reshape(means.size, 3 * p)).reshape(4 + i, 3, p)
        v, ws, b = met[:3], met[3 : 3 + i], met[3 + i]
        diagonal = jnp.einsum("iip->ip", v) + control[1] ** 2
        v = v + (control[1] ** 2 + damping + jnp.where(diagonal == 0, 1.0, 0.0))[:, None] * jnp.eye(3)[:, :, None]
        b = b + control[0] * control[1] + jnp.einsum("ckp,c->kp", rows_p, coupled)
        l = jax.lax.optimization_barrier(cholesky_3x3(v))  # noqa: E741
        border = jnp.concatenate([ws, rows_p, b[None]])
        border = jnp.stack(whiten(border.transpose(1, 0, 2), l), axis=1)
        z = jax.lax.optimization_barrier(jnp.stack(whiten(j.point, l), axis=2))
        y = j.eop[:, 0].transpose(1, 0, 2)[:, :, None] * z[0][:, None]
        y = y + j.eop[:, 1].transpose(1, 0, 2)[:, :, None] * z[1][:, None]
        f = jnp.concatenate([y.reshape(6 * m, 3 * p), border.reshape(-1, 3 * p)])
        return TileParts(j, f, l, b, z)

    return parts


def _with_other_rows(m: Float[Array, "images c c"], blocks: Jacobian, others: Residuals, s: Structure):
    """Sums by image, over all colours: those of image rows, and those of stations and attitudes."""
    q = s.n_image_colours
    kept = jnp.append(jnp.arange(6 + q), 6 + s.n_colours)
    m = jnp.zeros((s.n_images, 7 + s.n_colours, 7 + s.n_colours)).at[:, kept[:, None], kept].set(m)
    stations = jnp.concatenate([blocks.station_eop, blocks.station_shared, others.stations[None]])[:, None]
    attitudes = jnp.concatenate([blocks.attitude_eop, blocks.attitude_shared, others.attitudes[None]])
    for rows, image in ((stations, s.station_image), (attitudes, s.attitude_image)):
        if len(image):
            m = m + jax.ops.segment_sum(jnp.einsum("aon,bon->nab", rows, rows), image, s.n_images)
    return m


def _by_unknown(m: Float[Array, "images c c"], s: Structure):
    """Per-image sums by colour, brought to the columns of the shared unknowns (a dummy column is cut off)."""
    q, n = s.n_colours, s.n_shared
    each = jnp.arange(s.n_images)
    us = jnp.zeros((s.n_images, 6, n + 1)).at[each[:, None], :, s.column].add(m[:, :6, 6 : 6 + q].transpose(0, 2, 1))
    uss = jnp.zeros((n + 1, n + 1)).at[s.column[:, :, None], s.column[:, None, :]].add(m[:, 6 : 6 + q, 6 : 6 + q])
    b_s = jnp.zeros(n + 1).at[s.column].add(m[:, 6 : 6 + q, -1])
    return us[:, :, :n], uss[:n, :n], b_s[:n]


def _with_constraints(a: Band, g: Float[Array, "reduced constraints"], k) -> Band:
    """A = S + g K^-1 g': it joins all images, so the band is one full column block."""
    more = g @ jnp.linalg.solve(k, g.T)
    n = a.border.shape[1]
    return Band(a.columns.at[0, :n].add(more[:n, :n]), a.border + more[n:, :n], a.corner + more[n:, n:])
