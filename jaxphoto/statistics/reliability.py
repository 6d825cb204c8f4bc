"""Redundancy numbers and normalised residuals: how well each observation is checked by the others.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.local import blocks_at
from jaxphoto.adjustment.normal import solve_factored
from jaxphoto.adjustment.optimum import zero_increments
from jaxphoto.adjustment.padding import crop_residuals
from jaxphoto.adjustment.residuals import Residuals, Values
from jaxphoto.adjustment.result import Factored
from jaxphoto.adjustment.structure import Structure
from jaxphoto.compiling import run_compiled
from jaxphoto.statistics.covariance import Cofactors, Covariance

LEAST_CHECKED = 0.01
"""Redundancy number below which a normalised residual is mostly rounding and judges nothing."""
# Below this redundancy number an observation is not checked at all: no normalised residual is given.
_UNCHECKED = 1e-6


def redundancy_numbers(adjusted: Adjustment, covariance: Covariance) -> Residuals:
    """Redundancy number of every observation, shaped like `adjusted.residuals` (zero for the datum's constraints)."""
    padded = adjusted.computed
    arguments = (padded.values, covariance.cofactors, padded.factored, padded.structure)
    numbers = run_compiled(_redundancy, arguments, adjusted.seconds, "covariance")
    return crop_residuals(numbers, adjusted.structure)


def normalised_residuals(adjusted: Adjustment, redundancy: Residuals) -> Residuals:
    """w = v / (sigma0 sigma sqrt(r)) of every observation; NaN where nothing checks it."""

    sigma0 = float(adjusted.sigma0)

    def w(v, r):
        v, r = np.asarray(v), np.asarray(r)
        checked = r > _UNCHECKED
        return np.where(checked, v / (sigma0 * np.sqrt(np.where(checked, r, 1.0))), np.nan)

    return jax.tree.map(w, adjusted.residuals, redundancy)


@eqx.filter_jit
def _redundancy(values: Values, q: Cofactors, factored: Factored, s: Structure) -> Residuals:
    scale = factored.scale
    j = blocks_at(zero_increments(s), scale, values, s)[0]
    n = 6 * s.n_images
    # A last row and column of zeros serves colours that mean nothing in an image.
    shared = jnp.pad(q.reduced[n:, n:], (0, 1))
    eop = q.reduced[:n, :n].reshape(s.n_images, 6, s.n_images, 6)
    each = jnp.arange(s.n_images)
    own = eop[each, :, each, :]
    across = jnp.pad(q.reduced[:n, n:].reshape(s.n_images, 6, -1), ((0, 0), (0, 0), (0, 1)))
    in_image = across[each[:, None], :, s.column].transpose(0, 2, 1)
    by_colour = shared[s.column[:, :, None], s.column[:, None, :]]

    def image_part(a, c, image):
        """Of rows (.., n) that touch an image (a) and its shared unknowns (c): diag(J Q J')."""
        m = len(c)
        seen = jnp.einsum("aon,nab,bon->on", a, own[image], a) + 2 * jnp.einsum(
            "aon,naq,qon->on", a, in_image[image][:, :, :m], c
        )
        return seen + jnp.einsum("qon,nqr,ron->on", c, by_colour[image][:, :m, :m], c)

    a, b, c = j.image_eop, j.image_point, j.image_shared
    point_shared = jnp.pad(q.point_shared, ((0, 0), (0, 0), (0, 1)))
    columns = s.column[s.image][:, : len(c)]
    with_point = point_shared[s.point[:, None], :, columns]
    image = image_part(a, c, s.image)
    image += jnp.einsum("bon,nbd,don->on", b, q.points[s.point], b)
    image += 2 * jnp.einsum("bon,nba,aon->on", b, q.point_eop, a) + 2 * jnp.einsum("bon,nqb,qon->on", b, with_point, c)
    control = jnp.einsum("bn,nbd,dn->n", j.control, q.points[s.control_point], j.control)
    priors = j.priors**2 * jnp.diagonal(shared)[s.weighted]
    stations = image_part(j.station_eop[:, None], j.station_shared[:, None], s.station_image)[0]
    return Residuals(
        image=1 - image,
        stations=1 - stations,
        attitudes=1 - image_part(j.attitude_eop, j.attitude_shared, s.attitude_image),
        control=1 - control,
        distances=1 - _distances(j.distances, factored, s),
        priors=1 - priors,
        datum=jnp.zeros(values.datum_eop.shape[0]),
    )


def _distances(ends: jax.Array, factored: Factored, s: Structure) -> jax.Array:
    """diag(J Q J') of the distances, by one solve each: they join two points that never met otherwise."""

    def one(k):
        points = jnp.zeros((3, s.n_points))
        for end in range(2):
            points = points.at[:, s.distance_points[k, end]].add(ends[end, :, k])
        b = zero_increments(s)._replace(points=points)
        x = solve_factored(factored.normal, factored.reduced, factored.lower, b, s)
        return jnp.sum(points * x.points)

    if not len(s.distance_points):
        return jnp.zeros(0)
    return jax.lax.map(one, jnp.arange(len(s.distance_points)))
