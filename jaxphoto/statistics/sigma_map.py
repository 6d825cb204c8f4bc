"""Projection uncertainty of a calibrated camera over the image format (mrcal).

A point P is imaged at q = f(b, R (P - X0)) by the interior orientation b and the exterior orientation (X0, R). Both are
estimated in one adjustment, and their errors are correlated: a rotation of the images compensates an error of the
principal point. P is therefore fixed in the object frame as observed in each image i of the camera, transformed back by
the exterior orientation of image i, and the mean over the images is projected:

    p = d u                        d: distance, u: direction of q
    dp = mean_i (dtheta_i x p - R_i dX0_i)
    dq = df/db db + df/dp dp

with small rotations dtheta_i about the axes of the camera. At infinite distance the positions have no effect. dq is
linear in the unknowns, so the covariance of q is exact to first order. For any number of images it needs only the
covariance of b and of six means (`linear_forms`).

Source: D. Kogan, mrcal, projection uncertainty (https://mrcal.secretsauce.net/uncertainty.html), method of version 2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import ArrayLike, is_traced, namespace, to_numpy
from jaxphoto.block_edits import one_camera
from jaxphoto.camera import InteriorOrientation, Sensor, parameter_names
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr
from jaxphoto.stability import as_arrays, image_grid, parameter_vector, regular_rays, with_parameters
from jaxphoto.statistics.correlation import linear_forms

# Number of cells along the longer and the shorter side of the format.
_LONG, _SHORT = 60, 40


@pretty_repr
class SigmaMap(eqx.Module):
    """A posteriori covariances of projected points over the format of a camera."""

    camera: str = eqx.field(static=True)
    distance_m: float
    """Distance of the projected point from the projection centre; infinite for a direction."""
    points: Float[ArrayLike, "cells 2"]
    """Measured image coordinates (mm from the centre of the format)."""
    covariance: Float[Any, "cells 2 2"]
    """Covariance of x and y (mm^2); NaN if the distortion is not invertible or the ray points backwards."""

    @property
    def worst(self) -> Float[Any, "cells"]:
        """Largest standard deviation over all directions (mm): the semi-major axis of the error ellipse."""
        q = self.covariance
        mean, half = (q[:, 0, 0] + q[:, 1, 1]) / 2, (q[:, 0, 0] - q[:, 1, 1]) / 2
        xp = namespace(q)
        return xp.sqrt(mean + xp.hypot(half, q[:, 0, 1]))


def sigma_map(
    adjusted: Adjustment,
    camera: str | None = None,
    *,
    distance_m: float = float("inf"),
    points: Float[ArrayLike, "cells 2"] | None = None,
) -> SigmaMap:
    """Compute the covariance of the image of a point at `distance_m` due to errors of the camera orientation.

    The covariance includes interior and exterior orientation. `points` are measured image coordinates (mm from the
    centre), by default 60 x 40 cells over the format. `camera` is required for a block of several cameras. Other
    effects, such as a rolling shutter, are treated as known. Raises InputError for an unknown camera and for a distance
    that is not positive.
    """
    name = one_camera(adjusted.block, camera)
    if not distance_m > 0:
        raise InputError(f"distance_m must be positive, got {distance_m}")
    return _sigma_map(adjusted, name, distance_m, points, _joint_covariance(adjusted, name))


def _sigma_map(
    adjusted: Adjustment,
    name: str,
    distance_m: float,
    points: Float[ArrayLike, "cells 2"] | None,
    joint: tuple[list[str], Float[Any, "n n"]],
) -> SigmaMap:
    """Compute the uncertainty map of a camera from its `_joint_covariance`."""
    interior, sensor = adjusted.unknowns.interior[name], adjusted.block.sensors[name]
    xy = _cells(sensor) if points is None else np.asarray(points, float)
    parameters, covariance = joint
    jacobian = to_numpy(call_compiled(_derivatives, as_arrays(interior), xy, np.asarray(1 / distance_m)))
    index = [
        *(parameter_names(interior).index(p) for p in parameters),
        *range(jacobian.shape[2] - 6, jacobian.shape[2]),
    ]
    rows = jacobian[:, :, index]
    xp = namespace(rows, covariance)
    q = xp.einsum("nip,pq,njq->nij", rows, covariance, rows)
    q = xp.where(regular_rays(interior, xy)[:, None, None], q, np.nan)
    return SigmaMap(name, float(distance_m), xy, q)


def seen_distance_m(adjusted: Adjustment, camera: str | None = None) -> float:
    """Return the median distance (m) of the points measured by a camera."""
    s, name = adjusted.structure, one_camera(adjusted.block, camera)
    rows = np.array([c == name for c in adjusted.block.image_camera], bool)[s.image]
    rays = np.asarray(adjusted.unknowns.points)[s.point] - np.asarray(adjusted.unknowns.exterior.position)[s.image]
    return float(np.median(np.linalg.norm(rays[rows], axis=1)))


def sigma_maps(adjusted: Adjustment) -> dict[str, tuple[SigmaMap, SigmaMap]]:
    """Compute the maps of all cameras with estimated parameters: at infinity and at the median point distance."""
    s = adjusted.structure
    used = {adjusted.block.image_camera[i] for i in np.unique(s.image)}
    maps: dict[str, tuple[SigmaMap, SigmaMap]] = {}
    for name in adjusted.unknowns.interior:
        if name in used and any(label.startswith(f"interior[{name}].") for label in s.labels):
            joint = _joint_covariance(adjusted, name)
            infinite = _sigma_map(adjusted, name, float("inf"), None, joint)
            maps[name] = infinite, _sigma_map(adjusted, name, seen_distance_m(adjusted, name), None, joint)
    return maps


def _cells(sensor: Sensor) -> Float[ArrayLike, "cells 2"]:
    across = sensor.width_px >= sensor.height_px
    return image_grid(sensor, *((_LONG, _SHORT) if across else (_SHORT, _LONG)))


def _joint_covariance(adjusted: Adjustment, camera: str) -> tuple[list[str], Float[Any, "n n"]]:
    """Return the camera's estimated parameters, and their joint covariance with mean dtheta and mean -R dX0."""
    prefix, labels = f"interior[{camera}].", adjusted.structure.labels
    places = [k for k, label in enumerate(labels) if label.startswith(prefix)]
    n = len(places) + 6
    shared = np.zeros((n, len(labels)))
    shared[np.arange(len(places)), places] = 1.0
    images = np.flatnonzero(np.array(adjusted.block.image_camera) == camera)
    exterior: Any = np.zeros((n, len(adjusted.block.images), 6))
    exterior[-6:-3, images, 3:] = np.eye(3)[:, None, :] / len(images)
    minus_rotations = -to_numpy(adjusted.unknowns.exterior.camera_from_object)[images].swapaxes(0, 1) / len(images)
    if is_traced(minus_rotations):
        exterior = jnp.asarray(exterior).at[-3:, images, :3].set(minus_rotations)
    else:
        exterior[-3:, images, :3] = minus_rotations
    forms = linear_forms(adjusted, n, exterior=exterior, shared=shared)
    return [labels[k].removeprefix(prefix) for k in places], forms.variance


@eqx.filter_jit
def _derivatives(
    interior: InteriorOrientation, points: Float[Array, "cells 2"], nearness: Float[Array, ""]
) -> Float[Array, "cells 2 unknowns"]:
    """Compute dq by the camera parameters, dtheta (rad) and the shift of the point (m); `nearness` is 1 / distance."""
    vector = parameter_vector(interior)

    def jacobian(xy):
        u = jnp.stack(interior.direction_from_ideal(interior.ideal_from_measured(xy)))
        u = u / jnp.linalg.norm(u)

        def difference(change):
            """Return the ideal coordinate of the point minus the ideal coordinate of its image.

            By the implicit function theorem, dq keeps this difference zero.
            """
            camera = with_parameters(interior, change[:-6])
            ray = small_rotation(change[-6:-3]) @ u + nearness * change[-3:]
            return camera.ideal_from_direction(*ray) - camera.ideal_from_measured(xy)

        slope = jax.jacfwd(interior.ideal_from_measured)(xy)
        return solve(slope, jax.jacfwd(difference)(jnp.concatenate([vector, jnp.zeros(6)])))

    return jax.vmap(jacobian)(points)
