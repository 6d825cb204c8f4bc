"""Sums of the reduced normal matrix: contributions of rays to points, images and pairs of images, by chunk.

Each ray has three rows of F for the unknowns of its image; each point has three for its other coupled unknowns (see
`normal`). Products of F for one image are computed from chunks of rays, products for two images from chunks of pairs of
rays. Coupled unknowns other than images (`border_places`) are summed by point.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment.layout.padded import PaddedStructure, each_batch
from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.model.image_orientations import of_images, orientation_derivatives, orientations_of
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.band import Band, diagonal_of
from jaxphoto.adjustment.solver.non_image_rows import (
    NonImageRows,
    NormalSums,
    RowsOfPoints,
    add_blocks,
    add_non_image_rows,
    non_image_rows,
    sum_by,
)
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, ResidualRows
from jaxphoto.adjustment.solver.ray_rows import RayJacobian, points_at, ray_jacobian, seen_in
from jaxphoto.arrays import sum_terms
from jaxphoto.compiling import once
from jaxphoto.linear_algebra import solve
from jaxphoto.small_matrices import cholesky_3x3, whiten

# XLA compiles the loop over the rows of a scatter as one function if rows are short, otherwise as several calls per
# row.
_PIECE = 36
# Number of groups of points processed at a time.
_GROUPS = 64


class RightSide(NamedTuple):
    """Right-hand side b = J'r, and its parts for the reduced unknowns and for mu after elimination."""

    b: Increments
    reduced: Float[Array, "reduced"]
    d: Float[Array, "constraints"]


def interior_in_border(s: PaddedStructure) -> int:
    """Return the number of interior unknowns that points couple with directly, not through their images."""
    return 0 if s.rays.by_image else s.n_interior


def border_places(s: PaddedStructure, k: int) -> Int[Array, "groups border"]:
    """Return the unknowns, except images, that the points of each group couple with.

    Interior unknowns, k constraints, the right-hand side, and shared unknowns of rows at points. As indices among all
    shared unknowns, the constraints, the right-hand side, and one more for none.
    """
    n, met = s.n_shared, jnp.asarray(s.rays.met)
    first = jnp.concatenate([jnp.arange(interior_in_border(s)), n + jnp.arange(k + 1)])
    met = jnp.where(met < n, met, n + k + 1)
    return jnp.concatenate([jnp.broadcast_to(first, (len(met), len(first))), met], axis=1)


def image_places(s: PaddedStructure, k: int) -> Int[Array, "images colours"]:
    """Return the indices of each image's camera unknowns if `RayLists.by_image`."""
    colours = s.n_image_colours if s.rays.by_image else 0
    column = jnp.asarray(s.column)[:, :colours]
    return jnp.where(column < s.n_shared, column, s.n_shared + k + 1)


def reduced_columns(s: PaddedStructure, k: int) -> tuple[Int[Array, "images e"], Int[Array, "groups border"]]:
    """Return the indices of the images' unknowns and of each group's border among the reduced unknowns and k
    constraints.

    Missing unknowns have an index beyond these.
    """
    n = 6 * s.n_images
    eop = 6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6)
    return jnp.concatenate([eop, n + image_places(s, k)], axis=1), n + border_places(s, k)


def ray_columns(at: Linearised):
    """Return a function from images, points and measurements of a batch to its residuals and Jacobian."""
    s, points = at.structure, at.state.points
    scene = orientations_of(at.state, at.values, s)
    slopes = once(lambda: orientation_derivatives(at.increments, at.scale, at.values, s), s.eop_free)

    def columns_of(numbers) -> tuple[RayJacobian, RayJacobian]:
        image, point, xy, sigma = numbers
        seen = seen_in(xy, sigma, image, s)
        own = of_images(scene, image, s), of_images(slopes, image, s)
        return once(partial(ray_jacobian, s=s), s.eop_free, *own, points_at(points, point), seen)

    return columns_of


class _AtPoints(NamedTuple):
    """Sums by point, of points in metres."""

    v: Float[Array, "points 9"]
    """J_p' J_p (6) and J_p' r (3)."""
    w: Float[Array, "points interior+1 3"]
    """J_s' J_p; the last row is for colours without an unknown in an image."""

    @classmethod
    def none(cls, s: PaddedStructure, n: int) -> "_AtPoints":
        """Return initial sums."""
        return cls(jnp.zeros((n, 9)), jnp.zeros((n, interior_in_border(s) + 1, 3)))

    def plus(self, j: tuple[RayJacobian, RayJacobian], image: Array, point: Array, s: PaddedStructure) -> "_AtPoints":
        """Add the sums of a batch."""
        pairs = [(a, b) for a in range(3) for b in range(a + 1)]
        own = [sum_terms(c.point[a] * c.point[b] for c in j) for a, b in pairs]
        own += [sum_terms(c.point[a] * c.residual for c in j) for a in range(3)]
        v, w = add_rows(self.v, point, jnp.stack(own)), self.w
        i, q = w.shape[1] - 1, s.n_image_colours
        if i:
            met = sum_terms(c.shared[:, None] * c.point for c in j)
            if i == q:
                # One camera: its colours are its unknowns.
                met = jnp.concatenate([met, jnp.zeros_like(met[:1])]).reshape(-1, *point.shape)
                w = add_rows(w.reshape(len(w), -1), point, met).reshape(w.shape)
            else:
                column = jnp.minimum(jnp.asarray(s.column)[image, :q], i).T[:, :, None]
                at = (point * (i + 1) + column).reshape(-1)
                w = w.reshape(-1, 3).at[at].add(jnp.moveaxis(met, 1, -1).reshape(-1, 3)).reshape(w.shape)
        return _AtPoints(v, w)


def add_rows(sums: Float[Array, "n c"], which: Array, rows: Float[Array, "c m p"]) -> Float[Array, "n c"]:
    """Add rows of rays to the sums by index."""
    n, c = sums.shape
    pieces = next(k for k in range(1, c + 1) if c % k == 0 and c // k <= _PIECE)
    at = (which.reshape(-1)[:, None] * pieces + jnp.arange(pieces)).reshape(-1)
    rows = rows.reshape(c, -1).T.reshape(-1, c // pieces)
    return sums.reshape(-1, c // pieces).at[at].add(rows, mode="promise_in_bounds").reshape(n, c)


class _Eliminated(NamedTuple):
    """Eliminated points."""

    l: Float[Array, "6 points"]  # noqa: E741
    border: Float[Array, "points d c"]
    b: Float[Array, "3 points"]
    diagonal: Float[Array, "3 points"]
    """Diagonal of V, without damping."""


def _eliminated(sums: _AtPoints, rest: NonImageRows, met: Array, scale: Array, damping, s: PaddedStructure):
    """Return L of each point and F of its border; `met` is W of shared unknowns that its rows involve."""
    k, n, i = len(rest.coupled), len(sums.v), interior_in_border(s)
    if not s.rays.free_points:
        unit, none = jnp.array([1.0, 0, 1, 0, 0, 1])[:, None], jnp.zeros((3, n))
        return _Eliminated(jnp.broadcast_to(unit, (6, n)), jnp.zeros((n, 0, i + k + 1 + len(met))), none, none)
    v, b = sums.v[:, :6].T, sums.v[:, 6:].T * scale
    v = scale[:, None] * scale * v[np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])] + rest.v
    b = b + rest.b + jnp.einsum("kap,k->ap", rest.rows_p, rest.coupled)
    diagonal = jnp.einsum("iip->ip", v)
    extra = damping * diagonal + jnp.where(diagonal == 0, 1.0, 0.0)
    l = once(cholesky_3x3, s.eop_free, v + extra[:, None] * jnp.eye(3)[:, :, None])  # noqa: E741
    interior = sums.w[:, :i].transpose(1, 2, 0) * scale
    border = jnp.concatenate([interior, rest.rows_p, b[None], met]).transpose(1, 0, 2)
    border = once(lambda w, factors: jnp.stack(whiten(w, factors)).transpose(2, 0, 1), s.eop_free, border, l)
    return _Eliminated(l, border, b, diagonal)


class LinearisedRows(NamedTuple):
    """Derivatives and residuals of other rows, and sums over image rows."""

    rest: NonImageRows
    by_image: Float[Array, "images c c"]
    """Products of derivatives with respect to exterior orientation and camera unknowns, and of the residual."""
    of_points: _AtPoints
    w: Float[Array, "batches m p d e"]
    """W of each ray, of points in metres; in memory a batch is ordered (d, e, m, p)."""


def linearise_rows(
    at: Linearised, rows: ResidualRows | None = None, into: Array | None = None, keep: Bool[Array, ""] | None = None
) -> LinearisedRows:
    """Linearise all rows with their residuals, or with `rows`.

    W is written `into` an array of its size; if `keep` is true, the previous content is returned instead.
    """
    s, columns_of = at.structure, ray_columns(at)

    def to_sums(sums, numbers, before=None):
        *measured, residual = numbers
        image, point = measured[:2]
        of_points, by_image = sums
        j = columns_of(measured)
        if residual is not None:
            j = j[0]._replace(residual=residual[0]), j[1]._replace(residual=residual[1])
        both = [jnp.concatenate([o.eop, o.shared, o.residual[None]]).transpose(1, 0, 2) for o in j]
        whole = jnp.concatenate(both, axis=2)
        square = jnp.einsum("nax,nbx->nab", whole, whole).reshape(len(image), -1)
        w = _met_of_rays(j, s)
        w = w if keep is None else jnp.where(keep, before, w)
        of_points = of_points.plus(j, image, point, s) if s.rays.free_points else of_points
        return (of_points, by_image + sum_by(square, image, s.n_images)), w

    m = 7 + s.n_image_colours
    none = _AtPoints.none(s, at.scale.points.shape[1]), jnp.zeros((s.n_images, m * m))
    numbers = at.values.xy, at.values.sigma_xy, rows.image if rows else None
    (of_points, by_image), w = s.each(to_sums, none, numbers, into)
    return LinearisedRows(non_image_rows(at, rows.others if rows else None), by_image.reshape(-1, m, m), of_points, w)


def _met_of_rays(j: tuple[RayJacobian, RayJacobian], s: PaddedStructure) -> Float[Array, "m p d e"]:
    """Return the coupling W of images and points for the rays of a batch; empty if no point is free."""
    eop = [jnp.concatenate([o.eop, o.shared]) if s.rays.by_image else o.eop for o in j]
    e, *shape = eop[0].shape
    if not s.rays.free_points:
        return jnp.zeros((*shape, 0, e))
    w = [sum_terms(c * o.point[a] for c, o in zip(eop, j, strict=True)) for a in range(3)]
    return jnp.concatenate(w).reshape(*shape, 3, e)


def _whitened(w: Float[Array, "m p d e"], of_rays: Float[Array, "9 m p"], s: PaddedStructure) -> Array:
    """Return F of a batch from W, L and the scale of its points."""
    *shape, d, e = w.shape
    if not d:
        return w

    def by_component(w, of_rays):
        return jnp.stack(whiten([own * scale for own, scale in zip(w, of_rays[6:], strict=True)], of_rays[:6]))

    # Reorder to rays afterwards: XLA does not vectorise operations fused with this step.
    f = once(by_component, s.eop_free, w.reshape(3, e, *shape), of_rays)
    return f.reshape(3 * e, -1).T.reshape(*shape, 3, e)


def reduce_normal(
    at: Linearised, damping, rows: LinearisedRows | None = None, less: Increments | None = None
) -> tuple[Band, Reduced, RightSide]:
    """Eliminate the points of N + damping diag(N); return A, the arrays for back-substitution, and the right-hand side.

    The right-hand side is J'r - `less` for the residuals of `rows`. Fixed unknowns (zero columns) get a unit diagonal.
    """
    s, scale = at.structure, at.scale.points
    rest, by_image, of_points, w = rows or linearise_rows(at)
    if less is not None:
        rest = rest._replace(b=rest.b - less.points)
    k = len(rest.coupled)
    own_met, of_met = _rows_with_shared(rest, s)
    points = _eliminated(of_points, rest, own_met, scale, damping, s)
    of_rays = jnp.concatenate([points.l, scale])

    def to_images(sums, numbers, w):
        image, point = numbers
        f = _whitened(w, points_at(of_rays, point), s)
        return sums.with_rays(image, point, f, points.border, s, k), f

    sums, f = s.each(to_images, ProductSums.of(points.border, s, k), (), w)
    by_image, sums, of_met = total((by_image, sums.with_pairs(f, s, k), of_met), s)
    return _assembled(at, damping, less, rest, by_image, sums, of_met, points, f)


class ProductSums(NamedTuple):
    """Products F F' of images, of images with the border (`border_places`), and of pairs of images."""

    own: Float[Array, "images e_e"]
    across: Float[Array, "images places e"]
    border: Float[Array, "places places"]
    band: tuple[Array, Array]
    """Negative products of pairs of different images, by column block."""

    @classmethod
    def of(cls, border: Float[Array, "points d c"], s: PaddedStructure, k: int) -> "ProductSums":
        """Return initial sums, including the products of the border."""
        places, n, e, size = border_places(s, k), s.n_images, 6 + image_places(s, k).shape[1], s.n_shared + k + 2
        width, inner = n // s.rays.columns, s.rays.columns - 1
        band = jnp.zeros((inner, 2 * width, 6, width, 6)), jnp.zeros((width, 6, width, 6))
        return cls(jnp.zeros((n, e * e)), jnp.zeros((n, size, e)), _of_border(border, places, s, size), band)

    def with_rays(self, image: Array, point: Array, f: Array, border: Array, s: PaddedStructure, k: int):
        """Add the products of a batch."""
        (chunks, _, _, e), c = f.shape, interior_in_border(s) + k + 1
        places, flat = border_places(s, k), f.reshape(chunks, -1, e)
        met = border.at[point].get(mode="promise_in_bounds")
        first = met[..., :c].reshape(chunks, flat.shape[1], c)
        across = self.across.at[image[:, None], places[0, :c]].add(jnp.einsum("nxe,nxc->nce", flat, first))
        if met.shape[3] > c:
            each = jnp.einsum("npxe,npxb->npbe", f, met[..., c:])
            across = across.at[image[:, None, None], places[point // GROUP, c:]].add(each)
        own = jnp.einsum("nxe,nxf->nef", flat, flat).reshape(chunks, -1)
        return self._replace(own=self.own + sum_by(own, image, s.n_images), across=across)

    def with_pairs(self, f: Float[Array, "batches m p d e"], s: PaddedStructure, k: int) -> "ProductSums":
        """Add the products of pairs of rays and of camera unknowns."""
        e, own = f.shape[-1], image_places(s, k)

        def to_pairs(sums, numbers):
            pair, block = numbers
            one, other = (rows.at[pair[:, o]].get(mode="promise_in_bounds").reshape(len(pair), -1, e) for o in range(2))
            product = jnp.einsum("nxe,nxf->nef", one, other)
            sums = sums._replace(band=add_blocks(sums.band, -product[:, :6, :6], block))
            return (_of_cameras(sums, product, block, own, s) if e > 6 else sums), ()

        sums = self
        if s.rays.free_points:
            rows = f.reshape(-1, 3 * e)
            sums, _ = each_batch(to_pairs, sums, (s.pairs, s.rays.block), s.rays.used[0, 1])
        return _with_cameras(sums, own, s) if e > 6 else sums


def _of_border(border: Float[Array, "points d c"], places: Array, s: PaddedStructure, size: int):
    """Return F F' of the border."""
    zero = jnp.zeros((size, size))
    if not s.rays.met.shape[1]:
        flat = border.reshape(-1, border.shape[2])
        return zero.at[places[0][:, None], places[0]].add(flat.T @ flat)
    flat = border.reshape(len(places), -1, border.shape[2])
    return zero.at[places[:, :, None], places[:, None]].add(jnp.einsum("gxc,gxd->gcd", flat, flat))


def _of_cameras(sums: ProductSums, product: Array, block: Array, own: Array, s: PaddedStructure) -> ProductSums:
    """Add the products of pairs of images for their camera unknowns."""
    one, other = pair_images(block, s)
    columns = [jnp.asarray(own).at[image].get(mode="clip") for image in (one, other)]
    across = sums.across.at[one[:, None], columns[1], :6].add(product[:, :6, 6:].swapaxes(1, 2), mode="drop")
    across = across.at[other[:, None], columns[0], :6].add(product[:, 6:, :6], mode="drop")
    inner = product[:, 6:, 6:]
    border = sums.border.at[columns[0][:, :, None], columns[1][:, None]].add(inner)
    border = border.at[columns[1][:, :, None], columns[0][:, None]].add(inner.swapaxes(1, 2))
    return sums._replace(across=across, border=border)


def pair_images(block: Array, s: PaddedStructure) -> tuple[Array, Array]:
    """Return the two images of each chunk of pairs; an index beyond the last for empty chunks."""
    width = s.n_images // s.rays.columns
    which, row, column = jnp.asarray(block).T
    none = which == s.rays.columns
    return jnp.where(none, s.n_images, which * width + row), jnp.where(none, s.n_images, which * width + column)


def _with_cameras(sums: ProductSums, own: Array, s: PaddedStructure) -> ProductSums:
    """Add the products of each image for its camera unknowns."""
    n, e = s.n_images, 6 + own.shape[1]
    square, met = sums.own.reshape(n, e, e), sums.across[:, :, 6:]
    border = sums.border.at[own].add(met.swapaxes(1, 2))
    border = border.at[:, own].add(jnp.moveaxis(met, 0, 1))
    border = border.at[own[:, :, None], own[:, None]].add(square[:, 6:, 6:])
    across = sums.across.at[jnp.arange(n)[:, None], own, :6].add(square[:, 6:, :6])
    return sums._replace(across=across, border=border)


class _OfMet(NamedTuple):
    """J_s' J_s and J_s' r of rows at points, for all shared unknowns."""

    square: Float[Array, "shared shared"]
    right: Float[Array, "shared"]


def _rows_with_shared(rest: NonImageRows, s: PaddedStructure) -> tuple[Float[Array, "b 3 points"], _OfMet]:
    """Return J_s' J_p of rows at points for the border of their groups, and the sums without points."""
    size, n = s.rays.met.shape[1], s.n_shared
    none = jnp.zeros((size, 3, rest.b.shape[1]))
    if not rest.at_points:
        return none, _OfMet(jnp.zeros((n, n)), jnp.zeros(n))

    def of_group(groups: tuple[RowsOfPoints, ...]) -> tuple[Array, Array, Array]:
        each = [(rows.of_group(size), rows) for rows in groups]
        met = sum_terms(jnp.einsum("brpc,ckrp->bkp", of, rows.points) for of, rows in each)
        square = sum_terms(jnp.einsum("arpc,brpc->ab", of, of) for of, _ in each)
        return met, square, sum_terms(jnp.einsum("brpc,crp->b", of, rows.residual) for of, rows in each)

    groups = jax.tree.map(s.by_group, rest.at_points)
    met, square, right = jax.lax.map(of_group, groups, batch_size=_GROUPS)
    which = jnp.asarray(s.rays.met)
    zero = jnp.zeros((n + 1, n + 1)), jnp.zeros(n + 1)
    square = zero[0].at[which[:, :, None], which[:, None]].add(square)[:-1, :-1]
    return jnp.moveaxis(met, 0, -2).reshape(none.shape), _OfMet(square, zero[1].at[which].add(right)[:-1])


def _assembled(
    at: Linearised,
    damping,
    less: Increments | None,
    rest: NonImageRows,
    square,
    sums: ProductSums,
    of_met: _OfMet,
    points,
    f,
) -> tuple[Band, Reduced, RightSide]:
    """Assemble the reduced normal matrix and right-hand side from all sums."""
    s, coupled = at.structure, rest.coupled
    n, k, n_shared = s.n_images, len(coupled), s.n_shared
    width, inner = n // s.rays.columns, s.rays.columns - 1
    own = sums.own.reshape(n, sums.across.shape[2], -1)[:, :6, :6]
    us, uss, b_s = _by_unknown(square, s)
    images = NormalSums(sums.band, square[:, :6, :6], us, uss, b_s, square[:, :6, -1])
    (columns, last), u, us, uss, b_s, b_e = add_non_image_rows(images, rest, s)
    uss, b_s = uss + of_met.square, b_s + of_met.right
    weight = Increments(jnp.einsum("nii->in", u), jnp.diagonal(uss), points.diagonal)
    extra = damping * weight.eop.T + jnp.where(weight.eop.T == 0, 1.0, 0.0)
    u = u - own + extra[:, :, None] * jnp.eye(6)
    each, of_inner = jnp.arange(n), inner * width
    columns = columns.at[each[:of_inner] // width, each[:of_inner] % width, :, each[:of_inner] % width].add(
        u[:of_inner], unique_indices=True
    )
    last = last.at[each[:width], :, each[:width]].add(u[of_inner:], unique_indices=True)

    # Products with the border: shared unknowns, constraints and the right-hand side.
    e_shared, e_coupled, e_right, _ = jnp.split(
        sums.across[..., :6], [n_shared, n_shared + k, n_shared + k + 1], axis=1
    )
    s_shared, s_coupled, s_right, _ = jnp.split(
        sums.border[:n_shared], [n_shared, n_shared + k, n_shared + k + 1], axis=1
    )
    us = (us.transpose(2, 0, 1) - e_shared.transpose(1, 0, 2)).reshape(n_shared, 6 * n)
    uss = uss + damping * jnp.diag(weight.shared) - s_shared
    ge = rest.rows_e.transpose(1, 2, 0) - e_coupled.transpose(0, 2, 1)
    g = jnp.concatenate([ge.reshape(6 * n, k), rest.rows_s.T - s_coupled])
    of_mu = sums.border[n_shared : n_shared + k, n_shared : n_shared + k + 1]
    kk, d = jnp.eye(k) + of_mu[:, :k], of_mu[:, k]
    # Write whole parts: XLA does not vectorise the computation of `block` inside an update.
    end = jnp.zeros((6 * width + n_shared,) * 2).at[: 6 * width, : 6 * width].set(last.reshape(6 * width, -1))
    end = end.at[6 * width :, : 6 * width].set(us[:, 6 * of_inner :]).at[6 * width :, 6 * width :].set(uss)
    if k:
        # A = S + g K^-1 g' couples all images: the band has one full column block.
        end = end + g @ solve(kk, g.T)
    a = Band(columns.reshape(inner, 12 * width, 6 * width), us[:, : 6 * of_inner], end)

    b_e, b_s = b_e + jnp.einsum("cna,c->na", rest.rows_e, coupled), b_s + rest.rows_s.T @ coupled
    if less is not None:
        b_e, b_s = b_e - less.eop.T, b_s - less.shared
    right = jnp.concatenate([(b_e - e_right[:, 0]).reshape(-1), b_s - s_right[:, 0]])
    reduced = Reduced(diagonal_of(a), g, kk, f, points.border, points.l, weight, jnp.asarray(damping, float))
    return a, reduced, RightSide(Increments(b_e.T, b_s, points.b), right, d)


def _by_unknown(m: Float[Array, "images c c"], s: PaddedStructure):
    """Rearrange sums by image and colour to the columns of the shared unknowns; the last column is a dummy."""
    q, n = s.n_image_colours, s.n_shared
    each, column = jnp.arange(s.n_images), jnp.asarray(s.column)[:, : s.n_image_colours]
    us = jnp.zeros((s.n_images, 6, n + 1)).at[each[:, None], :, column].add(m[:, :6, 6 : 6 + q].transpose(0, 2, 1))
    uss = jnp.zeros((n + 1, n + 1)).at[column[:, :, None], column[:, None, :]].add(m[:, 6 : 6 + q, 6 : 6 + q])
    b_s = jnp.zeros(n + 1).at[column].add(m[:, 6 : 6 + q, -1])
    return us, uss, b_s
