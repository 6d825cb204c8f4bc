"""Residuals of a batch of rays and their derivatives, in all slots at once.

A row involves one image, one point and the parameters of one camera. Rays are stored in chunks of one image, so
quantities that depend only on the image are computed once per chunk. Each column of the Jacobian is one forward
derivative of `image_residual`, mapped over chunks and rays. Arrays end in (m, p): chunks, rays of a chunk.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.adjustment.layout.padded import PaddedStructure
from jaxphoto.adjustment.model.camera_groups import CameraGroup, interior_of
from jaxphoto.adjustment.model.image_orientations import ImageOrientations, OrientationDerivatives
from jaxphoto.arrays import sum_terms
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, camera_residual
from jaxphoto.compiling import once
from jaxphoto.georeferencing import apparent_point


class RayMeasurements(NamedTuple):
    """Measurements of a batch, with weights 1 / sigma; zero in empty slots."""

    xy: Float[Array, "2 m p"]
    weight: Float[Array, "2 m p"]
    member: tuple[Bool[Array, "m"], ...]
    """For each camera group: True if the image's camera belongs to it."""


Pair = tuple[Float[Array, "*batches m p"], Float[Array, "*batches m p"]]
"""x and y of the rows of a batch, or of all rows. Two arrays: XLA does not vectorise operations that join them to one.
"""


Triple = tuple[Float[Array, "m p"], Float[Array, "m p"], Float[Array, "m p"]]
"""Coordinates of the points in the camera frames."""


class RayJacobian(NamedTuple):
    """Weighted residuals of rows, x or y, and their derivatives with respect to scaled increments; for points, in
    metres.
    """

    residual: Float[Array, "m p"]
    eop: Float[Array, "6 m p"]
    shared: Float[Array, "colours m p"]
    point: Float[Array, "3 m p"]


def points_at(numbers: Float[Array, "c points"], point: Array) -> Float[Array, "c m p"]:
    """Gather values of the points of rays."""
    return jnp.moveaxis(jnp.asarray(numbers).T.at[point].get(mode="promise_in_bounds"), -1, 0)


def seen_in(xy: Array, sigma: Array, image: Array, s: PaddedStructure) -> RayMeasurements:
    """Return the measurements of a batch."""
    return RayMeasurements(xy, 1 / sigma, tuple(jnp.asarray(g.member)[image] for g in s.groups))


def ray_residuals(
    scene: ImageOrientations, points: Float[Array, "3 m p"], seen: RayMeasurements, s: PaddedStructure
) -> Pair:
    """Evaluate the weighted residuals of a batch: observed minus computed over sigma."""
    return _residuals(
        [_leaves_of(c) for c in scene.cameras], _in_cameras(scene.centre, scene.rotation, points, seen, s), seen, s
    )


def _in_cameras(centre: Array, rotation: Array, points: Array, seen: RayMeasurements, s: PaddedStructure) -> Triple:
    """Transform points to the camera frames."""

    def one(centre, rotation, point, weight):
        aim = apparent_point(centre, point, s.corrections)
        # In an empty slot the point is on the optical axis: all values stay finite.
        aim = jnp.where(weight > 0, aim, centre - rotation[2])
        u, v, w = camera_coordinates(ExteriorOrientation(centre, rotation), aim)
        return u, v, w

    along_points = jax.vmap(one, (None, None, -1, -1), -1)
    return jax.vmap(along_points, (0, 0, 1, 0))(centre, rotation, points, seen.weight[0])


def _leaves_of(camera: Array) -> list[Array]:
    return list(jnp.moveaxis(camera, -1, 0))


def _residuals(cameras: list[list[Array]], in_camera: Triple, seen: RayMeasurements, s: PaddedStructure) -> Pair:
    parts = [_residuals_of(g, c, in_camera, seen) for g, c in zip(s.groups, cameras, strict=True)]
    # Without cameras there are only empty slots.
    x, y = parts[0] if parts else (0 * in_camera[0], 0 * in_camera[0])
    if len(parts) > 1:
        x, y = (
            sum_terms(jnp.where(own[:, None], v, 0.0) for own, v in zip(seen.member, of_groups, strict=True))
            for of_groups in zip(*parts, strict=True)
        )
    if s.image_loss is not None:
        x, y = s.image_loss.reduced(x, y)
    return x, y


def _residuals_of(g: CameraGroup, camera: list[Array], in_camera: Triple, seen: RayMeasurements) -> Pair:
    def one(camera, in_camera, xy, weight):
        x, y = camera_residual(interior_of(g, camera), in_camera, xy)
        return x * weight[0], y * weight[1]

    along_points = jax.vmap(one, (None, -1, -1, -1), -1)
    whose = None if camera[0].ndim == 0 else 0
    return jax.vmap(along_points, (whose, 0, 1, 1))(camera, in_camera, seen.xy, seen.weight)


def ray_jacobian(
    scene: ImageOrientations,
    slopes: OrientationDerivatives,
    points: Float[Array, "3 m p"],
    seen: RayMeasurements,
    s: PaddedStructure,
) -> tuple[RayJacobian, RayJacobian]:
    """Evaluate residuals and Jacobian of a batch, x and y, by the chain rule through the camera frames."""
    centre, rotation, unit = scene.centre, scene.rotation, jnp.eye(3)
    # Use one loop for all six derivatives: XLA does not vectorise a loop over arrays that are joined afterwards.
    zero, turns = jnp.zeros((3, *rotation.shape)), jnp.moveaxis(slopes.rotation, -1, 0)
    seeds = jnp.concatenate([unit[:, None] * slopes.centre, zero[:, :, 0]]), jnp.concatenate([zero, turns])
    # jit caches the trace for all derivatives below.
    place = jax.jit(partial(_in_cameras, seen=seen, s=s))
    by_eop = _slope(lambda *x: place(*x, points), centre, rotation)(*seeds)
    by_point = _by_point(lambda x: place(centre, rotation, x), points, s)
    residual, by_place, by_camera = once(
        partial(_camera_columns, s=s), s.eop_free, scene.cameras, slopes.cameras, place(centre, rotation, points), seen
    )

    def of_one(k: int) -> RayJacobian:
        eop, point = (sum_terms(b[k] * v for b, v in zip(by_place, moved, strict=True)) for moved in (by_eop, by_point))
        return RayJacobian(residual[k], eop, by_camera[k], point)

    return of_one(0), of_one(1)


def _by_point(place: Callable, points: Float[Array, "3 m p"], s: PaddedStructure):
    """Differentiate the coordinates in the camera frames with respect to the points; empty if all points are fixed."""
    if not s.rays.free_points:
        return tuple(jnp.zeros((3, *v.shape)) for v in jax.eval_shape(place, points))
    return _slope(place, points)(jnp.broadcast_to(jnp.eye(3)[:, :, None, None], (3, *points.shape)))


def _camera_columns(
    cameras: tuple[Array, ...], slopes: tuple[Array, ...], in_camera: Triple, seen: RayMeasurements, s: PaddedStructure
):
    """Evaluate residuals and their derivatives with respect to the point in the camera frame and to the camera
    unknowns.
    """
    leaves = [_leaves_of(c) for c in cameras]
    # Only free parameters: XLA would compute the other derivatives although they are zero.
    free = [[own[k] for k in g.free_leaves] for g, own in zip(s.groups, leaves, strict=True)]

    def with_free(free):
        new = [dict(zip(g.free_leaves, f, strict=True)) for g, f in zip(s.groups, free, strict=True)]
        return [[of_group.get(k, v) for k, v in enumerate(own)] for of_group, own in zip(new, leaves, strict=True)]

    f = jax.jit(lambda free, in_camera: _residuals(with_free(free), in_camera, seen, s))

    def along(k: int) -> Pair:
        move = lambda x: f(free, (*in_camera[:k], x, *in_camera[k + 1 :]))  # noqa: E731
        return jax.jvp(move, (in_camera[k],), (jnp.ones_like(in_camera[k]),))[1]

    by_camera = (jnp.zeros((0, *in_camera[0].shape)),) * 2
    if s.n_image_colours:
        by_camera = _slope(lambda x: f(x, in_camera), free)([_leaves_of(jnp.moveaxis(c, -2, 0)) for c in slopes])
    return f(free, in_camera), tuple(map(along, range(3))), by_camera


def _slope(function: Callable, *x: Any) -> Callable:
    """Return a function from directions (leading axis) to derivatives of `function` at `x`."""
    return jax.vmap(lambda *d: jax.jvp(function, x, d)[1])
