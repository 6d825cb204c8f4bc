"""Direct georeferencing: exterior orientation from the sensors, points from the images, each with covariance.

    from jaxphoto import georeference, read_block
    found = georeference(read_block("block"))
    found.exterior_sigma, found.point_sigma, found.discrepancies.value

Exterior orientation is not adjusted, and control serves as check points. The points are identical to those of an
adjustment of `variants.direct` without control.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment.model.parameter_tables import scalar_priors
from jaxphoto.arrays import ArrayLike
from jaxphoto.block import Block, SensorRows, direct_exterior, sensor_rows
from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.compiling import jit_quickly
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Corrections, DirectPartials, direct_partials
from jaxphoto.georeferencing.intersection_covariance import (
    RayPartials,
    intersection_gain,
    intersection_step,
    own_covariance,
    ray_partials,
    shared_covariance,
)
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import camera_rays, padded_length, turn_to_object
from jaxphoto.observations import ControlCoordinates
from jaxphoto.short_repr import pretty_repr
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Weighted

# Number of Gauss-Newton steps after the intersection: the first leaves errors of micrometres, the second only rounding
# errors.
_STEPS = 4


@pretty_repr
class Georeferenced(eqx.Module):
    """Result of direct georeferencing. All covariances are a priori."""

    images: tuple[str, ...] = eqx.field(static=True)
    """Images with both a complete station and an attitude."""
    points: tuple[str, ...] = eqx.field(static=True)
    """Points with rays in two or more of these images."""
    exterior: ExteriorOrientation
    exterior_covariance: Float[ArrayLike, "images 6 6"]
    """Covariance of X, Y, Z (m) and a small rotation in the camera frame (rad)."""
    positions: Float[np.ndarray, "points 3"]
    """Positions of `points`, m."""
    covariance: Float[np.ndarray, "points 3 3"]
    """Covariance of `positions` (m^2), including errors common to images of a mount or a camera."""
    discrepancies: ControlCoordinates
    """Surveyed minus computed (m) at control, fixed and check points, with the survey's sigmas; `who` refers to
    `points`.
    """

    @property
    def exterior_sigma(self) -> Float[np.ndarray, "images 6"]:
        """Standard deviations of X, Y, Z (m) and of the rotations about the camera's axes (rad)."""
        return np.sqrt(np.diagonal(self.exterior_covariance, axis1=1, axis2=2))

    @property
    def point_sigma(self) -> Float[np.ndarray, "points 3"]:
        """Standard deviations of the points (m)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@outside_transformations
def georeference(block: Block) -> Georeferenced:
    """Compute the exterior orientation of the images of `block` from stations, attitudes and mounts, and then its
    points.

    Mounts, cameras and strips are taken from `block.start`. Weighted parameters in `block.priors` (except strips) have
    an error with their sigma; all others are error-free. Raises BlockError if no image has both a complete station and
    an attitude.
    """
    sensors = sensor_rows(block, block.start.unknowns)
    if not len(sensors.image):
        raise BlockError(
            "no image has both a complete station and an attitude: give stations and attitudes, or adjust the block"
        )
    exterior = jax.tree.map(np.asarray, direct_exterior(sensors))
    by = jax.tree.map(np.asarray, _direct_partials(sensors))
    sensor_covariance = _propagated(by.station, sensors.station_sigma) + _propagated(
        by.attitude, sensors.attitude_sigma
    )
    mount_of = np.array(block.image_mount, object)[sensors.image]
    mounts = block.start.unknowns.mounts
    mount_sigma = {name: _sigmas(scalar_priors(prior, mounts[name])) for name, prior in block.priors.mounts.items()}
    of_image = np.stack([mount_sigma.get(name, np.zeros(by.mount.shape[2])) for name in mount_of])

    rays, positions, shown = _intersected(block, sensors.image, exterior)
    point, n = rays.point, len(shown)
    own_of_ray = rays.exterior @ sensor_covariance[rays.image] @ rays.exterior.transpose(0, 2, 1)
    own_of_ray += rays.sigma[:, :, None] ** 2 * np.eye(2)
    covariance = _own_covariance(rays.gain, own_of_ray, point, n)
    for name, sigma in mount_sigma.items():
        rows = np.flatnonzero(mount_of[rays.image] == name)
        by_mount = rays.exterior[rows] @ by.mount[rays.image[rows]]
        covariance += _shared_covariance(rays.gain[rows], by_mount, np.diag(sigma**2), point[rows], n)
    for name, (rows, by_interior) in rays.interior.items():
        interior = block.priors.interior[name]
        sigma = _sigmas([get_parameter(interior, parameter) for parameter in parameter_names(interior)])
        covariance += _shared_covariance(rays.gain[rows], by_interior, np.diag(sigma**2), point[rows], n)

    surveyed = ControlCoordinates.joined(block.control, block.fixed, block.check)
    place = np.full(len(block.points), -1)
    place[shown] = np.arange(n)
    on_points = surveyed.take(place[surveyed.who] >= 0)
    who = place[on_points.who]
    return Georeferenced(
        images=tuple(block.images[i] for i in sensors.image),
        points=tuple(block.points[p] for p in shown),
        exterior=exterior,
        exterior_covariance=sensor_covariance + _propagated(by.mount, of_image),
        positions=positions,
        covariance=np.asarray(covariance),
        discrepancies=ControlCoordinates(
            who, on_points.axis, np.asarray(on_points.value) - positions[who, on_points.axis], on_points.sigma
        ),
    )


class _Rays(NamedTuple):
    """Intersecting rays: oriented image, point, gain, image sigma (mm), derivatives; see `ray_partials`."""

    image: Int[np.ndarray, "rows"]
    point: Int[np.ndarray, "rows"]
    gain: Float[np.ndarray, "rows 3 2"]
    sigma: Float[np.ndarray, "rows 2"]
    exterior: Float[np.ndarray, "rows 2 6"]
    interior: dict[str, tuple[np.ndarray, np.ndarray]]
    """By camera: the indices of its rows and their derivatives by its parameters."""


def _intersected(
    block: Block, oriented: Int[np.ndarray, "images"], exterior: ExteriorOrientation
) -> tuple[_Rays, Float[np.ndarray, "points 3"], Int[np.ndarray, "points"]]:
    """Return rays of the `oriented` images, the points (m) they determine, and their indices in the block."""
    observed = block.image_points
    place = np.full(len(block.images), -1)
    place[oriented] = np.arange(len(oriented))
    rows = np.flatnonzero(place[observed.image] >= 0)
    image, point = place[observed.image[rows]], observed.point[rows]
    xy, sigma = np.asarray(observed.xy)[rows], np.asarray(observed.sigma)[rows]
    camera = np.array(block.image_camera, object)[oriented][image]
    position, matrix = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)

    directions = np.zeros((len(rows), 3))
    interior = block.start.unknowns.interior
    for name, of in interior.items():
        of_camera = camera == name
        rays = camera_rays(of, xy[of_camera])
        directions[of_camera] = turn_to_object(matrix, image[of_camera], rays)
    positions, good = intersect_points(position[image], directions, point, len(block.points))
    is_behind = np.einsum("ni,ni->n", directions, positions[point] - position[image]) <= 0
    good[point[is_behind]] = False

    shown = np.flatnonzero(good)
    intersected = good[point]
    image, xy, sigma, camera = image[intersected], xy[intersected], sigma[intersected], camera[intersected]
    number = np.cumsum(good) - 1
    point, points, n = number[point[intersected]], positions[shown], len(shown)
    rows_of = {name: np.flatnonzero(camera == name) for name in interior if name in camera}
    residual, by_point, by_exterior = np.zeros((len(xy), 2)), np.zeros((len(xy), 2, 3)), np.zeros((len(xy), 2, 6))
    by_interior: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for _ in range(_STEPS):
        for name, r in rows_of.items():
            # Pad with repeated rows, so cameras of one model share compiled code.
            rows = np.resize(r, padded_length(len(r)))
            of_rows = ExteriorOrientation(position[image[rows]], matrix[image[rows]])  # type: ignore[arg-type]
            by = _ray_partials(_numbers(interior[name]), of_rows, points[point[rows]], xy[rows], block.corrections)
            new = [np.asarray(v)[: len(r)] for v in by]
            residual[r], by_point[r], by_exterior[r], by_interior[name] = *new[:3], (r, new[3])
        gain = np.asarray(_gain(by_point, sigma, point, n))
        points = points + np.asarray(_step(gain, residual, point, n))
    return _Rays(image, point, gain, sigma, by_exterior, by_interior), points, shown


def _propagated(by: Float[np.ndarray, "n 6 m"], sigma: Float[ArrayLike, "n m"]) -> Float[np.ndarray, "n 6 6"]:
    return np.einsum("nij,nj,nkj->nik", by, np.asarray(sigma) ** 2, by)


def _sigmas(priors: list) -> np.ndarray:
    """Return the sigma of each prior, zero if it has none."""
    return np.array([float(p.sigma) if isinstance(p, Weighted) else 0.0 for p in priors])


def _numbers(interior: InteriorOrientation) -> InteriorOrientation:
    """Convert floats to arrays; a Python float would be compiled in as a constant, separately for every camera."""
    return jax.tree.map(partial(np.asarray, dtype=float), interior)


_of_rows = partial(jit_quickly, static_argnum=3)
_gain, _step, _own_covariance = _of_rows(intersection_gain), _of_rows(intersection_step), _of_rows(own_covariance)
_shared_covariance = jit_quickly(shared_covariance, static_argnum=4)


@partial(jit_quickly, static_argnum=4)
def _ray_partials(interior, exterior, points, xy, corrections: Corrections) -> RayPartials:
    one = lambda e, point, measured: ray_partials(interior, e, point, measured, corrections)  # noqa: E731
    return jax.vmap(one)(exterior, points, xy)


@jit_quickly
def _direct_partials(sensors: SensorRows) -> DirectPartials:
    one = lambda s: direct_partials(s.station, s.roll_pitch_yaw, s.mount, s.bias, s.exposure)  # noqa: E731
    return jax.vmap(one)(sensors)
