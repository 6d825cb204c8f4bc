"""Every Jacobian block of the adjustment from a few products with coloured seeds.

A residual touches one image, one camera, one mount, one strip and one point (a distance: two). Seeding "x of
every image" therefore differentiates all rows at once, exactly: 6 + shared colours + 3 products give the whole
sparse Jacobian by automatic differentiation, and no dense Jacobian is ever made.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.residuals import Increments, Residuals
from jaxphoto.adjustment.structure import Structure


class Jacobian(NamedTuple):
    """Blocks of d(residual)/d(increment), colours first: image rows, station rows, attitude rows, and so on."""

    image_eop: Float[Array, "6 2 rows"]
    image_shared: Float[Array, "colours 2 rows"]
    image_point: Float[Array, "3 2 rows"]
    station_eop: Float[Array, "6 stations"]
    station_shared: Float[Array, "colours stations"]
    attitude_eop: Float[Array, "6 3 attitudes"]
    attitude_shared: Float[Array, "colours 3 attitudes"]
    control: Float[Array, "3 control"]
    distances: Float[Array, "2 3 distances"]
    priors: Float[Array, "weighted"]


def jacobian_blocks(product: Callable[[Increments], Residuals], structure: Structure) -> Jacobian:
    """All blocks of the linear map `product`, which takes increments to residuals."""
    s, q = structure, structure.n_colours
    n = 6 + q + 3 * s.n_classes
    colour, own = jnp.arange(n), jnp.arange(6 + q, n) - 6 - q
    # Seeds, colours first: one component of every image, one shared colour, one component of a class of points.
    eop = jnp.broadcast_to((colour[:, None] == jnp.arange(6))[:, :, None], (n, 6, s.n_images))
    shared = colour[:, None] == 6 + s.colour
    points = (own[:, None, None] // 3 == s.point_class) & (own[:, None] % 3 == jnp.arange(3))[:, :, None]
    points = jnp.concatenate([jnp.zeros((6 + q, *points.shape[1:]), bool), points])
    by_colour = jax.vmap(product)(Increments(*(v.astype(float) for v in (eop, shared, points))))
    by_eop, by_shared, by_point = (
        jax.tree.map(lambda v, i=i, j=j: v[i:j], by_colour) for i, j in ((0, 6), (6, 6 + q), (6 + q, n))
    )
    by_point = jax.tree.map(lambda v: v.reshape(s.n_classes, 3, *v.shape[1:]), by_point)
    each = jnp.arange(len(s.distance_points))
    ends = s.point_class[s.distance_points]
    weighted = s.colour[s.weighted]
    return Jacobian(
        image_eop=by_eop.image,
        image_shared=by_shared.image[: s.n_image_colours],
        image_point=by_point.image.sum(0),
        station_eop=by_eop.stations,
        station_shared=by_shared.stations,
        attitude_eop=by_eop.attitudes,
        attitude_shared=by_shared.attitudes,
        control=by_point.control.sum(0),
        distances=jnp.stack([by_point.distances[ends[:, k], :, each].T for k in range(2)]),
        priors=by_shared.priors[weighted, jnp.arange(len(s.weighted))],
    )
