"""Simulated scenes: buildings (upright prisms over rectangles with flat, gable or monopitch roofs), trees, terrain.

Each building is convex, the intersection of six half-spaces `normal . X <= offset`: walls, and one or two roof planes.
Roof heights and ray intersections are computed from these.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import BlockError
from jaxphoto.short_repr import pretty_repr
from jaxphoto.simulation.plans import Field, Swaths
from jaxphoto.simulation.sampling import stream

Pairs = tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]
"""Index of the object, and of the position or ray."""


def pairs_near(
    xy: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "m 2"], radius: Float[np.ndarray, "m"], more_m: float = 0.0
) -> Pairs:
    """Return all pairs of a circle and a position within its `radius` plus `more_m` (m); sorted by circle."""
    if not len(xy) or not len(centre):
        return np.zeros(0, int), np.zeros(0, int)
    # Slightly enlarged: the caller decides about the boundary.
    places = scipy.spatial.KDTree(xy).query_ball_point(centre, radius + more_m + 1e-6)
    circle = np.repeat(np.arange(len(centre)), [len(of) for of in places])
    return circle, np.concatenate(places).astype(int)


def pairs_along(
    end: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, "m"],
    top: Float[np.ndarray, "m"],
) -> Pairs:
    """Return pairs of an upright cylinder up to Z = `top` (m) and a ray that may pass it on its way to `end`."""
    if not len(end):
        return np.zeros(0, int), np.zeros(0, int)
    slant = np.max(np.hypot(*direction[:, :2].T) / -direction[:, 2])
    return pairs_near(end[:, :2], centre, radius, float(slant * max(top.max() - end[:, 2].min(), 0.0)))


Roof = Literal["flat", "gable", "monopitch"]
"""Roof shapes: level; two sides with a ridge over the centre line; one side that rises to the right."""
ROOFS: tuple[Roof, ...] = ("flat", "gable", "monopitch")
# The first faces of a building are its walls.
_WALLS = 4


@dataclasses.dataclass(frozen=True)
class Building:
    """Rectangle of `length_m` along `heading_deg` (from north) by `width_m` across, about `centre_m` (X, Y).

    The eaves (of a monopitch roof: on its left) are at Z = `eaves_m`; from there the roof rises by `slope_deg`.
    """

    centre_m: tuple[float, float]
    heading_deg: float
    length_m: float
    width_m: float
    eaves_m: float
    roof: Roof = "flat"
    slope_deg: float = 0.0

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Return unit vectors (east, north): along the building, and to its right."""
        heading = np.deg2rad(self.heading_deg)
        return np.array([[np.sin(heading), np.cos(heading)], [np.cos(heading), -np.sin(heading)]])

    @property
    def half(self) -> Float[np.ndarray, "2"]:
        """Return half the length and half the width (m)."""
        return np.array([self.length_m, self.width_m]) / 2

    @property
    def radius_m(self) -> float:
        """Return the distance from the centre to a corner (m)."""
        return float(np.hypot(*self.half))


class Solids(NamedTuple):
    """Buildings as bounding planes."""

    centre: Float[np.ndarray, "buildings 2"]
    radius: Float[np.ndarray, "buildings"]
    top: Float[np.ndarray, "buildings"]
    """Z of the ridge (m)."""
    normal: Float[np.ndarray, "buildings 6 3"]
    """Outward normals: four walls (unit length); two roof sides with Z component 1 (a single side is repeated)."""
    offset: Float[np.ndarray, "buildings 6"]


@functools.lru_cache(maxsize=4)
def solids(buildings: tuple[Building, ...]) -> Solids:
    """Return the planes that bound `buildings`."""
    each = [_planes(b) for b in buildings]
    centre = np.array([b.centre_m for b in buildings]).reshape(-1, 2)
    radius = np.array([b.radius_m for b in buildings])
    normal = np.array([normal for normal, _ in each]).reshape(-1, _WALLS + 2, 3)
    offset = np.array([offset for _, offset in each]).reshape(-1, _WALLS + 2)
    rise = [b.width_m * np.tan(np.deg2rad(b.slope_deg)) / (2 if b.roof == "gable" else 1) for b in buildings]
    top = np.array([b.eaves_m + (0.0 if b.roof == "flat" else r) for b, r in zip(buildings, rise, strict=True)])
    return Solids(centre, radius, top, normal, offset)


def roof_height(buildings: tuple[Building, ...], xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Return Z (m) of the roofs above positions (east, north); minus infinity without a roof."""
    z = np.full(len(xy), -np.inf)
    if buildings:
        all_of_them = solids(buildings)
        which, place = pairs_near(xy, all_of_them.centre, all_of_them.radius)
        normal, offset = all_of_them.normal[which], all_of_them.offset[which]
        left = offset - np.einsum("nkj,nj->nk", normal[..., :2], xy[place])
        inside = np.all(left[:, :_WALLS] >= 0, axis=1)
        np.maximum.at(z, place[inside], left[inside, _WALLS:].min(axis=1))
    return z


def wall_distance(
    buildings: tuple[Building, ...], xy: Float[np.ndarray, "n 2"], within_m: float
) -> Float[np.ndarray, "n"]:
    """Return the horizontal distance (m) to the nearest wall, from inside or outside; infinity beyond `within_m`."""
    nearest = np.full(len(xy), np.inf)
    if buildings:
        which, place = pairs_near(xy, *solids(buildings)[:2], within_m)
        axes, half = (np.stack([getattr(b, name) for b in buildings]) for name in ("axes", "half"))
        centre = np.array([b.centre_m for b in buildings])
        beyond = np.abs(np.einsum("nij,nj->ni", axes[which], xy[place] - centre[which])) - half[which]
        outside = np.hypot(*np.maximum(beyond, 0).T)
        distance = np.where(np.all(beyond < 0, axis=1), -beyond.max(axis=1), outside)
        near = distance <= within_m
        np.minimum.at(nearest, place[near], distance[near])
    return nearest


def entry_distances(
    planes: Solids, which: Int[np.ndarray, "n"], origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the distances at which rays enter building `which` through a roof, and through a wall; infinity if never.

    Source: Cyrus and Beck (1978), clipping of a line by a convex polyhedron.
    """
    normal = planes.normal[which]
    towards = np.einsum("nkj,nj->nk", normal, direction)
    left = planes.offset[which] - np.einsum("nkj,nj->nk", normal, origin)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = left / towards
    into = np.where(towards < 0, at, -np.inf)
    out_of = np.where(towards > 0, at, np.inf).min(axis=1)
    beside = np.any((towards == 0) & (left < 0), axis=1)
    face = into.argmax(axis=1)
    begin = np.take_along_axis(into, face[:, None], axis=1)[:, 0]
    hits = (begin <= out_of) & (begin >= 0) & ~beside
    roof = face >= _WALLS
    return np.where(hits & roof, begin, np.inf), np.where(hits & ~roof, begin, np.inf)


def _planes(b: Building) -> tuple[np.ndarray, np.ndarray]:
    along, right = b.axes
    half, centre = b.half, np.array(b.centre_m)
    walls = np.stack([along, -along, right, -right])
    reach = walls @ centre + np.repeat(half, 2)
    slope = np.tan(np.deg2rad(b.slope_deg))
    # Downward gradient in X and Y; `middle` is the height at the centre line.
    falls = {"flat": (0 * right, 0 * right), "gable": (slope * right, -slope * right)}.get(
        b.roof, (-slope * right,) * 2
    )
    middle = b.eaves_m + (0.0 if b.roof == "flat" else slope * half[1])
    normal = np.vstack([np.column_stack([walls, np.zeros(_WALLS)]), np.column_stack([np.stack(falls), np.ones(2)])])
    return normal, np.concatenate([reach, middle + np.stack(falls) @ centre])


# Trees: upright ellipsoidal crowns, which laser pulses penetrate.
#
# A pulse hits leaves after exponentially distributed distances within crowns; each hit gives a return, and half of the
# pulses continue.

# Height of the crown's base as a fraction of the tree's height.
_BARE = 0.3
# Mean path between leaves (m); maximum number of returns of a pulse from crowns.
_WAY_M = 2.5
_RETURNS = 3


@dataclasses.dataclass(frozen=True)
class Tree:
    """Tree at `at_m` (X, Y) on ground of Z = `foot_m`, `height_m` high, with a crown of `radius_m`."""

    at_m: tuple[float, float]
    foot_m: float
    height_m: float
    radius_m: float


class Leaves(NamedTuple):
    """Hits of leaves: index of the pulse, distance along its ray (m); mask of the pulses that ended there."""

    pulse: Int[np.ndarray, "returns"]
    at: Float[np.ndarray, "returns"]
    stopped: Bool[np.ndarray, "pulses"]


def crowns(trees: Sequence[Tree]) -> tuple[Float[np.ndarray, "trees 3"], Float[np.ndarray, "trees 3"]]:
    """Return centres and half axes (m) of the ellipsoidal crowns of `trees`."""
    upright = [(1 - _BARE) / 2 * t.height_m for t in trees]
    centre = [(*t.at_m, t.foot_m + t.height_m - up) for t, up in zip(trees, upright, strict=True)]
    half = [(t.radius_m, t.radius_m, up) for t, up in zip(trees, upright, strict=True)]
    return np.array(centre).reshape(-1, 3), np.array(half).reshape(-1, 3)


def under_crown(trees: Sequence[Tree], xy: Float[np.ndarray, "n 2"], margin_m: float) -> Bool[np.ndarray, "n"]:
    """Return True if a position (east, north) lies under a crown or within `margin_m` of one."""
    under = np.zeros(len(xy), bool)
    if trees:
        centre, half = crowns(trees)
        under[pairs_near(xy, centre[:, :2], half[:, 0], margin_m)[1]] = True
    return under


def intersect_crowns(
    trees: Sequence[Tree],
    origin: Float[np.ndarray, "pulses 3"],
    direction: Float[np.ndarray, "pulses 3"],
    end: Float[np.ndarray, "pulses"],
    rng: np.random.Generator,
) -> Leaves:
    """Return the hits of pulses in crowns along unit vectors, before their `end` (distance in m).

    Where crowns overlap, path lengths add up, as if leaves were twice as dense.
    """
    pulse, into, way = _chords(trees, origin, direction, end)
    order = np.lexsort((into, pulse))
    pulse, into, way = pulse[order], into[order], way[order]
    # Concatenate the paths of all pulses within crowns to one line, for lookup by accumulated path length.
    line = np.concatenate([[0.0], np.cumsum(way)])
    which, first, count = np.unique(pulse, return_index=True, return_counts=True)
    begin, length = line[first], line[first + count] - line[first]
    gone, on = np.zeros(len(which)), np.ones(len(which), bool)
    returns = []
    for _ in range(_RETURNS):
        gone = gone + rng.exponential(_WAY_M, len(which))
        stays = rng.random(len(which)) < 0.5
        meets = on & (gone < length)
        place = begin[meets] + gone[meets]
        chord = np.clip(np.searchsorted(line, place, side="right") - 1, 0, len(way) - 1)
        returns.append((which[meets], into[chord] + place - line[chord]))
        on &= ~(meets & stays)
    stopped = np.zeros(len(origin), bool)
    stopped[which[~on]] = True
    pulses, at = (np.concatenate(part) for part in zip(*returns, strict=True))
    return Leaves(pulses, at, stopped)


def _chords(
    trees: Sequence[Tree], origin: np.ndarray, direction: np.ndarray, end: np.ndarray
) -> tuple[Int[np.ndarray, "chords"], Float[np.ndarray, "chords"], Float[np.ndarray, "chords"]]:
    """Return the pulse, the distance (m) at which it enters a crown, and its path length (m) within."""
    if not trees:
        return np.zeros(0, int), np.zeros(0), np.zeros(0)
    centre, half = crowns(trees)
    ends = origin + end[:, None] * direction
    tree, pulse = pairs_along(ends, direction, centre[:, :2], half[:, 0], centre[:, 2] + half[:, 2])
    # Intersection with the unit sphere: |q + t e|^2 = 1.
    q, e = (origin[pulse] - centre[tree]) / half[tree], direction[pulse] / half[tree]
    ee, qe, qq = (np.einsum("ni,ni->n", a, b) for a, b in ((e, e), (q, e), (q, q)))
    root = np.sqrt(np.maximum(qe**2 - ee * (qq - 1), 0))
    into, out_of = (-qe - root) / ee, np.minimum((-qe + root) / ee, end[pulse])
    within = out_of > into
    return pulse[within], into[within], (out_of - into)[within]


# Minimum distance (m) of points from walls and crowns.
_CLEARANCE_M = 1.0


@dataclasses.dataclass(frozen=True)
class Wave:
    """`amplitude_m sin(2 pi d / length_m + phase_deg)`, d the distance (m) towards `heading_deg` (from north)."""

    amplitude_m: float
    length_m: float
    heading_deg: float = 90.0
    phase_deg: float = 0.0


@dataclasses.dataclass(frozen=True)
class RandomWaves:
    """Random waves with a given total root mean square height: random headings, phases and lengths.

    Lengths are log-uniformly distributed between half and twice `length_m`.
    """

    count: int
    rms_m: float
    length_m: float

    def draw(self, rng: np.random.Generator) -> tuple[Wave, ...]:
        """Draw headings, phases and lengths of the waves."""
        heading, phase = rng.uniform(0, 360, (2, self.count))
        length = self.length_m * 2.0 ** rng.uniform(-1, 1, self.count)
        amplitude = self.rms_m * np.sqrt(2 / self.count)
        return tuple(Wave(amplitude, *row) for row in np.stack([length, heading, phase], axis=1).tolist())


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Terrain:
    """Z = height + slope . (X, Y) + waves, with an independent uniform roughness of +- `roughness_m` at every point.

    `slope` is in metres per metre to the east and to the north. If `seed` is given, random waves, buildings and trees
    do not depend on the simulation's seed.
    """

    height_m: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[Wave, ...] = ()
    roughness_m: float = 0.0
    random: RandomWaves | None = None
    seed: int | None = None
    buildings: tuple[Building, ...] = ()
    trees: tuple[Tree, ...] = ()

    def drawn(self, rng: np.random.Generator) -> "Terrain":
        """Return the terrain with its random waves drawn."""
        if self.random is None:
            return self
        rng = rng if self.seed is None else np.random.default_rng(self.seed)
        return dataclasses.replace(self, waves=self.waves + self.random.draw(rng), random=None)

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return Z (m) of the smooth ground at (east, north); draw random waves first (`drawn`)."""
        z = self.height_m + xy @ np.array(self.slope)
        for wave in self.waves:
            heading = np.deg2rad(wave.heading_deg)
            distance = xy @ np.array([np.sin(heading), np.cos(heading)])
            z = z + wave.amplitude_m * np.sin(2 * np.pi * distance / wave.length_m + np.deg2rad(wave.phase_deg))
        return z

    def surface(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return Z (m) of the smooth ground or the roof above it, at (east, north)."""
        return np.maximum(self.height(xy), roof_height(self.buildings, xy))

    def open(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return True for positions (east, north) at least 1 m from walls and crowns, on ground or roof."""
        near_wall = np.isfinite(wall_distance(self.buildings, xy, _CLEARANCE_M))
        return ~near_wall & ~under_crown(self.trees, xy, _CLEARANCE_M)

    def place(self, xy: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
        """Return points (m) on the rough ground, or on smooth roofs, at (east, north)."""
        rough = rng.uniform(-1, 1, len(xy)) * self.roughness_m
        return np.column_stack([xy, np.maximum(self.height(xy) + rough, roof_height(self.buildings, xy))])

    def on_roofs(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Draw positions (east, north) uniformly over the roofs, at least 1 m from their edges; requires a building."""
        half = np.maximum(np.stack([b.half for b in self.buildings]) - 1.01 * _CLEARANCE_M, 0)
        area = half.prod(axis=1)
        which = rng.choice(len(half), n, p=area / area.sum() if area.any() else None)
        axes = np.stack([b.axes for b in self.buildings])[which]
        centre = np.array([b.centre_m for b in self.buildings])[which]
        return centre + np.einsum("ni,nij->nj", rng.uniform(-1, 1, (n, 2)) * half[which], axes)


ROLLING = Terrain(
    waves=(Wave(14.0, 2 * np.pi * 420.0, 90.0), Wave(10.0, 2 * np.pi * 310.0, 0.0, 90.0)), roughness_m=6.0
)
"""14 sin(X / 420 m) + 10 cos(Y / 310 m) +- 6 m: hills of about 57 m between extremes."""


Range = tuple[float, float]
"""Minimum and maximum of uniformly drawn sizes."""
# Minimum distance between two buildings, or a building and a crown (m).
_GAP_M = 2.0
# Number of positions per attempt, and maximum number of attempts for a building or tree.
_PLACES, _TRIES = 64, 20


@dataclasses.dataclass(frozen=True)
class Buildings:
    """Group of buildings with one roof shape: `count` at random positions, and those at `at_m` (X, Y).

    The eaves are level: `height_m` is their height above the ground at the building's centre.
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
    """Group of trees: `count` at random positions, and those at `at_m` (X, Y)."""

    count: int = 0
    at_m: tuple[tuple[float, float], ...] = ()
    height_m: Range = (6.0, 20.0)
    radius_m: Range = (1.5, 4.0)


@dataclasses.dataclass(frozen=True)
class Settlement:
    """Groups of buildings and of trees."""

    buildings: tuple[Buildings, ...] = ()
    trees: tuple[Trees, ...] = ()

    def settled(self, terrain: Terrain, ground: Swaths | Field, seed: int) -> Terrain:
        """Add buildings and trees to `terrain`, whose waves are `drawn`.

        Random buildings keep a distance from all buildings, and random crowns from buildings; crowns may overlap.
        Raises BlockError if there is not enough room.
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
    """Return the first `n` free positions."""
    result = np.zeros((0, 2))
    for _ in range(_TRIES):
        if len(result) >= n:
            return result[:n]
        xy = ground.draw(rng, max(_PLACES, 2 * n))
        result = np.vstack([result, xy[free(xy)]])
    raise BlockError(f"no room for {what} next to the other buildings; request fewer or smaller ones")
