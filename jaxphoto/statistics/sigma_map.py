"""How well a calibrated camera says where a point is seen, over its format: the projection uncertainty of mrcal.

A point P is seen at q = f(b, R (P - X0)) by the interior orientation b and the exterior orientation (X0, R). Both come
from one adjustment, and their errors are correlated: an image may be turned by what the principal point is off. So P is
held in the frame of the object, as each image i of the camera has it, taken back by the adjusted exterior orientation
of that image, and the mean over the images is projected:

    p = d u                        d: distance, u: direction of q
    dp = mean_i (dtheta_i x p - R_i dX0_i)
    dq = df/db db + df/dp dp

with small rotations dtheta_i about the axes of the camera. At an infinite distance the positions drop out. All this is
linear in the unknowns, so the covariance of q is exact to first order and needs the covariance of b and of six means
only (`linear_forms`), however many images there are.

Source: D. Kogan, mrcal, projection uncertainty (https://mrcal.secretsauce.net/uncertainty.html), method of version 2.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import Numbers, is_traced, namespace, still
from jaxphoto.block_edits import one_camera
from jaxphoto.camera import InteriorOrientation, Sensor, parameter_names
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import shown
from jaxphoto.stability import image_grid, parameter_vector, regular_rays, with_parameters
from jaxphoto.statistics.correlation import linear_forms

# Cells along the longer and the shorter side of the format.
_LONG, _SHORT = 60, 40


@shown
class SigmaMap(eqx.Module):
    """Covariances of where a point is seen, at places of the format of a camera; a posteriori."""

    camera: str = eqx.field(static=True)
    distance_m: float
    """Of the point from the projection centre; infinite for a direction."""
    points: Float[Numbers, "cells 2"]
    """Measured image coordinates (mm from the centre of the image)."""
    covariance: Float[Any, "cells 2 2"]
    """Of x and y (mm^2); NaN where the distortion folds or the ray looks behind the camera."""

    @property
    def worst(self) -> Float[Any, "cells"]:
        """Standard deviation (mm) in the direction in which it is largest: the longer half axis of the ellipse."""
        q = self.covariance
        mean, half = (q[:, 0, 0] + q[:, 1, 1]) / 2, (q[:, 0, 0] - q[:, 1, 1]) / 2
        xp = namespace(q)
        return xp.sqrt(mean + xp.hypot(half, q[:, 0, 1]))


def sigma_map(
    adjusted: Adjustment,
    camera: str | None = None,
    *,
    distance_m: float = float("inf"),
    points: Float[Numbers, "cells 2"] | None = None,
) -> SigmaMap:
    """What the errors of interior and exterior orientation do to the image of a point at `distance_m`, over the format.

    `points` are measured image coordinates (mm from the centre); 60 x 40 cells from edge to edge where they are not
    given. A block of several cameras needs the name of one. What bends the camera of an image beyond its interior
    orientation, such as a rolling shutter, is taken as known. Raises InputError for a camera that the block has not,
    and for a distance that is not positive.
    """
    name = one_camera(adjusted.block, camera)
    if not distance_m > 0:
        raise InputError(f"distance_m is the distance of a point from the camera, so it is positive, got {distance_m}")
    return _sigma_map(adjusted, name, distance_m, points, _joint_covariance(adjusted, name))


def _sigma_map(
    adjusted: Adjustment,
    name: str,
    distance_m: float,
    points: Float[Numbers, "cells 2"] | None,
    known: tuple[list[str], Float[Any, "n n"]],
) -> SigmaMap:
    """The map of a camera of which the `_joint_covariance` is `known`."""
    interior, sensor = adjusted.unknowns.interior[name], adjusted.block.sensors[name]
    xy = _cells(sensor) if points is None else np.asarray(points, float)
    own, covariance = known
    # Numbers as arrays, so that another value is not another program.
    arrays = jax.tree.map(lambda v: jnp.asarray(v, float), interior)
    jacobian = still(call_compiled(_derivatives, arrays, jnp.asarray(xy), jnp.asarray(1 / distance_m)))
    kept = [*(parameter_names(interior).index(p) for p in own), *range(jacobian.shape[2] - 6, jacobian.shape[2])]
    rows = jacobian[:, :, kept]
    xp = namespace(rows, covariance)
    found = xp.einsum("nip,pq,njq->nij", rows, covariance, rows)
    found = xp.where(regular_rays(interior, xy)[:, None, None], found, np.nan)
    return SigmaMap(name, float(distance_m), xy, found)


def seen_distance_m(adjusted: Adjustment, camera: str | None = None) -> float:
    """The median distance at which the images of a camera saw points (m)."""
    s, name = adjusted.structure, one_camera(adjusted.block, camera)
    mine = np.array([c == name for c in adjusted.block.image_camera], bool)[s.image]
    places = np.asarray(adjusted.unknowns.points)[s.point] - np.asarray(adjusted.unknowns.exterior.position)[s.image]
    return float(np.median(np.linalg.norm(places[mine], axis=1)))


def sigma_maps(adjusted: Adjustment) -> dict[str, tuple[SigmaMap, SigmaMap]]:
    """By camera of which something was estimated: at infinity, and at the median distance at which it saw points."""
    s = adjusted.structure
    seen = {adjusted.block.image_camera[i] for i in np.unique(s.image)}
    found: dict[str, tuple[SigmaMap, SigmaMap]] = {}
    for name in adjusted.unknowns.interior:
        if name in seen and any(label.startswith(f"interior[{name}].") for label in s.labels):
            known = _joint_covariance(adjusted, name)
            far = _sigma_map(adjusted, name, float("inf"), None, known)
            found[name] = far, _sigma_map(adjusted, name, seen_distance_m(adjusted, name), None, known)
    return found


def _cells(sensor: Sensor) -> Float[Numbers, "cells 2"]:
    across = sensor.width_px >= sensor.height_px
    return image_grid(sensor, *((_LONG, _SHORT) if across else (_SHORT, _LONG)))


def _joint_covariance(adjusted: Adjustment, camera: str) -> tuple[list[str], Float[Any, "n n"]]:
    """The estimated parameters of the camera, and the covariance of them, of mean dtheta and of mean -R dX0."""
    prefix, labels = f"interior[{camera}].", adjusted.structure.labels
    places = [k for k, label in enumerate(labels) if label.startswith(prefix)]
    n = len(places) + 6
    shared = np.zeros((n, len(labels)))
    shared[np.arange(len(places)), places] = 1.0
    images = np.flatnonzero(np.array(adjusted.block.image_camera) == camera)
    exterior: Any = np.zeros((n, len(adjusted.block.images), 6))
    exterior[-6:-3, images, 3:] = np.eye(3)[:, None, :] / len(images)
    turned = -still(adjusted.unknowns.exterior.camera_from_object)[images].swapaxes(0, 1) / len(images)
    if is_traced(turned):
        exterior = jnp.asarray(exterior).at[-3:, images, :3].set(turned)
    else:
        exterior[-3:, images, :3] = turned
    found = linear_forms(adjusted, n, exterior=exterior, shared=shared)
    return [labels[k].removeprefix(prefix) for k in places], found.variance


@eqx.filter_jit
def _derivatives(
    interior: InteriorOrientation, points: Float[Array, "cells 2"], nearness: Float[Array, ""]
) -> Float[Array, "cells 2 unknowns"]:
    """dq by the parameters of the camera, dtheta (rad) and the shift of the point (m); `nearness` is 1 / distance."""
    vector = parameter_vector(interior)

    def at(xy):
        u = jnp.stack(interior.direction_from_ideal(interior.ideal_from_measured(xy)))
        u = u / jnp.linalg.norm(u)

        def off(moved):
            """Ideal coordinate of the point less that of what was measured: zero, and it stays so while q moves."""
            camera = with_parameters(interior, moved[:-6])
            seen = small_rotation(moved[-6:-3]) @ u + nearness * moved[-3:]
            return camera.ideal_from_direction(*seen) - camera.ideal_from_measured(xy)

        stretch = jax.jacfwd(interior.ideal_from_measured)(xy)
        return solve(stretch, jax.jacfwd(off)(jnp.concatenate([vector, jnp.zeros(6)])))

    return jax.vmap(at)(points)
