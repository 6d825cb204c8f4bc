"""The inverse of the normal matrix as far as anybody asks for it: cofactors of unknowns and of rows.

With S~ = [S g; g' -K] the reduced matrix bordered by the few rows that couple points (see `normal`), V = L L' and
F = [W; Ws'; D_p] L^-T what a point p meets, whitened,

    Q~    = S~^-1                                   exterior and interior orientation, scanner, mounts, strips
    Q_pp  = L^-T (I + F' Q~ F) L^-1                 3 x 3 a point
    j Q j' = z'z + (j_r - F z)' Q~ (j_r - F z)      of an image row with columns j_r and j_p, z = L^-1 j_p'

summed tile by tile, and so of other rows by point that touch shared unknowns, too. The full matrix is never inverted.
In a free network the part along the open motions, which the constraints of the datum hold, is subtracted: what remains
is the covariance under inner (or minimal) constraints.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.sharding import TILES, along_points, sharded
from jaxphoto.adjustment.layout.tiled import TiledStructure
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.row_functions import RowJacobian, over_portions, reduced_places, rows_at_once
from jaxphoto.adjustment.solver.band import invert_band
from jaxphoto.adjustment.solver.elimination import FactoredNormal, over_tiles, solve_factored
from jaxphoto.adjustment.solver.non_image_rows import non_image_rows
from jaxphoto.adjustment.solver.normal import Linearised, Reduced, dot
from jaxphoto.adjustment.solver.reduced import tile_columns
from jaxphoto.adjustment.solver.similarity import along_motions, n_open_motions
from jaxphoto.linear_algebra import inverse as inverse_of
from jaxphoto.linear_algebra import solve
from jaxphoto.small_matrices import unwhiten, whiten


class Cofactors(NamedTuple):
    """Cofactors of reduced unknowns and points, in scaled increments."""

    reduced: Float[Array, "reduced reduced"]
    points: Float[Array, "points 3 3"]


class RowCofactors(NamedTuple):
    """j Q j' of rows, in padded sizes: of the numbers of a row with one another."""

    image: Float[Array, "chunks tiles 3 m p"]
    """Of x, of y, and of both with one another."""
    at_points: tuple[Float[Array, "c c rows points"], ...]
    """Of the groups of `AbstractStructure.with_shared`."""


def cofactors_of(at: Linearised, factored: FactoredNormal, of_rows: bool) -> tuple[Cofactors, RowCofactors | None]:
    """All cofactors of one factored block, and j Q j' of its rows if these are wanted; see the module's head."""
    s = at.structure
    reduced = factored.reduced
    inverse = invert_band(factored.factor)
    full = inverse
    if reduced.g.shape[1]:
        kg = solve(reduced.k, reduced.g.T)
        low = inverse @ kg.T
        full = jnp.block([[inverse, low], [low.T, kg @ low - inverse_of(reduced.k)]])
    out = (TILES, RowCofactors(TILES, (along_points(4),) * len(s.with_shared)) if of_rows else None)
    points, rows = sharded(_of_points, s, out)(full, reduced, at, of_rows)
    return _without_open_motions(Cofactors(inverse, points), at, factored), rows


def _of_points(
    full: Float[Array, "n n"], reduced: Reduced, at: Linearised, of_rows: bool
) -> tuple[Float[Array, "points 3 3"], RowCofactors | None]:
    """Cofactors of points, and j Q j' of rows if these are wanted."""
    _, scale, values, s = at
    columns_of = tile_columns(at)
    at_points = non_image_rows(at).at_points if s.with_shared else ()
    n, q, k, n_met = 6 * s.n_images, s.n_image_colours, len(reduced.k), s.tiles.met.shape[2]
    # One more than there are: zeros serve the last row of F, and what means nothing in an image or a tile.
    interior, rest, none = n + jnp.arange(s.n_interior), n + s.n_shared + jnp.arange(k + 1), n + s.n_shared + k
    met = jnp.asarray(s.tiles.met)
    met = jnp.where(met < s.n_shared, n + met, none)

    def tile(f, image, l, at_points, met, *measured):  # noqa: E741
        size = l.shape[1]
        if not s.tiles.free_points:
            f = jnp.zeros((len(f), 3 * size))
        index = jnp.concatenate([(6 * image[:, None] + jnp.arange(6)).reshape(-1), interior, met, rest])
        own = full.at[index[:, None], index].get(mode="fill", fill_value=0.0)
        a = own @ f
        # A product of matrices would want both turned round first.
        g = jnp.sum(f.reshape(-1, 3, 1, size) * a.reshape(-1, 1, 3, size), axis=0)
        inner = jnp.eye(3)[:, :, None] + g
        half = jnp.stack(unwhiten(inner, l))
        points = jnp.stack(unwhiten(half.transpose(1, 0, 2), l)).transpose(2, 0, 1)
        return (points, *rows((image, *measured), at_points, l, own, a, inner)) if of_rows else (points,)

    def rows(measured, at_points, l, own, a, inner):  # noqa: E741
        image, both = measured[0], columns_of(measured)
        m, size = both[0].residual.shape
        column = jnp.asarray(s.column)[image, :q]
        column = jnp.where(column < s.n_interior, 6 * m + column, len(own) - 1)
        touched = jnp.concatenate([6 * jnp.arange(m)[:, None] + jnp.arange(6), column], axis=1)
        j = jnp.stack([jnp.concatenate([c.eop, c.shared]) for c in both], axis=1).transpose(2, 0, 1, 3)
        z = jnp.stack([jnp.stack(whiten(c.point, l)) for c in both]).transpose(0, 2, 1, 3)
        seen = jnp.einsum("mab,mbn->man", own[touched[:, :, None], touched[:, None, :]], j.reshape(m, 6 + q, -1))
        seen, across = seen.reshape(j.shape), jnp.einsum("mcop,mckp->omkp", j, a[touched].reshape(m, 6 + q, 3, size))

        def of_both(o: int, k: int) -> Float[Array, "m p"]:
            met = jnp.sum(z[o] * across[k] + z[k] * across[o], axis=1)
            return jnp.sum(j[:, :, o] * seen[:, :, k], axis=1) - met + jnp.einsum("mkp,klp,mlp->mp", z[o], inner, z[k])

        found = jnp.stack([of_both(0, 0), of_both(1, 1), of_both(0, 1)])
        return found, tuple(of_group(group, 6 * m, l, own, a, inner) for group in at_points)

    def of_group(group, of_images, l, own, a, inner):  # noqa: E741
        j, z = group.shared, jnp.stack(whiten(group.points.swapaxes(0, 1), l))
        at = jnp.where(group.slot < n_met, of_images + s.n_interior + group.slot, len(own) - 1)
        of_slot = a.reshape(len(a), 3, -1)[at, :, jnp.arange(at.shape[2])]
        across = jnp.einsum("clrp,lrpk->ckrp", j, of_slot)
        shared = jnp.einsum("clrp,lmrp,dmrp->cdrp", j, own[at[:, None], at[None]], j)
        both = jnp.einsum("kcrp,dkrp->cdrp", z, across)
        return shared - both - both.swapaxes(0, 1) + jnp.einsum("kcrp,klp,ldrp->cdrp", z, inner, z)

    of_points = (reduced.l, at_points, values.points, scale.points)
    l, at_points, *places = jax.tree.map(s.by_tile, of_points)  # noqa: E741
    points, *found = over_tiles(tile, at, reduced, (l, at_points, met, values.xy, values.sigma_xy, *places))
    rows_found = RowCofactors(found[0], tuple(s.by_point(v) for v in found[1])) if of_rows else None
    return points.reshape(-1, 3, 3), rows_found


def _without_open_motions(q: Cofactors, at: Linearised, factored: FactoredNormal) -> Cofactors:
    """Subtract E E': what the constraints D of the datum, taken as observations, leave along the motions they hold.

    E = (N + D'D)^-1 D' spans those motions exactly, because N does not see them; where all are open, they are known.
    """
    defect = len(at.values.datum_eop)
    if not defect:
        return q
    _, scale, values, s = at
    rows = at.constraints()
    if n_open_motions(values, s):
        # The motions are known: E = M (D M)^-1.
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
    """J Q J' of image rows, and of the numbers of each other row with one another (c, c, ...)."""
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


def _of_reduced(g: ObservedGroup, j: RowJacobian, q: Array, s: TiledStructure) -> Float[Array, "c c rows"]:
    def of(touched: Array, own: Array) -> Array:
        at = touched.T
        # What means no unknown lies behind the last.
        met = q.at[at[:, :, None], at[:, None]].get(mode="fill", fill_value=0.0)
        seen = jnp.einsum("nab,dbn->dan", met, own)
        return jnp.einsum("can,dan->cdn", own, seen)

    touched = reduced_places(g, s.n_images)
    own = jnp.concatenate([j.eop.reshape(g.components, -1, g.n_rows), j.shared], axis=1)
    return over_portions(of, (touched, own), g.n_rows, rows_at_once(len(touched) ** 2))


def _of_coupled(g: ObservedGroup, j: RowJacobian, at: Linearised, factored: FactoredNormal) -> Float[Array, "c c rows"]:
    """By one solve for each number: they join what never met otherwise."""
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
