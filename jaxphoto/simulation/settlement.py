"""Places of buildings and trees: given, or random within the area of a block."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError
from jaxphoto.simulation.buildings import Building, Roof, roof_height, wall_distance
from jaxphoto.simulation.convergent_plan import Field
from jaxphoto.simulation.flight_plan import Swaths
from jaxphoto.simulation.streams import stream
from jaxphoto.simulation.terrain import Terrain
from jaxphoto.simulation.trees import Tree

Range = tuple[float, float]
"""Smallest and largest of uniformly drawn sizes."""
# Minimum distance between two buildings, or a building and a crown (m).
_GAP_M = 2.0
# Places drawn at a time, and number of attempts, before a building or tree is given up.
_PLACES, _TRIES = 64, 20


@dataclasses.dataclass(frozen=True)
class Buildings:
    """Group of buildings with one kind of roof: `count` at random places, and those at `at_m` (X, Y).

    Each is level: `height_m` is that of the eaves above the ground at its centre.
    """

    roof: Roof = "flat"
    count: int = 0
    at_m: tuple[tuple[float, float], ...] = ()
    length_m: Range = (10.0, 30.0)
    width_m: Range = (8.0, 15.0)
    height_m: Range = (3.0, 9.0)
    slope_deg: Range = (20.0, 40.0)
    heading_deg: Range = (0.0, 360.0)


@dataclasses.dataclass(frozen=True)
class Trees:
    """Group of trees: `count` at random places, and those at `at_m` (X, Y)."""

    count: int = 0
    at_m: tuple[tuple[float, float], ...] = ()
    height_m: Range = (6.0, 20.0)
    radius_m: Range = (1.5, 4.0)


@dataclasses.dataclass(frozen=True)
class Settlement:
    """All groups of buildings and of trees."""

    buildings: tuple[Buildings, ...] = ()
    trees: tuple[Trees, ...] = ()

    def settled(self, terrain: Terrain, ground: Swaths | Field, seed: int) -> Terrain:
        """Return `terrain`, whose waves are `drawn`, with buildings and trees.

        Random buildings keep clear of all others and random crowns of buildings; crowns may overlap. Raises BlockError
        if there is no room.
        """
        seed = seed if terrain.seed is None else terrain.seed
        for number, group in enumerate(self.buildings):
            rng = stream(seed, f"buildings {number}")
            terrain = dataclasses.replace(terrain, buildings=terrain.buildings + _built(group, terrain, ground, rng))
        for number, row in enumerate(self.trees):
            rng = stream(seed, f"trees {number}")
            terrain = dataclasses.replace(terrain, trees=terrain.trees + _planted(row, terrain, ground, rng))
        return terrain


def _built(
    group: Buildings, terrain: Terrain, ground: Swaths | Field, rng: np.random.Generator
) -> tuple[Building, ...]:
    n = len(group.at_m) + group.count
    ranges = (group.length_m, group.width_m, group.height_m, group.slope_deg, group.heading_deg)
    length, width, height, slope, heading = (rng.uniform(*r, n) for r in ranges)
    radius = np.hypot(length, width) / 2
    centre, taken = list(map(np.array, group.at_m)), [np.array(b.centre_m) for b in terrain.buildings]
    radii = [b.radius_m for b in terrain.buildings]
    for k in range(len(centre), n):
        others, reach = np.array(taken + centre).reshape(-1, 2), np.array(radii + radius[:k].tolist())

        def free(xy: np.ndarray, others=others, reach=reach + radius[k] + _GAP_M) -> np.ndarray:
            return np.all(np.hypot(*(xy[:, None] - others).transpose(2, 0, 1)) > reach, axis=1)

        centre += list(_places(free, ground, rng, 1, f"{group.count} buildings"))
    foot = terrain.height(np.array(centre).reshape(-1, 2))
    return tuple(
        Building(
            (float(x), float(y)), float(heading[k]), float(length[k]), float(width[k]), float(foot[k] + height[k]),
            group.roof, 0.0 if group.roof == "flat" else float(slope[k]),
        )
        for k, (x, y) in enumerate(centre)
    )  # fmt: skip


def _planted(row: Trees, terrain: Terrain, ground: Swaths | Field, rng: np.random.Generator) -> tuple[Tree, ...]:
    n = len(row.at_m) + row.count
    height, radius = (rng.uniform(*r, n) for r in (row.height_m, row.radius_m))
    clearance = row.radius_m[1] + _GAP_M

    def free(xy: np.ndarray) -> np.ndarray:
        near_wall = np.isfinite(wall_distance(terrain.buildings, xy, clearance))
        return ~near_wall & np.isneginf(roof_height(terrain.buildings, xy))

    at = np.vstack([np.array(row.at_m).reshape(-1, 2), _places(free, ground, rng, row.count, f"{row.count} trees")])
    foot = terrain.height(at)
    return tuple(
        Tree((float(x), float(y)), float(foot[k]), float(height[k]), float(radius[k])) for k, (x, y) in enumerate(at)
    )


def _places(
    free: Callable[[np.ndarray], np.ndarray], ground: Swaths | Field, rng: np.random.Generator, n: int, what: str
) -> Float[np.ndarray, "n 2"]:
    """Return the first `n` free places."""
    found = np.zeros((0, 2))
    for _ in range(_TRIES):
        if len(found) >= n:
            return found[:n]
        xy = ground.draw(rng, max(_PLACES, 2 * n))
        found = np.vstack([found, xy[free(xy)]])
    raise BlockError(f"there is no room for {what} beside the other buildings; ask for fewer or smaller ones")
