"""The image of a circle's centre is not the centre of the circle's image.

A circle is seen as an ellipse (bent by the lens), and what is measured is the centroid of its area. Both centres are
computed from the adjusted orientation, the plane and the radius of the circle. With the boundary b(t), 0 <= t < 2 pi,
projected through the whole camera, Green's theorem gives area and centroid,

    A = 1/2 int (b x b') dt,    centroid = 1/(3 A) int b (b x b') dt,

and on a smooth closed curve the trapezoidal rule converges exponentially: 32 points give every digit. Without
distortion it is the centre of the ellipse exactly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.orientation.rays import padded_length

_POINTS = 32


def eccentricity(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    centre: Float[Array, "3"],
    axes: Float[Array, "3 2"],
    radius_m: Float[Array, ""],
) -> Float[Array, "2"]:
    """Centroid of a circle's image minus the image of its centre, in mm of the measured image.

    `centre` (m) and two orthogonal unit vectors in its plane, `axes`, in the object frame. Source: the centre of the
    ellipse is in any book of projective geometry; the centroid through a distorting lens follows from Green's theorem.
    """

    def boundary(t):
        point = centre + radius_m * (axes[:, 0] * jnp.cos(t) + axes[:, 1] * jnp.sin(t))
        return project(interior, exterior, point)

    about = project(interior, exterior, centre)
    t = jnp.arange(_POINTS) * (2 * jnp.pi / _POINTS)
    b, slope = jax.vmap(lambda t: jax.jvp(boundary, (t,), (1.0,)))(t)
    # About the centre's image, so that the small difference keeps its digits.
    b = b - about
    cross = b[:, 0] * slope[:, 1] - b[:, 1] * slope[:, 0]
    return 2 / 3 * jnp.sum(b * cross[:, None], axis=0) / jnp.sum(cross)


def eccentricities(
    interior: InteriorOrientation,
    position: Float[np.ndarray, "rows 3"],
    camera_from_object: Float[np.ndarray, "rows 3 3"],
    centre: Float[np.ndarray, "rows 3"],
    axes: Float[np.ndarray, "3 2"],
    radius_m: Float[np.ndarray, "rows"],
) -> Float[np.ndarray, "rows 2"]:
    """`eccentricity` (mm) of one circle in one image a row, all in planes parallel to `axes`; 0 where the radius is."""
    n = len(centre)
    some = np.arange(padded_length(n)) % n
    # A point has no area: any radius does, and the result is not used.
    radius = np.where(radius_m > 0, radius_m, max(float(np.max(radius_m)), 1e-12))
    numbers = jax.tree.map(lambda v: np.asarray(v, float), interior)
    arguments = (numbers, position[some], camera_from_object[some], centre[some], axes, radius[some])
    found = np.asarray(call_compiled(_eccentricities, *arguments))[:n]
    return np.where(radius_m[:, None] > 0, found, 0.0)


@eqx.filter_jit
def _eccentricities(interior, position, camera_from_object, centre, axes, radius):
    one = lambda x, m, p, r: eccentricity(interior, ExteriorOrientation(x, m), p, axes, r)  # noqa: E731
    return jax.vmap(one)(position, camera_from_object, centre, radius)
