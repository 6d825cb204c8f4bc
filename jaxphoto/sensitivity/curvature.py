"""Second derivatives of half the weighted square sum, of all but image rows: with the residuals' curvature, or without.

Each function takes `curved`: 1 for J'J + sum_r r d2r, 0 for J'J alone (see `hessian`). They are exact, by automatic
differentiation, and kept by what each row touches: no dense second derivative of a residual is ever made.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment.normal import At, residuals_at
from jaxphoto.adjustment.reduced import other_rows
from jaxphoto.adjustment.residuals import Increments, Values, other_residuals
from jaxphoto.arrays import Numbers


def mixed_second(at: At, direction: Values, curved: Float[Numbers, ""]) -> Increments:
    """B dv over all rows, for a direction of change of the numbers; leaves that are None do not change."""

    def gradient(moved):
        values = eqx.combine(moved, at.values)
        residuals, pull = jax.vjp(lambda y: residuals_at(At(y, at.scale, values, at.structure)), at.increments)
        counted = jax.tree.map(lambda r: r - (1 - curved) * jax.lax.stop_gradient(r), residuals)
        return pull(counted)[0]

    there = jax.tree.map(lambda d: d is not None, direction, is_leaf=lambda d: d is None)
    return jax.jvp(gradient, (eqx.filter(at.values, there),), (direction,))[1]


def attitude_second(at: At, curved: Float[Numbers, ""]) -> tuple[Float[Array, "3 6 n"], Float[Array, "3 colours n"]]:
    """B of each attitude by its observed roll, pitch, yaw (rad): in eop, and in colours."""

    def of(observed):
        rest = other_rows(at._replace(values=eqx.tree_at(lambda v: v.attitudes, at.values, observed)))
        return (rest.blocks.attitude_eop, rest.blocks.attitude_shared), rest.residuals.attitudes

    def by(seed):
        primals, ((eop, shared), dr) = jax.jvp(of, (at.values.attitudes,), (seed,))
        (j_eop, j_shared), r = primals
        return jnp.sum(j_eop * dr + curved * eop * r, axis=1), jnp.sum(j_shared * dr + curved * shared * r, axis=1)

    return jax.vmap(by)(jnp.broadcast_to(jnp.eye(3)[:, :, None], (3, *at.values.attitudes.shape)))


def coupling_rows(at: At, curved: Float[Numbers, ""]) -> tuple[Array, Array, Array]:
    """D, by the reduced unknowns (k, n) and by the points (k, 3, points), and its weight C."""
    values, scale, s = at.values, at.scale, at.structure
    ends = s.distance_points
    count, fixed = len(ends), values.datum_eop.shape[0]

    def second(apart, observed, sigma):
        return jax.hessian(lambda d: _half_square((observed - jnp.sqrt(jnp.sum(d**2))) / sigma, curved))(apart)

    weight = jnp.eye(3 * count + fixed)
    spans = jnp.zeros((count, 3, 3, s.n_points))
    if count:
        apart = values.points[:, ends[:, 0]] - values.points[:, ends[:, 1]]
        blocks = jax.vmap(second)(apart.T, values.distances, values.sigma_distances)
        weight = weight.at[: 3 * count, : 3 * count].set(jax.scipy.linalg.block_diag(*blocks))
        each, axis = np.arange(count)[:, None], np.arange(3)
        for end, sign in ((0, 1.0), (1, -1.0)):
            at_end = ends[:, end, None]
            spans = spans.at[each, axis, axis, at_end].set(sign * scale.points[axis, at_end])
    d_p = jnp.concatenate([spans.reshape(-1, 3, s.n_points), values.datum_points * scale.points])
    datum = (values.datum_eop * scale.eop).transpose(0, 2, 1).reshape(fixed, 6 * s.n_images)
    d_e = jnp.zeros((3 * count + fixed, 6 * s.n_images + s.n_shared)).at[3 * count :, : 6 * s.n_images].set(datum)
    return d_e, d_p, weight


def other_second(at: At, curved: Float[Numbers, ""]) -> Float[Array, "n n"]:
    """H of stations, attitudes and priors in the reduced unknowns: an image touches itself and any shared unknown."""
    zero, s = at.increments, at.structure
    n, each = 6 * s.n_images, jnp.arange(s.n_images)

    def half_square(eop, shared):
        r = other_residuals(Increments(eop, shared, zero.points), at.scale, at.values, s)
        return sum((_half_square(v, curved) for v in (r.stations, r.attitudes, r.priors)), jnp.zeros(()))

    def product(eop, shared):
        return jax.jvp(jax.grad(half_square, (0, 1)), (zero.eop, zero.shared), (eop, shared))[1]

    seeds = jnp.broadcast_to(jnp.eye(6)[:, :, None], (6, 6, s.n_images))
    by_eop = jax.vmap(lambda seed: product(seed, zero.shared)[0])(seeds)
    h = jnp.zeros((s.n_images, 6, s.n_images, 6)).at[each, :, each].set(by_eop.transpose(2, 0, 1)).reshape(n, n)
    across, own = jax.vmap(lambda seed: product(zero.eop, seed))(jnp.eye(s.n_shared))
    across = across.transpose(0, 2, 1).reshape(s.n_shared, n)
    return jnp.concatenate([jnp.concatenate([h, across.T], 1), jnp.concatenate([across, own], 1)])


def _half_square(r: Array, curved: Float[Numbers, ""]) -> Float[Array, ""]:
    """Half the square sum, with the second derivative J'J + curved r d2r."""
    return jnp.sum(0.5 * r * r - (1 - curved) * jax.lax.stop_gradient(r) * r)
