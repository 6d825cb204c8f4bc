"""Jacobian blocks of everything but image rows and control, from a few products with coloured seeds.

A residual touches one image, one camera, one mount and one strip (a distance: two points). Seeding "X of every image"
therefore differentiates all rows at once, exactly, by automatic differentiation, and no dense Jacobian is ever made.
Image rows are differentiated in their tiles (`tiles`), control coordinate by coordinate.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.residuals import Increments, Residuals
from jaxphoto.adjustment.structure import Structure


class Jacobian(NamedTuple):
    """Blocks of d(residual)/d(increment), colours first: station rows, attitude rows, and so on."""

    station_eop: Float[Array, "6 stations"]
    station_shared: Float[Array, "colours stations"]
    attitude_eop: Float[Array, "6 3 attitudes"]
    attitude_shared: Float[Array, "colours 3 attitudes"]
    distances: Float[Array, "2 3 distances"]
    priors: Float[Array, "weighted"]


def jacobian_blocks(product: Callable[[Increments], Residuals], zero: Increments, structure: Structure) -> Jacobian:
    """All blocks of the linear map `product`, which takes increments (shaped like `zero`) to residuals."""
    s, q = structure, structure.n_colours
    colour = jnp.arange(6 + q)
    # Seeds, colours first: one component of every image, or one shared colour.
    eop = jnp.broadcast_to((colour[:, None] == jnp.arange(6))[:, :, None], (6 + q, *zero.eop.shape))
    shared = colour[:, None] == 6 + s.colour
    by_colour = jax.vmap(lambda e, h: product(Increments(e, h, zero.points)))(eop.astype(float), shared.astype(float))
    by_eop, by_shared = (jax.tree.map(lambda v, i=i, j=j: v[i:j], by_colour) for i, j in ((0, 6), (6, 6 + q)))
    return Jacobian(
        station_eop=by_eop.stations,
        station_shared=by_shared.stations,
        attitude_eop=by_eop.attitudes,
        attitude_shared=by_shared.attitudes,
        distances=_distances(product, zero, s),
        priors=by_shared.priors[s.colour[s.weighted], jnp.arange(len(s.weighted))],
    )


def _distances(product: Callable[[Increments], Residuals], zero: Increments, s: Structure) -> Float[Array, "2 3 n"]:
    """One component of one class of points a seed: the ends of a distance lie in different classes."""
    if not len(s.distance_points):
        return jnp.zeros((2, 3, 0))
    colour = jnp.arange(3 * s.n_classes)
    seeds = (colour[:, None, None] // 3 == s.point_class) & (colour[:, None] % 3 == jnp.arange(3))[:, :, None]
    by_colour = jax.vmap(lambda p: product(zero._replace(points=p)).distances)(seeds.astype(float))
    by_class = by_colour.reshape(s.n_classes, 3, -1)
    ends, each = jnp.asarray(s.point_class)[s.distance_points], jnp.arange(len(s.distance_points))
    return jnp.stack([by_class[ends[:, k], :, each].T for k in range(2)])
