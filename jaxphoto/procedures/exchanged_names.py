"""Two image points of one image that have each other's name: found among what contradicts the others, and put right.

A point that has other rays enough says where in the image it should be. One that had two rays, of which one is wrong,
is gone with them: with the other's measurement its rays must meet, in front of the cameras and as far away as other
points are. Where both points had their two rays in the same two images, nobody can tell in which of these the names
were exchanged; the points are the same.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import still
from jaxphoto.block import Block
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.procedures.cross_validation import measured_discrepancies
from jaxphoto.procedures.exchange import Exchange, exchanged, rays_of, with_places
from jaxphoto.procedures.robust import Blocks, Masks
from jaxphoto.statistics import LEVEL, chi_square_limit

# Two image points may have each other's name where one lies as near to the prediction of the other, beside how far
# apart they are.
_NEAR = 0.2
# Points are this much nearer or farther than any other of the image at most.
_DEPTH = 1.5


class _Seen(NamedTuple):
    """What tells whether a measurement suits a point."""

    block: Block
    measured: Float[np.ndarray, "rows 2"]
    predicted: Float[np.ndarray, "rows 2"]
    """Where the points of the rows should be, of points that are not gone."""
    gone: Bool[np.ndarray, "points"]
    left: Bool[np.ndarray, "rows"]
    origins: Float[np.ndarray, "rows 3"]
    directions: Float[np.ndarray, "rows 3"]
    """Of the rays in the object frame."""
    sigma: Float[np.ndarray, "rows"]
    """Of a ray's direction (rad)."""
    depths: Float[np.ndarray, "images 2"]
    """The nearest and the farthest point of each image (m)."""
    limit: float
    """Of the square sum of one number over its variance."""

    def partners(self, row: int) -> Int[np.ndarray, "others"]:
        """The other rays of the point of a row: those that are in, or else all."""
        p = self.block.image_points
        own = np.flatnonzero((p.point == p.point[row]) & (np.arange(len(p)) != row))
        return own[~self.left[own]] if not self.left[own].all() else own


def name_exchanges(
    at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sigma0: float, r: Blocks
) -> tuple[list[Exchange], Adjustment]:
    """The exchanges that put right what is `left` out, and points that are `gone`, of `at`: the block linearised.

    And `at` with points that were gone where their rays meet.
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
    """Of the points that are `gone`, those all of whose rays meet after all, and where (m)."""
    seen, p = _seen(at, left, gone, sigma0), at.block.image_points
    met = {point: np.flatnonzero(p.point == point) for point in gone.tolist()}
    places = {point: _meeting(seen, rays) for point, rays in met.items() if len(rays) > 1}
    return {point: place for point, place in places.items() if place is not None}


def put_back(block: Block, left: Masks, points: Iterable[int]) -> Masks:
    """`left` without the image points of these."""
    p = block.image_points
    return left | {p.group: left[p.group] & ~np.isin(p.point, list(points))}


def _seen(at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sigma0: float) -> _Seen:
    block, unknowns = at.block, at.unknowns
    p = block.image_points
    measured = still(p.xy)
    origins, directions, c = rays_of(at)
    is_gone = np.isin(np.arange(len(block.points)), gone)
    far = np.linalg.norm(still(unknowns.points)[p.point] - origins, axis=1)
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
        still(p.sigma).mean(axis=1) / c,
        depths * [1 / _DEPTH, _DEPTH],
        sigma0**2 * float(chi_square_limit(np.array(1), LEVEL / len(p))),
    )


def _candidates(seen: _Seen) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of suspected rows of an image that may have each other's name, as far as a look tells."""
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
    """Whether the point of each `row` may be what was measured in the `other` one of its image."""
    p = seen.block.image_points
    apart = np.abs(seen.measured[row] - seen.measured[other]).max(axis=1, initial=0.0)
    near = np.abs(seen.measured[other] - seen.predicted[row]).max(axis=1, initial=0.0) < _NEAR * apart
    partner = {int(k): seen.partners(int(k))[:1] for k in np.unique(row[seen.gone[p.point[row]]])}
    for n in np.flatnonzero(seen.gone[p.point[row]]).tolist():
        rays = partner[int(row[n])]
        near[n] = len(rays) > 0 and _off_plane(seen, int(rays[0]), int(other[n])) < 2 * seen.limit**0.5
    return near


def _off_plane(seen: _Seen, one: int, other: int) -> float:
    """By how many standard deviations two rays miss each other."""
    base = seen.origins[other] - seen.origins[one]
    normal = np.cross(seen.directions[one], seen.directions[other])
    length = np.linalg.norm(normal) * np.linalg.norm(base)
    if length == 0:
        return np.inf
    # The angle between a ray and the plane of the base and the other one, both rays alike uncertain.
    plane = np.cross(base, seen.directions[one])
    off = abs(float(seen.directions[other] @ plane)) / max(float(np.linalg.norm(plane)), 1e-300)
    return off / float(np.hypot(seen.sigma[one], seen.sigma[other]))


def _met(seen: _Seen, row: int, other: int) -> tuple[int, Float[np.ndarray, "3"], list[int]] | None:
    """The point of `row`, where its rays meet if it was measured in `other`, and these; None where they do not meet."""
    partners = seen.partners(row)
    place = _meeting(seen, np.array([other, *partners])) if len(partners) else None
    return None if place is None else (int(seen.block.image_points.point[row]), place, partners.tolist())


def _meeting(seen: _Seen, rays: Int[np.ndarray, "rays"]) -> Float[np.ndarray, "3"] | None:
    """Where the rays of these rows meet, two at least; None where they do not, or not where other points are."""
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
    """Whether those of the pair whose points are not gone lie where these are predicted, once exchanged."""
    p = at.block.image_points
    staying = [k for k in pair if not seen.gone[p.point[k]]]
    if not staying:
        return True
    # So far from where it was predicted, a difference is no measure: once more with the names exchanged.
    block, _ = exchanged(at.block, {}, Exchange(p.group, (pair,), "", {}))
    off = (measured_discrepancies(block, at.unknowns) / still(p.sigma))[staying]
    # Both coordinates of a point are tested; as all others, against all others.
    limit = sigma0**2 * float(chi_square_limit(np.array(2), LEVEL / len(p)))
    return bool(np.all(np.einsum("ni,nij,nj->n", off, r[p.group][staying], off) < limit))
