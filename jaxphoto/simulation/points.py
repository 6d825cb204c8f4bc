"""Simulated tie points and targets: positions, names, roles, and visibility in the images.

Buildings occlude points; trees and terrain do not.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.plans import Field, Swaths
from jaxphoto.simulation.recipe import Choice, Recipe, Role, TargetPlan
from jaxphoto.simulation.sampling import in_chunks, stream
from jaxphoto.simulation.scene import Building, Terrain, entry_distances, pairs_along, solids

_CHUNK = 1024
# Maximum number of image-point pairs processed at a time; limits memory.
_PAIRS = 2_000_000
# Grid size per side for the range of ideal coordinates over the format; 31 x 31 points fill a chunk.
_PLACES = 31
# Minimum distance (m) of an obstacle from a point it occludes: a roof does not occlude its own points.
_ON_IT_M = 1e-3


class Rays(NamedTuple):
    """Measured image coordinates (mm from the image centre), sorted by point, then image."""

    image: Int[np.ndarray, "rays"]
    point: Int[np.ndarray, "rays"]
    xy: Float[np.ndarray, "rays 2"]

    def take(self, chosen: np.ndarray) -> "Rays":
        """Select rays by mask or indices."""
        return Rays(self.image[chosen], self.point[chosen], self.xy[chosen])

    def per_point(self, n: int) -> Int[np.ndarray, "points"]:
        """Return the number of images for each of `n` points."""
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
    The projection is `jaxphoto.collinearity.project`.
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
    """Apply `photograph` to all points without chunks."""
    position, matrix = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)
    # axes: (images, points, 3), in the camera frame
    in_camera = np.einsum("kij,knj->kni", matrix, points[None] - position[:, None])
    parts = []
    for name, interior in cameras.items():
        sensor = sensors[name]
        interior = jax.tree.map(np.float64, interior)
        half = np.array([sensor.width_mm, sensor.height_mm]) / 2
        images = np.flatnonzero([camera == name for camera in image_camera])
        direction = np.moveaxis(in_camera[images], -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = np.stack(interior.projection.ideal_from_direction(float(interior.c), *direction), axis=-1)
        visible = np.asarray(interior.projection.sees(*direction))
        image, point = np.nonzero(visible & (np.abs(ideal) <= _reach(interior, half)).all(axis=2))
        if not len(image):
            continue
        xy, valid = in_chunks(functools.partial(_measured, interior), _CHUNK, ideal[image, point])
        parts.append(Rays(images[image], point, xy).take(valid & (np.abs(xy) < half - margin_mm).all(axis=1)))
    if not parts:
        return Rays(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    rays = Rays(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return rays.take(np.lexsort((rays.image, rays.point)))


def _reach(interior: InteriorOrientation, half: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return the maximum of |ideal coordinates| over the format, to evaluate the distortion only for candidates."""
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


def remove_hidden(
    rays: Rays, exterior: ExteriorOrientation, points: Float[np.ndarray, "points 3"], buildings: tuple[Building, ...]
) -> Rays:
    """Remove rays occluded by a building."""
    if not buildings or not len(rays.point):
        return rays
    origin, end = np.asarray(exterior.position)[rays.image], points[rays.point]
    length = np.linalg.norm(end - origin, axis=1)
    direction = (end - origin) / length[:, None]
    planes = solids(buildings)
    which, ray = pairs_along(end, direction, planes.centre, planes.radius, planes.top)
    met = np.minimum(*entry_distances(planes, which, origin[ray], direction[ray])) < length[ray] - _ON_IT_M
    hidden = np.zeros(len(length), bool)
    hidden[ray[met]] = True
    return rays.take(~hidden)


def thin_rays(rays: Rays, n_points: int, min_images: int, mean_rays: float, rng: np.random.Generator) -> Rays:
    """Remove rays at random down to an average of `mean_rays` per point; each point retains at least `min_images`."""
    surplus = len(rays.point) - round(mean_rays * n_points)
    if surplus <= 0:
        return rays
    order = np.lexsort((rng.random(len(rays.point)), rays.point))
    begin = np.concatenate([[0], np.cumsum(rays.per_point(n_points))[:-1]])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - begin[rays.point[order]]
    spare = rng.permutation(np.flatnonzero(rank >= min_images))
    return rays.take(np.setdiff1d(np.arange(len(order)), spare[:surplus]))


# Maximum number of batches of positions.
_TRIES = 20


class TruePoints(NamedTuple):
    """Points (m) and their rays without noise."""

    ids: tuple[str, ...]
    xyz: Float[np.ndarray, "points 3"]
    roles: tuple[Role, ...]
    is_target: Bool[np.ndarray, "points"]
    rays: Rays


def scatter(recipe: Recipe, flight: Flight, terrain: Terrain, seed: int) -> TruePoints:
    """Draw ties and targets of the recipe. Raises BlockError if too few images see them."""
    rng = stream(seed, "ties")
    ids = [f"{k + 1}" for k in range(recipe.points.ties)]
    on_roofs = round(recipe.points.on_roofs * len(ids)) if terrain.buildings else 0
    roofs = stream(seed, "ties on roofs")
    xyz = [
        _uniform(recipe, flight, terrain, len(ids) - on_roofs, rng),
        _seen_often(recipe, flight, terrain, on_roofs, roofs, lambda n: terrain.on_roofs(roofs, n)),
    ]
    roles: list[Role] = ["tie"] * len(ids)
    counts: dict[str, int] = {}
    for number, group in enumerate(recipe.targets):
        rng = stream(seed, f"targets {number}")
        stated = _given(group, terrain, recipe.ground, rng)
        often = _rays(recipe, flight, terrain, stated).per_point(len(stated))
        for k in np.flatnonzero(often < recipe.points.min_images):
            raise BlockError(
                f"the target at X {stated[k, 0]:.1f} m, Y {stated[k, 1]:.1f} m is seen in {often[k]} image(s), not in "
                f"{recipe.points.min_images}; move it inside the block"
            )
        places = np.vstack([stated, _uniform(recipe, flight, terrain, group.count, rng)])
        begin = counts.get(group.prefix, 0)
        counts[group.prefix] = begin + len(places)
        ids += [f"{group.prefix}{begin + k + 1}" for k in range(len(places))]
        xyz.append(places)
        roles += [group.role] * len(places)
        if group.choice is not None:
            for target in _chosen(group.choice, places[:, :2], recipe.ground):
                roles[target - len(places)] = group.choice.role
    points = np.vstack(xyz)
    is_target = np.arange(len(points)) >= recipe.points.ties
    return TruePoints(tuple(ids), points, tuple(roles), is_target, _rays(recipe, flight, terrain, points))


def _rays(recipe: Recipe, flight: Flight, terrain: Terrain, xyz: np.ndarray) -> Rays:
    cameras = {name: camera.truth for name, camera in recipe.cameras.items()}
    rays = photograph(cameras, recipe.sensors, flight.cameras, flight.exterior, xyz, recipe.points.margin_mm)
    return remove_hidden(rays, flight.exterior, xyz, terrain.buildings)


def _uniform(recipe: Recipe, flight: Flight, terrain: Terrain, n: int, rng: np.random.Generator) -> np.ndarray:
    return _seen_often(recipe, flight, terrain, n, rng, lambda n: recipe.ground.draw(rng, n))


def _seen_often(
    recipe: Recipe,
    flight: Flight,
    terrain: Terrain,
    n: int,
    rng: np.random.Generator,
    draw: Callable[[int], np.ndarray],
) -> np.ndarray:
    """Return the first `n` positions from `draw`, on open ground or roofs, that are visible in enough images."""
    result = np.zeros((0, 3))
    for _ in range(_TRIES):
        if len(result) >= n:
            break
        places = terrain.place(draw(n), rng)
        often = _rays(recipe, flight, terrain, places).per_point(n) >= recipe.points.min_images
        result = np.vstack([result, places[often & terrain.open(places[:, :2])]])
    if len(result) < n:
        raise BlockError(
            f"only {len(result)} of {n} points are seen in {recipe.points.min_images} images, of {_TRIES * n} tried; "
            "raise the overlaps or the number of images, or require fewer images per point"
        )
    return result[:n]


def _given(group: TargetPlan, terrain: Terrain, ground: Swaths | Field, rng: np.random.Generator) -> np.ndarray:
    axes = ground.axes
    low, high = ground.extent(axes)
    parts = np.array(group.at, float).reshape(-1, 2)
    relative = ((low + high) / 2 + parts * (high - low) / 2) @ axes
    flat = np.array([place[:2] for place in group.at_m], float).reshape(-1, 2)
    places = terrain.place(np.vstack([relative, flat]), rng)
    for k, place in enumerate(group.at_m, start=len(relative)):
        places[k, 2:] = place[2:] or places[k, 2:]
    return places


def _chosen(choice: Choice, xy: np.ndarray, ground: Swaths | Field) -> list[int]:
    low, high = ground.extent(np.eye(2))
    xy = xy - (low + high) / 2
    chosen = list(range(min(choice.first, len(xy))))
    rankings = [(np.hypot(*xy.T), 1)] if choice.centre else []
    for ahead in ground.directions:
        rankings += [(xy @ ahead, choice.outermost), (-xy @ ahead, choice.outermost)]
    # Apply the rules in order, excluding points already chosen, so each rule yields its full count.
    for rank, count in rankings:
        chosen += [int(k) for k in np.argsort(rank, kind="stable") if k not in chosen][:count]
    return chosen
