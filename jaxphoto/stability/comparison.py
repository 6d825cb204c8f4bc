"""Two interior orientations compared by their bundles of rays: offsets after alignment, and their RMSE."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import Numbers, still
from jaxphoto.camera import InteriorOrientation, invert
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.short_repr import shown
from jaxphoto.stability.alignment import UNKNOWNS, Method, align, offsets_of
from jaxphoto.stability.bundles import image_rays, parameter_vector, with_parameters


@shown
class BundleOffsets(eqx.Module):
    """What remains between two bundles after alignment, on the first one's virtual image plane, in mm.

    `alignment` is (small rotation in rad, position in units of the object's distance), as much of it as the method
    leaves free. `jacobian` is dv/dp of the offsets, point by point x then y, by `parameter_vector` of the first and
    then of the second interior orientation, the alignment being found anew: what covariances are propagated with.
    """

    points: Float[Array, "points 2"]
    offsets: Float[Array, "points 2"]
    measured: Float[Array, "points 2"]
    """The offsets carried back through the first distortion into the image as it is measured: free of R0."""
    alignment: Float[Array, "u"]
    jacobian: Float[Array, "2*points parameters"]
    stretch: Float[Array, "points 2 2"]
    """d(ideal) / d(measured) coordinate of the first camera: `offsets` are `stretch` times `measured`."""
    converged: Bool[Array, ""]

    @property
    def measured_jacobian(self) -> Float[Array, "coordinates parameters"]:
        """dv/dp like `jacobian`, of the offsets in the image as it is measured, to first order."""
        by_point = self.jacobian.reshape(len(self.points), 2, -1)
        return jax.vmap(solve)(self.stretch, by_point).reshape(self.jacobian.shape)

    @property
    def redundancy(self) -> int:
        """2 n - u: coordinates of the grid less unknowns of the alignment."""
        return 2 * len(self.points) - len(self.alignment)

    @property
    def rmse_mm(self) -> Float[Array, ""]:
        """RMSE_offset = sqrt(v'v / (2 n - u)), in mm (paper 002)."""
        return ((self.offsets**2).sum() / self.redundancy) ** 0.5

    @property
    def rmse_measured_mm(self) -> Float[Array, ""]:
        """The same of `measured`: it compares with the noise of measured coordinates where distortion is large."""
        return ((self.measured**2).sum() / self.redundancy) ** 0.5


def rmse_offset(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[Numbers, "points 2"],
    method: Method = "rot",
    depth: Float[Numbers, "points"] | None = None,
) -> Float[Array, ""]:
    """RMSE_offset (mm) of two interior orientations over image points (mm, from the centre; see `image_grid`).

    `sqrt(v'v / (2 n - u))`, of any distortion models. `depth` is that of the object points of the method spr, in units
    of their mean distance; flat where it is None. A pure function for `jax.jit`, `jax.grad` and `jax.vmap`; at equal
    bundles it is a norm at zero and has no derivative: there differentiate `bundle_offsets`.
    Source: paper 002, section on stability analysis; Habib et al. (2006).
    """
    v = _aligned(first, second, points, method, _depths(points, depth))[0]
    return jnp.sqrt(jnp.sum(v**2) / (2 * len(points) - UNKNOWNS[method]))


def bundle_offsets(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[Numbers, "points 2"],
    method: Method = "rot",
    depth: Float[Numbers, "points"] | None = None,
) -> BundleOffsets:
    """The offsets of two bundles after alignment, with their derivatives; arguments as in `rmse_offset`.

    Raises ValueError for fewer points than the alignment needs.
    """
    if 2 * len(points) <= UNKNOWNS[method]:
        raise ValueError(f"{len(points)} image points leave nothing to compare after {UNKNOWNS[method]} unknowns")
    points = jnp.asarray(points, float)
    return call_compiled(_compared, as_arrays(first), as_arrays(second), points, method, _depths(points, depth))


def check_rays(interior: InteriorOrientation, points: Float[Numbers, "points 2"], name: str) -> None:
    """Raise InputError where the distortion of `interior`, called `name`, folds or has no ray at some of `points`."""
    good = regular_rays(interior, points)
    if not good.all():
        reach = np.hypot(*np.asarray(points)[~good].T).min()
        raise InputError(
            f"{name}: its distortion means nothing at {(~good).sum()} of {len(good)} points of the grid, or they look "
            f"behind the camera, the nearest {reach:.3g} mm from the image centre; compare over a smaller extent"
        )


def regular_rays(interior: InteriorOrientation, points: Float[Numbers, "points 2"]) -> Bool[Numbers, "points"]:
    """At which image points (mm) the distortion does not fold, and the ray looks ahead."""
    return still(call_compiled(_regular, as_arrays(interior), jnp.asarray(points, float)))


@eqx.filter_jit
def _compared(first, second, points, method, depth) -> BundleOffsets:
    def offsets(p1, p2):
        v, *others = _aligned(with_parameters(first, p1), with_parameters(second, p2), points, method, depth)
        return v.ravel(), (v, *others)

    p1, p2 = parameter_vector(first), parameter_vector(second)
    (j1, j2), (v, alignment, converged) = jax.jacfwd(offsets, argnums=(0, 1), has_aux=True)(p1, p2)
    stretch = jax.vmap(jax.jacfwd(first.ideal_from_measured))(points)
    measured = jax.vmap(solve)(stretch, v)
    return BundleOffsets(points, v, measured, alignment, jnp.hstack([j1, j2]), stretch, converged)


@eqx.filter_jit
def _regular(interior, points):
    """Whether the map from measured to ideal coordinates keeps its orientation at the points, and they look ahead."""

    def one(xy):
        _, _, w = interior.direction_from_ideal(interior.ideal_from_measured(xy))
        return unfolded(xy) & (w < 0)

    def unfolded(xy):
        if interior.distortion.domain == "ideal":
            reduced = xy - interior.principal_point
            return invert(interior.distortion, reduced / interior.c if interior.distortion.normalised else reduced)[1]
        return jnp.linalg.det(jax.jacfwd(interior.ideal_from_measured)(xy)) > 0

    return jax.vmap(one)(points)


def _aligned(first, second, points, method, depth):
    rays = image_rays(first, points), image_rays(second, points)
    alignment, converged = align(*rays, depth, method)
    return offsets_of(alignment, *rays, depth, method), alignment, converged


def _depths(points, depth):
    return jnp.ones(len(points)) if depth is None else jnp.asarray(depth, float)


def as_arrays(interior: InteriorOrientation) -> InteriorOrientation:
    """Numbers as arrays, so that another value is not another program."""
    return jax.tree.map(lambda v: jnp.asarray(v, float), interior)
