"""Detect exchanged observations: names of two image points of an image, coordinates of control points or stations.

Names: the other rays of a point predict its image. A point with two rays, one of which is wrong, is lost; with the
measurement of the other its rays must intersect, in front of the cameras and at the distance of other points. If both
points have their two rays in the same two images, the image of the exchange is ambiguous; the points are the same.

Coordinates (two, or a file shifted by a row): the images determine the position of each object, a point from its rays,
an image from its points. An object at another's stated position has that other's coordinates. Alternatively, the names
of the points were exchanged in all images: no measurement distinguishes these, and the camera is the same.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment, PaddedSizes, linearise
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError, few
from jaxphoto.initial import resect
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.observations import AbstractCoordinates
from jaxphoto.procedures.model_choice import measured_discrepancies
from jaxphoto.procedures.robust import RedundancyBlocks, RowMasks
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import LEVEL, chi_square_limit


@pretty_repr
class Exchange(NamedTuple):
    """Rows of a group that exchange observed values and standard deviations."""

    group: str
    rows: tuple[tuple[int, ...], ...]
    """Two or more each: the first receives the observation of the second, and so on; the last that of the first."""
    words: str
    """Message such as "points 12 and 31 of image A2 had each other's name"."""
    back: dict[str, tuple[int, ...]]
    """Rows that are accepted again after the exchange, by group."""
    out: tuple[int, ...] = ()
    """Rows of the group that belong to none of them, and are removed."""

    @property
    def undone(self) -> "Exchange":
        """Return the exchange of nothing."""
        return self._replace(rows=tuple(rows[::-1] for rows in self.rows), back={}, out=())


def exchanged(block: Block, left: RowMasks, exchange: Exchange) -> tuple[Block, RowMasks]:
    """Exchange these rows, and accept rows again."""
    rows = block.named_observations[exchange.group]
    order = np.arange(len(rows))
    for cycle in exchange.rows:
        order[list(cycle)] = np.roll(cycle, -1)
    new, sigma = rows.with_observation(to_numpy(rows.observation)[order]), to_numpy(rows.sigmas)
    new = new.with_sigmas_times(sigma[order] / sigma)
    left = left | {group: _set_rows(left[group], back, False) for group, back in exchange.back.items()}
    left = left | {exchange.group: _set_rows(left[exchange.group], exchange.out, True)} if exchange.out else left
    return block.with_observations({exchange.group: new}), left


def with_dependants(done: Sequence[Exchange], wrong: Sequence[bool]) -> list[Exchange]:
    """Return wrong exchanges, and later ones of the same rows."""
    undone: list[Exchange] = []
    rows: set[tuple[str, int]] = set()
    for exchange, bad in zip(done, wrong, strict=True):
        cells = {(exchange.group, row) for rows_ in exchange.rows for row in rows_}
        if bad or cells & rows:
            undone.append(exchange)
            rows |= cells
    return undone


def with_positions(at: Adjustment, places: Mapping[int, Float[np.ndarray, "3"]]) -> Adjustment:
    """Return `at` with points at these places (m)."""
    points = np.array(to_numpy(at.unknowns.points))
    for point, place in places.items():
        points[point] = place
    return eqx.tree_at(lambda a: a.unknowns.points, at, points)


def rays_of(
    at: Adjustment,
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows"]]:
    """Origin (m) and direction in the object frame of the ray of each image point, and c (mm) of its camera."""
    block, exterior = at.block, at.unknowns.exterior
    p, measured = block.image_points, to_numpy(block.image_points.xy)
    camera, rays, c = np.array(block.image_camera, object)[p.image], np.zeros((len(p), 3)), np.ones(len(p))
    for name, interior in at.unknowns.interior.items():
        of_camera = camera == name
        if of_camera.any():
            rays[of_camera], c[of_camera] = camera_rays(interior, measured[of_camera]), float(interior.c)
    return to_numpy(exterior.position)[p.image], turn_to_object(to_numpy(exterior.camera_from_object), p.image, rays), c


def _set_rows(left: np.ndarray, rows: tuple[int, ...], out: bool) -> np.ndarray:
    changed = left.copy()
    changed[list(rows)] = out
    return changed


# Maximum ratio of the distance from the other's prediction to the distance of the two image points.
_NEAR = 0.2
# Maximum ratio of a point's distance to the nearest or farthest other point of the image.
_DEPTH = 1.5


class _Rays(NamedTuple):
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
        others = np.flatnonzero((p.point == p.point[row]) & (np.arange(len(p)) != row))
        return others[~self.left[others]] if not self.left[others].all() else others


def name_exchanges(
    at: Adjustment, left: RowMasks, gone: Int[np.ndarray, "points"], sigma0: float, r: RedundancyBlocks
) -> tuple[list[Exchange], Adjustment]:
    """Return exchanges that resolve rejected rows `left` and lost points `gone`; `at` is the linearised block.

    Also returns `at` with lost points at their intersections.
    """
    rays, block = _ray_data(at, left, gone, sigma0), at.block
    group, point = block.image_points.group, block.image_points.point
    exchanges: list[Exchange] = []
    places: dict[int, np.ndarray] = {}
    done: set[int] = set()
    for a, b in _candidates(rays).tolist():
        points = int(point[a]), int(point[b])
        if done.intersection(points):
            continue
        sides = [_intersect_with(rays, k, other) for k, other in ((a, b), (b, a)) if rays.gone[point[k]]]
        if all(side is not None for side in sides) and _agrees_with_prediction(at, rays, (a, b), r, sigma0):
            intersections = [side for side in sides if side is not None]
            names, image = [block.points[k] for k in points], block.images[block.image_points.image[a]]
            words = f"points {names[0]} and {names[1]} of image {image} had each other's name"
            back = (a, b, *(row for *_, rows in intersections for row in rows))
            exchanges.append(Exchange(group, ((a, b),), words, {group: back}))
            places |= {point: place for point, place, _ in intersections}
            done.update(points)
    return exchanges, with_positions(at, places)


def intersecting_points(
    at: Adjustment, left: RowMasks, gone: Int[np.ndarray, "points"], sigma0: float
) -> dict[int, Float[np.ndarray, "3"]]:
    """Positions (m) of lost points all of whose rays intersect after all."""
    rays, p = _ray_data(at, left, gone, sigma0), at.block.image_points
    rays_of_point = {point: np.flatnonzero(p.point == point) for point in gone.tolist()}
    places = {point: _intersection(rays, rows) for point, rows in rays_of_point.items() if len(rows) > 1}
    return {point: place for point, place in places.items() if place is not None}


def reinstate_points(block: Block, left: RowMasks, points: Iterable[int]) -> RowMasks:
    """Return `left` without the image points of these."""
    p = block.image_points
    return left | {p.group: left[p.group] & ~np.isin(p.point, list(points))}


def _ray_data(at: Adjustment, left: RowMasks, gone: Int[np.ndarray, "points"], sigma0: float) -> _Rays:
    block, unknowns = at.block, at.unknowns
    p = block.image_points
    measured = to_numpy(p.xy)
    origins, directions, c = rays_of(at)
    is_gone = np.isin(np.arange(len(block.points)), gone)
    far = np.linalg.norm(to_numpy(unknowns.points)[p.point] - origins, axis=1)
    depths = np.tile([np.inf, 0.0], (len(block.images), 1))
    valid = ~is_gone[p.point] & ~left[p.group]
    np.minimum.at(depths[:, 0], p.image[valid], far[valid])
    np.maximum.at(depths[:, 1], p.image[valid], far[valid])
    return _Rays(
        block, measured, measured - measured_discrepancies(block, unknowns), is_gone, left[p.group], origins,
        directions, to_numpy(p.sigma).mean(axis=1) / c, depths * [1 / _DEPTH, _DEPTH],
        sigma0**2 * float(chi_square_limit(np.array(1), LEVEL / len(p))),
    )  # fmt: skip


def _candidates(rays: _Rays) -> Int[np.ndarray, "pairs 2"]:
    """Return candidate pairs of suspected rows of an image."""
    p = rays.block.image_points
    suspected = np.flatnonzero(rays.left | rays.gone[p.point])
    pairs = [np.zeros((0, 2), int)]
    for image in np.unique(p.image[suspected]):
        in_image = suspected[p.image[suspected] == image]
        first, second = np.triu_indices(len(in_image), 1)
        a, b = in_image[first], in_image[second]
        some = p.point[a] != p.point[b]
        a, b = a[some], b[some]
        plausible = _plausible(rays, a, b) & _plausible(rays, b, a)
        pairs.append(np.stack([a[plausible], b[plausible]], axis=1))
    return np.concatenate(pairs)


def _plausible(rays: _Rays, row: Int[np.ndarray, "n"], other: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return True if the measurement `other` of its image may belong to the point of `row`."""
    p = rays.block.image_points
    apart = np.abs(rays.measured[row] - rays.measured[other]).max(axis=1, initial=0.0)
    near = np.abs(rays.measured[other] - rays.predicted[row]).max(axis=1, initial=0.0) < _NEAR * apart
    partner = {int(k): rays.partners(int(k))[:1] for k in np.unique(row[rays.gone[p.point[row]]])}
    for n in np.flatnonzero(rays.gone[p.point[row]]).tolist():
        others = partner[int(row[n])]
        near[n] = len(others) > 0 and _epipolar_distance(rays, int(others[0]), int(other[n])) < 2 * rays.limit**0.5
    return near


def _epipolar_distance(rays: _Rays, one: int, other: int) -> float:
    """Return the distance of two rays in standard deviations."""
    base = rays.origins[other] - rays.origins[one]
    normal = np.cross(rays.directions[one], rays.directions[other])
    length = np.linalg.norm(normal) * np.linalg.norm(base)
    if length == 0:
        return np.inf
    # Angle between a ray and the plane of the base and the other one, both rays of equal uncertainty.
    plane = np.cross(base, rays.directions[one])
    distance = abs(float(rays.directions[other] @ plane)) / max(float(np.linalg.norm(plane)), 1e-300)
    return distance / float(np.hypot(rays.sigma[one], rays.sigma[other]))


def _intersect_with(rays: _Rays, row: int, other: int) -> tuple[int, Float[np.ndarray, "3"], list[int]] | None:
    """Return the point of `row` if it was measured in `other`, and its rays; None if they do not intersect."""
    partners = rays.partners(row)
    place = _intersection(rays, np.array([other, *partners])) if len(partners) else None
    return None if place is None else (int(rays.block.image_points.point[row]), place, partners.tolist())


def _intersection(data: _Rays, rays: Int[np.ndarray, "rays"]) -> Float[np.ndarray, "3"] | None:
    """Return the intersection of these rows, at least two; None if there is none, or not at the distance of other
    points.
    """
    origins, directions = data.origins[rays], data.directions[rays]
    places, determined = intersect_points(origins, directions, np.zeros(len(rays), int), 1)
    if not determined[0]:
        return None
    towards = places[0] - origins
    far = np.sum(towards * directions, axis=1)
    nearest, farthest = data.depths[data.block.image_points.image[rays]].T
    if not np.all((far > nearest) & (far < farthest)):
        return None
    error = np.linalg.norm(towards - far[:, None] * directions, axis=1) / far / data.sigma[rays]
    freedom = 2 * len(rays) - 3
    return places[0] if float(np.sum(error**2)) <= data.limit * freedom else None


def _agrees_with_prediction(
    at: Adjustment, rays: _Rays, pair: tuple[int, int], r: RedundancyBlocks, sigma0: float
) -> bool:
    """Return True if the points of the pair that are not lost agree with their predictions after the exchange."""
    p = at.block.image_points
    staying = [k for k in pair if not rays.gone[p.point[k]]]
    if not staying:
        return True
    # Far from the prediction a difference is not a measure: repeat with exchanged names.
    block, _ = exchanged(at.block, {}, Exchange(p.group, (pair,), "", {}))
    discrepancy = (measured_discrepancies(block, at.unknowns) / to_numpy(p.sigma))[staying]
    # Both coordinates of a point are tested; like all others, against all others.
    limit = sigma0**2 * float(chi_square_limit(np.array(2), LEVEL / len(p)))
    return bool(np.all(np.einsum("ni,nij,nj->n", discrepancy, r[p.group][staying], discrepancy) < limit))


# Maximum ratio of the distance from another's coordinates to that from the next nearest.
_NEAR = 0.2
# The same if all of a group is rejected: it then distorts nothing, and the positions are accurate.
_NEARER = 0.05
# Number of points required for a resection.
_LEAST_POINTS = 4
# Fraction of contradicting points from which an image may have another's station.
_CONTRADICTING = 0.25


def coordinate_exchanges(
    at: Adjustment, left: RowMasks, gone: Int[np.ndarray, "points"], sizes: PaddedSizes
) -> tuple[list[Exchange], Adjustment]:
    """Return exchanges that resolve rejected rows `left` and lost points `gone`; `at` is the linearised block.

    Also returns `at` with positions from the images.
    """
    exchanges: list[Exchange] = []
    for group, rows in at.block.named_observations.items():
        if not isinstance(rows, AbstractCoordinates) or len(rows.indices()) != 1:
            continue
        ((what, who),) = ((what, to_numpy(index)) for what, index in rows.indices())
        suspects = _suspects(at.block, left, group, what, who, gone)
        if len(suspects) < 2:
            continue
        if what == "point":
            # However large the misclosure of their rays: an image distorted by these still gives a close position.
            places = intersecting_points(at, left, suspects, np.inf)
            by_images, placed = with_positions(at, places), list(places)
        else:
            by_images, placed = _placed_images(at, suspects, gone)
        there = linearise(at.block, by_images.unknowns, at.block.priors, sizes)
        discrepancy = np.where(np.isin(who, placed), rows.physical(to_numpy(there.residuals[group])), np.nan)
        near = _NEARER if left[group].all() else _NEAR
        if new := [
            _exchange(at.block, rows, what, *cycle) for cycle in _cycles(rows, who, suspects, discrepancy, near)
        ]:
            exchanges, at = exchanges + new, by_images
    return exchanges, at


def merge_exchanges(block: Block, done: Sequence[Exchange], left: RowMasks) -> list[Exchange]:
    """Merge exchanges of coordinates found successively; all others unchanged.

    Objects all of whose rows are rejected in the end have no coordinates of their own.
    """
    merged = []
    for group, rows in block.named_observations.items():
        of_group = [e for e in done if e.group == group]
        if not isinstance(rows, AbstractCoordinates) or not of_group:
            merged += of_group
            continue
        ((what, who),) = ((what, to_numpy(index)) for what, index in rows.indices())
        order, out = np.arange(len(rows)), left[group]
        for one in (one for e in of_group for one in e.rows):
            order[list(one)] = order[np.roll(one, -1)]
        lacks = set(np.flatnonzero(out & ~np.isin(who, who[~out])).tolist())
        rounds: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
        for one in _permutation_cycles(order, lacks):
            rounds.setdefault(tuple(who[list(one)].tolist()), []).append(one)
        for ids, axes in rounds.items():
            gone = tuple(row for one in axes for row in one[-1:] if row in lacks)
            merged.append(_exchange(block, rows, what, ids, tuple(axes), gone))
    return merged


def _permutation_cycles(order: Int[np.ndarray, "rows"], last: set[int]) -> Iterator[tuple[int, ...]]:
    """Return cycles of rows, `order[k]` the source of row k; ending with one of `last`."""
    visited: set[int] = set()
    for first in np.flatnonzero(order != np.arange(len(order))).tolist():
        if first in visited:
            continue
        one = [first]
        while (following := int(order[one[-1]])) != first:
            one.append(following)
        visited.update(one)
        end = next((k + 1 for k, row in enumerate(one) if row in last), 0)
        yield (*one[end:], *one[:end])


def _exchange(
    block: Block,
    rows: AbstractCoordinates,
    what: str,
    ids: tuple[int, ...],
    cycles: tuple[tuple[int, ...], ...],
    lacks: tuple[int, ...],
) -> Exchange:
    p = block.image_points
    rows_seen = np.flatnonzero(np.isin(p.point if what == "point" else p.image, ids))
    back = {p.group: tuple(rows_seen.tolist()), rows.group: tuple(row for of_axis in cycles for row in of_axis)}
    names = [(block.points if what == "point" else block.images)[k] for k in ids]
    many, has, otherwise = (
        ("control points", "coordinates", "their names are exchanged in all images")
        if what == "point"
        else ("images", "station", "their image points are exchanged")
    )
    if len(ids) == 2 and not lacks:
        words = f"{many} {names[0]} and {names[1]} had each other's {has}, or {otherwise}"
    else:
        stood = [f"{a}'s at {b}" for a, b in zip(names, names[1:] + names[:1], strict=True)]
        stood = stood[: -1 if lacks else None]
        # In the order of the block, except for the closing link.
        shifted_by_one = int((np.abs(np.diff([*ids, ids[0]])) == 1).sum()) >= len(ids) - 1
        words = (
            f"{len(ids)} {many} had one another's {has}, {few(stood)}"
            f"{': the rows are off by one' if shifted_by_one else ''}; or {otherwise}"
        )
    return Exchange(rows.group, cycles, words, back, lacks)


def _suspects(
    block: Block, left: RowMasks, group: str, what: str, who: Int[np.ndarray, "rows"], gone
) -> Int[np.ndarray, "doubted"]:
    """Return points or images of the group with a contradicting observation."""
    p = block.image_points
    out, theirs = left[p.group], p.point if what == "point" else p.image
    total, wrong = (np.bincount(theirs[k], minlength=int(np.max(who)) + 1) for k in (np.s_[:], out))
    some = wrong > (0 if what == "point" else _CONTRADICTING * total)
    lost = np.intersect1d(who, gone) if what == "point" else gone[:0]
    return np.unique(np.concatenate([who[left[group]], who[some[who]], lost]))


def _placed_images(
    at: Adjustment, images: Int[np.ndarray, "doubted"], gone: Int[np.ndarray, "points"]
) -> tuple[Adjustment, list[int]]:
    """Return `at` with these images resected from their points, and the images with enough points.

    Points are intersected from other images, if these suffice: an image with a wrong station has distorted them.
    """
    block, exterior = at.block, at.unknowns.exterior
    p, points = block.image_points, to_numpy(at.unknowns.points)
    positions, matrices = (np.array(to_numpy(v)) for v in (exterior.position, exterior.camera_from_object))
    placed = []
    for image in images.tolist():
        in_image = np.flatnonzero((p.image == image) & ~np.isin(p.point, gone))
        ids, which = np.unique(p.point[in_image], return_inverse=True)
        intersections, valid = _intersect_rows(at, ids, np.isin(p.point, ids) & (p.image != image))
        places = intersections if valid.sum() >= _LEAST_POINTS else points[ids]
        chosen = np.isfinite(places[which]).all(axis=1)
        interior = at.unknowns.interior[block.image_camera[image]]
        try:
            pose = resect(interior, to_numpy(p.xy)[in_image[chosen]], places[which[chosen]], block.images[image])
        except BlockError:
            continue
        positions[image], matrices[image] = to_numpy(pose.position), to_numpy(pose.camera_from_object)
        placed.append(image)
    new = ExteriorOrientation(jnp.asarray(positions), jnp.asarray(matrices))
    at = eqx.tree_at(lambda a: a.unknowns.exterior, at, new)
    # Its points move along: they were distorted by wrong stations, and would pull it back.
    ids = np.unique(p.point[np.isin(p.image, placed)])
    intersections, valid = _intersect_rows(at, ids, np.isin(p.point, ids))
    return with_positions(at, dict(zip(ids[valid].tolist(), intersections[valid], strict=True))), placed


def _intersect_rows(
    at: Adjustment, points: Int[np.ndarray, "n"], rows: Bool[np.ndarray, "rows"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Return the intersections of the rays of these rows (m), by point, and True where they are valid."""
    origins, directions, _ = rays_of(at)
    which = np.searchsorted(points, at.block.image_points.point[rows])
    return intersect_points(origins[rows], directions[rows], which, len(points))


def _cycles(
    rows: AbstractCoordinates, who, suspects, discrepancy: Float[np.ndarray, "rows"], near: float
) -> Iterator[tuple]:
    """Return cycles in which each lies where the next is said to be, and their rows, axis by axis.

    `off` is observed minus determined (m), NaN if undetermined by the images. The last lies where the first is said to
    be; or is not determined, and coordinates are then not of a single axis; or lies elsewhere, and its observation is
    removed: a file shifted by a row lacks one row, and may contain one twice.
    """
    rows_of = {int(k): np.flatnonzero(who == k) for k in suspects}
    rows_of = {k: own_rows[np.argsort(rows.axis[own_rows])] for k, own_rows in rows_of.items()}
    after = _coincidences(rows, rows_of, discrepancy, near)
    while after:
        first = next((k for k in after if k not in after.values()), next(iter(after)))
        ids = [first]
        while (following := after.pop(ids[-1], None)) not in (None, first):
            ids.append(following)
        last = rows_of[ids[-1]]
        closed, unseen = following == first, not np.isfinite(discrepancy[last]).all()
        if closed or len(ids) > 2 or len(last) > 1:
            lacks = () if closed or unseen else tuple(last.tolist())
            yield tuple(ids), tuple(zip(*(rows_of[k].tolist() for k in ids), strict=True)), lacks


def _coincidences(
    rows: AbstractCoordinates,
    rows_of: dict[int, Int[np.ndarray, "axes"]],
    discrepancy: Float[np.ndarray, "rows"],
    near: float,
) -> dict[int, int]:
    """Return the pairs of positions and stated coordinates that coincide."""
    pairs: list[tuple[float, int, int]] = []
    for axes in {tuple(rows.axis[own_rows].tolist()) for own_rows in rows_of.values()}:
        ids = [k for k, own_rows in rows_of.items() if tuple(rows.axis[own_rows].tolist()) == axes]
        stated = np.array([np.asarray(rows.value)[rows_of[k]] for k in ids])
        determined = stated - np.array([discrepancy[rows_of[k]] for k in ids])
        usable = np.flatnonzero(np.isfinite(determined).all(axis=1))
        for k in usable.tolist() if len(ids) > 1 else ():
            miss = np.abs(stated - determined[k]).max(axis=1)
            nearest, second = np.argsort(miss)[:2].tolist()
            # Correct ones have their own; and some of many lie close to another's by chance.
            if nearest != k and miss[nearest] < near * miss[second]:
                pairs.append((float(miss[nearest]), ids[k], ids[nearest]))
    after: dict[int, int] = {}
    for _, a, b in sorted(pairs):
        if b not in after.values():
            after[a] = b
    return after
