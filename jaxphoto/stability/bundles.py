"""Bundles of rays of interior orientations: alignment, offsets and RMSE, uncertainty over the format.

With the rays (x1, -c1) and (x2, -c2) of the same measured image points, in mm, the offsets v on the virtual image plane
of the first bundle are

    zrot   v = x1 - x2 c1 / c2                                              no alignment
    rot    v = x1 + c1 w_xy / w_z,   w = R (x2, -c2)                        second bundle rotated, v'v minimal
    spr    v = -c1 q_xy / q_z - x2 c1 / c2,   q = R (P - X0)                second bundle resected, v'v minimal

where P = d (x1, -c1) / c1 are object points on the first bundle's rays, at depths d. Bundles that differ only by the
alignment are equivalent in application. No alignment is applied if position and attitude are observed and the camera is
fixed to these sensors (zrot), a rotation if only positions are observed (rot), and both in indirect georeferencing
(spr).
Source: Habib, Pullivelli, Mitishita, Ghanma and Kim, Photogrammetric Record 21 (2006), 29-43.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, invert, parameter_names, set_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr


def image_grid(
    sensor: Sensor, columns: int = 15, rows: int = 11, extent_mm: tuple[float, float] | None = None
) -> Float[np.ndarray, "points 2"]:
    """Return a regular grid of measured image points (mm from the image centre), row by row from the lower left.

    `columns` x `rows` points cover the format, or a centred rectangle `extent_mm` (width and height), from edge to
    edge. Raises ValueError for fewer than 2 columns or rows, and for an extent that is not positive.
    """
    if columns < 2 or rows < 2:
        raise ValueError(f"a grid needs at least 2 columns and 2 rows, got {columns} x {rows}")
    width, height = extent_mm if extent_mm is not None else (sensor.width_mm, sensor.height_mm)
    if not (width > 0 and height > 0):
        raise ValueError(f"the extent of a grid must be positive, got {width:g} x {height:g} mm")
    x, y = np.linspace(-width / 2, width / 2, columns), np.linspace(-height / 2, height / 2, rows)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def image_rays(interior: InteriorOrientation, points: Float[ArrayLike, "points 2"]) -> Float[Array, "points 3"]:
    """Return the bundle of rays (x', y', -c) in mm, in the camera frame, of measured image points (mm from the centre).

    x' is the distortion-free coordinate from the principal point, on the virtual image plane at distance c, for any
    projection; rays must be within 90 degrees of the axis.
    """

    def ray(xy):
        u, v, w = interior.direction_from_ideal(interior.ideal_from_measured(xy))
        scale = -interior.c / w
        return jnp.stack([u * scale, v * scale, -jnp.asarray(interior.c, float)])

    return jax.vmap(ray)(jnp.asarray(points, float))


def parameter_vector(interior: InteriorOrientation) -> Float[Array, "parameters"]:
    """Return the values of `jaxphoto.camera.parameter_names`, in their order and units."""
    return jnp.stack([jnp.asarray(get_parameter(interior, name), float) for name in parameter_names(interior)])


def with_parameters(interior: InteriorOrientation, vector: Float[Array, "parameters"]) -> InteriorOrientation:
    """Return `interior` with the values of a `parameter_vector`; constants of the model are unchanged."""
    for name, value in zip(parameter_names(interior), vector, strict=True):
        interior = set_parameter(interior, name, value)
    return interior


Method = Literal["zrot", "rot", "spr"]
METHODS: tuple[Method, ...] = ("zrot", "rot", "spr")
UNKNOWNS: dict[Method, int] = {"zrot": 0, "rot": 3, "spr": 6}
"""Number of unknowns of the alignment: three angles (rad), then position in units of the object distance."""
ALIGNED: dict[Method, str] = {
    "zrot": "not aligned",
    "rot": "aligned by rotation",
    "spr": "aligned by rotation and translation",
}
"""Labels of the alignment methods."""

# Maximum number of Gauss-Newton steps; bundles of one camera need 3 to 6.
_MAX_STEPS = 50
_STEP_TOLERANCE = 1e-13
# Maximum cosine between the offsets and their derivatives at an optimum.
_GRADIENT_TOLERANCE = 1e-9


def offsets_of(
    alignment: Float[Array, "u"],
    first: Float[Array, "points 3"],
    second: Float[Array, "points 3"],
    depth: Float[Array, "points"],
    method: Method,
) -> Float[Array, "points 2"]:
    """Compute the offsets v (mm) of two bundles for an alignment of `UNKNOWNS` values; see the module's docstring."""
    c1, c2 = -first[0, 2], -second[0, 2]
    if method == "zrot":
        return first[:, :2] - second[:, :2] * (c1 / c2)
    if method == "rot":
        w = second @ small_rotation(alignment).T
        return first[:, :2] + c1 * w[:, :2] / w[:, 2:]
    q = (first * (depth / c1)[:, None] - alignment[3:]) @ small_rotation(alignment[:3]).T
    return -c1 * q[:, :2] / q[:, 2:] - second[:, :2] * (c1 / c2)


def align(
    first: Float[Array, "points 3"], second: Float[Array, "points 3"], depth: Float[Array, "points"], method: Method
) -> tuple[Float[Array, "u"], Bool[Array, ""]]:
    """Minimise v'v over the alignment; the flag is True at convergence.

    Uses Gauss-Newton iterations from the identity. Derivatives of any order follow from the implicit function theorem,
    applied to the gradient at the optimum.
    """
    if not UNKNOWNS[method]:
        return jnp.zeros(0), jnp.array(True)

    def offsets(alignment):
        return offsets_of(alignment, first, second, depth, method).ravel()

    def gradient(alignment):
        v, vjp = jax.vjp(offsets, alignment)
        return vjp(v)[0]

    def gauss_newton(_, start):
        def unfinished(state):
            _, step, k = state
            return (k < _MAX_STEPS) & (jnp.max(jnp.abs(step)) > _STEP_TOLERANCE)

        def body(state):
            alignment, _, k = state
            columns = jax.jacfwd(offsets)(alignment)
            # Use normal equations: sufficient for six well-conditioned unknowns, and three times faster to compile.
            step = solve(columns.T @ columns, columns.T @ offsets(alignment))
            return alignment - step, step, k + 1

        return jax.lax.while_loop(unfinished, body, (start, jnp.ones_like(start), 0))[0]

    def tangent(linear, b):
        return solve(jax.jacfwd(linear)(jnp.zeros_like(b)), b)

    optimum = jax.lax.custom_root(gradient, jnp.zeros(UNKNOWNS[method]), gauss_newton, tangent)
    columns = jnp.linalg.norm(jax.jacfwd(offsets)(optimum), axis=0)
    size = _GRADIENT_TOLERANCE * jnp.linalg.norm(offsets(optimum)) + _STEP_TOLERANCE * jnp.linalg.norm(first)
    return optimum, jnp.all(jnp.abs(gradient(optimum)) <= columns * size)


@pretty_repr
class BundleOffsets(eqx.Module):
    """Offsets (mm) of two bundles after alignment, on the virtual image plane of the first bundle.

    `alignment`: unknowns of the method (small rotation in rad, position in units of the object distance). `jacobian`:
    derivative of the offsets (x, y of each point) with respect to the `parameter_vector` of the first and then of the
    second interior orientation. It includes the change of the optimal alignment and is used for covariance propagation.
    """

    points: Float[Array, "points 2"]
    offsets: Float[Array, "points 2"]
    measured: Float[Array, "points 2"]
    """Offsets converted to the measured image by the first distortion; independent of R0."""
    alignment: Float[Array, "u"]
    jacobian: Float[Array, "2*points parameters"]
    stretch: Float[Array, "points 2 2"]
    """Derivative d(ideal) / d(measured) of the first camera: `offsets` = `stretch` times `measured`."""
    converged: Bool[Array, ""]

    @property
    def measured_jacobian(self) -> Float[Array, "coordinates parameters"]:
        """Return dv/dp like `jacobian`, for the offsets in the measured image, to first order."""
        by_point = self.jacobian.reshape(len(self.points), 2, -1)
        return jax.vmap(solve)(self.stretch, by_point).reshape(self.jacobian.shape)

    @property
    def redundancy(self) -> int:
        """Return 2 n - u: number of coordinates of the grid minus number of unknowns of the alignment."""
        return 2 * len(self.points) - len(self.alignment)

    @property
    def rmse_mm(self) -> Float[Array, ""]:
        """Return RMSE_offset = sqrt(v'v / (2 n - u)) in mm (paper 002)."""
        return ((self.offsets**2).sum() / self.redundancy) ** 0.5

    @property
    def rmse_measured_mm(self) -> Float[Array, ""]:
        """Return RMSE_offset of `measured`, comparable with the noise of measured coordinates at any distortion."""
        return ((self.measured**2).sum() / self.redundancy) ** 0.5


def rmse_offset(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[ArrayLike, "points 2"],
    method: Method = "rot",
    depth: Float[ArrayLike, "points"] | None = None,
) -> Float[Array, ""]:
    """Compute RMSE_offset (mm) of two interior orientations at image points (mm from the centre; see `image_grid`).

    RMSE_offset = `sqrt(v'v / (2 n - u))`, for any distortion models. `depth` is the depth of the object points for the
    method spr, in units of their mean distance; flat if None. A pure function for `jax.jit`, `jax.grad` and `jax.vmap`.
    For equal bundles the norm is not differentiable: differentiate `bundle_offsets` instead.
    Source: paper 002, section on stability analysis; Habib et al. (2006).
    """
    v = _aligned(first, second, points, method, _depths(points, depth))[0]
    return jnp.sqrt(jnp.sum(v**2) / (2 * len(points) - UNKNOWNS[method]))


def bundle_offsets(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[ArrayLike, "points 2"],
    method: Method = "rot",
    depth: Float[ArrayLike, "points"] | None = None,
) -> BundleOffsets:
    """Compute the offsets of two bundles after alignment, with derivatives; arguments as in `rmse_offset`.

    Raises ValueError for fewer points than the alignment needs.
    """
    if 2 * len(points) <= UNKNOWNS[method]:
        raise ValueError(f"{len(points)} image points are too few for {UNKNOWNS[method]} unknowns of the alignment")
    points = jnp.asarray(points, float)
    return call_compiled(_bundle_offsets, as_arrays(first), as_arrays(second), points, method, _depths(points, depth))


def check_rays(interior: InteriorOrientation, points: Float[ArrayLike, "points 2"], name: str) -> None:
    """Raise InputError if, at some of `points`, the distortion is not invertible or the ray points backward."""
    regular = regular_rays(interior, points)
    if not regular.all():
        radius = np.hypot(*np.asarray(points)[~regular].T).min()
        raise InputError(
            f"{name}: its distortion is not invertible, or rays point backwards, at {(~regular).sum()} of "
            f"{len(regular)} points of the grid, from {radius:.3g} mm from the image centre on: use a smaller extent"
        )


def regular_rays(interior: InteriorOrientation, points: Float[ArrayLike, "points 2"]) -> Bool[ArrayLike, "points"]:
    """Return True for image points (mm) with an invertible distortion and a forward ray."""
    return to_numpy(call_compiled(_regular, as_arrays(interior), jnp.asarray(points, float)))


@eqx.filter_jit
def _bundle_offsets(first, second, points, method, depth) -> BundleOffsets:
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
    """Return True where the mapping from measured to ideal coordinates is invertible and the ray points forward."""

    def regular(xy):
        _, _, w = interior.direction_from_ideal(interior.ideal_from_measured(xy))
        return invertible(xy) & (w < 0)

    def invertible(xy):
        if interior.distortion.domain == "ideal":
            reduced = xy - interior.principal_point
            return invert(interior.distortion, reduced / interior.c if interior.distortion.normalised else reduced)[1]
        return jnp.linalg.det(jax.jacfwd(interior.ideal_from_measured)(xy)) > 0

    return jax.vmap(regular)(points)


def _aligned(first, second, points, method, depth):
    rays = image_rays(first, points), image_rays(second, points)
    alignment, converged = align(*rays, depth, method)
    return offsets_of(alignment, *rays, depth, method), alignment, converged


def _depths(points, depth):
    return jnp.ones(len(points)) if depth is None else jnp.asarray(depth, float)


def as_arrays(interior: InteriorOrientation) -> InteriorOrientation:
    """Convert values to arrays, so that other values do not require recompilation."""
    return jax.tree.map(lambda v: jnp.asarray(v, float), interior)


def frame_sigma(
    interior: InteriorOrientation,
    covariance: Float[np.ndarray, "p p"],
    points: Float[np.ndarray, "points 2"],
    method: Method,
) -> Float[np.ndarray, "points"]:
    """Propagate the covariance of `parameter_names` to the root mean square error (mm, both axes) at image points (mm).

    `method`: alignment that the orientation of images can absorb. Raises InputError for points where the distortion is
    not invertible.
    """
    check_rays(interior, points, "the camera")
    derivatives = call_compiled(_derivatives, as_arrays(interior), jnp.asarray(points, float))
    stretch, by_parameters, by_alignment = jax.tree.map(np.asarray, derivatives)
    # At zero offsets the alignment is an orthogonal projection: use the residuals of the least-squares fit.
    columns = by_alignment[method].reshape(2 * len(points), -1)
    absorbed = columns @ np.linalg.lstsq(columns, by_parameters, rcond=None)[0]
    rest = (by_parameters - absorbed).reshape(len(points), 2, -1)
    rows = np.linalg.solve(stretch, rest)[:, :, : len(covariance)]
    return np.sqrt(np.maximum(np.einsum("nip,pq,niq->n", rows, covariance, rows), 0.0))


@eqx.filter_jit
def _derivatives(
    interior: InteriorOrientation, points: Float[Array, "points 2"]
) -> tuple[Float[Array, "points 2 2"], Float[Array, "coordinates p"], dict[Method, Float[Array, "points 2 u"]]]:
    """Return d(ideal) / d(measured), d(offsets) / d(parameters) without alignment, d(offsets) / d(alignment) by method.

    Evaluates all methods in one program, because compiling one program per method takes longer.
    """
    rays, depth = image_rays(interior, points), jnp.ones(len(points))

    def offsets(parameters):
        first = image_rays(with_parameters(interior, parameters), points)
        return offsets_of(jnp.zeros(0), first, rays, depth, "zrot").ravel()

    by_alignment = {
        method: jax.jacfwd(lambda a, method=method: offsets_of(a, rays, rays, depth, method))(
            jnp.zeros(UNKNOWNS[method])
        )
        for method in METHODS
    }
    stretch = jax.vmap(jax.jacfwd(interior.ideal_from_measured))(points)
    return stretch, jax.jacfwd(offsets)(parameter_vector(interior)), by_alignment
