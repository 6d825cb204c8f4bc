"""Detection of exchanged names of two image points in one image, among contradicting observations.

Other rays of a point predict its image. A point with two rays, one of which is wrong, is lost with them: with the
other's measurement its rays must intersect, in front of the cameras and at the distance of other points. If both points
have their two rays in the same two images, the image of the exchange is ambiguous; the points are the same.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.procedures.cross_validation import measured_discrepancies
from jaxphoto.procedures.exchange import Exchange, exchanged, rays_of, with_places
from jaxphoto.procedures.robust import Blocks, Masks
from jaxphoto.statistics import LEVEL, chi_square_limit

# Maximum ratio of the distance from the other's prediction to the distance of the two image points.
_NEAR = 0.2
# Maximum ratio of a point's distance to the nearest or farthest other point of the image.
_DEPTH = 1.5


class _Seen(NamedTuple):
    """Data to judge whether a measurement matches a point."""

    block: Block
    measured: Float[np.ndarray, "rows 2"]
    predicted: Float[np.ndarray, "rows 2"]
    """Predicted image coordinates of the points of the rows, except lost ones."""
    gone: Bool[np.ndarray, "points"]
    left: Bool[np.ndarray, "rows"]
    origins: Float[np.ndarray, "rows 3"]
    directions: Float[np.ndarray, "rows 3"]
    """Ray directions in the object frame."""
    sigma: Float[np.ndarray, "rows"]
    """Standard deviation of a ray's direction (rad)."""
    depths: Float[np.ndarray, "images 2"]
    """Distances of the nearest and the farthest point of each image (m)."""
    limit: float
    """Limit of a squared number over its variance."""

    def partners(self, row: int) -> Int[np.ndarray, "others"]:
        """Return the other rays of the point of a row: accepted ones, or else all."""
        p = self.block.image_points
        own = np.flatnonzero((p.point == p.point[row]) & (np.arange(len(p)) != row))
        return own[~self.left[own]] if not self.left[own].all() else own


def name_exchanges(
    at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sigma0: float, r: Blocks
) -> tuple[list[Exchange], Adjustment]:
    """Return exchanges that resolve rejected rows `left` and points that are `gone`; `at` is the linearised block.

    Also returns `at` with lost points at their intersections.
    """
    seen, block = _seen(at, left, gone, sigma0), at.block
    group, point = block.image_points.group, block.image_points.point
    found: list[Exchange] = []
    places: dict[int, np.ndarray] = {}
    done: set[int] = set()
    for a, b in _candidates(seen).tolist():
        points = int(point[a]), int(point[b])
        if done.intersection(points):
            continue
        sides = [_met(seen, k, other) for k, other in ((a, b), (b, a)) if seen.gone[point[k]]]
        if all(side is not None for side in sides) and _predicted(at, seen, (a, b), r, sigma0):
            met = [side for side in sides if side is not None]
            names, image = [block.points[k] for k in points], block.images[block.image_points.image[a]]
            words = f"points {names[0]} and {names[1]} of image {image} had each other's name"
            back = (a, b, *(row for *_, rows in met for row in rows))
            found.append(Exchange(group, ((a, b),), words, {group: back}))
            places |= {point: place for point, place, _ in met}
            done.update(points)
    return found, with_places(at, places)


def points_that_meet(
    at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sigma0: float
) -> dict[int, Float[np.ndarray, "3"]]:
    """Return lost points all of whose rays intersect after all, and where (m)."""
    seen, p = _seen(at, left, gone, sigma0), at.block.image_points
    met = {point: np.flatnonzero(p.point == point) for point in gone.tolist()}
    places = {point: _meeting(seen, rays) for point, rays in met.items() if len(rays) > 1}
    return {point: place for point, place in places.items() if place is not None}


def put_back(block: Block, left: Masks, points: Iterable[int]) -> Masks:
    """Return `left` without the image points of these."""
    p = block.image_points
    return left | {p.group: left[p.group] & ~np.isin(p.point, list(points))}


def _seen(at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sigma0: float) -> _Seen:
    block, unknowns = at.block, at.unknowns
    p = block.image_points
    measured = to_numpy(p.xy)
    origins, directions, c = rays_of(at)
    is_gone = np.isin(np.arange(len(block.points)), gone)
    far = np.linalg.norm(to_numpy(unknowns.points)[p.point] - origins, axis=1)
    depths = np.tile([np.inf, 0.0], (len(block.images), 1))
    sound = ~is_gone[p.point] & ~left[p.group]
    np.minimum.at(depths[:, 0], p.image[sound], far[sound])
    np.maximum.at(depths[:, 1], p.image[sound], far[sound])
    return _Seen(
        block,
        measured,
        measured - measured_discrepancies(block, unknowns),
        is_gone,
        left[p.group],
        origins,
        directions,
        to_numpy(p.sigma).mean(axis=1) / c,
        depths * [1 / _DEPTH, _DEPTH],
        sigma0**2 * float(chi_square_limit(np.array(1), LEVEL / len(p))),
    )


def _candidates(seen: _Seen) -> Int[np.ndarray, "pairs 2"]:
    """Return candidate pairs of suspected rows of an image."""
    p = seen.block.image_points
    suspected = np.flatnonzero(seen.left | seen.gone[p.point])
    pairs = [np.zeros((0, 2), int)]
    for image in np.unique(p.image[suspected]):
        own = suspected[p.image[suspected] == image]
        first, second = np.triu_indices(len(own), 1)
        a, b = own[first], own[second]
        some = p.point[a] != p.point[b]
        a, b = a[some], b[some]
        kept = _may_be(seen, a, b) & _may_be(seen, b, a)
        pairs.append(np.stack([a[kept], b[kept]], axis=1))
    return np.concatenate(pairs)


def _may_be(seen: _Seen, row: Int[np.ndarray, "n"], other: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return True if the measurement `other` of its image may belong to the point of `row`."""
    p = seen.block.image_points
    apart = np.abs(seen.measured[row] - seen.measured[other]).max(axis=1, initial=0.0)
    near = np.abs(seen.measured[other] - seen.predicted[row]).max(axis=1, initial=0.0) < _NEAR * apart
    partner = {int(k): seen.partners(int(k))[:1] for k in np.unique(row[seen.gone[p.point[row]]])}
    for n in np.flatnonzero(seen.gone[p.point[row]]).tolist():
        rays = partner[int(row[n])]
        near[n] = len(rays) > 0 and _off_plane(seen, int(rays[0]), int(other[n])) < 2 * seen.limit**0.5
    return near


def _off_plane(seen: _Seen, one: int, other: int) -> float:
    """Return the distance of two rays in standard deviations."""
    base = seen.origins[other] - seen.origins[one]
    normal = np.cross(seen.directions[one], seen.directions[other])
    length = np.linalg.norm(normal) * np.linalg.norm(base)
    if length == 0:
        return np.inf
    # Angle between a ray and the plane of the base and the other one, both rays of equal uncertainty.
    plane = np.cross(base, seen.directions[one])
    off = abs(float(seen.directions[other] @ plane)) / max(float(np.linalg.norm(plane)), 1e-300)
    return off / float(np.hypot(seen.sigma[one], seen.sigma[other]))


def _met(seen: _Seen, row: int, other: int) -> tuple[int, Float[np.ndarray, "3"], list[int]] | None:
    """Return the point of `row` if it was measured in `other`, and its rays; None if they do not intersect."""
    partners = seen.partners(row)
    place = _meeting(seen, np.array([other, *partners])) if len(partners) else None
    return None if place is None else (int(seen.block.image_points.point[row]), place, partners.tolist())


def _meeting(seen: _Seen, rays: Int[np.ndarray, "rays"]) -> Float[np.ndarray, "3"] | None:
    """Return the intersection of these rows, at least two; None if there is none, or not at the distance of other
    points.
    """
    origins, directions = seen.origins[rays], seen.directions[rays]
    places, determined = intersect_points(origins, directions, np.zeros(len(rays), int), 1)
    if not determined[0]:
        return None
    towards = places[0] - origins
    far = np.sum(towards * directions, axis=1)
    nearest, farthest = seen.depths[seen.block.image_points.image[rays]].T
    if not np.all((far > nearest) & (far < farthest)):
        return None
    off = np.linalg.norm(towards - far[:, None] * directions, axis=1) / far / seen.sigma[rays]
    freedom = 2 * len(rays) - 3
    return places[0] if float(np.sum(off**2)) <= seen.limit * freedom else None


def _predicted(at: Adjustment, seen: _Seen, pair: tuple[int, int], r: Blocks, sigma0: float) -> bool:
    """Return True if the points of the pair that are not lost agree with their predictions after the exchange."""
    p = at.block.image_points
    staying = [k for k in pair if not seen.gone[p.point[k]]]
    if not staying:
        return True
    # Far from the prediction a difference is not a measure: repeat with exchanged names.
    block, _ = exchanged(at.block, {}, Exchange(p.group, (pair,), "", {}))
    off = (measured_discrepancies(block, at.unknowns) / to_numpy(p.sigma))[staying]
    # Both coordinates of a point are tested; like all others, against all others.
    limit = sigma0**2 * float(chi_square_limit(np.array(2), LEVEL / len(p)))
    return bool(np.all(np.einsum("ni,nij,nj->n", off, r[p.group][staying], off) < limit))
