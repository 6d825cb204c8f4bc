"""The layout of a block: images in order, rays in chunks of one image, pairs of rays in chunks of two images.

A ray is an image row: one image sees one point. Rays of an image lie together, so what they add to the image is one
product of matrices a chunk; so do pairs of rays that see a free point from the same two images, so what its elimination
adds to the block of these two images in the reduced normal matrix is one product, too. Images are numbered so that
those which meet lie close (reverse Cuthill-McKee), which makes that matrix a band. Where all points are fixed there are
no pairs, and it is an arrow: images by themselves, and what they share.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.adjustment.model.observed_groups import ObservedGroup
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.short_repr import shown


@shown
class Sizes(NamedTuple):
    """How large each kind of list is, in a block or as it is compiled for; of one device."""

    images: int = 1
    bandwidth: int = 1
    """Largest difference of places of two images that meet in a free point."""
    point_groups: int = 1
    chunks: int = 1
    """Of rays."""
    pair_chunks: int = 0
    met: int = 0
    """Shared unknowns that rows at the points of a group touch, in the group that has most."""
    rows: tuple[tuple[str, int], ...] = ()
    """Of each group of observations; of rows at points, the most that a point has."""

    def __or__(self, other: object) -> "Sizes":
        """What both fit into."""
        if not isinstance(other, Sizes):
            return NotImplemented
        most = [dict(self.rows), dict(other.rows)]
        rows = tuple((name, max(of.get(name, 0) for of in most)) for name in most[0] | most[1])
        images, bandwidth, groups, chunks, pairs, met = map(max, self[:-1], other[:-1])
        return Sizes(images, bandwidth, groups, chunks, pairs, met, rows)


LEAST = Sizes()
"""No more than a block needs by itself."""


class Places(NamedTuple):
    """Where a block's own images, points and image rows lie in the padded arrays."""

    image: Int[np.ndarray, "images"]
    point: Int[np.ndarray, "points"]
    row: Int[np.ndarray, "rows"]
    """Number of the ray: chunk * `CHUNK` + place in it."""


GROUP = 32
"""Points that share a list of the unknowns that their rows touch (`MetUnknowns`)."""
CHUNK, PAIRS = 64, 16
"""Rays, and pairs of rays, of a chunk. Half or twice as many change the time of a solution by less than a tenth, in
blocks of 31 to 200 images and points of five to twenty rays."""
# Up to so many images, a larger reduced matrix costs less than another program; and any order of them will do.
_SMALL = 64
# What a column block costs beside its operations, counted in operations (measured: about 10 microseconds).
_OVERHEAD = 2e5

NO_SLOT = int(np.iinfo(np.int32).max)
"""For what is no unknown: no group meets so many, and what is added there is dropped."""


def size_class(n: int, step: int) -> int:
    """The next multiple of `step`; of more than 16 steps the next that is 8 to 16 times a power of two of them."""
    while n > 16 * step:
        step *= 2
    return -(-n // step) * step


def sizes_of(structure: Structure) -> Sizes:
    """The sizes of a block, with room for the image that nothing needs."""
    return RayLayout.of(structure, LEAST, shards=1, dense=False).sizes


class MetUnknowns(NamedTuple):
    """Which shared unknowns rows at points touch, by groups of points."""

    group_of: Int[np.ndarray, "points"]
    key: Int[np.ndarray, "met"]
    """Group * (number of unknowns + 1) + unknown, sorted."""
    slot: Int[np.ndarray, "met"]
    """Which of its group's it is."""
    n_shared: int

    @classmethod
    def of(cls, s: Structure, group_of: Int[np.ndarray, "points"]) -> "MetUnknowns":
        """`group_of` is the group of each of the block's points."""
        touched = [np.zeros(0, np.int64)]
        for g in (g for g in s.observed if g.elimination == "point"):
            touched.append(_keys(group_of[g.point[0]], g.column, s.n_shared))
        key = np.unique(np.concatenate(touched))
        group = key // (s.n_shared + 1)
        return cls(group_of, key, np.arange(len(key)) - np.searchsorted(group, group), s.n_shared)

    @property
    def most(self) -> int:
        """How many lie in one group, in steps of which there are few."""
        return size_class(int(self.slot.max(initial=-1)) + 1, 8)

    def listed(self, groups: int, size: int) -> Int[np.ndarray, "groups size"]:
        """Those of every group, and the number of unknowns in places too many."""
        result = np.full((groups, size), self.n_shared, np.int32)
        result[self.key // (self.n_shared + 1), self.slot] = self.key % (self.n_shared + 1)
        return result

    def slots(self, g: ObservedGroup) -> Int[np.ndarray, "l rows"]:
        """Which of its group's each unknown of a row is."""
        found = np.full(g.column.shape, NO_SLOT, np.int32)
        free = g.column < self.n_shared
        found[free] = self.slot[np.searchsorted(self.key, _keys(self.group_of[g.point[0]], g.column, self.n_shared))]
        return found


def _keys(group: np.ndarray, column: np.ndarray, n_shared: int) -> np.ndarray:
    return (group.astype(np.int64) * (n_shared + 1) + column)[column < n_shared]


class Chunks(NamedTuple):
    """Numbers in order of a key, cut into chunks of one key each."""

    key: Int[np.ndarray, "chunks"]
    slot: Int[np.ndarray, "numbers"]
    """chunk * size + place in it, of each."""

    @classmethod
    def of(cls, key: Int[np.ndarray, "numbers"], size: int) -> "Chunks":
        """Of sorted keys."""
        which, first, count = np.unique(key, return_index=True, return_counts=True)
        n = -(-count // size)
        rank = np.arange(len(key)) - np.repeat(first, count)
        return cls(np.repeat(which, n), np.repeat(np.cumsum(n) - n, count) * size + rank)


class DeviceLists(NamedTuple):
    """Rays and pairs of the points that one device has."""

    ray: Int[np.ndarray, "rays"]
    """Rows of the block, by image and place of the point."""
    image: Int[np.ndarray, "rays"]
    pair: Int[np.ndarray, "2 pairs"]
    """Numbers among `ray` of two that see a free point, the image of the first not before that of the second; by
    images."""
    images: Int[np.ndarray, "pairs"]
    """Both images as one number: place of the first * `n_images` + place of the second."""
    chunks: Chunks
    """Of rays, by image,"""
    pair_chunks: Chunks
    """and of pairs, by both images."""

    @classmethod
    def of(cls, row, image, point, own, n_images: int) -> "DeviceLists":
        """Of image rows `row`, with their places of images and points, and whether the point is free."""
        order = np.lexsort((point, image))
        row, image, point, own = row[order], image[order], point[order], own[order]
        by_point = np.argsort(np.where(own, point, np.iinfo(np.int32).max), kind="stable")[: int(own.sum())]
        at, one, other = point[by_point], [], []
        # Of a point, images ascend.
        for step in range(1, int(np.bincount(at).max(initial=0))):
            same = np.flatnonzero(at[step:] == at[:-step])
            one.append(by_point[same + step])
            other.append(by_point[same])
        none = [np.zeros(0, np.int64)]
        pair = np.stack([np.concatenate(none + one), np.concatenate(none + other)])
        images = image[pair[0]].astype(np.int64) * n_images + image[pair[1]]
        order = np.argsort(images, kind="stable")
        images = images[order]
        return cls(row, image, pair[:, order], images, Chunks.of(image, CHUNK), Chunks.of(images, PAIRS))


class RayLayout(NamedTuple):
    """Images in order, points in order, rays and pairs by device."""

    image_place: Int[np.ndarray, "images"]
    point_place: Int[np.ndarray, "points"]
    columns: int
    """Column blocks of the reduced matrix."""
    width: int
    """Images of each."""
    devices: tuple[DeviceLists, ...]
    met: MetUnknowns
    sizes: Sizes

    @classmethod
    def of(cls, s: Structure, wanted: Sizes, shards: int, dense: bool) -> "RayLayout":
        """Lay out a block with sizes of `wanted` at least; `dense` asks for a reduced matrix that is not a band."""
        own = np.any(s.point_free, axis=0)[s.point]
        place, bandwidth = order_images(*_meetings(s, own))
        images, bandwidth = max(s.n_images + 1, wanted.images), max(bandwidth, wanted.bandwidth)
        n = size_class(images, 32 if images <= _SMALL else 16)
        columns, width = (1, n) if dense else column_blocks(n, min(n, size_class(bandwidth, 8)))
        groups = size_class(max(-(-s.n_points // (GROUP * shards)), wanted.point_groups), 16)
        image = place[s.image]
        point_place = np.empty(s.n_points, np.int32)
        # Devices have as many points each, whatever the padding.
        of_device, number = np.divmod(np.arange(s.n_points), max(-(-s.n_points // shards), 1))
        point_place[_order_points(image, s.point, s.n_points)] = of_device * groups * GROUP + number
        device = point_place[s.point] // (groups * GROUP)
        rows = [np.flatnonzero(device == k) for k in range(shards)]
        lists = tuple(
            DeviceLists.of(row, image[row], point_place[s.point[row]], own[row], columns * width) for row in rows
        )
        met = MetUnknowns.of(s, point_place // GROUP)
        sizes = Sizes(
            images=images,
            bandwidth=bandwidth,
            point_groups=groups,
            # One ray at least is none: what fills up chunks of pairs is made of it.
            chunks=max(len(d.chunks.key) + 1 for d in lists),
            pair_chunks=max(len(d.pair_chunks.key) for d in lists),
            met=met.most,
            rows=tuple((g.name, g.depth if g.elimination == "point" else g.n_rows) for g in s.observed),
        )
        return cls(place, point_place, columns, width, lists, met, sizes)


def order_images(image: np.ndarray, point: np.ndarray, n_images: int, n_points: int) -> tuple[np.ndarray, int]:
    """The place of each image, and the largest difference of places of two images that see a point together."""
    if n_images < _SMALL or not len(image):
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


def _order_points(image: np.ndarray, point: np.ndarray, n_points: int) -> Int[np.ndarray, "points"]:
    """Points by the first, last and mean image that sees them: those that lie together follow one another."""
    low, high, total = np.full(n_points, np.inf), np.zeros(n_points), np.zeros(n_points)
    np.minimum.at(low, point, image)
    np.maximum.at(high, point, image)
    np.add.at(total, point, image)
    rays = np.bincount(point, minlength=n_points)
    return np.lexsort((total / np.maximum(rays, 1), high, np.where(rays, low, 0.0)))


def column_blocks(n_images: int, bandwidth: int) -> tuple[int, int]:
    """Number k of column blocks and images w of each, for images of which none meet further apart than `bandwidth`.

    w >= bandwidth and k w >= n_images. Costs counted are operations of the factorization: n^3 / 3 of a dense one with
    n = 6 n_images, and m^3 / 3 for each of k column blocks with m = 6 w, 3 m^3 for each but the last (triangular
    solution m^3, product 2 m^3) and a constant for each. The w of least cost is taken if it halves the cost at least,
    else the block is one column.
    """

    def cost(k: int, w: int) -> float:
        m = 6 * w
        return k * m**3 / 3 + (k - 1) * 3 * m**3 + k * _OVERHEAD

    n = max(n_images, 1)
    narrowest = min(max(bandwidth, 1), n)
    # For each number of column blocks the narrowest; more of them would only be padding.
    widths = {max(narrowest, -(-n // k)) for k in range(1, -(-n // narrowest) + 1)}
    choices = [(-(-n // w), w) for w in sorted(widths)]
    best = min(choices, key=lambda choice: cost(*choice))
    return best if 2 * cost(*best) <= cost(1, n) else (1, n)


def _meetings(s: Structure, own: Bool[np.ndarray, "rows"]) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Which images meet in which free points (`own` rows); those that an observation joins, in a point of their own."""
    image, point, n = [s.image[own]], [s.point[own]], s.n_points
    for g in s.observed:
        if g.elimination == "reduced" and len(g.image) > 1:
            image.append(g.image.T.ravel())
            point.append(n + np.repeat(np.arange(g.n_rows), len(g.image)))
            n += g.n_rows
    return np.concatenate(image), np.concatenate(point), s.n_images, n
