"""Detection of exchanged coordinates of control points or stations: two of them, or a file shifted by a row.

The images determine the position of each: a point, from its rays; an image, from its points. If one lies where another
is said to be, it has that other's coordinates. Alternatively, the names of the points were exchanged in all images: no
measurement distinguishes these, and the camera is the same.
"""

from collections.abc import Iterator, Sequence

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
from jaxphoto.observations import AbstractCoordinates
from jaxphoto.procedures.exchange import Exchange, rays_of, with_places
from jaxphoto.procedures.exchanged_names import points_that_meet
from jaxphoto.procedures.robust import Masks

# Maximum ratio of the distance from another's coordinates to that from the next nearest.
_NEAR = 0.2
# The same if all of a group is rejected: it then distorts nothing, and the positions are accurate.
_NEARER = 0.05
# Number of points required for a resection.
_ENOUGH = 4
# Fraction of contradicting points from which an image may have another's station.
_DOUBTED = 0.25


def coordinate_exchanges(
    at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sizes: PaddedSizes
) -> tuple[list[Exchange], Adjustment]:
    """Return exchanges that resolve rejected rows `left` and points that are `gone`; `at` is the linearised block.

    Also returns `at` with positions from the images.
    """
    found: list[Exchange] = []
    for group, rows in at.block.named_observations.items():
        if not isinstance(rows, AbstractCoordinates) or len(rows.indices()) != 1:
            continue
        ((what, who),) = ((what, to_numpy(index)) for what, index in rows.indices())
        doubted = _doubted(at.block, left, group, what, who, gone)
        if len(doubted) < 2:
            continue
        if what == "point":
            # However large the misclosure of their rays: an image distorted by these still gives a close position.
            places = points_that_meet(at, left, doubted, np.inf)
            by_images, placed = with_places(at, places), list(places)
        else:
            by_images, placed = _placed_images(at, doubted, gone)
        there = linearise(at.block, by_images.unknowns, at.block.priors, sizes)
        off = np.where(np.isin(who, placed), rows.physical(to_numpy(there.residuals[group])), np.nan)
        near = _NEARER if left[group].all() else _NEAR
        if new := [_exchange(at.block, rows, what, *own) for own in _rounds(rows, who, doubted, off, near)]:
            found, at = found + new, by_images
    return found, at


def as_one(block: Block, done: Sequence[Exchange], left: Masks) -> list[Exchange]:
    """Merge exchanges of coordinates found successively; all others unchanged.

    Objects all of whose rows are rejected in the end have no coordinates of their own.
    """
    found = []
    for group, rows in block.named_observations.items():
        own = [e for e in done if e.group == group]
        if not isinstance(rows, AbstractCoordinates) or not own:
            found += own
            continue
        ((what, who),) = ((what, to_numpy(index)) for what, index in rows.indices())
        order, out = np.arange(len(rows)), left[group]
        for one in (one for e in own for one in e.rows):
            order[list(one)] = order[np.roll(one, -1)]
        lacks = set(np.flatnonzero(out & ~np.isin(who, who[~out])).tolist())
        rounds: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
        for one in _rounds_of(order, lacks):
            rounds.setdefault(tuple(who[list(one)].tolist()), []).append(one)
        for ids, axes in rounds.items():
            gone = tuple(row for one in axes for row in one[-1:] if row in lacks)
            found.append(_exchange(block, rows, what, ids, tuple(axes), gone))
    return found


def _rounds_of(order: Int[np.ndarray, "rows"], last: set[int]) -> Iterator[tuple[int, ...]]:
    """Return cycles of rows, `order[k]` the source of row k; ending with one of `last`."""
    seen: set[int] = set()
    for first in np.flatnonzero(order != np.arange(len(order))).tolist():
        if first in seen:
            continue
        one = [first]
        while (following := int(order[one[-1]])) != first:
            one.append(following)
        seen.update(one)
        end = next((k + 1 for k, row in enumerate(one) if row in last), 0)
        yield (*one[end:], *one[:end])


def _exchange(
    block: Block,
    rows: AbstractCoordinates,
    what: str,
    ids: tuple[int, ...],
    own: tuple[tuple[int, ...], ...],
    lacks: tuple[int, ...],
) -> Exchange:
    p = block.image_points
    seen = np.flatnonzero(np.isin(p.point if what == "point" else p.image, ids))
    back = {p.group: tuple(seen.tolist()), rows.group: tuple(row for of_axis in own for row in of_axis)}
    names = [(block.points if what == "point" else block.images)[k] for k in ids]
    many, has, otherwise = (
        ("control points", "coordinates", "their names are exchanged in all images")
        if what == "point"
        else ("images", "station", "their image points are exchanged")
    )
    if len(ids) == 2 and not lacks:
        words = f"{many} {names[0]} and {names[1]} had each other's {has}, or {otherwise}"
    else:
        stood = [f"{a}'s stood at {b}" for a, b in zip(names, names[1:] + names[:1], strict=True)]
        stood = stood[: -1 if lacks else None]
        # In the order of the block, except for the closing link.
        off = int((np.abs(np.diff([*ids, ids[0]])) == 1).sum()) >= len(ids) - 1
        words = (
            f"{len(ids)} {many} had one another's {has}, {few(stood)}"
            f"{': the rows are off by one' if off else ''}; or {otherwise}"
        )
    return Exchange(rows.group, own, words, back, lacks)


def _doubted(
    block: Block, left: Masks, group: str, what: str, who: Int[np.ndarray, "rows"], gone
) -> Int[np.ndarray, "doubted"]:
    """Return points or images of the group with a contradicting observation."""
    p = block.image_points
    out, theirs = left[p.group], p.point if what == "point" else p.image
    seen, wrong = (np.bincount(theirs[k], minlength=int(np.max(who)) + 1) for k in (np.s_[:], out))
    some = wrong > (0 if what == "point" else _DOUBTED * seen)
    lost = np.intersect1d(who, gone) if what == "point" else gone[:0]
    return np.unique(np.concatenate([who[left[group]], who[some[who]], lost]))


def _placed_images(
    at: Adjustment, images: Int[np.ndarray, "doubted"], gone: Int[np.ndarray, "points"]
) -> tuple[Adjustment, list[int]]:
    """Return `at` with these images resected from their points, and True for those with enough points.

    Points are intersected from other images, if these suffice: an image with a wrong station has distorted them.
    """
    block, exterior = at.block, at.unknowns.exterior
    p, points = block.image_points, to_numpy(at.unknowns.points)
    positions, matrices = (np.array(to_numpy(v)) for v in (exterior.position, exterior.camera_from_object))
    placed = []
    for image in images.tolist():
        own = np.flatnonzero((p.image == image) & ~np.isin(p.point, gone))
        known, which = np.unique(p.point[own], return_inverse=True)
        met, told = _met(at, known, np.isin(p.point, known) & (p.image != image))
        places = met if told.sum() >= _ENOUGH else points[known]
        chosen = np.isfinite(places[which]).all(axis=1)
        interior = at.unknowns.interior[block.image_camera[image]]
        try:
            seen = resect(interior, to_numpy(p.xy)[own[chosen]], places[which[chosen]], block.images[image])
        except BlockError:
            continue
        positions[image], matrices[image] = to_numpy(seen.position), to_numpy(seen.camera_from_object)
        placed.append(image)
    new = ExteriorOrientation(jnp.asarray(positions), jnp.asarray(matrices))
    at = eqx.tree_at(lambda a: a.unknowns.exterior, at, new)
    # Its points move along: they were distorted by wrong stations, and would pull it back.
    known = np.unique(p.point[np.isin(p.image, placed)])
    met, told = _met(at, known, np.isin(p.point, known))
    return with_places(at, dict(zip(known[told].tolist(), met[told], strict=True))), placed


def _met(
    at: Adjustment, points: Int[np.ndarray, "n"], rows: Bool[np.ndarray, "rows"]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Return the intersections of the rays of these rows (m), by point, and True where they are valid."""
    origins, directions, _ = rays_of(at)
    which = np.searchsorted(points, at.block.image_points.point[rows])
    return intersect_points(origins[rows], directions[rows], which, len(points))


def _rounds(rows: AbstractCoordinates, who, doubted, off: Float[np.ndarray, "rows"], near: float) -> Iterator[tuple]:
    """Return cycles in which each lies where the next is said to be, and their rows, axis by axis.

    `off` is observed minus determined (m), NaN if undetermined by the images. The last lies where the first is said to
    be; or is not determined, and coordinates are then not of a single axis; or lies elsewhere, and its observation is
    removed: a file shifted by a row lacks one row, and may contain one twice.
    """
    own = {int(k): np.flatnonzero(who == k) for k in doubted}
    own = {k: mine[np.argsort(rows.axis[mine])] for k, mine in own.items()}
    after = _lying_at(rows, own, off, near)
    while after:
        first = next((k for k in after if k not in after.values()), next(iter(after)))
        ids = [first]
        while (following := after.pop(ids[-1], None)) not in (None, first):
            ids.append(following)
        last = own[ids[-1]]
        closed, unseen = following == first, not np.isfinite(off[last]).all()
        if closed or len(ids) > 2 or len(last) > 1:
            lacks = () if closed or unseen else tuple(last.tolist())
            yield tuple(ids), tuple(zip(*(own[k].tolist() for k in ids), strict=True)), lacks


def _lying_at(
    rows: AbstractCoordinates, own: dict[int, Int[np.ndarray, "axes"]], off: Float[np.ndarray, "rows"], near: float
) -> dict[int, int]:
    """Return the pairs of positions and stated coordinates that coincide."""
    found: list[tuple[float, int, int]] = []
    for axes in {tuple(rows.axis[mine].tolist()) for mine in own.values()}:
        ids = [k for k, mine in own.items() if tuple(rows.axis[mine].tolist()) == axes]
        said = np.array([np.asarray(rows.value)[own[k]] for k in ids])
        seen = said - np.array([off[own[k]] for k in ids])
        told = np.flatnonzero(np.isfinite(seen).all(axis=1))
        for k in told.tolist() if len(ids) > 1 else ():
            miss = np.abs(said - seen[k]).max(axis=1)
            nearest, second = np.argsort(miss)[:2].tolist()
            # Correct ones have their own; and some of many lie close to another's by chance.
            if nearest != k and miss[nearest] < near * miss[second]:
                found.append((float(miss[nearest]), ids[k], ids[nearest]))
    after: dict[int, int] = {}
    for _, a, b in sorted(found):
        if b not in after.values():
            after[a] = b
    return after
