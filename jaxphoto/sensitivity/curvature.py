"""Second derivatives of half the weighted square sum, of all but image rows: with the residuals' curvature, or without.

Each function takes `curved`: 1 for J'J + sum_r r d2r, 0 for J'J alone (see `hessian`). They are exact, by automatic
differentiation, and kept by what each row touches: no dense second derivative of a residual is ever made.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxphoto.adjustment import Linearised, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.row_functions import (
    RowInputs,
    Touched,
    each_row,
    gathered_rows,
    reduced_places,
    row_function,
)
from jaxphoto.arrays import Numbers


class RowSecond(NamedTuple):
    """Second derivatives of half the square of each row of a group, rows last, by what the row touches: the increments
    of its images, its shared unknowns and the increments of its points, in this order (z)."""

    h: Float[Array, "z z rows"]
    b: Float[Array, "z o rows"]
    """By z and by the numbers observed."""


def mixed_second(at: Linearised, direction: PaddedValues, curved: Float[Numbers, ""]) -> Increments:
    """B dv over all rows, for a direction of change of the numbers; leaves that are None do not change."""

    def gradient(moved):
        values = eqx.combine(moved, at.values)
        residuals, pull = jax.vjp(lambda y: Linearised(y, at.scale, values, at.structure).residuals(), at.increments)
        counted = jax.tree.map(lambda r: r - (1 - curved) * jax.lax.stop_gradient(r), residuals)
        return pull(counted)[0]

    there = jax.tree.map(lambda d: d is not None, direction, is_leaf=lambda d: d is None)
    return jax.jvp(gradient, (eqx.filter(at.values, there),), (direction,))[1]


def row_second(group: ObservedGroup, numbers: Any, at: Linearised, curved: Float[Numbers, ""]) -> RowSecond:
    """H and B of all rows of a group, each by itself."""
    function = row_function(group, at.structure)

    def one(z: Touched, given: RowInputs) -> RowSecond:
        flat, unravel = ravel_pytree(z)
        observed = given.row.observation

        def half_square(flat: Array, observed: Array) -> Float[Array, ""]:
            r = function(unravel(flat), given._replace(row=given.row.with_observation(observed)))
            # Its second derivative is J'J + curved r d2r.
            return jnp.sum(0.5 * r * r - (1 - curved) * jax.lax.stop_gradient(r) * r)

        slope = jax.grad(half_square)
        h, b = jax.jacfwd(slope, (0, 1))(flat, observed)
        return RowSecond(h, b.reshape(len(flat), -1))

    given = gathered_rows(group, numbers, at.increments, at.scale, at.values)
    return each_row(one, group, *given)


def rows_second(at: Linearised, curved: Float[Numbers, ""]) -> tuple[RowSecond, ...]:
    """`row_second` of all groups."""
    s = at.structure
    return tuple(row_second(g, numbers, at, curved) for g, numbers in zip(s.observed, at.values.groups, strict=True))


class AtPointsSecond(NamedTuple):
    """Sums over the rows that lie at points (see `NonImageRows`)."""

    v: Float[Array, "3 3 points"]
    w: Float[Array, "b 3 points"]
    """By what else the groups of points meet, `RayLists.met`."""


def points_second(second: tuple[RowSecond, ...], at: Linearised) -> AtPointsSecond:
    """H of rows at points, by these, and by these and shared unknowns."""
    s, n = at.structure, at.increments.points.shape[1]
    v, w = jnp.zeros((3, 3, n)), jnp.zeros((s.rays.met.shape[1], n, 3))
    for g, own in zip(s.observed, second, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            k = len(g.place)
            v = v + jnp.sum(own.h[k:, k:], axis=2)
            w = w.at[jnp.asarray(g.slot), jnp.arange(n)].add(jnp.moveaxis(own.h[:k, k:], 1, -1), mode="drop")
    return AtPointsSecond(v, jnp.moveaxis(w, 2, 1))


def coupling_rows(second: tuple[RowSecond, ...], at: Linearised) -> tuple[Array, Array, Array]:
    """D, by the reduced unknowns (k, n) and by the points (k, 3, points), and its weight C.

    Of a row that couples points, D is what it touches, one after the other, and C its H.
    """
    values, scale, s = at.values, at.scale, at.structure
    n, n_points, fixed = 6 * s.n_images + s.n_shared, scale.points.shape[1], values.datum_eop.shape[0]
    d_e: list[Array] = []
    d_p: list[Array] = []
    blocks: list[Array] = []
    for g, own in zip(s.observed, second, strict=True):
        if g.elimination == "coupled":
            places = reduced_places(g, s.n_images).T
            reduced, z = places.shape[1], len(own.h)
            each = jnp.arange(g.n_rows)[:, None]
            e = jnp.zeros((g.n_rows, z, n)).at[each, jnp.arange(reduced), places].set(1.0, mode="drop")
            p = jnp.zeros((g.n_rows, z, 3, n_points))
            for k, point in enumerate(g.point):
                axis = jnp.arange(3)
                p = p.at[each, reduced + 3 * k + axis, axis, jnp.asarray(point)[:, None]].set(1.0)
            d_e, d_p = [*d_e, e.reshape(-1, n)], [*d_p, p.reshape(-1, 3, n_points)]
            blocks += list(jnp.moveaxis(own.h, 2, 0))
    datum = at.constraints()
    d_e.append(jnp.concatenate([datum.eop.transpose(0, 2, 1).reshape(fixed, 6 * s.n_images), datum.shared], axis=1))
    d_p.append(datum.points)
    return jnp.concatenate(d_e), jnp.concatenate(d_p), _block_diagonal([*blocks, jnp.eye(fixed)])


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(b) for b in blocks)
    result, first = jnp.zeros((size, size)), 0
    for b in blocks:
        result = result.at[first : first + len(b), first : first + len(b)].set(b)
        first += len(b)
    return result


def other_second(second: tuple[RowSecond, ...], s: PaddedStructure) -> Float[Array, "n n"]:
    """H of all rows but image rows in the reduced unknowns, without those that couple points."""
    n = 6 * s.n_images + s.n_shared
    h = jnp.zeros((n, n))
    for g, own in zip(s.observed, second, strict=True):
        if isinstance(g.rows, RowsAtPoints):
            k, rows = len(g.place), math.prod(own.h.shape[2:])
            place = 6 * s.n_images + jnp.asarray(g.column).reshape(k, rows)
            of_rows = own.h[:k, :k].reshape(k, k, rows)
        elif g.elimination == "reduced":
            place, of_rows = reduced_places(g, s.n_images), own.h
        else:
            continue
        # What means no unknown lies behind the last.
        h = h.at[place.T[:, :, None], place.T[:, None]].add(jnp.moveaxis(of_rows, 2, 0), mode="drop")
    return h
