"""Tie points and targets: where they lie, what they are called, which role they play."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.errors import BlockError
from jaxphoto.simulation.convergent_plan import Field
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.flight_plan import Swaths
from jaxphoto.simulation.recipe import Choice, Recipe, Role, TargetPlan
from jaxphoto.simulation.streams import stream
from jaxphoto.simulation.terrain import Terrain
from jaxphoto.simulation.visibility import Rays, photograph, unhidden

# Batches of places to try before a rule that finds too few points is given up.
_TRIES = 20


class TruePoints(NamedTuple):
    """The points, (points, 3) in m, and their rays without noise."""

    ids: tuple[str, ...]
    xyz: Float[np.ndarray, "points 3"]
    roles: tuple[Role, ...]
    is_target: Bool[np.ndarray, "points"]
    rays: Rays


def scatter(recipe: Recipe, flight: Flight, terrain: Terrain, seed: int) -> TruePoints:
    """Ties and targets of the recipe. Raises BlockError where images do not see them often enough."""
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
        given = _given(group, terrain, recipe.ground, rng)
        _check_seen(recipe, flight, terrain, given)
        places = np.vstack([given, _uniform(recipe, flight, terrain, group.count, rng)])
        begin = counts.get(group.prefix, 0)
        counts[group.prefix] = begin + len(places)
        ids += [f"{group.prefix}{begin + k + 1}" for k in range(len(places))]
        xyz.append(places)
        roles += _roles(group, places, recipe.ground)
    points = np.vstack(xyz)
    is_target = np.arange(len(points)) >= recipe.points.ties
    return TruePoints(tuple(ids), points, tuple(roles), is_target, _rays(recipe, flight, terrain, points))


def _rays(recipe: Recipe, flight: Flight, terrain: Terrain, xyz: np.ndarray) -> Rays:
    cameras = {name: camera.truth for name, camera in recipe.cameras.items()}
    rays = photograph(cameras, recipe.sensors, flight.cameras, flight.exterior, xyz, recipe.points.margin_mm)
    return unhidden(rays, flight.exterior, xyz, terrain.buildings)


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
    """Return the first `n` open places from `draw`, on ground or roofs, that enough images see."""
    found = np.zeros((0, 3))
    for _ in range(_TRIES):
        if len(found) >= n:
            break
        places = terrain.place(draw(n), rng)
        often = _rays(recipe, flight, terrain, places).per_point(n) >= recipe.points.min_images
        found = np.vstack([found, places[often & terrain.open(places[:, :2])]])
    if len(found) < n:
        raise BlockError(
            f"only {len(found)} of {n} points are seen in {recipe.points.min_images} images, of {_TRIES * n} tried; "
            "raise the overlaps or the number of images, or ask less of the points"
        )
    return found[:n]


def _given(group: TargetPlan, terrain: Terrain, ground: Swaths | Field, rng: np.random.Generator) -> np.ndarray:
    axes = ground.axes
    low, high = ground.extent(axes)
    parts = np.array(group.at, float).reshape(-1, 2)
    relative = ((low + high) / 2 + parts * (high - low) / 2) @ axes
    flat = np.array([place[:2] for place in group.at_m], float).reshape(-1, 2)
    given = terrain.place(np.vstack([relative, flat]), rng)
    for k, place in enumerate(group.at_m, start=len(relative)):
        given[k, 2:] = place[2:] or given[k, 2:]
    return given


def _check_seen(recipe: Recipe, flight: Flight, terrain: Terrain, xyz: np.ndarray) -> None:
    seen = _rays(recipe, flight, terrain, xyz).per_point(len(xyz))
    for k in np.flatnonzero(seen < recipe.points.min_images):
        x, y, _ = xyz[k]
        raise BlockError(
            f"the target at X {x:.1f} m, Y {y:.1f} m is seen in {seen[k]} image(s), not in {recipe.points.min_images}; "
            "move it inside the block"
        )


def _roles(group: TargetPlan, xyz: np.ndarray, ground: Swaths | Field) -> list[Role]:
    roles = [group.role] * len(xyz)
    if group.choice is not None:
        for k in _chosen(group.choice, xyz[:, :2], ground):
            roles[k] = group.choice.role
    return roles


def _chosen(choice: Choice, xy: np.ndarray, ground: Swaths | Field) -> list[int]:
    low, high = ground.extent(np.eye(2))
    xy = xy - (low + high) / 2
    chosen = list(range(min(choice.first, len(xy))))
    rankings = [(np.hypot(*xy.T), 1)] if choice.centre else []
    for ahead in ground.directions:
        rankings += [(xy @ ahead, choice.outermost), (-xy @ ahead, choice.outermost)]
    # One after the other, passing over those already chosen: every rule gets as many as it asks for.
    for rank, count in rankings:
        chosen += [int(k) for k in np.argsort(rank, kind="stable") if k not in chosen][:count]
    return chosen
