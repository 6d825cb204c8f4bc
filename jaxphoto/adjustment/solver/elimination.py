"""Solution of the normal equations: right-hand sides go down to the reduced unknowns, solutions back to the points.

Both ways lead through F, see `normal`. The F of a small block is kept; that of a large one takes longer to fetch from
memory than to make anew, a few tiles at a time. One solution, not one of many, comes back to the points by two
derivatives of the image rows instead, in a direction and back: W' x = J_p' (J_e x).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.tiled import TiledResiduals, TiledStructure
from jaxphoto.adjustment.model.image_orientations import ImageOrientations, of_images, orientations_of
from jaxphoto.adjustment.model.numbers import Increments, NonImageResiduals, datum_residuals, state_at
from jaxphoto.adjustment.model.observed_groups import RowsAtPoints
from jaxphoto.adjustment.model.row_functions import non_image_residuals, row_jacobian, rows_at_once
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.band import BandFactor, solve_band
from jaxphoto.adjustment.solver.non_image_rows import non_image_rows
from jaxphoto.adjustment.solver.normal import Linearised, Reduced
from jaxphoto.adjustment.solver.reduced import tile_columns, tile_numbers, tile_parts
from jaxphoto.adjustment.solver.tile_rows import seen_in, tile_residuals
from jaxphoto.arrays import added
from jaxphoto.linear_algebra import solve
from jaxphoto.short_repr import shown
from jaxphoto.small_matrices import unwhiten, whiten


@shown
class FactoredNormal(eqx.Module):
    """The normal equations at an optimum in scaled increments, undamped, factored."""

    reduced: Reduced
    factor: BandFactor
    scale: Increments


def over_tiles(function: Callable, at: Linearised, reduced: Reduced, numbers: tuple) -> Any:
    """`function(F, images, *numbers)` of every tile, for the F of `reduced`, linearised `at`."""
    if reduced.f is None:
        rest = non_image_rows(at)
        parts_of = tile_parts(at, reduced.damping, rest.coupled)
        given, f_of = tile_numbers(at, rest), lambda given: parts_of(given).f
    else:
        given, f_of = reduced.f, lambda f: f

    def tile(of_tile):
        image, given, *own = of_tile
        return function(f_of(given), image, *own)

    return at.structure.each_tile(tile, (given, *numbers))


def solve_factored(reduced: Reduced, factor: BandFactor, b: Increments, at: Linearised) -> Increments:
    """x of (N + damping diag(N)) x = b, one of many: down to the reduced unknowns, and back to the points."""
    return solve_reduced(reduced, factor, *reduce_right(reduced, b, at), b.points, at, many=True)


def reduce_right(reduced: Reduced, b: Increments, at: Linearised) -> tuple[Array, Array]:
    """A right-hand side taken down to the reduced unknowns and to mu."""
    s = at.structure
    if not s.tiles.free_points:
        return jnp.concatenate([b.eop.T.reshape(-1), b.shared]), jnp.zeros(len(reduced.k))
    z = jnp.stack(whiten(b.points, reduced.l))
    image, z = s.tiles.image, s.by_tile(z)
    down = over_tiles(lambda f, _, z: f @ z.reshape(-1), at, reduced, (z,))
    of_images, border = jnp.split(down, [6 * image.shape[2]], axis=2)
    of_images = jax.ops.segment_sum(of_images.reshape(-1, 6), image.reshape(-1), s.n_images)
    interior, met, rest = jnp.split(border, [s.n_interior, border.shape[2] - len(reduced.k) - 1], axis=2)
    shared = s.by_unknown(met).at[: s.n_interior].add(jnp.sum(interior, (0, 1)))
    of_images, shared, d = total((of_images, shared, jnp.sum(rest, (0, 1))[:-1]), s)
    return jnp.concatenate([(b.eop.T - of_images).reshape(-1), b.shared - shared]), d


def solve_reduced(
    reduced: Reduced, factor: BandFactor, right, d, b_points, at: Linearised, many: bool = False
) -> Increments:
    """x of a right-hand side taken down already: `right` to the reduced unknowns, `d` to mu."""
    r, s, n = reduced, at.structure, at.structure.n_images
    if len(d):
        right = right - r.g @ solve(r.k, d)
    x = solve_band(factor, right)
    mu = solve(r.k, r.g.T @ x + d) if len(d) else d
    eop, shared = x[: 6 * n].reshape(n, 6), x[6 * n :]
    if not s.tiles.free_points:
        return Increments(eop.T, shared, jnp.zeros_like(b_points))
    if r.f is None and not many:
        b_points = b_points - _up_by_rows(eop.T, shared, mu, at)
        return Increments(eop.T, shared, jnp.stack(unwhiten(whiten(b_points, r.l), r.l)))
    interior, rest, met = shared[: s.n_interior], jnp.append(mu, 0.0), jnp.append(shared, 0.0)[s.tiles.met]

    def up(f, image, met):
        return (jnp.concatenate([eop[image].reshape(-1), interior, met, rest]) @ f).reshape(3, -1)

    z = jnp.stack(whiten(b_points, r.l)) - s.by_point(over_tiles(up, at, r, (met,)))
    return Increments(eop.T, shared, jnp.stack(unwhiten(z, r.l)))


def _up_by_rows(eop: Array, shared: Array, mu: Array, at: Linearised) -> Array:
    """What increments of images and shared unknowns, and mu, add to the right-hand sides of the points."""
    increments, scale, values, s = at
    rest = non_image_rows(at)
    scene, moved = jax.jvp(partial(_scene_at, at), (increments.eop, increments.shared), (eop, shared))

    def tile(numbers):
        image, point, xy, sigma = numbers
        seen, place = seen_in(xy, sigma, image, s), of_images(scene, image, s)
        moves = jax.jvp(lambda scene: tile_residuals(scene, point, seen, s), (place,), (of_images(moved, image, s),))[1]
        return jax.vjp(lambda point: tile_residuals(place, point, seen, s), point)[1](moves)[0]

    numbers = (s.by_tile(at.state.points), values.xy, values.sigma_xy)
    result = s.by_point(s.each_tile(tile, numbers)) * scale.points + jnp.einsum("kcp,k->cp", rest.rows_p, mu)
    for g, rows in zip(s.with_shared, rest.at_points, strict=True):
        moved = jnp.append(shared, 0.0)[jnp.asarray(g.column)]
        result = result + jnp.einsum("ckrp,clrp,lrp->kp", rows.points, rows.shared, moved)
    return result


def pull(z: TiledResiduals, at: Linearised) -> Increments:
    """J'z of many residuals, along a leading axis, on one device; J is computed once for all of them."""
    _, scale, values, s = at
    columns_of, image = tile_columns(at), s.tiles.image

    def tile(numbers):
        *measured, z = numbers
        z = jnp.moveaxis(z, 1, 0)
        columns = columns_of(measured)
        both = [jnp.concatenate([j.eop, j.shared]) for j in columns]
        of_image = added(jnp.einsum("amp,kmp->mka", j, v) for j, v in zip(both, z, strict=True))
        each = zip(columns, z, strict=True)
        of_point = added(j.point[:, k] * v[:, None, k] for j, v in each for k in range(z.shape[2]))
        return of_image, of_point

    given = (values.xy, values.sigma_xy, s.by_tile(at.state.points), s.by_tile(scale.points))
    of_images, of_points = s.each_tile(tile, (*given, jnp.moveaxis(z.image, 0, 2)))
    of_images = jax.ops.segment_sum(of_images.reshape(-1, *of_images.shape[3:]), image.reshape(-1), s.n_images)
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.zeros((s.n_shared + 1, len(z.image))).at[column].add(of_images[:, :, 6:].swapaxes(1, 2))[:-1].T
    b = Increments(of_images[:, :, :6].transpose(1, 2, 0), shared, s.by_point(of_points))
    return jax.tree.map(jnp.add, b, pull_others(z, at))


def pull_others(z: NonImageResiduals, at: Linearised) -> Increments:
    """J'z of all but the image rows, of many along a leading axis; J is computed once for all of them."""
    increments, scale, values, s = at
    pairs = list(zip(s.observed, values.groups, strict=True))
    jacobians = [row_jacobian(g, numbers, increments, scale, values, s) for g, numbers in pairs]
    _, of_datum = jax.vjp(lambda y: datum_residuals(y, scale, values, s), increments)

    def one(own: tuple[tuple[Any, ...], Any]) -> Increments:
        others, datum = own
        eop, shared, points = of_datum(datum)[0]
        for g, j, v in zip(s.observed, jacobians, others, strict=True):
            shared = shared.at[g.column].add(jnp.einsum("cl...,c...->l...", j.shared, v), mode="drop")
            if isinstance(g.rows, RowsAtPoints):
                points = points + jnp.einsum("cjarp,crp->ap", j.points, v)
                continue
            eop = eop.at[:, g.image].add(jnp.einsum("ckar,cr->akr", j.eop, v))
            points = points.at[:, g.point].add(jnp.einsum("cjar,cr->ajr", j.points, v))
        return Increments(eop, shared, points)

    return _of_many(one, (z.others, z.datum), len(z.datum), s)


def _of_many(function: Callable[[Any], Any], values: Any, many: int, s: TiledStructure) -> Any:
    """`function` of many `values` along their leading axes, of as many side by side as memory allows.

    Of each of these, every row has numbers of what it touches.
    """
    most = rows_at_once(sum(g.components * g.n_rows * len(g.parameter) for g in s.observed))
    if many <= most:
        return jax.vmap(function)(values)
    # None is left over, which would be compiled by itself.
    size = next(k for k in range(most, 0, -1) if many % k == 0)
    batches = jax.tree.map(lambda v: v.reshape(many // size, size, *v.shape[1:]), values)
    found = jax.lax.map(jax.vmap(function), batches)
    return jax.tree.map(lambda v: v.reshape(many, *v.shape[2:]), found)


def push(x: Increments, at: Linearised) -> TiledResiduals:
    """J x of many increments, along a leading axis, on one device."""
    image = jax.vmap(lambda own: _push_images(own, at))(x)
    both = lambda own, image: TiledResiduals(own.others, own.datum, own.names, image)  # noqa: E731
    return jax.vmap(both)(push_others(x, at), image)


def _push_images(x: Increments, at: Linearised) -> Float[Array, "chunks tiles 2 m p"]:
    """J x of the image rows, tile by tile: what lies between stays in the processor's cache."""
    _, scale, values, s = at
    scene, moved = jax.jvp(partial(_scene_at, at), at.increments[:2], x[:2])

    def tile(numbers):
        image, point, step, xy, sigma = numbers
        seen = seen_in(xy, sigma, image, s)
        places, steps = (of_images(scene, image, s), point), (of_images(moved, image, s), step)
        return jnp.stack(jax.jvp(lambda scene, point: tile_residuals(scene, point, seen, s), places, steps)[1])

    numbers = (s.by_tile(at.state.points), s.by_tile(x.points * scale.points), values.xy, values.sigma_xy)
    return s.each_tile(tile, numbers)


def push_others(x: Increments, at: Linearised) -> NonImageResiduals:
    """J x of all but the image rows, of many along a leading axis."""
    _, scale, values, s = at

    def one(own: Increments) -> NonImageResiduals:
        return jax.jvp(lambda y: non_image_residuals(y, scale, values, s), (at.increments,), (own,))[1]

    return _of_many(one, x, len(x.shared), s)


def _scene_at(at: Linearised, eop: Array, shared: Array) -> ImageOrientations:
    increments, scale, values, s = at
    return orientations_of(state_at(increments._replace(eop=eop, shared=shared), scale, values, s), values, s)
