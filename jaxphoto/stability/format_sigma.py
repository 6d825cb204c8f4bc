"""How sure a calibration is of where rays lie in the image, over the format."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.compiling import call_compiled
from jaxphoto.stability.alignment import METHODS, UNKNOWNS, Method, offsets_of
from jaxphoto.stability.bundles import image_rays, parameter_vector, with_parameters
from jaxphoto.stability.comparison import as_arrays, check_rays


def format_sigma(
    interior: InteriorOrientation,
    covariance: Float[np.ndarray, "p p"],
    points: Float[np.ndarray, "points 2"],
    method: Method,
) -> Float[np.ndarray, "points"]:
    """Root mean square error (mm, both axes together) at image points (mm) by the covariance of `parameter_names`.

    `method` is what the orientation of images may take up (`stability.alignment`). Raises InputError where the
    distortion means nothing at some of the points.
    """
    check_rays(interior, points, "the camera")
    found = call_compiled(_derivatives, as_arrays(interior), jnp.asarray(points, float))
    stretch, by_parameters, by_alignment = jax.tree.map(np.asarray, found)
    # Where offsets vanish their least squares are a projection: what the alignment cannot follow is left.
    columns = by_alignment[method].reshape(2 * len(points), -1)
    taken_up = columns @ np.linalg.lstsq(columns, by_parameters, rcond=None)[0]
    left = (by_parameters - taken_up).reshape(len(points), 2, -1)
    rows = np.linalg.solve(stretch, left)[:, :, : len(covariance)]
    return np.sqrt(np.maximum(np.einsum("nip,pq,niq->n", rows, covariance, rows), 0.0))


@eqx.filter_jit
def _derivatives(
    interior: InteriorOrientation, points: Float[Array, "points 2"]
) -> tuple[Float[Array, "points 2 2"], Float[Array, "coordinates p"], dict[Method, Float[Array, "points 2 u"]]]:
    """d(ideal) / d(measured); d(offsets) / d(parameters) of a bundle from its own; those by the alignment's unknowns.

    The same program for every method: each would compile for longer than all run.
    """
    rays, depth = image_rays(interior, points), jnp.ones(len(points))

    def changed(parameters):
        first = image_rays(with_parameters(interior, parameters), points)
        return offsets_of(jnp.zeros(0), first, rays, depth, "zrot").ravel()

    by_alignment = {
        method: jax.jacfwd(lambda a, method=method: offsets_of(a, rays, rays, depth, method))(
            jnp.zeros(UNKNOWNS[method])
        )
        for method in METHODS
    }
    stretch = jax.vmap(jax.jacfwd(interior.ideal_from_measured))(points)
    return stretch, jax.jacfwd(changed)(parameter_vector(interior)), by_alignment
