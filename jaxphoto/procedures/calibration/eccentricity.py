"""The image of a circle's centre is not the centre of the circle's image.

A circle is seen as an ellipse (bent by the lens), and what is measured is the centre of the ellipse that is nearest to
its edge (`jaxphoto.extras.photos.targets`). Both centres are computed from the adjusted orientation, the plane and
the radius of the circle. With the boundary b(t), 0 <= t < 2 pi, projected through the whole camera, Green's theorem
gives area, centroid and second moments of the image,

    A = 1/2 int (b x b') dt,   m = 1/(3 A) int b (b x b') dt,   M = 1/(4 A) int (b - m) (b - m)' ((b - m) x b') dt,

and from the ellipse with these, Q = (4 M)^-1 = L L', Gauss-Newton steps lead to the nearest one,

    int e^2 |b'| dt -> min,   e = rho (rho - 1) / |L L' d|,   rho = |L' d|,   d = b - centre.

On a smooth closed curve the trapezoidal rule converges exponentially: 32 points give every digit. Without distortion
the three centres, of area, of the nearest ellipse and of the conic, are one; with it the first two are up to some
hundredths of a pixel apart, for circles of a hundred pixels seen at a steep angle in the corner.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.linear_algebra import cholesky, inverse, solve
from jaxphoto.orientation.rays import padded_length

_POINTS = 32
# From the ellipse of the moments, which is the nearest but for the lens.
_STEPS = 3


def eccentricity(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    centre: Float[Array, "3"],
    axes: Float[Array, "3 2"],
    radius_m: Float[Array, ""],
) -> Float[Array, "2"]:
    """Centre of the ellipse nearest to a circle's image minus the image of the circle's centre, in mm as measured.

    `centre` (m) and two orthogonal unit vectors in its plane, `axes`, in the object frame. Source: the centre of the
    ellipse is in any book of projective geometry; through a distorting lens it is that of the formulas above.
    """

    def boundary(t):
        point = centre + radius_m * (axes[:, 0] * jnp.cos(t) + axes[:, 1] * jnp.sin(t))
        return project(interior, exterior, point)

    about = project(interior, exterior, centre)
    t = jnp.arange(_POINTS) * (2 * jnp.pi / _POINTS)
    b, slope = jax.vmap(lambda t: jax.jvp(boundary, (t,), (1.0,)))(t)
    # About the centre's image, so that the small difference keeps its digits, and in units of the circle's size.
    b = b - about
    cross = b[:, 0] * slope[:, 1] - b[:, 1] * slope[:, 0]
    size = jnp.sqrt(jnp.abs(jnp.sum(cross)))
    b, slope, cross = b / size, slope / size, cross / size**2
    centroid = 2 / 3 * jnp.sum(b * cross[:, None], axis=0) / jnp.sum(cross)
    d = b - centroid
    about_centroid = d[:, 0] * slope[:, 1] - d[:, 1] * slope[:, 0]
    moments = jnp.einsum("ti,tj,t->ij", d, d, about_centroid) / (2 * jnp.sum(cross))
    lower = cholesky(inverse(4 * moments))
    ellipse = jnp.stack([*centroid, lower[0, 0], lower[1, 0], lower[1, 1]])
    weight = jnp.linalg.norm(slope, axis=1)[:, None]
    for _ in range(_STEPS):
        columns = jax.jacfwd(_distances)(ellipse, b)
        ellipse -= solve(columns.T @ (weight * columns), columns.T @ (weight[:, 0] * _distances(ellipse, b)))
    return size * ellipse[:2]


def _distances(ellipse: Float[Array, "5"], b: Float[Array, "points 2"]) -> Float[Array, "points"]:
    """Distances of points from an ellipse (column, row and the three of L) to first order."""
    x, y = b[:, 0] - ellipse[0], b[:, 1] - ellipse[1]
    u, v = ellipse[2] * x + ellipse[3] * y, ellipse[4] * y
    # XLA without optimisation differentiates jnp.hypot wrongly (jax 0.10.2).
    rho = jnp.sqrt(u**2 + v**2)
    return rho * (rho - 1) / jnp.sqrt((ellipse[2] * u) ** 2 + (ellipse[3] * u + ellipse[4] * v) ** 2)


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
