"""Covariances of linear functions of the unknowns, such as the mean height of all points."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.right_hand_sides import solve_many
from jaxphoto.arrays import Numbers, is_traced, still
from jaxphoto.short_repr import shown
from jaxphoto.statistics.responses import products_of


@shown
class LinearForms(NamedTuple):
    """Covariances of linear functions of unknowns, with one another and with the shared unknowns."""

    variance: Float[Any, "forms forms"]
    with_shared: Float[Any, "forms shared"]


def linear_forms(
    adjusted: Adjustment,
    n_forms: int,
    *,
    points: Float[Numbers, "forms points 3"] | None = None,
    exterior: Float[Numbers, "forms images 6"] | None = None,
    shared: Float[Numbers, "forms shared"] | None = None,
) -> LinearForms:
    """Covariances (a posteriori) of `n_forms` sums g' x of unknowns with these weights g; without weights, none of it.

    With f = g' x of unknowns x with normal matrix N, cov(f, h) = sigma0^2 g' N^-1 h. Unknowns are the coordinates of
    points (m), of each image its position (m) and small rotations about the axes of its camera (rad), and the shared
    ones in the order of `Structure.labels`, in their own units.
    """
    equations, places = adjusted.equations.on_one_device.weighed, adjusted.padded.places
    scale = jax.tree.map(still, equations.scale)

    def weights(given: Any, at: Any, of: Any) -> Any:
        if given is None:
            return np.zeros((n_forms, *of.shape))
        if is_traced((given, of)):
            return jnp.zeros((n_forms, *of.shape)).at[..., at].set(given) * of
        placed = np.zeros((n_forms, *of.shape))
        placed[..., at] = given
        return placed * of

    b = Increments(
        weights(None if exterior is None else exterior.swapaxes(1, 2), places.image, scale.eop),
        weights(shared, np.arange(0 if shared is None else shared.shape[1]), scale.shared),
        weights(None if points is None else points.swapaxes(1, 2), places.point, scale.points),
    )
    x, factor = solve_many(equations, b, adjusted.seconds), adjusted.sigma0**2
    return LinearForms(factor * products_of(b, x), factor * x.shared * scale.shared)
