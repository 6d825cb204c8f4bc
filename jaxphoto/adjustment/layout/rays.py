"""Order of images and points; rays in chunks of one image, pairs of rays in chunks of two images.

A ray is an image row: one image sees one point. Rays of an image are contiguous, so their contribution to the image is
one matrix product per chunk. The same applies to pairs of rays that see a free point from the same two images, which
contribute to the block of these images in the reduced normal matrix. Images are numbered by reverse Cuthill-McKee,
which makes that matrix banded. If all points are fixed there are no pairs, and the matrix is an arrow: block-diagonal
images with a border of shared unknowns.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.adjustment.model.observed_groups import ObservedGroup
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.short_repr import pretty_repr


@pretty_repr
class PaddedSizes(NamedTuple):
    """Padded length of each list of a block, per device."""

    images: int = 1
    bandwidth: int = 1
    """Largest difference of the indices of two images that share a free point."""
    point_groups: int = 1
    chunks: int = 1
    """Number of chunks of rays."""
    pair_chunks: int = 0
    met: int = 0
    """Largest number of shared unknowns involved in rows at the points of a group."""
    rows: tuple[tuple[str, int], ...] = ()
    """Number of rows of each observation group; for rows stored by point, the largest number at a point."""

    def __or__(self, other: object) -> "PaddedSizes":
        """Return sizes that are sufficient for both."""
        if not isinstance(other, PaddedSizes):
            return NotImplemented
        most = [dict(self.rows), dict(other.rows)]
        rows = tuple((name, max(of.get(name, 0) for of in most)) for name in most[0] | most[1])
        images, bandwidth, groups, chunks, pairs, met = map(max, self[:-1], other[:-1])
        return PaddedSizes(images, bandwidth, groups, chunks, pairs, met, rows)


MINIMAL_SIZES = PaddedSizes()
"""Minimum sizes: no larger than the block requires."""


class Places(NamedTuple):
    """Indices of the block's images, points and image rows in the padded arrays."""

    image: Int[np.ndarray, "images"]
    point: Int[np.ndarray, "points"]
    row: Int[np.ndarray, "rows"]
    """Index of the ray: chunk * `CHUNK` + position in the chunk."""


GROUP = 32
"""Number of points that share a list of the unknowns that their rows involve (`MetUnknowns`)."""
CHUNK, PAIRS = 64, 16
"""Number of rays, and of pairs of rays, per chunk. Half or double these sizes change the solution time by less than 10
%, for blocks of 31 to 200 images and points of five to twenty rays.
"""
# Maximum number of images of a block that are not sorted: a larger reduced matrix costs less than another compiled
# program.
_SMALL = 64
# Constant cost of a column block, in floating-point operations (measured: about 10 microseconds).
_OVERHEAD = 2e5

NO_SLOT = int(np.iinfo(np.int32).max)
"""Slot without an unknown: larger than any list, so additions to it are dropped."""


def size_class(n: int, step: int) -> int:
    """Round up to a multiple of `step`; above 16 steps, to 8 to 16 times a power of two times `step`."""
    while n > 16 * step:
        step *= 2
    return -(-n // step) * step


def sizes_of(structure: Structure) -> PaddedSizes:
    """Return the sizes of a block, including one padding image."""
    return RayLayout.of(structure, MINIMAL_SIZES, shards=1, dense=False).sizes


class MetUnknowns(NamedTuple):
    """Shared unknowns that rows at points involve, by group of points."""

    group_of: Int[np.ndarray, "points"]
    key: Int[np.ndarray, "met"]
    """Group * (number of unknowns + 1) + unknown, sorted."""
    slot: Int[np.ndarray, "met"]
    """Slot of each unknown in the list of its group."""
    n_shared: int

    @classmethod
    def of(cls, s: Structure, group_of: Int[np.ndarray, "points"]) -> "MetUnknowns":
        """Collect the unknowns; `group_of` is the group of each point of the block."""
        touched = [np.zeros(0, np.int64)]
        for g in (g for g in s.observed if g.elimination == "point"):
            touched.append(_keys(group_of[g.point[0]], g.column, s.n_shared))
        key = np.unique(np.concatenate(touched))
        group = key // (s.n_shared + 1)
        return cls(group_of, key, np.arange(len(key)) - np.searchsorted(group, group), s.n_shared)

    @property
    def most(self) -> int:
        """Largest number of unknowns of a group, rounded up to few size classes."""
        return size_class(int(self.slot.max(initial=-1)) + 1, 8)

    def listed(self, groups: int, size: int) -> Int[np.ndarray, "groups size"]:
        """Return the lists of all groups, padded with the number of unknowns."""
        result = np.full((groups, size), self.n_shared, np.int32)
        result[self.key // (self.n_shared + 1), self.slot] = self.key % (self.n_shared + 1)
        return result

    def slots(self, g: ObservedGroup) -> Int[np.ndarray, "l rows"]:
        """Return the slot of each unknown of a row in the list of its group."""
        found = np.full(g.column.shape, NO_SLOT, np.int32)
        free = g.column < self.n_shared
        found[free] = self.slot[np.searchsorted(self.key, _keys(self.group_of[g.point[0]], g.column, self.n_shared))]
        return found


def _keys(group: np.ndarray, column: np.ndarray, n_shared: int) -> np.ndarray:
    return (group.astype(np.int64) * (n_shared + 1) + column)[column < n_shared]


class Chunks(NamedTuple):
    """Elements sorted by a key and cut into chunks of one key each."""

    key: Int[np.ndarray, "chunks"]
    slot: Int[np.ndarray, "numbers"]
    """Slot of each element: chunk * size + position in the chunk."""

    @classmethod
    def of(cls, key: Int[np.ndarray, "numbers"], size: int) -> "Chunks":
        """Cut sorted keys into chunks."""
        which, first, count = np.unique(key, return_index=True, return_counts=True)
        n = -(-count // size)
        rank = np.arange(len(key)) - np.repeat(first, count)
        return cls(np.repeat(which, n), np.repeat(np.cumsum(n) - n, count) * size + rank)


class DeviceLists(NamedTuple):
    """Rays and pairs of the points of one device."""

    ray: Int[np.ndarray, "rays"]
    """Image rows of the block, sorted by image and index of the point."""
    image: Int[np.ndarray, "rays"]
    pair: Int[np.ndarray, "2 pairs"]
    """Indices in `ray` of two rays of a free point; the image of the first does not precede that of the second. Sorted
    by images.
    """
    images: Int[np.ndarray, "pairs"]
    """Both images as one integer: index of the first * `n_images` + index of the second."""
    chunks: Chunks
    """Chunks of rays, by image."""
    pair_chunks: Chunks
    """Chunks of pairs, by both images."""

    @classmethod
    def of(cls, row, image, point, own, n_images: int) -> "DeviceLists":
        """Build the lists from image rows `row`, indices of their images and points, and flags of free points."""
        order = np.lexsort((point, image))
        row, image, point, own = row[order], image[order], point[order], own[order]
        by_point = np.argsort(np.where(own, point, np.iinfo(np.int32).max), kind="stable")[: int(own.sum())]
        at, one, other = point[by_point], [], []
        # The images of a point are in ascending order.
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
    """Order of images and points, rays and pairs by device."""

    image_place: Int[np.ndarray, "images"]
    point_place: Int[np.ndarray, "points"]
    columns: int
    """Number of column blocks of the reduced matrix."""
    width: int
    """Images per column block."""
    devices: tuple[DeviceLists, ...]
    met: MetUnknowns
    sizes: PaddedSizes

    @classmethod
    def of(cls, s: Structure, wanted: PaddedSizes, shards: int, dense: bool) -> "RayLayout":
        """Arrange a block with at least the sizes `wanted`; `dense` requests a dense reduced matrix, not a band."""
        own = np.any(s.point_free, axis=0)[s.point]
        place, bandwidth = order_images(*_meetings(s, own))
        images, bandwidth = max(s.n_images + 1, wanted.images), max(bandwidth, wanted.bandwidth)
        n = size_class(images, 32 if images <= _SMALL else 16)
        columns, width = (1, n) if dense else column_blocks(n, min(n, size_class(bandwidth, 8)))
        groups = size_class(max(-(-s.n_points // (GROUP * shards)), wanted.point_groups), 16)
        image = place[s.image]
        point_place = np.empty(s.n_points, np.int32)
        # All devices store the same number of points, including padding.
        of_device, number = np.divmod(np.arange(s.n_points), max(-(-s.n_points // shards), 1))
        point_place[_order_points(image, s.point, s.n_points)] = of_device * groups * GROUP + number
        device = point_place[s.point] // (groups * GROUP)
        rows = [np.flatnonzero(device == k) for k in range(shards)]
        lists = tuple(
            DeviceLists.of(row, image[row], point_place[s.point[row]], own[row], columns * width) for row in rows
        )
        met = MetUnknowns.of(s, point_place // GROUP)
        sizes = PaddedSizes(
            images=images,
            bandwidth=bandwidth,
            point_groups=groups,
            # Add at least one empty ray: padding of pairs refers to it.
            chunks=max(len(d.chunks.key) + 1 for d in lists),
            pair_chunks=max(len(d.pair_chunks.key) for d in lists),
            met=met.most,
            rows=tuple((g.name, g.depth if g.elimination == "point" else g.n_rows) for g in s.observed),
        )
        return cls(place, point_place, columns, width, lists, met, sizes)


def order_images(image: np.ndarray, point: np.ndarray, n_images: int, n_points: int) -> tuple[np.ndarray, int]:
    """Return the index of each image, and the largest index difference of two images that share a point."""
    if n_images < _SMALL or not len(image):
        return np.arange(n_images, dtype=np.int32), n_images if len(image) else 1
    # Import here: it takes 0.1 s, and small blocks do not need it.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    sees = csr_matrix((np.ones(len(image), np.int32), (point, image)), shape=(n_points, n_images))
    meet = (sees.T @ sees).tocsr()
    place = np.empty(n_images, np.int32)
    place[reverse_cuthill_mckee(meet, symmetric_mode=True)] = np.arange(n_images)
    one, other = meet.nonzero()
    return place, int(np.abs(place[one] - place[other]).max(initial=1))


def _order_points(image: np.ndarray, point: np.ndarray, n_points: int) -> Int[np.ndarray, "points"]:
    """Sort points by first, last and mean image to store neighbours contiguously."""
    low, high, total = np.full(n_points, np.inf), np.zeros(n_points), np.zeros(n_points)
    np.minimum.at(low, point, image)
    np.maximum.at(high, point, image)
    np.add.at(total, point, image)
    rays = np.bincount(point, minlength=n_points)
    return np.lexsort((total / np.maximum(rays, 1), high, np.where(rays, low, 0.0)))


def column_blocks(n_images: int, bandwidth: int) -> tuple[int, int]:
    """Choose the number k of column blocks and the number w of images in each; images further apart than `bandwidth`
    share no point.

    w >= bandwidth and k w >= n_images. The cost is the number of operations of the factorisation: n^3 / 3 if dense,
    with n = 6 n_images; m^3 / 3 for each of k column blocks with m = 6 w, 3 m^3 for each but the last (triangular
    solution m^3, product 2 m^3), and a constant each. The w of least cost is used if it at least halves the cost, else
    one column block.
    """

    def cost(k: int, w: int) -> float:
        m = 6 * w
        return k * m**3 / 3 + (k - 1) * 3 * m**3 + k * _OVERHEAD

    n = max(n_images, 1)
    narrowest = min(max(bandwidth, 1), n)
    # Try the minimum width for each number of column blocks; a larger width only adds padding.
    widths = {max(narrowest, -(-n // k)) for k in range(1, -(-n // narrowest) + 1)}
    choices = [(-(-n // w), w) for w in sorted(widths)]
    best = min(choices, key=lambda choice: cost(*choice))
    return best if 2 * cost(*best) <= cost(1, n) else (1, n)


def _meetings(s: Structure, own: Bool[np.ndarray, "rows"]) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Return image and point of the rays of free points; images coupled by an observation share an artificial point."""
    image, point, n = [s.image[own]], [s.point[own]], s.n_points
    for g in s.observed:
        if g.elimination == "reduced" and len(g.image) > 1:
            image.append(g.image.T.ravel())
            point.append(n + np.repeat(np.arange(g.n_rows), len(g.image)))
            n += g.n_rows
    return np.concatenate(image), np.concatenate(point), s.n_images, n
