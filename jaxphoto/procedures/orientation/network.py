"""A network of images while it grows: what is oriented so far, and the points that the rays of its images meet in.

A point is met anew from all its rays each time. Rays beyond a limit are left out one by one, that which misses its
point by most first, and so a ray that was left out while the orientation was poor comes back when it is better.
"""

import enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import ideal_coordinates, turn_to_object, unit_rays

# Rays left out of one point at most, one in each round: longer false tracks are hopeless.
_ROUNDS = 12


class Fate(enum.IntEnum):
    """What became of an image point; those that are not `USED` are gross errors, or of no use."""

    USED = 0
    BEYOND = 1
    """Its ray misses the point by more than the limit, or the point lies behind the camera."""
    SMALL_ANGLE = 2
    """The rays of its point meet at too small an angle."""
    TOO_FEW = 3
    """Fewer than two rays of its point are left."""
    UNORIENTED = 4
    """Its image is not oriented."""
    UNSUPPORTED = 5
    """Its point has two rays, at a depth where nothing near it in the images is."""


class Sight(NamedTuple):
    """The image rows of a block as rays in the camera frames, with the interior orientation they were made by."""

    image: Int[np.ndarray, " rows"]
    point: Int[np.ndarray, " rows"]
    c_mm: Float[np.ndarray, " rows"]
    ideal: Float[np.ndarray, "rows 2"]
    """Ideal image coordinates, mm from the principal point."""
    ray: Float[np.ndarray, "rows 3"]
    sigma: Float[np.ndarray, " rows"]
    """Standard deviation across the ray (rad)."""

    def of_image(self, image: int) -> Int[np.ndarray, " n"]:
        """The rows of `image`."""
        return np.flatnonzero(self.image == image)


class Network(NamedTuple):
    """Images oriented so far, in a frame of their own, and the points they see."""

    interior: dict[str, InteriorOrientation]
    positions: Float[np.ndarray, "images 3"]
    camera_from_object: Float[np.ndarray, "images 3 3"]
    oriented: Bool[np.ndarray, " images"]
    points: Float[np.ndarray, "points 3"]
    fate: Int[np.ndarray, " rows"]
    """A `Fate` for each image row."""

    @property
    def used(self) -> Bool[np.ndarray, " rows"]:
        """The image rows whose rays meet in their points."""
        return self.fate == Fate.USED

    def met(self, sight: Sight) -> Bool[np.ndarray, " points"]:
        """The points in which rays meet."""
        met = np.zeros(len(self.points), bool)
        met[sight.point[self.used]] = True
        return met

    def with_image(
        self, image: int, position: Float[np.ndarray, "3"], camera_from_object: Float[np.ndarray, "3 3"]
    ) -> "Network":
        """With one more image oriented."""
        positions, matrices, oriented = self.positions.copy(), self.camera_from_object.copy(), self.oriented.copy()
        positions[image], matrices[image], oriented[image] = position, camera_from_object, True
        return self._replace(positions=positions, camera_from_object=matrices, oriented=oriented)

    def without_image(self, image: int) -> "Network":
        """With one image less; what it sees is to be met again."""
        oriented = self.oriented.copy()
        oriented[image] = False
        return self._replace(oriented=oriented)


def empty_network(block: Block) -> Network:
    """Nothing oriented yet."""
    n = len(block.images)
    return Network(
        dict(block.start.unknowns.interior),
        np.zeros((n, 3)),
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros(n, bool),
        np.full((len(block.points), 3), np.nan),
        np.full(len(block.image_points.image), int(Fate.UNORIENTED)),
    )


def sight_of(block: Block, interior: dict[str, InteriorOrientation]) -> Sight:
    """All image rows of `block` as rays, by the interior orientations `interior` of its cameras."""
    rows = block.image_points
    image, xy = np.asarray(rows.image), np.asarray(rows.xy, float)
    names = sorted(set(block.image_camera))
    camera = np.array([names.index(name) for name in block.image_camera], int)[image]
    c_mm = np.array([float(interior[name].c) for name in names])[camera]
    ideal = np.zeros_like(xy)
    for k, name in enumerate(names):
        mine = camera == k
        if mine.any():
            ideal[mine] = ideal_coordinates(interior[name], xy[mine])
    sigma = np.sqrt(np.mean(np.asarray(rows.sigma, float) ** 2, axis=1)) / c_mm
    return Sight(image, np.asarray(rows.point), c_mm, ideal, unit_rays(c_mm, ideal), sigma)


def misfits(sight: Sight, network: Network, rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """By how many standard deviations the rays of `rows` miss their points; infinite behind the camera."""
    return _misfits(sight, network.positions, network.camera_from_object, network.points, rows)


def normalised_misfits(sight: Sight, network: Network) -> Float[np.ndarray, " used"]:
    """Misfits of all rows in use, each over the root of the part of its error that its point's rays can show.

    That is (2 n - 3) / (2 n) for n rays.
    """
    rows = np.flatnonzero(network.used)
    return misfits(sight, network, rows) / _shown(sight.point[rows], len(network.points))


def _shown(point: Int[np.ndarray, " rows"], n_points: int) -> Float[np.ndarray, " rows"]:
    rays = np.bincount(point, minlength=n_points)[point]
    return np.sqrt(1 - 1.5 / rays)


def _misfits(sight: Sight, positions, matrices, points, rows) -> Float[np.ndarray, " n"]:
    image, point = sight.image[rows], sight.point[rows]
    direction = turn_to_object(matrices, image, sight.ray[rows])
    towards = points[point] - positions[image]
    distance = np.linalg.norm(towards, axis=1)
    along = np.einsum("ni,ni->n", direction, towards)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.linalg.norm(np.cross(direction, towards), axis=1) / distance
    return np.where(along > 0, across / sight.sigma[rows], np.inf)


def meet(sight: Sight, network: Network, limit: float, min_angle: float) -> Network:
    """The points in which the rays of the oriented images meet, and what becomes of every image row.

    A ray that misses its point by more than `limit` standard deviations is left out, one of each point at a time;
    a point needs two rays at `min_angle` (rad) or more.
    """
    fate = np.where(network.oriented[sight.image], Fate.USED, Fate.UNORIENTED).astype(int)
    n = len(network.points)
    points = np.full((n, 3), np.nan)
    changed = np.ones(n, bool)
    for _ in range(_ROUNDS):
        rows = np.flatnonzero((fate == Fate.USED) & changed[sight.point])
        if not len(rows):
            break
        fate, points = _meet_once(sight, network, rows, fate, points, min_angle)
        rows = rows[fate[rows] == Fate.USED]
        point = sight.point[rows]
        off = _misfits(sight, network.positions, network.camera_from_object, points, rows) / _shown(point, n)
        largest = np.zeros(n)
        np.maximum.at(largest, point, off)
        out = (off > limit) & (off == largest[point])
        fate[rows[out]] = Fate.BEYOND
        changed = np.zeros(n, bool)
        changed[point[out]] = True
    fate[(fate == Fate.USED) & changed[sight.point]] = Fate.BEYOND
    return network._replace(points=points, fate=fate)


def meet_some(
    sight: Sight, network: Network, rows: Int[np.ndarray, " n"], limit: float, min_angle: float
) -> tuple[Network, Float[np.ndarray, " used"]]:
    """`meet` of some points, of which `rows` are all image rows; and the `normalised_misfits` of those in use."""
    seen, point = np.unique(sight.point[rows], return_inverse=True)
    part = Sight(*(values[rows] for values in sight))._replace(point=point)
    own = network._replace(points=network.points[seen], fate=network.fate[rows])
    own = meet(part, own, limit, min_angle)
    points, fate = network.points.copy(), network.fate.copy()
    points[seen], fate[rows] = own.points, own.fate
    return network._replace(points=points, fate=fate), normalised_misfits(part, own)


def _meet_once(sight: Sight, network: Network, rows, fate, points, min_angle: float):
    """Points anew from the rays `rows`; those of points of one ray, or whose rays are parallel, go."""
    image, point, n = sight.image[rows], sight.point[rows], len(points)
    alone = np.bincount(point, minlength=n)[point] < 2
    fate[rows[alone]] = Fate.TOO_FEW
    rows, image, point = rows[~alone], image[~alone], point[~alone]
    directions = turn_to_object(network.camera_from_object, image, sight.ray[rows])
    found, good = intersect_points(network.positions[image], directions, point, n, min_angle=min_angle)
    fate[rows[~good[point]]] = Fate.SMALL_ANGLE
    points[point] = found[point]
    return fate, points


def robust_scale(values: Float[np.ndarray, " n"]) -> float:
    """The standard deviation per axis that the median of the lengths of errors in two axes speaks of."""
    # The median of the length is 1.1774 sigma (Rayleigh's distribution).
    return float(np.median(values)) / 1.1774 if len(values) else 0.0
