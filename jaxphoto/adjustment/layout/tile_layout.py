"""The layout of a block: images in order, points in tiles, tiles in chunks, and how large each list is.

A point without a free coordinate is not eliminated, so nothing makes it unique: where all images of a test field see
the same points, each of them lies once in the tile of every few images. Images that meet in such points only do not
meet in the reduced normal matrix; where no point is free it is an arrow: images by themselves, and what they share.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.adjustment.layout.tiling import (
    TILE_STEP,
    Tiling,
    field_shape,
    order_images,
    size_class,
    split_points,
    tile_points,
    tile_shape,
    tiles_at_once,
)
from jaxphoto.adjustment.model.observed_groups import ObservedGroup
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.short_repr import shown


@shown
class Sizes(NamedTuple):
    """How large each kind of list is, in a block or as it is compiled for."""

    images: int = 1
    bandwidth: int = 1
    """Largest difference of places of two images that meet in a free point."""
    tiles: int = 1
    tile_images: int = 4
    tile_points: int = 8
    blocks: int = 1
    """Pairs of images that meet anywhere in a chunk, in the chunk that has most."""
    met: int = 0
    """Shared unknowns that rows at the points of a tile touch, in the tile that has most."""
    rows: tuple[tuple[str, int], ...] = ()
    """Of each group of observations; of rows at points, the most that a point has."""

    def __or__(self, other: object) -> "Sizes":
        """What both fit into."""
        if not isinstance(other, Sizes):
            return NotImplemented
        most = [dict(self.rows), dict(other.rows)]
        rows = tuple((name, max(of.get(name, 0) for of in most)) for name in most[0] | most[1])
        images, bandwidth, tiles, m, p, blocks, met = map(max, self[:-1], other[:-1])
        return Sizes(images, bandwidth, tiles, m, p, blocks, met, rows)


LEAST = Sizes()
"""No more than a block needs by itself."""


class Places(NamedTuple):
    """Where a block's own images, points and image rows lie in the padded arrays."""

    image: Int[np.ndarray, "images"]
    point: Int[np.ndarray, "points"]
    """Of a fixed point that lies at several places, the first: what is observed of it but in images is there."""
    row: Int[np.ndarray, "rows"]
    """(tile * M + image) * P + point."""
    point_at: Int[np.ndarray, "padded"]
    """The block's point at every place of the padded arrays, -1 at those that are padding."""


def sizes_of(structure: Structure) -> Sizes:
    """The sizes of a block, with room for the image that nothing needs."""
    return TileLayout.of(structure, LEAST, shards=1, dense=False).sizes


# Tiles are summed in chunks whose products take no more numbers than this.
_CHUNK = 4_000_000
# Up to so many images, a larger reduced matrix costs less than another program.
_SMALL = 64
# What a column block costs beside its operations, counted in operations (measured: about 10 microseconds).
_OVERHEAD = 2e5


NO_SLOT = int(np.iinfo(np.int32).max)
"""For what is no unknown: no tile meets so many, and what is added there is dropped."""


class MetUnknowns(NamedTuple):
    """Which shared unknowns rows at points touch, tile by tile."""

    tile_of: Int[np.ndarray, "points"]
    key: Int[np.ndarray, "met"]
    """Tile * (number of unknowns + 1) + unknown, sorted."""
    slot: Int[np.ndarray, "met"]
    """Which of its tile's it is."""
    n_shared: int

    @classmethod
    def of(cls, s: Structure, tile_of: Int[np.ndarray, "points"]) -> "MetUnknowns":
        """`tile_of` is the tile of each of the block's points."""
        touched = [np.zeros(0, np.int64)]
        for g in (g for g in s.observed if g.elimination == "point"):
            touched.append(_keys(tile_of[g.point[0]], g.column, s.n_shared))
        key = np.unique(np.concatenate(touched))
        tile = key // (s.n_shared + 1)
        return cls(tile_of, key, np.arange(len(key)) - np.searchsorted(tile, tile), s.n_shared)

    @property
    def most(self) -> int:
        """How many lie in one tile, in steps of which there are few."""
        return size_class(int(self.slot.max(initial=-1)) + 1, 8)

    def listed(self, tiles: int, size: int) -> Int[np.ndarray, "tiles size"]:
        """Those of every tile, and the number of unknowns in places too many."""
        result = np.full((tiles, size), self.n_shared, np.int32)
        result[self.key // (self.n_shared + 1), self.slot] = self.key % (self.n_shared + 1)
        return result

    def slots(self, g: ObservedGroup) -> Int[np.ndarray, "l rows"]:
        """Which of its tile's each unknown of a row is."""
        found = np.full(g.column.shape, NO_SLOT, np.int32)
        free = g.column < self.n_shared
        found[free] = self.slot[np.searchsorted(self.key, _keys(self.tile_of[g.point[0]], g.column, self.n_shared))]
        return found


def _keys(tile: np.ndarray, column: np.ndarray, n_shared: int) -> np.ndarray:
    return (tile.astype(np.int64) * (n_shared + 1) + column)[column < n_shared]


class TileLayout(NamedTuple):
    """Images in order, points in tiles, tiles in chunks."""

    image_place: np.ndarray
    tiling: Tiling
    point_of: Int[np.ndarray, "copies"]
    """The point that each of the tiling's points is."""
    free_points: bool
    """Whether any point has a free coordinate."""
    columns: int
    width: int
    """Images of a column block."""
    chunks: int
    chunk: int
    at_once: int
    lists: tuple[list[np.ndarray], ...]
    met: "MetUnknowns"
    sizes: Sizes

    @classmethod
    def of(cls, structure: Structure, wanted: Sizes, shards: int, dense: bool) -> "TileLayout":
        """Of a block on its own; `wanted` are sizes that it is to have at least."""
        s = structure
        free = np.any(s.point_free > 0, axis=0)
        own = free[s.point]
        place, bandwidth = order_images(*_meetings(s, own))
        tiling, point_of, (m, p) = _tiles(place[s.image], s.point, free, s.n_images, wanted)
        tiles = max(len(tiling.image), wanted.tiles)
        images, bandwidth = max(s.n_images + 1, wanted.images), max(bandwidth, wanted.bandwidth)
        n = size_class(images, 32 if images <= _SMALL else 16)
        columns, width = (1, n) if dense else column_blocks(n, min(n, size_class(bandwidth, 8)))
        per_shard = -(-tiles // shards)
        _, first = np.unique(point_of, return_index=True)
        met = MetUnknowns.of(s, tiling.place[first] // p)
        # Of each tile there are sums for its images, and sums for what else its points meet.
        largest = max(6 * m, s.n_interior + max(met.most, wanted.met) + s.n_coupled)
        chunks = -(-per_shard * largest**2 // _CHUNK)
        at_once = tiles_at_once(m, p)
        chunk = size_class(-(-per_shard // chunks), TILE_STEP)
        # No more than it takes: a chunk may be larger than asked for.
        chunks = -(-per_shard // chunk)
        lists = _pair_lists(_images_of_free_points(tiling, own, p), chunk, width)
        blocks = max(map(len, lists[2]), default=0)
        rows = tuple((g.name, g.depth if g.elimination == "point" else g.n_rows) for g in s.observed)
        sizes = Sizes(images, bandwidth, tiles, m, p, blocks + 1, max(met.most, wanted.met), rows)
        return cls(
            place,
            tiling,
            point_of,
            bool(free.any()),
            columns,
            width,
            shards * chunks,
            chunk,
            at_once,
            lists,
            met,
            sizes,
        )

    @property
    def pairs(self) -> int:
        """As many pairs of images as there can be in the tiles of a chunk."""
        m = self.sizes.tile_images
        return self.chunk * m * (m + 1) // 2 if self.free_points else 0


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


def _tiles(
    image: Int[np.ndarray, "rows"], point: Int[np.ndarray, "rows"], free: Bool[np.ndarray, "points"], n: int, wanted
) -> tuple[Tiling, np.ndarray, tuple[int, int]]:
    """The tiles, the point that each of their points is, and their shape; `image` are places."""
    own, n_points = free[point], len(free)
    rays = np.bincount(point, minlength=n_points)
    # Of a point that is free all images are in one tile; fixed ones are split where they would want a wider one.
    split = rays[~free].max(initial=0) > rays[free].max(initial=0)
    if not free.any():
        m, p = field_shape(image, point, n, n_points)
    elif split:
        kept = np.cumsum(free) - 1
        m, p = tile_shape(image[own], kept[point[own]], n, int(free.sum()))
    else:
        m, p = tile_shape(image, point, n, n_points)
    m, p = max(m, wanted.tile_images), max(p, wanted.tile_points)
    if not split:
        return tile_points(image, point, n_points, m, p), np.arange(n_points), (m, p)
    copy, point_of = split_points(image, point, ~free, m)
    order = np.argsort(copy, kind="stable")
    tiling = tile_points(image[order], copy[order], len(point_of), m, p)
    slot = np.empty_like(tiling.slot)
    slot[order] = tiling.slot
    return tiling._replace(slot=slot), point_of, (m, p)


def _images_of_free_points(tiling: Tiling, own: Bool[np.ndarray, "rows"], p: int) -> Int[np.ndarray, "tiles m"]:
    """The images of each tile that see a free point in it, -1 in place of the others; `own` says which rows do."""
    seen = np.zeros(tiling.image.shape, bool)
    seen.reshape(-1)[tiling.slot[own] // p] = True
    return np.where(seen, tiling.image, -1)


def _pair_lists(tile_image: np.ndarray, chunk: int, width: int) -> tuple[list[np.ndarray], ...]:
    """By chunk: pairs of images of a tile (tile, first, second), their block, and the blocks (see `Tiles`)."""
    all_pairs, all_blocks, blocks = [], [], []
    m = tile_image.shape[1]
    first, second = np.tril_indices(m)
    for start in range(0, len(tile_image), chunk):
        own = tile_image[start : start + chunk]
        a, b = own[:, first], own[:, second]
        tile, pair = np.nonzero((a >= 0) & (b >= 0))
        a, b = a[tile, pair].astype(np.int64), b[tile, pair]
        key = a * (int(own.max(initial=0)) + 1) + b
        order = np.argsort(key, kind="stable")
        unique, block = np.unique(key[order], return_inverse=True)
        row, column = np.divmod(unique, int(own.max(initial=0)) + 1)
        which = column // width
        all_pairs.append(np.stack([tile, first[pair], second[pair]], axis=1)[order])
        all_blocks.append(block)
        blocks.append(np.stack([which, row - which * width, column % width], axis=1))
    return all_pairs, all_blocks, blocks
