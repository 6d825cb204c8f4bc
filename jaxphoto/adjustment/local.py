"""Jacobian blocks at given increments: image rows one by one, everything else by coloured products.

An image row touches 12 numbers of its image, 3 of its point and the parameters of its camera. They are gathered once,
and each column of the row's Jacobian is one forward derivative of `image_residual` with respect to them: no tangent is
ever gathered, and a derivative that cannot be other than zero is never computed.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.colouring import Jacobian, jacobian_blocks
from jaxphoto.adjustment.residuals import Increments, Residuals, State, Values, other_residuals, state_at
from jaxphoto.adjustment.structure import CameraGroup, Structure, interior_of
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.georeferencing import apparent_point
from jaxphoto.rotation import small_rotation

Columns = tuple[Array, Array, Array, Array]
"""Residuals (2, rows) of image rows and their derivatives: eop (6, 2, rows), shared (colours, 2, rows), point."""


def blocks_at(y: Increments, scale: Increments, values: Values, structure: Structure) -> tuple[Jacobian, Residuals]:
    """All blocks of d(residual)/d(increment) at `y`, and the residuals there."""
    others, product = jax.linearize(lambda y: other_residuals(y, scale, values, structure), y)
    image, eop, shared, point = _image_blocks(y, scale, values, structure)
    blocks = jacobian_blocks(product, structure)
    return blocks._replace(image_eop=eop, image_shared=shared, image_point=point), others._replace(image=image)


def _image_blocks(y: Increments, scale: Increments, values: Values, s: Structure) -> Columns:
    state, n = state_at(y, scale, values, s), s.n_images

    def slopes(angles, k, start):
        return jax.jacfwd(lambda d: small_rotation((angles + d) * k) @ start)(jnp.zeros(3))

    turn = jax.vmap(slopes, in_axes=-1, out_axes=-1)(y.eop[3:], scale.eop[3:], values.rotation)
    table = jnp.concatenate([state.position, state.rotation.reshape(9, n), scale.eop[:3], turn.reshape(27, n)])
    points = jnp.concatenate([state.points, scale.points])
    parts = [_group_blocks(g, table, points, state, scale, values, s) for g in s.groups]
    if len(parts) == 1:
        return parts[0]
    return jax.tree.map(lambda *v: jnp.concatenate(v, axis=-1)[..., s.unsort], *parts)


def _group_blocks(
    g: CameraGroup,
    table: Float[Array, "42 images"],
    points: Float[Array, "6 points"],
    state: State,
    scale: Increments,
    values: Values,
    s: Structure,
) -> Columns:
    """Of the rows of one group of cameras.

    `table` holds, by image, position, rotation, scale of the position, derivatives of the rotation; `points` place and
    scale.
    """
    pick = (lambda a: a) if g.rows is None else (lambda a: a[..., g.rows])
    # What a row touches, gathered before the arithmetic: fused into it, every column would gather anew.
    img, pt = jax.lax.optimization_barrier((_take(table, pick(s.image)), _take(points, pick(s.point))))
    xy, sigma = pick(values.xy), pick(values.sigma_xy)
    m = g.treedef.num_leaves
    single = len(g.names) == 1
    own_parameters = slice(g.offset, g.offset + m * len(g.names))
    leaves = state.shared[own_parameters].reshape(-1, m)
    parameters = tuple(leaves[0]) if single else tuple(_take(leaves.T, g.camera))

    def one(parameters, position, rotation, point, xy, sigma):
        centre = jnp.stack(position)
        exterior = ExteriorOrientation(centre, jnp.stack(rotation).reshape(3, 3))
        aim = apparent_point(centre, jnp.stack(point), s.corrections)
        return image_residual(interior_of(g, list(parameters)), exterior, aim, xy) / sigma

    # jit keeps the trace: every column below uses it again.
    rows = jax.jit(jax.vmap(one, in_axes=(None if single else -1, -1, -1, -1, -1, -1), out_axes=-1))
    centre, rotation, at = tuple(img[:3]), tuple(img[3:12]), tuple(pt[:3])

    def put(v: tuple, k: int, x: Any) -> tuple:
        return (*v[:k], x, *v[k + 1 :])

    def slope(f, x, direction):
        return jax.jvp(f, (x,), (direction,))[1]

    residual = rows(parameters, centre, rotation, at, xy, sigma)
    eop = [
        slope(lambda x, k=k: rows(parameters, put(centre, k, x), rotation, at, xy, sigma), centre[k], img[12 + k])
        for k in range(3)
    ]
    eop += [
        slope(lambda x: rows(parameters, centre, x, at, xy, sigma), rotation, tuple(img[15 + k :: 3])) for k in range(3)
    ]
    point = [
        slope(lambda x, k=k: rows(parameters, centre, rotation, put(at, k, x), xy, sigma), at[k], pt[3 + k])
        for k in range(3)
    ]
    # One column a parameter that is free in any camera of the group: scaled, and zero where it is fixed.
    factor = jnp.zeros(state.shared.shape).at[s.free].set(scale.shared)[own_parameters].reshape(-1, m)
    own = [
        slope(
            lambda x, k=k: rows(put(parameters, k, x), centre, rotation, at, xy, sigma),
            parameters[k],
            factor[0, k] if single else _take(factor[:, k], g.camera),
        )
        for k in g.free_leaves
    ]
    residual, eop, own, point = jax.lax.optimization_barrier((residual, eop, own, point))
    return residual, jnp.stack(eop), _by_colour(g, own, state, s, residual.shape), jnp.stack(point)


def _by_colour(g: CameraGroup, own: list[Array], state: State, s: Structure, shape: tuple[int, ...]) -> Array:
    """Columns of the group's free parameters, (colours, 2, rows)."""
    shared = jnp.zeros((s.n_image_colours, *shape))
    if not own:
        return shared
    if len(g.names) == 1:
        # The parameters of one camera have the colours 0, 1, ... in their own order.
        return shared.at[: len(own)].set(jnp.stack(own))
    m = g.treedef.num_leaves
    colours = jnp.full(state.shared.shape, -1).at[s.free].set(s.colour)
    colours = colours[g.offset : g.offset + m * len(g.names)].reshape(-1, m)[:, list(g.free_leaves)]
    hot = (colours[:, :, None] == jnp.arange(s.n_image_colours)).astype(float)[g.camera]
    return jnp.einsum("jon,njc->con", jnp.stack(own), hot)


def _take(a: Array, index: Any) -> Array:
    return a.at[..., index].get(mode="promise_in_bounds")
