"""Covariances of linear functions of the unknowns, such as the mean height of all points."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.right_hand_sides import solve_many
from jaxphoto.arrays import still
from jaxphoto.short_repr import shown
from jaxphoto.statistics.responses import products_of


@shown
class LinearForms(NamedTuple):
    """Covariances of linear functions of unknowns, with one another and with the shared unknowns."""

    variance: Float[np.ndarray, "forms forms"]
    with_shared: Float[np.ndarray, "forms shared"]


def linear_forms(
    adjusted: Adjustment,
    n_forms: int,
    *,
    points: Float[np.ndarray, "forms points 3"] | None = None,
    exterior: Float[np.ndarray, "forms images 6"] | None = None,
    shared: Float[np.ndarray, "forms shared"] | None = None,
) -> LinearForms:
    """Covariances (a posteriori) of `n_forms` sums g' x of unknowns with these weights g; without weights, none of it.

    With f = g' x of unknowns x with normal matrix N, cov(f, h) = sigma0^2 g' N^-1 h. Unknowns are the coordinates of
    points (m), of each image its position (m) and small rotations about the axes of its camera (rad), and the shared
    ones in the order of `Structure.labels`, in their own units.
    """
    equations, places = adjusted.equations.on_one_device.weighed, adjusted.tiled.places
    scale = jax.tree.map(still, equations.scale)
    b = jax.tree.map(lambda v: np.zeros((n_forms, *v.shape)), scale)
    if points is not None:
        b.points[:, :, places.point] = np.moveaxis(points, 1, 2)
    if exterior is not None:
        b.eop[:, :, places.image] = np.moveaxis(exterior, 1, 2)
    if shared is not None:
        b.shared[:, : shared.shape[1]] = shared
    for v, own in zip(b, scale, strict=True):
        v *= own
    x, factor = solve_many(equations, b, adjusted.seconds), float(adjusted.sigma0) ** 2
    return LinearForms(factor * products_of(b, x), factor * np.asarray(x.shared) * scale.shared)
