"""Required parts of the inverse normal matrix: cofactors of unknowns and of rows.

With S~ = [S g; g' -K] the reduced matrix bordered by the few rows that couple points (see `normal`), V = L L' and F =
[W; Ws'; D_p] L^-T, the whitened coupling of point p,

    Q~    = S~^-1                                   exterior and interior orientation, scanner, mounts, strips
    Q_pp  = L^-T (I + F' Q~ F) L^-1                 3 x 3 per point
    j Q j' = z'z + (j_r - F z)' Q~ (j_r - F z)      of an image row with derivatives j_r and j_p, z = L^-1 j_p'

summed over rays and pairs of rays. The same formulas apply to rows stored by point that involve shared unknowns. The
full matrix is never inverted. In a free network the component along the undetermined motions, which the datum
constraints fix, is subtracted: the result is the covariance under inner (or minimal) constraints.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.padded import PaddedStructure, each_batch
from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.layout.sharding import BATCHES, along_points, sharded
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.row_functions import RowJacobian, over_portions, reduced_places, rows_at_once
from jaxphoto.adjustment.solver.band import invert_band
from jaxphoto.adjustment.solver.elimination import FactoredNormal, solve_factored
from jaxphoto.adjustment.solver.non_image_rows import RowsOfPoints, non_image_rows
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, dot
from jaxphoto.adjustment.solver.ray_rows import points_at
from jaxphoto.adjustment.solver.reduced import (
    add_rows,
    interior_in_border,
    pair_images,
    ray_columns,
    reduced_columns,
)
from jaxphoto.adjustment.solver.similarity import along_motions, n_open_motions
from jaxphoto.linear_algebra import inverse as inverse_of
from jaxphoto.linear_algebra import solve
from jaxphoto.small_matrices import unwhiten, whiten


class Cofactors(NamedTuple):
    """Cofactors of reduced unknowns and points, in scaled increments."""

    reduced: Float[Array, "reduced reduced"]
    points: Float[Array, "points 3 3"]


class RowCofactors(NamedTuple):
    """Cofactors j Q j' of the components of a row, in padded sizes."""

    image: Float[Array, "batches 3 m p"]
    """Variances of x and y, and their covariance."""
    at_points: tuple[Float[Array, "c c rows points"], ...]
    """Cofactors of the groups of `AbstractStructure.with_shared`."""


def cofactors_of(at: Linearised, factored: FactoredNormal, of_rows: bool) -> tuple[Cofactors, RowCofactors | None]:
    """Return all cofactors of a factored block, and j Q j' of its rows if `of_rows`; see the module docstring."""
    s = at.structure
    reduced = factored.reduced
    inverse = invert_band(factored.factor)
    full = inverse
    if reduced.g.shape[1]:
        kg = solve(reduced.k, reduced.g.T)
        low = inverse @ kg.T
        full = jnp.block([[inverse, low], [low.T, kg @ low - inverse_of(reduced.k)]])
    out = (BATCHES, RowCofactors(BATCHES, (along_points(4),) * len(s.with_shared)) if of_rows else None)
    points, rows = sharded(_of_points, s, out)(full, reduced, at, of_rows)
    return _without_open_motions(Cofactors(inverse, points), at, factored), rows


def _of_points(
    full: Float[Array, "n n"], reduced: Reduced, at: Linearised, of_rows: bool
) -> tuple[Float[Array, "points 3 3"], RowCofactors | None]:
    """Return cofactors of points, and j Q j' of rows if `of_rows`."""
    s = at.structure
    seen = _seen(full, reduced, s)
    half = jnp.stack(unwhiten(seen.inner, reduced.l))
    points = jnp.stack(unwhiten(half.transpose(1, 0, 2), reduced.l)).transpose(2, 0, 1)
    if not of_rows:
        return points, None
    at_points = non_image_rows(at).at_points if s.with_shared else ()
    of_groups = tuple(_of_group(full, group, seen, reduced, s) for group in at_points)
    return points, RowCofactors(_of_images(full, seen, reduced, at), of_groups)


class _Propagated(NamedTuple):
    """Q~ F of each point by coupled unknowns, and I + F' Q~ F."""

    rays: Float[Array, "batches m p d e"]
    """Product for the unknowns of the ray's image."""
    border: Float[Array, "points c 3"]
    inner: Float[Array, "3 3 points"]


def _block(full: Array, row: Array, column: Array) -> Array:
    """Gather Q~ at rows and columns (last axes); zero for missing unknowns."""
    return full.at[row[..., :, None], column[..., None, :]].get(mode="fill", fill_value=0.0)


def _seen(full: Float[Array, "n n"], reduced: Reduced, s: PaddedStructure) -> _Propagated:
    of_image, of_group = reduced_columns(s, len(reduced.k))
    border = reduced.border.reshape(len(of_group), GROUP, *reduced.border.shape[1:])
    n_points, d, c = reduced.border.shape
    if not s.rays.free_points:
        unit = jnp.broadcast_to(jnp.eye(3)[:, :, None], (3, 3, n_points))
        return _Propagated(reduced.f, jnp.zeros((n_points, c, d)), unit)
    take = lambda v, at: v.at[at].get(mode="clip")  # noqa: E731

    def own(sums, numbers):
        image, point, f = numbers
        columns = of_image[image]
        if s.rays.met.shape[1]:
            across = _block(full, of_group[point // GROUP], columns[:, None])
            of_border = jnp.einsum("npce,npae->npca", across, f)
            seen = jnp.einsum("npce,npac->npae", across, take(reduced.border, point))
        else:
            across = _block(full, of_group[0], columns)
            of_border = jnp.einsum("nce,npae->npca", across, f)
            seen = jnp.einsum("nce,npac->npae", across, take(reduced.border, point))
        seen = seen + jnp.einsum("nef,npaf->npae", _block(full, columns, columns), f)
        rows = of_border.reshape(*point.shape, -1)
        return add_rows(sums, point, jnp.moveaxis(rows, -1, 0)), seen

    by_border = jnp.einsum("gcd,gpad->gpca", _block(full, of_group, of_group), border).reshape(n_points, -1)
    by_border, rays = s.each(own, by_border, (reduced.f,))
    by_border, flat, shape = by_border.reshape(n_points, c, -1), reduced.f, reduced.f.shape

    def of_pairs(sums, numbers):
        pair, block = numbers
        one, other = (take(of_image, image) for image in pair_images(block, s))
        met = _block(full, one, other)
        f = flat.reshape(-1, *shape[3:])
        seen = (
            jnp.einsum("nef,nqaf->nqae", met, take(f, pair[:, 1])),
            jnp.einsum("nef,nqae->nqaf", met, take(f, pair[:, 0])),
        )
        rows = (v.reshape(-1, shape[3] * shape[4]) for v in seen)
        for which, v in zip((pair[:, 0], pair[:, 1]), rows, strict=True):
            sums = sums.at[which.reshape(-1)].add(v)
        return sums, ()

    pairs, of_all = (s.pairs, s.rays.block), rays.reshape(-1, shape[3] * shape[4])
    rays = each_batch(of_pairs, of_all, pairs, s.rays.used[0, 1])[0].reshape(shape)

    def met(sums, numbers):
        _, point, f, seen = numbers
        rows = jnp.einsum("npae,npbe->npab", f, seen).reshape(*point.shape, -1)
        return add_rows(sums, point, jnp.moveaxis(rows, -1, 0)), ()

    inner = jnp.eye(3) + jnp.einsum("nac,ncb->nab", reduced.border, by_border)
    inner, _ = s.each(met, inner.reshape(-1, 9), (reduced.f, rays))
    return _Propagated(rays, by_border, inner.T.reshape(3, 3, -1))


def _of_images(full: Array, seen: _Propagated, reduced: Reduced, at: Linearised) -> Float[Array, "batches 3 m p"]:
    """Return j Q j' of image rows."""
    _, scale, values, s = at
    columns_of, n, q = ray_columns(at), 6 * s.n_images, s.n_image_colours
    column = jnp.asarray(s.column)[:, :q]
    touched = jnp.concatenate(
        [6 * jnp.arange(s.n_images)[:, None] + jnp.arange(6), jnp.where(column < s.n_shared, n + column, len(full))], 1
    )
    of_points = jnp.concatenate([reduced.l, scale.points, seen.inner.reshape(9, -1)])

    def batch(numbers):
        image, point, xy, sigma, rays = numbers
        both, own = columns_of((image, point, xy, sigma)), touched[image]
        l, scale, inner = jnp.split(points_at(of_points, point), [6, 9])  # noqa: E741
        inner = inner.reshape(3, 3, *point.shape)
        if s.rays.free_points and not s.rays.by_image:
            of_border = seen.border.at[point].get(mode="clip")
            own_column = jnp.minimum(column[image], of_border.shape[2] - 1)[:, None, :, None]
            of_cameras = jnp.take_along_axis(of_border, own_column, axis=2).swapaxes(2, 3)
            rays = jnp.concatenate([rays, of_cameras], axis=3)
        j = [jnp.concatenate([o.eop, o.shared]) for o in both]
        z = [jnp.stack(whiten(o.point * scale, l)) for o in both]
        met = _block(full, own, own)
        moved = [jnp.einsum("nab,bnp->anp", met, o) for o in j]
        across = [jnp.einsum("anp,npka->knp", o, rays) for o in j] if s.rays.free_points else [0 * z[0]] * 2

        def of_both(o: int, k: int) -> Float[Array, "m p"]:
            met = jnp.sum(z[o] * across[k] + z[k] * across[o], axis=0)
            return jnp.sum(j[o] * moved[k], axis=0) - met + jnp.einsum("knp,klnp,lnp->np", z[o], inner, z[k])

        return jnp.stack([of_both(0, 0), of_both(1, 1), of_both(0, 1)])

    return s.each_ray(batch, (values.xy, values.sigma_xy, seen.rays))


def _of_group(full: Array, rows: RowsOfPoints, seen: _Propagated, reduced: Reduced, s: PaddedStructure) -> Array:
    """Return j Q j' of rows stored by point that involve shared unknowns."""
    first = interior_in_border(s) + len(reduced.k) + 1

    def one(numbers):
        rows, border, of_group, inner, l = numbers  # noqa: E741
        j, z = rows.shared, jnp.stack(whiten(rows.points.swapaxes(0, 1), l))
        at = jnp.where(rows.slot < s.rays.met.shape[1], first + rows.slot, border.shape[0] - 1)
        of_slot = border[at, :, jnp.arange(at.shape[2])]
        across = jnp.einsum("clrp,lrpk->ckrp", j, of_slot)
        own = full.at[of_group[at][:, None], of_group[at][None]].get(mode="fill", fill_value=0.0)
        shared = jnp.einsum("clrp,lmrp,dmrp->cdrp", j, own, j)
        both = jnp.einsum("kcrp,dkrp->cdrp", z, across)
        return shared - both - both.swapaxes(0, 1) + jnp.einsum("kcrp,klp,ldrp->cdrp", z, inner, z)

    border = seen.border.transpose(1, 2, 0)
    rows, border, inner, l = jax.tree.map(s.by_group, (rows, border, seen.inner, reduced.l))  # noqa: E741
    found = jax.lax.map(one, (rows, border, reduced_columns(s, len(reduced.k))[1], inner, l), batch_size=64)
    return jnp.moveaxis(found, 0, -2).reshape(*found.shape[1:-1], -1)


def _without_open_motions(q: Cofactors, at: Linearised, factored: FactoredNormal) -> Cofactors:
    """Subtract E E': the component of the cofactors along the motions that the datum constraints D fix.

    E = (N + D'D)^-1 D' spans these motions exactly, because they are in the null space of N. If all motions are
    undetermined, they are known in advance.
    """
    defect = len(at.values.datum_eop)
    if not defect:
        return q
    _, scale, values, s = at
    rows = at.constraints()
    if n_open_motions(values, s):
        # E = M (D M)^-1, with known motions M.
        m = along_motions(values, scale, s.on_one_device)
        met = jnp.einsum("kci,jci->kj", rows.eop, m.eop) + jnp.einsum("kcp,jcp->kj", rows.points, m.points)
        e = jax.tree.map(lambda v: jnp.tensordot(inverse_of(met), v, (0, 0)), m)
    else:
        e = jax.vmap(lambda row: solve_factored(factored.reduced, factored.factor, row, at))(rows)
    e_eop, e_shared, e_points = e.eop.transpose(2, 1, 0), e.shared.T, e.points.transpose(2, 1, 0)
    e_reduced = jnp.concatenate([e_eop.reshape(-1, defect), e_shared])
    return q._replace(
        reduced=q.reduced - e_reduced @ e_reduced.T, points=q.points - jnp.einsum("pck,pdk->pcd", e_points, e_points)
    )


def row_variances(
    at: Linearised, q: Cofactors, of_rows: RowCofactors, factored: FactoredNormal
) -> tuple[Array, tuple[Array, ...]]:
    """Return J Q J' of the image rows, and of every other group as (c, c, ...), c components per row."""
    at = at._replace(structure=at.structure.on_one_device)
    s = at.structure
    rest = non_image_rows(at)
    at_points, found = iter(of_rows.at_points), []
    for g, j in zip(s.observed, rest.jacobians, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            own = jnp.einsum("carp,pab,dbrp->cdrp", j.points[:, 0], q.points, j.points[:, 0])
            found.append(next(at_points) if g.place else own)
        elif g.elimination == "reduced":
            found.append(_of_reduced(g, j, q.reduced, s))
        else:
            found.append(_of_coupled(g, j, at, factored))
    return of_rows.image, tuple(found)


def _of_reduced(g: ObservedGroup, j: RowJacobian, q: Array, s: PaddedStructure) -> Float[Array, "c c rows"]:
    def of(touched: Array, own: Array) -> Array:
        at = touched.T
        # A missing unknown has the index after the last.
        met = q.at[at[:, :, None], at[:, None]].get(mode="fill", fill_value=0.0)
        seen = jnp.einsum("nab,dbn->dan", met, own)
        return jnp.einsum("can,dan->cdn", own, seen)

    touched = reduced_places(g, s.n_images)
    own = jnp.concatenate([j.eop.reshape(g.components, -1, g.n_rows), j.shared], axis=1)
    return over_portions(of, (touched, own), g.n_rows, rows_at_once(len(touched) ** 2))


def _of_coupled(g: ObservedGroup, j: RowJacobian, at: Linearised, factored: FactoredNormal) -> Float[Array, "c c rows"]:
    """Return j Q j' of coupled rows by one solution per component: no other rows couple their unknowns."""
    s, zero = at.structure, at.increments

    def whole(k, c) -> Increments:
        y = zero
        for n, image in enumerate(g.image):
            y = y._replace(eop=y.eop.at[:, jnp.asarray(image)[k]].add(j.eop[c, n, :, k]))
        for n, column in enumerate(g.column):
            y = y._replace(shared=y.shared.at[jnp.asarray(column)[k]].add(j.shared[c, n, k], mode="drop"))
        for n, point in enumerate(g.point):
            y = y._replace(points=y.points.at[:, jnp.asarray(point)[k]].add(j.points[c, n, :, k]))
        return y

    def one(at_number):
        k, c = at_number
        x = solve_factored(factored.reduced, factored.factor, whole(k, c), at)
        return jnp.stack([dot(whole(k, d), x, s) for d in range(g.components)])

    each = jnp.meshgrid(jnp.arange(g.n_rows), jnp.arange(g.components), indexing="ij")
    found = jax.lax.map(one, tuple(v.reshape(-1) for v in each))
    return found.reshape(g.n_rows, g.components, g.components).transpose(1, 2, 0)
