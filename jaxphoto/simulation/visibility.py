"""Visibility of points in images, without noise; buildings hide points, trees and terrain do not."""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.simulation.buildings import Building, entered, solids
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.nearby import pairs_along

_CHUNK = 1024
# Images times points processed at a time: bounds the memory.
_PAIRS = 2_000_000
# Grid of the format, per side, on which the range of ideal coordinates is determined; 31 x 31 fill a chunk.
_PLACES = 31
# Obstacles closer than this (m) to a point do not hide it: a roof does not hide its own points.
_ON_IT_M = 1e-3


class Rays(NamedTuple):
    """Measured coordinates (mm from the image centre) of points in images, sorted by point, then image."""

    image: Int[np.ndarray, "rays"]
    point: Int[np.ndarray, "rays"]
    xy: Float[np.ndarray, "rays 2"]

    def take(self, chosen: np.ndarray) -> "Rays":
        """Select rays by mask or indices."""
        return Rays(self.image[chosen], self.point[chosen], self.xy[chosen])

    def per_point(self, n: int) -> Int[np.ndarray, "points"]:
        """Return the number of images of each of `n` points."""
        return np.bincount(self.point, minlength=n)


def photograph(
    cameras: Mapping[str, InteriorOrientation],
    sensors: Mapping[str, Sensor],
    image_camera: Sequence[str],
    exterior: ExteriorOrientation,
    points: Float[np.ndarray, "points 3"],
    margin_mm: float = 0.0,
) -> Rays:
    """Return the rays of all visible points.

    A point is visible if its direction has an image (`AbstractProjection.sees`; in front of a perspective camera), the
    distortion is invertible (`InteriorOrientation.invertible`), and it is inside the format by more than `margin_mm`.
    Coordinates are those of `jaxphoto.collinearity.project`.
    """
    at_once = max(1, _PAIRS // max(len(image_camera), 1))
    begins = range(0, max(len(points), 1), at_once)
    parts = [_photograph(cameras, sensors, image_camera, exterior, points[k : k + at_once], margin_mm) for k in begins]
    point = [part.point + begin for part, begin in zip(parts, begins, strict=True)]
    return Rays(
        np.concatenate([part.image for part in parts]), np.concatenate(point), np.concatenate([p.xy for p in parts])
    )


def _photograph(
    cameras: Mapping[str, InteriorOrientation],
    sensors: Mapping[str, Sensor],
    image_camera: Sequence[str],
    exterior: ExteriorOrientation,
    points: Float[np.ndarray, "points 3"],
    margin_mm: float,
) -> Rays:
    """Apply `photograph` to all points at once."""
    position, matrix = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)
    # (images, points, 3), in the camera frame
    seen = np.einsum("kij,knj->kni", matrix, points[None] - position[:, None])
    found = []
    for name, interior in cameras.items():
        sensor = sensors[name]
        interior = jax.tree.map(np.float64, interior)
        half = np.array([sensor.width_mm, sensor.height_mm]) / 2
        own = np.flatnonzero([camera == name for camera in image_camera])
        direction = np.moveaxis(seen[own], -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = np.stack(interior.projection.ideal_from_direction(float(interior.c), *direction), axis=-1)
        mine = np.asarray(interior.projection.sees(*direction))
        image, point = np.nonzero(mine & (np.abs(ideal) <= _reach(interior, half)).all(axis=2))
        if not len(image):
            continue
        xy, valid = in_chunks(functools.partial(_measured, interior), _CHUNK, ideal[image, point])
        found.append(Rays(own[image], point, xy).take(valid & (np.abs(xy) < half - margin_mm).all(axis=1)))
    if not found:
        return Rays(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    rays = Rays(*(np.concatenate(part) for part in zip(*found, strict=True)))
    return rays.take(np.lexsort((rays.image, rays.point)))


def _reach(interior: InteriorOrientation, half: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return bounds of |ideal coordinates| on the format, so that the distortion is not evaluated for every pair."""
    grid = np.stack(np.meshgrid(*np.linspace(-half, half, _PLACES).T), axis=-1).reshape(-1, 2)
    ideal = np.abs(in_chunks(functools.partial(_ideal, interior), _CHUNK, grid))
    return 1.05 * np.max(ideal, axis=0, initial=0.0, where=np.isfinite(ideal))


@jax.jit
def _ideal(interior: InteriorOrientation, measured):
    return jax.vmap(interior.ideal_from_measured)(measured)


@jax.jit
def _measured(interior: InteriorOrientation, ideal):
    each = jax.vmap(lambda xy: (interior.measured_from_ideal(xy), interior.invertible(xy)))
    return each(ideal)


def unhidden(
    rays: Rays, exterior: ExteriorOrientation, points: Float[np.ndarray, "points 3"], buildings: tuple[Building, ...]
) -> Rays:
    """Remove rays that a building blocks."""
    if not buildings or not len(rays.point):
        return rays
    origin, end = np.asarray(exterior.position)[rays.image], points[rays.point]
    length = np.linalg.norm(end - origin, axis=1)
    direction = (end - origin) / length[:, None]
    planes = solids(buildings)
    which, ray = pairs_along(end, direction, planes.centre, planes.radius, planes.top)
    met = np.minimum(*entered(planes, which, origin[ray], direction[ray])) < length[ray] - _ON_IT_M
    hidden = np.zeros(len(length), bool)
    hidden[ray[met]] = True
    return rays.take(~hidden)


def thinned(rays: Rays, n_points: int, min_images: int, mean_rays: float, rng: np.random.Generator) -> Rays:
    """Remove rays at random until points have `mean_rays` on average; each keeps at least `min_images`."""
    surplus = len(rays.point) - round(mean_rays * n_points)
    if surplus <= 0:
        return rays
    order = np.lexsort((rng.random(len(rays.point)), rays.point))
    begin = np.concatenate([[0], np.cumsum(rays.per_point(n_points))[:-1]])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - begin[rays.point[order]]
    spare = rng.permutation(np.flatnonzero(rank >= min_images))
    return rays.take(np.setdiff1d(np.arange(len(order)), spare[:surplus]))
