"""Solution of the normal equations: forward elimination to the reduced unknowns, back-substitution to the points.

Both use F, see `normal`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure
from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.model.image_orientations import ImageOrientations, of_images, orientations_of
from jaxphoto.adjustment.model.numbers import Increments, NonImageResiduals, state_at
from jaxphoto.adjustment.model.observed_groups import RowsAtPoints
from jaxphoto.adjustment.model.row_functions import RowJacobian, non_image_residuals, row_jacobian, rows_at_once
from jaxphoto.adjustment.model.structure import total
from jaxphoto.adjustment.solver.band import BandFactor, solve_band
from jaxphoto.adjustment.solver.normal import Linearised, Reduced
from jaxphoto.adjustment.solver.ray_rows import points_at, ray_residuals, seen_in
from jaxphoto.adjustment.solver.reduced import LinearisedRows, add_rows, border_places, image_places, ray_columns
from jaxphoto.arrays import sum_terms
from jaxphoto.linear_algebra import solve
from jaxphoto.short_repr import pretty_repr
from jaxphoto.small_matrices import unwhiten, whiten


@pretty_repr
class FactoredNormal(eqx.Module):
    """Undamped factored normal equations at an optimum, in scaled increments."""

    reduced: Reduced
    factor: BandFactor
    scale: Increments


def solve_factored(reduced: Reduced, factor: BandFactor, b: Increments, at: Linearised) -> Increments:
    """Solve (N + damping diag(N)) x = b."""
    return solve_reduced(reduced, factor, *reduce_right(reduced, b, at), b.points, at)


def reduce_right(reduced: Reduced, b: Increments, at: Linearised) -> tuple[Array, Array]:
    """Eliminate the points from a right-hand side; return its parts for the reduced unknowns and for mu."""
    s, k = at.structure, len(reduced.k)
    if not s.rays.free_points:
        return jnp.concatenate([b.eop.T.reshape(-1), b.shared]), jnp.zeros(k)
    z = jnp.stack(whiten(b.points, reduced.l))
    places, own, n = border_places(s, k), image_places(s, k), s.n_shared

    def down(sums, numbers):
        image, point, f = numbers
        return sums.at[image].add(jnp.einsum("npae,anp->ne", f, points_at(z, point))), ()

    of_images, _ = s.each(down, jnp.zeros((s.n_images, reduced.f.shape[-1])), (reduced.f,))
    border = jnp.einsum("gpac,gap->gc", reduced.border.reshape(len(places), GROUP, 3, -1), s.by_group(z))
    border = jnp.zeros(n + k + 2).at[places].add(border).at[own].add(of_images[:, 6:])
    of_images, border = total((of_images[:, :6], border), s)
    right = jnp.concatenate([(b.eop.T - of_images).reshape(-1), b.shared - border[:n]])
    return right, border[n : n + k]


def solve_reduced(reduced: Reduced, factor: BandFactor, right, d, b_points, at: Linearised) -> Increments:
    """Solve for x, given the eliminated right-hand side: `right` for the reduced unknowns, `d` for mu."""
    r, s, n = reduced, at.structure, at.structure.n_images
    if len(d):
        right = right - r.g @ solve(r.k, d)
    x = solve_band(factor, right)
    mu = solve(r.k, r.g.T @ x + d) if len(d) else d
    eop, shared = x[: 6 * n].reshape(n, 6), x[6 * n :]
    if not s.rays.free_points:
        return Increments(eop.T, shared, jnp.zeros_like(b_points))
    border = jnp.concatenate([shared, mu, jnp.zeros(2)])
    of_images = jnp.concatenate([eop, border[image_places(s, len(d))]], axis=1)

    def up(sums, numbers):
        image, point, f = numbers
        return sums.at[point].add(jnp.einsum("npae,ne->npa", f, of_images[image])), ()

    by_group = r.border.reshape(-1, GROUP, *r.border.shape[1:])
    z = jnp.einsum("gpac,gc->gpa", by_group, border[border_places(s, len(d))]).reshape(-1, 3)
    z, _ = s.each(up, z, (r.f,))
    return Increments(eop.T, shared, jnp.stack(unwhiten(jnp.stack(whiten(b_points, r.l)) - z.T, r.l)))


def jt_product(z: PaddedResiduals, at: Linearised) -> Increments:
    """Return J'z of many residual vectors (leading axis) on one device; J is evaluated once."""
    _, scale, values, s = at
    columns_of, many = ray_columns(at), len(z.image)

    def batch(sums, numbers):
        *measured, z = numbers
        (of_images, of_points), j = sums, columns_of(measured)
        both = list(zip((jnp.concatenate([c.eop, c.shared]) for c in j), jnp.moveaxis(z, 1, 0), strict=True))
        of_image = sum_terms(jnp.einsum("anp,knp->nka", c, v) for c, v in both)
        of_point = sum_terms(c.point * v[:, None] for c, v in zip(j, jnp.moveaxis(z, 1, 0), strict=True))
        of_point = of_point.reshape(3 * many, *measured[1].shape)
        return (of_images.at[measured[0]].add(of_image), add_rows(of_points, measured[1], of_point)), ()

    none = jnp.zeros((s.n_images, many, 6 + s.n_image_colours)), jnp.zeros((s.n_points, 3 * many))
    (of_images, of_points), _ = s.each(batch, none, (values.xy, values.sigma_xy, jnp.moveaxis(z.image, 0, 1)))
    of_points = of_points.T.reshape(many, 3, -1) * scale.points
    return jax.tree.map(jnp.add, _by_unknown(of_images, of_points, s), jt_product_others(z, at))


def gradient(rows: LinearisedRows, at: Linearised) -> Increments:
    """Return J'r at the linearisation point of the rows."""
    s = at.structure
    of_points = rows.of_points.v[:, 6:].T * at.scale.points
    b = _by_unknown(total(rows.by_image[:, None, :-1, -1], s), of_points[None], s)
    others = jax.tree.map(lambda v: v[None], rows.rest.residuals)
    b = jax.tree.map(jnp.add, b, _pull_others(others, rows.rest.jacobians, at))
    return jax.tree.map(lambda v: v[0], b)


def _by_unknown(of_images: Float[Array, "images k a"], points: Float[Array, "k 3 points"], s: PaddedStructure):
    """Return sums by image and by point as increments; vectors along the second and the first axis, respectively."""
    column = jnp.asarray(s.column)[:, : s.n_image_colours]
    shared = jnp.zeros((s.n_shared + 1, len(points))).at[column].add(of_images[:, :, 6:].swapaxes(1, 2))[:-1].T
    return Increments(of_images[:, :, :6].transpose(1, 2, 0), shared, points)


def jt_product_others(z: NonImageResiduals, at: Linearised) -> Increments:
    """Return J'z of all rows except image rows for many vectors (leading axis); J is evaluated once."""
    increments, scale, values, s = at
    pairs = zip(s.observed, values.groups, strict=True)
    return _pull_others(z, tuple(row_jacobian(g, own, increments, scale, values, s) for g, own in pairs), at)


def _pull_others(z: NonImageResiduals, jacobians: tuple[RowJacobian, ...], at: Linearised) -> Increments:
    s, constraints = at.structure, at.constraints()

    def one(own: tuple[tuple[Any, ...], Any]) -> Increments:
        others, datum = own
        eop, everywhere, points = (jnp.einsum("k...,k->...", v, datum) for v in constraints)
        dealt_out = jnp.zeros_like(everywhere)
        for g, j, v in zip(s.observed, jacobians, others, strict=True):
            shared = jnp.einsum("cl...,c...->l...", j.shared, v)
            if isinstance(g.rows, RowsAtPoints):
                dealt_out = dealt_out.at[g.column].add(shared, mode="drop")
                points = points + jnp.einsum("cjarp,crp->ap", j.points, v)
                continue
            everywhere = everywhere.at[g.column].add(shared, mode="drop")
            eop = eop.at[:, g.image].add(jnp.einsum("ckar,cr->akr", j.eop, v))
            points = points.at[:, g.point].add(jnp.einsum("cjar,cr->ajr", j.points, v))
        return Increments(eop, everywhere + total(dealt_out, s), points)

    return _of_many(one, (z.others, z.datum), len(z.datum), s)


def _of_many(function: Callable[[Any], Any], values: Any, many: int, s: PaddedStructure) -> Any:
    """Map `function` over the leading axes of `values`, limiting the number at a time to the available memory.

    Every row contains elements of all unknowns it involves.
    """
    most = rows_at_once(sum(g.components * g.n_rows * len(g.parameter) for g in s.observed))
    if many <= most:
        return jax.vmap(function)(values)
    # Use equal batches: a remainder would be compiled separately.
    size = next(k for k in range(most, 0, -1) if many % k == 0)
    batches = jax.tree.map(lambda v: v.reshape(many // size, size, *v.shape[1:]), values)
    found = jax.lax.map(jax.vmap(function), batches)
    return jax.tree.map(lambda v: v.reshape(many, *v.shape[2:]), found)


def j_product(x: Increments, at: Linearised) -> PaddedResiduals:
    """Return J x of many increments (leading axis) on one device."""
    image = jax.vmap(lambda own: _push_images(own, at))(x)
    both = lambda own, image: PaddedResiduals(own.others, own.datum, own.names, image)  # noqa: E731
    return jax.vmap(both)(j_product_others(x, at), image)


def _push_images(x: Increments, at: Linearised) -> Float[Array, "batches 2 chunks p"]:
    """Return J x of the image rows by batch: intermediate arrays then fit in the processor's cache."""
    _, scale, values, s = at
    scene, moved = jax.jvp(partial(_scene_at, at), at.increments[:2], x[:2])
    points, steps = at.state.points, x.points * scale.points

    def batch(numbers):
        image, point, xy, sigma = numbers
        seen = seen_in(xy, sigma, image, s)
        place = of_images(scene, image, s), points_at(points, point)
        step = of_images(moved, image, s), points_at(steps, point)
        return jnp.stack(jax.jvp(lambda scene, points: ray_residuals(scene, points, seen, s), place, step)[1])

    return s.each_ray(batch, (values.xy, values.sigma_xy))


def j_product_others(x: Increments, at: Linearised) -> NonImageResiduals:
    """Return J x of all rows except image rows for many increments (leading axis)."""
    _, scale, values, s = at

    def one(own: Increments) -> NonImageResiduals:
        return jax.jvp(lambda y: non_image_residuals(y, scale, values, s), (at.increments,), (own,))[1]

    return _of_many(one, x, len(x.shared), s)


def _scene_at(at: Linearised, eop: Array, shared: Array) -> ImageOrientations:
    increments, scale, values, s = at
    return orientations_of(state_at(increments._replace(eop=eop, shared=shared), scale, values, s), values, s)
