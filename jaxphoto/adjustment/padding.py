"""Layout and size classes: blocks as they are computed with; what is compiled serves every block of similar size.

Before it is computed with, a block is laid out in tiles (`tiling`) and padded with images and points that nothing
depends on: rows of infinite standard deviation, unknowns that are held fixed. Images and tiles have coarse classes; all
other lists have sizes that follow from these two, so that they seldom tell blocks apart. The results are cropped again
and put back in the block's own order. Names stay outside: the padded structure has none.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxphoto.adjustment.band import column_blocks
from jaxphoto.adjustment.residuals import Residuals, State, Values
from jaxphoto.adjustment.structure import CameraGroup, Structure, Tiles
from jaxphoto.adjustment.tiling import TILES, Tiling, order_images, size_class, tile_points, tile_shape
from jaxphoto.arrays import still


class Sizes(NamedTuple):
    """How large each kind of list is, in a block or as it is compiled for."""

    images: int = 1
    bandwidth: int = 1
    """Largest difference of places of two images that meet."""
    tiles: int = 1
    tile_images: int = 4
    tile_points: int = 8
    blocks: int = 1
    """Pairs of images that meet anywhere in a chunk, in the chunk that has most."""
    stations: int = 0
    attitudes: int = 0

    def __or__(self, other: object) -> "Sizes":
        """What both fit into."""
        return Sizes(*map(max, self, other)) if isinstance(other, Sizes) else NotImplemented


LEAST = Sizes()
"""No more than a block needs by itself."""


class Places(NamedTuple):
    """Where a block's own images, points and image rows lie in the padded arrays."""

    image: Int[np.ndarray, "images"]
    point: Int[np.ndarray, "points"]
    row: Int[np.ndarray, "rows"]
    """(tile * M + image) * P + point."""


def sizes_of(structure: Structure) -> Sizes:
    """The sizes of a block, with room for the image that nothing needs."""
    return _Layout.of(structure, LEAST, shards=1, dense=False).sizes


# Tiles are summed in chunks whose products take no more numbers than this.
_CHUNK = 4_000_000
# Up to so many images, a larger reduced matrix costs less than another program.
_SMALL = 64
# Slots that are computed with at a time.
_SLOTS = 4000


class _Layout(NamedTuple):
    """Images in order, points in tiles, tiles in chunks."""

    image_place: np.ndarray
    tiling: Tiling
    columns: int
    width: int
    """Images of a column block."""
    chunks: int
    chunk: int
    at_once: int
    lists: tuple[list[np.ndarray], ...]
    sizes: Sizes

    @classmethod
    def of(cls, structure: Structure, wanted: Sizes, shards: int, dense: bool) -> "_Layout":
        s = structure
        place, bandwidth = order_images(s.image, s.point, s.n_images, s.n_points)
        image = place[s.image]
        m, p = tile_shape(image, s.point, s.n_images, s.n_points)
        m, p = max(m, wanted.tile_images), max(p, wanted.tile_points)
        tiling = tile_points(image, s.point, s.n_points, m, p)
        tiles = max(len(tiling.image), wanted.tiles)
        images, bandwidth = max(s.n_images + 1, wanted.images), max(bandwidth, wanted.bandwidth)
        n = size_class(images, 32 if images <= _SMALL else 16)
        columns, width = (1, n) if dense else column_blocks(n, min(n, size_class(bandwidth, 8)))
        per_shard = -(-tiles // shards)
        chunks = -(-per_shard * (6 * m) ** 2 // _CHUNK)
        at_once = max(k for k in range(1, TILES + 1) if TILES % k == 0 and k * m * p <= max(_SLOTS, m * p))
        chunk = size_class(-(-per_shard // chunks), TILES)
        lists = _pair_lists(tiling.image, chunk, width)
        blocks = max(map(len, lists[2]), default=0)
        sizes = Sizes(images, bandwidth, tiles, m, p, blocks + 1, len(s.station_image), len(s.attitude_image))
        return cls(place, tiling, columns, width, shards * chunks, chunk, at_once, lists, sizes)


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


def pad_structure(
    structure: Structure, sizes: Sizes = LEAST, *, shards: int = 1, dense: bool = False
) -> tuple[Structure, Places]:
    """The structure in tiles and padded sizes, and where everything went; the last image is the one nothing depends on.

    `sizes` are sizes that are wanted at least, such as those of all blocks of a study; `shards` is the number of
    devices; `dense` asks for a reduced matrix that is not a band.
    """
    s, layout = structure, _Layout.of(structure, sizes, shards, dense)
    have = layout.sizes | sizes
    m, p = layout.sizes.tile_images, layout.sizes.tile_points
    n_images, n_chunks = layout.columns * layout.width, layout.chunks
    # As many as there can be, or as there often are: padding costs next to nothing here.
    pairs = layout.chunk * m * (m + 1) // 2
    blocks = min(size_class(have.blocks, 16 * n_images), pairs + 1)
    # A group without rows is left out of the program, so it stays empty.
    stations = size_class(have.stations, 3 * n_images) * (len(s.station_image) > 0)
    attitudes = size_class(have.attitudes, n_images) * (len(s.attitude_image) > 0)
    tile_image = np.full((n_chunks * layout.chunk, m), n_images - 1, np.int32)
    own = layout.tiling.image
    tile_image[: len(own)] = np.where(own >= 0, own, n_images - 1)
    listed = np.zeros((n_chunks, pairs, 3), np.int32)
    pair_block = np.full((n_chunks, pairs), blocks - 1, np.int32)
    # Blocks that are none lie outside the matrix: what is written there is dropped.
    block = np.tile(np.array([layout.columns, 0, 0], np.int32), (n_chunks, blocks, 1))
    for k, (pair, which, found) in enumerate(zip(*layout.lists, strict=True)):
        listed[k, : len(pair)], pair_block[k, : len(pair)], block[k, : len(found)] = pair, which, found
    # Each elsewhere, so that no two are one.
    block[:, :, 1] += np.where(block[:, :, 0] == layout.columns, np.arange(blocks), 0)
    places = Places(layout.image_place, layout.tiling.place.astype(np.int32), layout.tiling.slot)
    at = places.image
    n_points = n_chunks * layout.chunk * p
    padded = dataclasses.replace(
        s,
        groups=tuple(_pad_group(g, at, n_images) for g in s.groups),
        n_images=n_images,
        n_points=n_points,
        image=np.zeros(0, np.int32),
        point=np.zeros(0, np.int32),
        column=_put(s.column, at, n_images, len(s.free)),
        mount=_put(s.mount, at, n_images, 0),
        strip=_put(s.strip, at, n_images, 0),
        station_image=_pad(at[s.station_image], stations, n_images - 1),
        station_axis=_pad(s.station_axis, stations, 0),
        attitude_image=_pad(at[s.attitude_image], attitudes, n_images - 1),
        control_point=np.zeros(0, np.int32),
        control_axis=np.zeros(0, np.int32),
        surface_point=np.zeros(0, np.int32),
        surface_strip=_surface_strips(s, places, n_points),
        distance_points=places.point[s.distance_points],
        point_class=_put(s.point_class, places.point, n_points, 0),
        eop_free=_put(s.eop_free.T, at, n_images, 0.0).T,
        point_free=_put(s.point_free.T, places.point, n_points, 0.0).T,
        labels=(),
        tiles=Tiles(
            image=tile_image.reshape(n_chunks, layout.chunk, m),
            per_tile=p,
            groups=-(-np.clip(len(own) - layout.chunk * np.arange(n_chunks), 0, layout.chunk) // layout.at_once),
            at_once=layout.at_once,
            pair_tile=listed[..., 0],
            pair_images=listed[..., 1:],
            pair_block=pair_block,
            block=block,
            columns=layout.columns,
            shards=shards,
        ),
    )
    return padded, places


def pad_values(values: Values, structure: Structure, padded: Structure, places: Places) -> Values:
    """The numbers of a block in the sizes and the order of its padded structure.

    Slots that no image row fills have infinite standard deviation: finite everywhere, and of no weight. So do control
    coordinates that nobody observed.
    """
    v, p = values, padded
    n_images, n_points = p.n_images, p.n_points
    slots = (*p.in_tiles.image.shape, p.in_tiles.per_tile)
    control = places.point[structure.control_point] + n_points * structure.control_axis
    stations, attitudes = len(p.station_image), len(p.attitude_image)
    surface, depth = _surface_places(structure, places, n_points), len(p.surface_strip)

    def observed(xy: Any, fill: float) -> Any:
        rows = _scatter(xy, places.row, int(np.prod(slots)), fill)
        xp = np if isinstance(rows, np.ndarray) else jnp
        return xp.moveaxis(rows.reshape(2, *slots), 0, 2)

    def images(x: Any, fill: Any) -> Any:
        return _scatter(x, places.image, n_images, fill)

    def points(x: Any, fill: Any) -> Any:
        return _scatter(x, places.point, n_points, fill)

    def surfaces(x: Any, fill: float) -> Any:
        padded = _scatter(x, surface, depth * n_points, fill)
        return padded.reshape(*x.shape[:-1], depth, n_points)

    return Values(
        xy=observed(v.xy, 0.0),
        sigma_xy=observed(v.sigma_xy, np.inf),
        stations=_last(v.stations, stations, 0.0),
        sigma_stations=_last(v.sigma_stations, stations, np.inf),
        time=images(v.time, 0.0),
        velocity=images(v.velocity, 0.0),
        rate=images(v.rate, 0.0),
        nominal=images(v.nominal, np.eye(3)[:, :, None]),
        attitudes=_last(v.attitudes, attitudes, 0.0),
        sigma_attitudes=_last(v.sigma_attitudes, attitudes, np.inf),
        control=_scatter(v.control, control, 3 * n_points, 0.0).reshape(3, n_points),
        sigma_control=_scatter(v.sigma_control, control, 3 * n_points, np.inf).reshape(3, n_points),
        foot=surfaces(v.foot, 0.0),
        normal=surfaces(v.normal, 0.0),
        turn=surfaces(v.turn, 0.0),
        sigma_surfaces=surfaces(v.sigma_surfaces, np.inf),
        distances=v.distances,
        sigma_distances=v.sigma_distances,
        priors=v.priors,
        sigma_priors=v.sigma_priors,
        position=images(v.position, v.position[..., :1]),
        rotation=images(v.rotation, v.rotation[..., :1]),
        shared=v.shared,
        points=points(v.points, v.points[..., :1]),
        datum_eop=images(v.datum_eop, 0.0),
        datum_points=points(v.datum_points, 0.0),
    )


def crop_state(state: State, places: Places) -> State:
    """The state in the block's own sizes and order."""
    position, rotation, shared, points = map(still, state)
    return State(position[..., places.image], rotation[..., places.image], shared, points[..., places.point])


def crop_residuals(residuals: Residuals, structure: Structure, places: Places) -> Residuals:
    """Residuals, or what is shaped like them, in the block's own sizes and order."""
    s, r = structure, Residuals(*map(still, residuals))
    chunks, tiles, _, m, p = r.image.shape
    image = r.image.reshape(chunks * tiles, 2, m * p)
    tile, slot = np.divmod(places.row, m * p)
    return r._replace(
        image=image[tile, :, slot].T,
        stations=r.stations[: len(s.station_image)],
        attitudes=r.attitudes[:, : len(s.attitude_image)],
        control=r.control[s.control_axis, places.point[s.control_point]],
        surfaces=r.surfaces.reshape(-1)[_surface_places(s, places, r.surfaces.shape[1])],
    )


def crop_reduced(matrix: Any, structure: Structure, places: Places) -> np.ndarray:
    """A matrix over the reduced unknowns (6 an image, then the shared ones) in the block's own sizes and order."""
    matrix, q = still(matrix), structure.n_shared
    kept = np.append((6 * places.image[:, None] + np.arange(6)).ravel(), np.arange(len(matrix) - q, len(matrix)))
    return matrix[np.ix_(kept, kept)]


def _surface_places(s: Structure, places: Places, n_points: int) -> np.ndarray:
    """Where the rows of surfaces lie in (rows, points): those of a point one below the other."""
    order = np.argsort(s.surface_point, kind="stable")
    of_point = s.surface_point[order]
    below = np.arange(len(order)) - np.searchsorted(of_point, of_point)
    result = np.zeros(len(order), int)
    result[order] = below * n_points + places.point[of_point]
    return result


def _surface_strips(s: Structure, places: Places, n_points: int) -> np.ndarray:
    depth = int(np.bincount(s.surface_point).max(initial=0))
    result = np.zeros(depth * n_points, np.int32)
    result[_surface_places(s, places, n_points)] = s.surface_strip
    return result.reshape(depth, n_points)


def _pad(array: np.ndarray, size: int, fill: float) -> np.ndarray:
    """`array` with its first axis filled up to `size`."""
    more = np.full((size - len(array), *array.shape[1:]), fill, array.dtype)
    return np.concatenate([array, more])


def _put(array: np.ndarray, at: np.ndarray, size: int, fill: float) -> np.ndarray:
    """`array`'s rows at their places along the first axis."""
    result = np.full((size, *array.shape[1:]), fill, array.dtype)
    result[at] = array
    return result


def _scatter(array: Any, at: np.ndarray, size: int, fill: Any) -> Any:
    """`array` at its places along the last axis, `fill` elsewhere."""
    xp = jnp if any(isinstance(x, jax.core.Tracer) for x in (array, fill)) else np
    result = xp.array(xp.broadcast_to(xp.asarray(fill, float), (*array.shape[:-1], size)))
    if xp is jnp:
        return result.at[..., at].set(array, unique_indices=True)
    result[..., at] = array
    return result


def _last(array: Any, size: int, fill: Any) -> Any:
    """`array` with its last axis filled up to `size`."""
    return _scatter(array, np.arange(array.shape[-1]), size, fill)


def _pad_group(group: CameraGroup, at: np.ndarray, n_images: int) -> CameraGroup:
    """A group of cameras without their names; images too many have its first camera."""
    return dataclasses.replace(
        group,
        names=tuple("" for _ in group.names),
        camera=_put(group.camera, at, n_images, 0),
        member=_put(group.member, at, n_images, group.offset == 0),
    )
