"""Redundancy numbers and normalised residuals: how well each observation is checked by the others.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.elimination import solve_factored
from jaxphoto.adjustment.normal import At
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.padding import crop_residuals
from jaxphoto.adjustment.reduced import other_rows
from jaxphoto.adjustment.residuals import Residuals, Values
from jaxphoto.adjustment.result import Factored, Padded
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.statistics.covariance import Cofactors, Covariance, RowCofactors, prepare_covariance, row_cofactors

LEAST_CHECKED = 0.01
"""Redundancy number below which a normalised residual is mostly rounding and judges nothing."""
# Below this redundancy number an observation is not checked at all: no normalised residual is given.
_UNCHECKED = 1e-6


def prepare_statistics(padded: Padded, seconds: dict[str, float]) -> None:
    """Have what `covariance` and `redundancy_numbers` need compiled in the background; see `solve`."""
    if jax.process_count() > 1:
        # What comes from several processes is of types of its own.
        return
    prepare_covariance(padded, seconds)
    s, n = padded.structure, 6 * padded.structure.n_images + padded.structure.n_shared
    v = padded.values
    shapes = (n, n), (s.n_points, 3, 3), v.xy.shape, v.sigma_surfaces.shape
    *cofactors, image, surfaces = (np.broadcast_to(0.0, shape) for shape in shapes)
    rows = RowCofactors(image, surfaces)  # type: ignore[arg-type]
    prepare(_redundancy, (v, Cofactors._make(cofactors), rows, padded.factored, s), seconds)


def redundancy_numbers(adjusted: Adjustment, covariance: Covariance) -> Residuals:
    """Redundancy number of every observation, shaped like `adjusted.residuals` (zero for the datum's constraints)."""
    padded = adjusted.computed
    rows = row_cofactors(adjusted, covariance.rotations)
    arguments = (padded.values, covariance.cofactors, rows, padded.factored, padded.structure)
    numbers = run_compiled(_redundancy, arguments, adjusted.seconds, "covariance")
    return crop_residuals(numbers, adjusted.structure, padded.places)


def normalised_residuals(adjusted: Adjustment, redundancy: Residuals) -> Residuals:
    """w = v / (sigma0 sigma sqrt(r)) of every observation; NaN where nothing checks it."""

    sigma0 = float(adjusted.sigma0)

    def w(v, r):
        v, r = np.asarray(v), np.asarray(r)
        checked = r > _UNCHECKED
        return np.where(checked, v / (sigma0 * np.sqrt(np.where(checked, r, 1.0))), np.nan)

    return jax.tree.map(w, adjusted.residuals, redundancy)


@eqx.filter_jit
def _redundancy(values: Values, q: Cofactors, of_rows: RowCofactors, factored: Factored, s: Structure) -> Residuals:
    scale, s = factored.scale, on_one_device(s)
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, weigh_datum(values, s), s)
    rest = other_rows(at)
    j, n = rest.blocks, 6 * s.n_images
    # A last row and column of zeros serves colours that mean nothing in an image.
    shared = jnp.pad(q.reduced[n:, n:], (0, 1))
    eop = q.reduced[:n, :n].reshape(s.n_images, 6, s.n_images, 6)
    across = jnp.pad(q.reduced[:n, n:].reshape(s.n_images, 6, -1), ((0, 0), (0, 0), (0, 1)))

    def image_part(a, c, image):
        """Of rows (.., n) that touch an image (a) and its shared unknowns (c): diag(J Q J')."""
        column = jnp.asarray(s.column)[image]
        seen = jnp.einsum("aon,nab,bon->on", a, eop[image, :, image, :], a)
        with_shared = across[image[:, None], :, column].transpose(0, 2, 1)
        seen += 2 * jnp.einsum("aon,naq,qon->on", a, with_shared, c)
        by_colour = shared[column[:, :, None], column[:, None, :]]
        return seen + jnp.einsum("qon,nqr,ron->on", c, by_colour, c)

    own_points = jnp.diagonal(q.points, axis1=1, axis2=2).T
    stations = image_part(j.station_eop[:, None], j.station_shared[:, None], jnp.asarray(s.station_image))[0]
    return Residuals(
        image=1 - of_rows.image,
        stations=1 - stations,
        attitudes=1 - image_part(j.attitude_eop, j.attitude_shared, jnp.asarray(s.attitude_image)),
        control=1 - rest.control**2 * own_points,
        surfaces=1 - of_rows.surfaces,
        distances=1 - _distances(j.distances, at, factored),
        priors=1 - j.priors**2 * jnp.diagonal(shared)[s.weighted],
        datum=jnp.zeros(values.datum_eop.shape[0]),
    )


def _distances(ends: jax.Array, at: At, factored: Factored) -> jax.Array:
    """diag(J Q J') of the distances, by one solve each: they join two points that never met otherwise."""
    s, zero = at.structure, at.increments

    def one(k):
        points = jnp.zeros_like(zero.points)
        for end in range(2):
            points = points.at[:, s.distance_points[k, end]].add(ends[end, :, k])
        x = solve_factored(factored.reduced, factored.factor, zero._replace(points=points), at)
        return jnp.sum(points * x.points)

    if not len(s.distance_points):
        return jnp.zeros(0)
    return jax.lax.map(one, jnp.arange(len(s.distance_points)))
