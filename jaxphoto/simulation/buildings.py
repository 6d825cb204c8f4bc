"""Buildings: upright prisms over rectangles with flat, gable or monopitch roofs.

Each is convex, the intersection of six half-spaces, `normal . X <= offset`: its walls, and one or two sides of the
roof. Roof heights and intersections with rays follow from these.
"""

import dataclasses
import functools
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.simulation.nearby import pairs_near

Roof = Literal["flat", "gable", "monopitch"]
"""Level; two sides that meet in a ridge over the centre line; one side that rises to the right."""
ROOFS: tuple[Roof, ...] = ("flat", "gable", "monopitch")
# The first faces of a building are its walls.
_WALLS = 4


@dataclasses.dataclass(frozen=True)
class Building:
    """Rectangle of `length_m` along `heading_deg` (from north) by `width_m` across, about `centre_m` (X, Y).

    Its eaves, those on the left of a monopitch roof, are at Z = `eaves_m`; from there the roof rises by `slope_deg`.
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
        """Unit vectors (east, north): along the building, and to its right."""
        heading = np.deg2rad(self.heading_deg)
        return np.array([[np.sin(heading), np.cos(heading)], [np.cos(heading), -np.sin(heading)]])

    @property
    def half(self) -> Float[np.ndarray, "2"]:
        """Half the length and half the width (m)."""
        return np.array([self.length_m, self.width_m]) / 2

    @property
    def radius_m(self) -> float:
        """Distance from the centre to a corner."""
        return float(np.hypot(*self.half))


class Solids(NamedTuple):
    """Buildings as planes."""

    centre: Float[np.ndarray, "buildings 2"]
    radius: Float[np.ndarray, "buildings"]
    top: Float[np.ndarray, "buildings"]
    """Z of the ridge (m)."""
    normal: Float[np.ndarray, "buildings 6 3"]
    """Outward normals: four walls, of unit length; two sides of the roof, of Z component 1 (a single side twice)."""
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
    """Return Z (m) of the roofs above places (east, north), minus infinity if there is none."""
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


def entered(
    planes: Solids, which: Int[np.ndarray, "n"], origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the distance at which each ray enters building `which` by a roof, and by a wall; infinity if it does not.

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
    met = (begin <= out_of) & (begin >= 0) & ~beside
    roof = face >= _WALLS
    return np.where(met & roof, begin, np.inf), np.where(met & ~roof, begin, np.inf)


def _planes(b: Building) -> tuple[np.ndarray, np.ndarray]:
    along, right = b.axes
    half, centre = b.half, np.array(b.centre_m)
    walls = np.stack([along, -along, right, -right])
    reach = walls @ centre + np.repeat(half, 2)
    slope = np.tan(np.deg2rad(b.slope_deg))
    # Decrease of Z along X and Y; at the centre line the planes are at `middle`.
    falls = {"flat": (0 * right, 0 * right), "gable": (slope * right, -slope * right)}.get(
        b.roof, (-slope * right,) * 2
    )
    middle = b.eaves_m + (0.0 if b.roof == "flat" else slope * half[1])
    normal = np.vstack([np.column_stack([walls, np.zeros(_WALLS)]), np.column_stack([np.stack(falls), np.ones(2)])])
    return normal, np.concatenate([reach, middle + np.stack(falls) @ centre])
