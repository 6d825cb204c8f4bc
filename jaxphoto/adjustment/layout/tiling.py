"""Tiles: a few points with all the images that see any of them; their sums are products of small dense matrices.

Aerial and close-range blocks alike are locally dense: points that lie together are seen by nearly the same images. A
tile of P points and M images holds M x P slots, empty where an image does not see a point; what is computed on it needs
no list of rows, only the M numbers of its images. Images are numbered so that those which meet lie close (reverse
Cuthill-McKee), which makes the reduced normal matrix a band and lets points in the order of their images fill tiles.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Int


class Tiling(NamedTuple):
    """Where every point and every image row lies."""

    image: Int[np.ndarray, "tiles m"]
    """Places of a tile's images, ascending; -1 in slots that are empty."""
    place: Int[np.ndarray, "points"]
    """Of each point: tile * P + number in the tile."""
    slot: Int[np.ndarray, "rows"]
    """Of each image row: (tile * M + image) * P + point."""


# Below this the reduced matrix is dense anyway, and any order will do.
_FEW_IMAGES = 64


def order_images(image: np.ndarray, point: np.ndarray, n_images: int, n_points: int) -> tuple[np.ndarray, int]:
    """The place of each image, and the largest difference of places of two images that see a point together."""
    if n_images < _FEW_IMAGES or not len(image):
        return np.arange(n_images, dtype=np.int32), n_images if len(image) else 1
    # Imported here: it takes a tenth of a second, which small blocks need not wait for.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    sees = csr_matrix((np.ones(len(image), np.int32), (point, image)), shape=(n_points, n_images))
    meet = (sees.T @ sees).tocsr()
    place = np.empty(n_images, np.int32)
    place[reverse_cuthill_mckee(meet, symmetric_mode=True)] = np.arange(n_images)
    one, other = meet.nonzero()
    return place, int(np.abs(place[one] - place[other]).max(initial=1))


# Tiles come in multiples of this many: padding takes milliseconds, compiling seconds. A power of two, so that any
# number of tiles that fits a core's cache divides it.
TILE_STEP = 32
# Slots that are computed with at a time.
_SLOTS = 4000


def size_class(n: int, step: int) -> int:
    """The next multiple of `step`; of more than 16 steps the next that is 8 to 16 times a power of two of them."""
    while n > 16 * step:
        step *= 2
    return -(-n // step) * step


def tiles_at_once(m: int, p: int) -> int:
    """Return how many tiles of `m` images and `p` points are computed with at a time: a divisor of `TILE_STEP`."""
    return max(k for k in range(1, TILE_STEP + 1) if TILE_STEP % k == 0 and k * m * p <= max(_SLOTS, m * p))


# Points of a tile that are tried.
_POINTS = (8, 32)


def tile_shape(image: np.ndarray, point: np.ndarray, n_images: int, n_points: int) -> tuple[int, int]:
    """Return the images and points of a tile that make the sums cheapest, found on a part of the block; see `_cost`.

    Shapes are few, so that small blocks differ in little that they are compiled for: images are a multiple of 12, or
    all.
    """
    orders, images = _orders(image, point, n_points)
    parts = [_part_of(order) for order in orders]
    of_all = n_points / max(len(parts[0]), 1)
    most = max(1, max(map(len, images), default=1))
    all_images = size_class(n_images, 8)
    widths = {min(size_class(int(np.ceil(k * most)), 12), all_images) for k in (1, 1.25, 1.5, 2)}
    options = [(m, p) for m in sorted(widths) for p in _POINTS]
    return min(options, key=lambda shape: _cost(math.ceil(of_all * len(_best_cut(parts, images, *shape)[1])), *shape))


# Points of a tile, all of them fixed, and images of one that are tried.
_FIELD, _WIDTHS = 128, (12, 4)
# Slots whose computation takes as long as what a tile takes besides.
_TILE = 40


def field_shape(image: np.ndarray, point: np.ndarray, n_images: int, n_points: int) -> tuple[int, int]:
    """Images and points of a tile where all points are fixed (`split_points`): a field is cut into few equal parts.

    Where images see few of the points in common, tiles of few images have fewer empty slots.
    """
    parts = -(-max(n_points, 1) // _FIELD)
    p = size_class(-(-n_points // parts), 8)
    fixed = np.ones(n_points, bool)

    def cost(m: int) -> int:
        copy, point_of = split_points(image, point, fixed, m)
        order = np.argsort(copy, kind="stable")
        tiles = len(_best_cut(*_orders(image[order], copy[order], len(point_of)), m, p)[1])
        return tiles * (m * p + _TILE)

    return min((min(m, size_class(max(n_images, 1), 4)) for m in _WIDTHS), key=cost), p


# Points on which tile shapes are tried: so many runs of so many.
_RUNS, _RUN = 6, 500


def _part_of(order: np.ndarray) -> np.ndarray:
    if len(order) <= _RUNS * _RUN:
        return order
    starts = np.linspace(0, len(order) - _RUN, _RUNS).astype(int)
    return order[(starts[:, None] + np.arange(_RUN)).ravel()]


def _cost(tiles: int, m: int, p: int) -> float:
    """Return the microseconds that the sums over all tiles take.

    25 a tile, 0.22 a slot and 1e-4 a multiplication of F F', of all tiles that are computed with, and 0.05 a slot that
    arrays have (residuals, covariances); measured on two cores of an AMD EPYC, blocks of 10 to 200 images.
    """
    at_once = tiles_at_once(m, p)
    n_computed, n_allocated = -(-tiles // at_once) * at_once, size_class(tiles, TILE_STEP)
    return n_computed * (25 + 0.22 * m * p + (6 * m) ** 2 * 3 * p / 1e4) + 0.05 * n_allocated * m * p


def tile_points(image: np.ndarray, point: np.ndarray, n_points: int, m: int, p: int) -> Tiling:
    """Tiles of at most `m` images and `p` points; `image` are places, the rows sorted by point.

    Raises ValueError where a point has more than `m` rays.
    """
    orders, images = _orders(image, point, n_points)
    if max(map(len, images), default=0) > m:
        raise ValueError(f"a point is seen by more than the {m} images of a tile")
    order, tiles = _best_cut(orders, images, m, p)
    own = np.full((len(tiles), m), -1, np.int32)
    place, slot = np.empty(n_points, np.int32), np.empty(len(image), np.int64)
    for t, (members, start, stop) in enumerate(tiles):
        own[t, : len(members)] = members
        place[order[start:stop]] = t * p + np.arange(stop - start)
    tile = place[point] // p
    # A row's image within its tile: the tile's images ascend, so numbers tile by tile do.
    width = int(image.max(initial=0)) + 2
    key = np.where(own >= 0, own, width - 1) + width * np.arange(len(tiles))[:, None]
    column = np.searchsorted(key.ravel(), image + width * tile) - m * tile
    slot = (tile.astype(np.int64) * m + column) * p + place[point] % p
    return Tiling(own, place, slot)


# Images of a point that the second order looks at.
_SORTED_BY = 16


def _orders(image: np.ndarray, point: np.ndarray, n_points: int) -> tuple[list[np.ndarray], list[list[int]]]:
    """Two orders of the points, and each point's images.

    By first image, last image and mean image; and by first image, second image, and so on, which is better where
    there are many more points than sets of images that see one.
    """
    first = np.searchsorted(point, np.arange(n_points + 1))
    rays = np.diff(first)
    seen = rays > 0
    low, high, mean = (np.zeros(n_points) for _ in range(3))
    starts = first[:-1][seen]
    if len(starts):
        low[seen] = np.minimum.reduceat(image, starts)
        high[seen] = np.maximum.reduceat(image, starts)
        mean[seen] = np.add.reduceat(image.astype(float), starts) / rays[seen]
    rank = np.arange(len(image)) - first[point]
    near = rank < _SORTED_BY
    each = np.full((_SORTED_BY, n_points), np.iinfo(np.int32).max, np.int32)
    each[rank[near], point[near]] = image[np.lexsort((image, point))][near]
    places = image.tolist()
    return [np.lexsort((mean, high, low)), np.lexsort(each[::-1])], [places[a:b] for a, b in pairwise(first.tolist())]


def _best_cut(orders: list[np.ndarray], images: list[list[int]], m: int, p: int):
    """The order that makes fewest tiles, and these."""
    return min(((order, _cut(order, images, m, p)) for order in orders), key=lambda cut: len(cut[1]))


def _cut(order: np.ndarray, images: list[list[int]], m: int, p: int) -> list[tuple[list[int], int, int]]:
    """Cut points in their order into tiles: (images, first, last + 1)."""
    tiles, start = [], 0
    members: set[int] = set()
    for k, j in enumerate(order.tolist()):
        own = images[j]
        union = members.union(own)
        if k > start and (len(union) > m or k - start == p):
            tiles.append((sorted(members), start, k))
            union, start = set(own), k
        members = union
    if len(order):
        tiles.append((sorted(members), start, len(order)))
    return tiles


def split_points(
    image: np.ndarray, point: np.ndarray, fixed: np.ndarray, m: int
) -> tuple[Int[np.ndarray, "rows"], Int[np.ndarray, "copies"]]:
    """A copy of each `fixed` point for every `m` images in a row that see it: the copy of each row, the point of each.

    Copies are in the order of their points; a point that no image sees has one as well.
    """
    groups = int(image.max(initial=0)) // m + 1
    key = point.astype(np.int64) * groups + np.where(fixed[point], image // m, 0)
    unseen = np.setdiff1d(np.arange(len(fixed)), point) * groups
    copies = np.union1d(key, unseen)
    return np.searchsorted(copies, key), copies // groups
