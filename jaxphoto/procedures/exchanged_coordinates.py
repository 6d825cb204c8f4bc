"""Two control points that have each other's coordinates, or two images each other's station.

The images alone say where either is: a point, where its rays meet; an image, from where it sees its points. Where each
lies where the other is said to be, the two were exchanged. As well may the names of the two points have been exchanged
in all images: no measurement tells one from the other, and the camera is the same.
"""

from collections.abc import Iterator
from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment, Sizes, linearise
from jaxphoto.arrays import still
from jaxphoto.block import Block
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.observations import AbstractCoordinates
from jaxphoto.orientation import resect
from jaxphoto.procedures.exchange import Exchange, with_places
from jaxphoto.procedures.exchanged_names import points_that_meet
from jaxphoto.procedures.robust import Masks

# Two may have each other's coordinates where each lies as near to those of the other, beside how far apart these are.
_NEAR = 0.2
# An image may have another's station where more of its points than this part contradict the others.
_DOUBTED = 0.25


def coordinate_exchanges(
    at: Adjustment, left: Masks, gone: Int[np.ndarray, "points"], sizes: Sizes
) -> tuple[list[Exchange], Adjustment]:
    """The exchanges that put right what is `left` out, and points that are `gone`, of `at`: the block linearised.

    And `at` with what they are of where the images place it.
    """
    found: list[Exchange] = []
    for group, rows in at.block.named_observations.items():
        if not isinstance(rows, AbstractCoordinates) or len(rows.indices()) != 1:
            continue
        ((what, who),) = ((what, still(index)) for what, index in rows.indices())
        doubted = _doubted(at.block, left, group, what, who, gone)
        if len(doubted) < 2:
            continue
        if what == "point":
            # However badly their rays meet: an image that these have turned puts them near enough.
            places = points_that_meet(at, left, doubted, np.inf)
            by_images, placed = with_places(at, places), list(places)
        else:
            by_images, placed = _placed_images(at, doubted, gone)
        there = linearise(at.block, by_images.unknowns, at.block.priors, sizes)
        off = np.where(np.isin(who, placed), rows.physical(still(there.residuals[group])), np.nan)
        if new := [_exchange(at.block, rows, what, *pair) for pair in _pairs(rows, who, doubted, off)]:
            found, at = found + new, by_images
    return found, at


def _exchange(
    block: Block, rows: AbstractCoordinates, what: str, ids: tuple[int, int], pairs: tuple[tuple[int, int], ...]
) -> Exchange:
    p = block.image_points
    seen = np.flatnonzero(np.isin(p.point if what == "point" else p.image, ids))
    back = {p.group: tuple(seen.tolist()), rows.group: tuple(row for pair in pairs for row in pair)}
    one, other = ((block.points if what == "point" else block.images)[k] for k in ids)
    words = (
        f"control points {one} and {other} had each other's coordinates, or their names are exchanged in all images"
        if what == "point"
        else f"images {one} and {other} had each other's station, or their image points are exchanged"
    )
    return Exchange(rows.group, pairs, words, back)


def _doubted(
    block: Block, left: Masks, group: str, what: str, who: Int[np.ndarray, "rows"], gone
) -> Int[np.ndarray, "doubted"]:
    """Points or images of the group of which something contradicts the others."""
    p = block.image_points
    out, theirs = left[p.group], p.point if what == "point" else p.image
    seen, wrong = (np.bincount(theirs[k], minlength=int(np.max(who)) + 1) for k in (np.s_[:], out))
    some = wrong > (0 if what == "point" else _DOUBTED * seen)
    lost = np.intersect1d(who, gone) if what == "point" else gone[:0]
    return np.unique(np.concatenate([who[left[group]], who[some[who]], lost]))


def _placed_images(
    at: Adjustment, images: Int[np.ndarray, "doubted"], gone: Int[np.ndarray, "points"]
) -> tuple[Adjustment, list[int]]:
    """`at` with these images where they see their points from, and which of them have enough of them."""
    block, exterior = at.block, at.unknowns.exterior
    p, points = block.image_points, still(at.unknowns.points)
    positions, matrices = (np.array(still(v)) for v in (exterior.position, exterior.camera_from_object))
    placed = []
    for image in images.tolist():
        own = (p.image == image) & ~np.isin(p.point, gone)
        interior = at.unknowns.interior[block.image_camera[image]]
        try:
            seen = resect(interior, still(p.xy)[own], points[p.point[own]], block.images[image])
        except BlockError:
            continue
        positions[image], matrices[image] = still(seen.position), still(seen.camera_from_object)
        placed.append(image)
    new = ExteriorOrientation(jnp.asarray(positions), jnp.asarray(matrices))
    return eqx.tree_at(lambda a: a.unknowns.exterior, at, new), placed


def _pairs(rows: AbstractCoordinates, who, doubted, off: Float[np.ndarray, "rows"]) -> Iterator[tuple]:
    """Pairs of the doubted that lie where the other should be, the nearest first, with their rows.

    `off` is observed minus seen (m), and no number where the images do not tell: then the other of the two decides, of
    coordinates that are not of a single axis.
    """
    value, found = np.asarray(rows.value), []
    own = {int(k): np.flatnonzero(who == k) for k in doubted}
    own = {k: mine[np.argsort(rows.axis[mine])] for k, mine in own.items()}
    for (a, one), (b, other) in combinations(own.items(), 2):
        if not np.array_equal(rows.axis[one], rows.axis[other]):
            continue
        apart = value[other] - value[one]
        # Where the one is seen, from where the other is said to be; and the other way round.
        misses = np.array([np.abs(apart + off[one]).max(), np.abs(apart - off[other]).max()])
        misses = misses[np.isfinite(misses)] / max(np.abs(apart).max(), 1e-9)
        if len(misses) == 2 or (len(misses) == 1 and len(one) > 1):
            found.append((float(misses.max()), (a, b), tuple(zip(one.tolist(), other.tolist(), strict=True))))
    done: set[int] = set()
    for miss, ids, pairs in sorted(found):
        if miss < _NEAR and not done.intersection(ids):
            done.update(ids)
            yield ids, pairs
