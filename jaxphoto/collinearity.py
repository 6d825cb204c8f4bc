"""Collinearity: projection of object points, rays of image points, intersection of rays.

The map from directions in the camera frame to the image belongs to the camera (`camera.projection`): perspective, or a
fisheye whose rays may come from behind the image plane.

Each function takes one image and one point (intersection: one point and its rays); map over rows with `jax.vmap`.
Frames, signs and units: docs/conventions.md. Source of the equations: paper 001, equation (1).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.argument_checks import single
from jaxphoto.arrays import from_list
from jaxphoto.camera import InteriorOrientation
from jaxphoto.linear_algebra import solve
from jaxphoto.rotation import matrix_from_omega_phi_kappa, omega_phi_kappa_from_matrix, rotate
from jaxphoto.short_repr import pretty_repr

# Without jit every operation would be compiled separately. Inside another jitted function these are inlined.
_compiled = functools.partial(jax.jit, inline=True)
# Number of iterations to find the row of a rolling shutter that sees a point: each reduces the error to a hundredth or
# less.
_ROWS = 10


_matrices = _compiled(jnp.vectorize(matrix_from_omega_phi_kappa, signature="(i)->(i,j)"))


@pretty_repr
class ExteriorOrientation(eqx.Module):
    """Projection centre (m) and rotation of one image, or of many with a leading axis."""

    position: Float[Array, "*images 3"] = eqx.field(converter=from_list)
    camera_from_object: Float[Array, "*images 3 3"] = eqx.field(converter=from_list)

    @staticmethod
    def from_angles(
        position: Float[Array, "*images 3"], omega_phi_kappa: Float[Array, "*images 3"]
    ) -> "ExteriorOrientation":
        """Create from projection centre (m) and (omega, phi, kappa) in radians."""
        angles = jnp.asarray(omega_phi_kappa, float)
        return ExteriorOrientation(jnp.asarray(position, float), _matrices(angles))

    @property
    def omega_phi_kappa(self) -> Float[Array, "*images 3"]:
        """(omega, phi, kappa) in radians."""
        return jnp.vectorize(omega_phi_kappa_from_matrix, signature="(i,j)->(i)")(self.camera_from_object)


def _single(exterior: ExteriorOrientation) -> ExteriorOrientation:
    """Return the orientation of one image as arrays; see `jaxphoto.argument_checks`."""
    return ExteriorOrientation(
        single("exterior.position", exterior.position, 3),
        single("exterior.camera_from_object", exterior.camera_from_object, 3, 3),
    )


def camera_coordinates(exterior: ExteriorOrientation, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Transform an object point (m) to the camera frame: x right, y up, z backwards; z < 0 is in front."""
    return rotate(exterior.camera_from_object, point - exterior.position)


def project_ideal(
    interior: InteriorOrientation, exterior: ExteriorOrientation, point: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Return the ideal image coordinate (mm, from the principal point); perspective: x = -c U / W, y = -c V / W."""
    u, v, w = camera_coordinates(exterior, point)
    return interior.ideal_from_direction(u, v, w)


def in_field(interior: InteriorOrientation, exterior: ExteriorOrientation, point: Float[Array, "3"]) -> Bool[Array, ""]:
    """Return True if a point (m) has an image; the image format is not checked.

    Its direction must have an image (a perspective camera requires the point in front), and the distortion must be
    invertible there.
    """
    u, v, w = camera_coordinates(exterior, point)
    return interior.projection.sees(u, v, w) & interior.invertible(interior.ideal_from_direction(u, v, w))


def project(
    interior: InteriorOrientation, exterior: ExteriorOrientation, point: Float[Array, "3"]
) -> Float[Array, "2"]:
    """Return the measured image coordinate (mm, from the image centre) of an object point (m).

    For a rolling shutter, the coordinate in the row exposed when it sees the point, by iteration. Meaningless if the
    point is not `in_field`.
    """
    return _project(interior, _single(exterior), single("point", point, 3))


@_compiled
def _project(interior: InteriorOrientation, exterior: ExteriorOrientation, point: Float[Array, "3"]) -> Array:
    in_camera = tuple(camera_coordinates(exterior, point))
    seen = lambda u, v, w: interior.measured_from_ideal(interior.ideal_from_direction(u, v, w))  # noqa: E731
    rows = interior.rows
    if rows is None:
        return seen(*in_camera)
    return jax.lax.fori_loop(0, _ROWS, lambda _, xy: seen(*rows.at_row(xy[1], in_camera)), seen(*in_camera))


def image_ray(
    interior: InteriorOrientation, exterior: ExteriorOrientation, xy: Float[Array, "2"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return origin (m) and unit direction, in the object frame, of the ray of a measured image coordinate (mm)."""
    return _image_ray(interior, _single(exterior), single("xy", xy, 2))


@_compiled
def _image_ray(interior: InteriorOrientation, exterior: ExteriorOrientation, xy: Float[Array, "2"]) -> tuple:
    in_camera = interior.direction_from_ideal(interior.ideal_from_measured(xy))
    direction = rotate(exterior.camera_from_object.T, jnp.stack(in_camera))
    return exterior.position, direction / jnp.sqrt(jnp.sum(direction**2))


def image_residual(
    interior: InteriorOrientation,
    exterior: ExteriorOrientation,
    point: Float[Array, "3"],
    xy: Float[Array, "2"],
) -> Float[Array, "2"]:
    """Return observed minus computed image coordinate (mm), in the image in which the distortion has a closed form.

    `ideal(measured) - projection` for models in the measured coordinate; `measured - distorted projection` for models
    in the ideal one. If `interior.residuals` is "measured", the former is transformed to the measured image by the
    derivative of the distortion at the measured coordinate. With a rolling shutter, the camera pose is the pose at
    which the row of the measured coordinate was exposed (`camera.rolling_shutter`).
    """
    return camera_residual(interior, camera_coordinates(exterior, point), xy)


def camera_residual(
    interior: InteriorOrientation, in_camera: Float[Array, "3"] | tuple[Array, Array, Array], xy: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Return `image_residual` of a point in the camera frame (m; see `camera_coordinates`)."""
    # Compute by component: intermediate arrays of length two would cost 10 % of an adjustment's time.
    u, v, w = in_camera
    if interior.rows is not None:
        u, v, w = interior.rows.at_row(xy[1], (u, v, w))
    projection = interior.ideal_from_direction(u, v, w)
    reduced = jnp.stack([xy[0] - interior.xp, xy[1] - interior.yp])
    if interior.distortion.domain == "ideal":
        return jnp.stack(_apart(reduced, interior.closed_form(projection)))
    if interior.residuals == "model":
        return jnp.stack(_apart(interior.closed_form(reduced), projection))
    ideal, slopes = jax.linearize(interior.closed_form, reduced)
    (a, c), (b, d) = (slopes(jnp.array(e)) for e in ((1.0, 0.0), (0.0, 1.0)))
    (x, y), determinant = _apart(ideal, projection), a * d - b * c
    return jnp.stack([(d * x - b * y) / determinant, (a * y - c * x) / determinant])


def _apart(xy: Float[Array, "2"], other: Float[Array, "2"]) -> tuple[Array, Array]:
    return xy[0] - other[0], xy[1] - other[1]


def intersect(
    origins: Float[Array, "rays 3"],
    directions: Float[Array, "rays 3"],
    weights: Float[Array, "rays"] | None = None,
) -> Float[Array, "3"]:
    """Intersect rays: the point (m) closest to all of them, `sum w (I - d d') (X - origin) = 0`.

    `directions` are unit vectors; rays of weight zero are ignored. Parallel rays give NaN or a distant point.
    """
    origins, directions = single("origins", origins, None, 3), single("directions", directions, len(origins), 3)
    w = jnp.ones(len(origins)) if weights is None else single("weights", weights, len(origins))
    across = w[:, None, None] * (jnp.eye(3) - directions[:, :, None] * directions[:, None, :])
    # Use coordinates relative to the first origin: large coordinates would lose digits.
    b = jnp.einsum("nij,nj->i", across, origins - origins[0])
    return origins[0] + solve(jnp.sum(across, 0), b)


def intersection_angle(directions: Float[Array, "rays 3"]) -> Float[Array, ""]:
    """Return the largest angle between any two rays (radians)."""
    cosine = jnp.clip(directions @ directions.T, -1.0, 1.0)
    return jnp.arccos(jnp.min(jax.lax.stop_gradient(cosine)))
