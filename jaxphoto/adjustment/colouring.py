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
    s = structure
    zero = Increments(jnp.zeros((6, s.n_images)), jnp.zeros(s.n_shared), jnp.zeros((3, s.n_points)))

    def eop(seed):
        return product(zero._replace(eop=jnp.broadcast_to(seed[:, None], (6, s.n_images))))

    def shared(colour):
        return product(zero._replace(shared=jnp.where(s.colour == colour, 1.0, 0.0)))

    def points(seed, point_class):
        chosen = jnp.where(s.point_class == point_class, 1.0, 0.0)
        return product(zero._replace(points=seed[:, None] * chosen))

    by_eop = jax.vmap(eop)(jnp.eye(6))
    by_shared = jax.vmap(shared)(jnp.arange(s.n_colours))
    classes = jnp.repeat(jnp.arange(s.n_classes), 3)
    by_point = jax.vmap(points)(jnp.tile(jnp.eye(3), (s.n_classes, 1)), classes)
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
