"""Sizes come in classes: blocks as they are computed with; what is compiled serves every block of similar size.

Before it is computed with, a block is laid out in tiles (`tiling`) and padded with images and points that nothing
depends on: rows of infinite standard deviation, unknowns that are held fixed. Images and tiles have coarse classes; all
other lists have sizes that follow from these two, so that they seldom tell blocks apart. The results are cropped again
and put back in the block's own order. Ids stay outside: no program depends on them.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment.layout.padded_groups import crop_rows, pad_groups, pad_rows, put, scatter
from jaxphoto.adjustment.layout.tile_layout import LEAST, Places, Sizes, TileLayout
from jaxphoto.adjustment.layout.tiled import TiledResiduals, TiledStructure, TiledValues, Tiles
from jaxphoto.adjustment.layout.tiling import size_class
from jaxphoto.adjustment.model.camera_groups import CameraGroup
from jaxphoto.adjustment.model.numbers import Residuals, UnknownArrays, Values
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.arrays import still
from jaxphoto.short_repr import shown
from jaxphoto.static_values import Content


@shown
@dataclasses.dataclass(frozen=True, eq=False)
class TiledBlock:
    """A block as given and in tiles, and the way from one to the other.

    Compared by its content and hashed once: to `Adjustment` it is structure, not numbers.
    """

    own: Structure
    structure: TiledStructure
    places: Places

    @functools.cached_property
    def _content(self) -> tuple[Any, ...]:
        arrays, structure = jax.tree.flatten((self.own, self.structure, self.places))
        return structure, *(Content(np.asarray(array)) for array in arrays)

    @functools.cached_property
    def _hash(self) -> int:
        return hash(self._content)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, TiledBlock) and self._content == other._content)

    def pad(self, values: Values) -> TiledValues:
        """Numbers of the block in its tiles."""
        return pad_values(values, self.own, self.structure, self.places)

    def crop_state(self, state: UnknownArrays) -> UnknownArrays:
        """The state in the block's own sizes and order."""
        position, rotation, shared, points = map(still, state)
        p = self.places
        return UnknownArrays(position[..., p.image], rotation[..., p.image], shared, points[..., p.point])

    def crop_residuals(self, residuals: TiledResiduals) -> Residuals:
        """Residuals in the block's own sizes and order."""
        groups = zip(self.own.observed, residuals.others, strict=True)
        others = tuple(self.crop_rows(g, still(v)) for g, v in groups)
        return Residuals(others, still(residuals.datum), residuals.names, self.crop_image(residuals.image))

    def pad_residuals(self, own: Residuals, fill: float) -> TiledResiduals:
        """The reverse of `crop_residuals`: a number for each observation at its place, `fill` in all other places."""
        s = self.structure

        def rows(g: ObservedGroup) -> tuple[int, ...]:
            return np.shape(jax.tree.leaves(g.own)[0])[-2 if isinstance(g.rows, RowsAtPoints) else -1 :]

        image = (*s.tiles.image.shape[:2], 2, s.tiles.image.shape[2], s.tiles.per_tile)
        shapes = (image, *((g.components, *rows(g)) for g in s.observed), np.shape(own.datum))
        starts = np.cumsum([0, *(np.prod(shape, dtype=int) for shape in shapes)])

        def split(numbers: np.ndarray) -> TiledResiduals:
            pieces = zip(shapes, np.split(numbers, starts[1:-1]), strict=True)
            image, *others, datum = (piece.reshape(shape) for shape, piece in pieces)
            return TiledResiduals(tuple(others), datum, own.names, image)

        laid = np.full(starts[-1], fill)
        places = self.crop_residuals(split(np.arange(starts[-1], dtype=float)))
        for place, values in zip(jax.tree.leaves(places), jax.tree.leaves(own), strict=True):
            laid[place.astype(int)] = values
        return split(laid)

    def crop_rows(self, group: ObservedGroup, numbers: np.ndarray) -> np.ndarray:
        """Numbers of padded rows, (components, ...), in the block's own order: (rows) where a row is one number."""
        return crop_rows(group, numbers, self.places)

    def crop_image(self, image: Any) -> np.ndarray:
        """Numbers of the slots of tiles (chunks, tiles, k, m, p) by image row of the block (k, rows)."""
        image = still(image)
        chunks, tiles, k, m, p = image.shape
        tile, slot = np.divmod(self.places.row, m * p)
        return image.reshape(chunks * tiles, k, m * p)[tile, :, slot].T

    def crop_reduced(self, matrix: Any) -> np.ndarray:
        """A matrix over the reduced unknowns (6 an image, then the shared ones) in the block's own sizes and order."""
        matrix, q = still(matrix), self.own.n_shared
        of_images = (6 * self.places.image[:, None] + np.arange(6)).ravel()
        kept = np.append(of_images, np.arange(len(matrix) - q, len(matrix)))
        return matrix[np.ix_(kept, kept)]


def pad_structure(structure: Structure, sizes: Sizes = LEAST, *, shards: int = 1, dense: bool = False) -> TiledBlock:
    """The block in tiles and padded sizes; the last image is the one nothing depends on.

    `sizes` are sizes that are wanted at least, such as those of all blocks of a study; `shards` is the number of
    devices; `dense` asks for a reduced matrix that is not a band.
    """
    s, layout = structure, TileLayout.of(structure, sizes, shards, dense)
    have = layout.sizes | sizes
    m, p = layout.sizes.tile_images, layout.sizes.tile_points
    n_images, n_chunks = layout.columns * layout.width, layout.chunks
    # As many as there can be, or as there often are: padding costs next to nothing here.
    pairs = layout.pairs
    blocks = min(size_class(have.blocks, 16 * n_images), pairs + 1)
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
    n_points = n_chunks * layout.chunk * p
    point_at = put(layout.point_of, layout.tiling.place, n_points, -1)
    _, first = np.unique(layout.point_of, return_index=True)
    places = Places(layout.image_place, layout.tiling.place[first].astype(np.int32), layout.tiling.slot, point_at)
    at, n_met = places.image, have.met
    slots = {g.name: layout.met.slots(g) for g in s.observed if g.elimination == "point"}
    padded = TiledStructure(
        corrections=s.corrections,
        n_interior=s.n_interior,
        n_image_colours=s.n_image_colours,
        free=s.free,
        colour=s.colour,
        image_loss=s.image_loss,
        groups=tuple(_pad_group(g, at, n_images) for g in s.groups),
        n_images=n_images,
        n_points=n_points,
        column=put(s.column, at, n_images, len(s.free)),
        tables=tuple(
            dataclasses.replace(t, owners=("",) * len(t.owners), of_image=put(t.of_image, at, n_images, len(t.owners)))
            for t in s.tables
        ),
        observed=pad_groups(s, places, n_images, n_points, layout.width, dict(have.rows), slots),
        eop_free=put(s.eop_free.T, at, n_images, 0.0).T,
        point_free=put(s.point_free.T, places.point, n_points, 0.0).T,
        tiles=Tiles(
            image=tile_image.reshape(n_chunks, layout.chunk, m),
            per_tile=p,
            free_points=layout.free_points,
            met=layout.met.listed(n_chunks * layout.chunk, n_met).reshape(n_chunks, layout.chunk, n_met),
            batches=-(-np.clip(len(own) - layout.chunk * np.arange(n_chunks), 0, layout.chunk) // layout.at_once),
            at_once=layout.at_once,
            pair_tile=listed[..., 0],
            pair_images=listed[..., 1:],
            pair_block=pair_block,
            block=block,
            columns=layout.columns,
            shards=shards,
        ),
    )
    return TiledBlock(s, padded, places)


def pad_values(values: Values, structure: Structure, padded: TiledStructure, places: Places) -> TiledValues:
    """The numbers of a block in the sizes and the order of its padded structure.

    Slots that no image row fills have infinite standard deviation: finite everywhere, and of no weight.
    """
    v, p, own = values, padded, structure
    n_images, n_points = p.n_images, p.n_points
    slots = (*p.tiles.image.shape, p.tiles.per_tile)

    def observed(xy: Any, fill: float) -> Any:
        rows = scatter(xy, places.row, int(np.prod(slots)), fill)
        xp = np if isinstance(rows, np.ndarray) else jnp
        return xp.moveaxis(rows.reshape(2, *slots), 0, 2)

    def images(x: Any, fill: Any) -> Any:
        return scatter(x, places.image, n_images, fill)

    def points(x: Any, fill: Any) -> Any:
        return scatter(x, places.point, n_points, fill)

    def everywhere(x: Any) -> Any:
        # Padding looks like the first point: -1 would be the last.
        return x[..., np.maximum(places.point_at, 0)] if own.n_points else np.zeros((*x.shape[:-1], n_points))

    return TiledValues(
        xy=observed(v.xy, 0.0),
        sigma_xy=observed(v.sigma_xy, np.inf),
        groups=pad_rows(v, structure, p, places),
        time=images(v.time, 0.0),
        velocity=images(v.velocity, 0.0),
        rate=images(v.rate, 0.0),
        nominal=images(v.nominal, np.eye(3)[:, :, None]),
        flight_time=images(v.flight_time, 0.0),
        height=images(v.height, 1.0),
        temperature=images(v.temperature, 0.0),
        position=images(v.position, v.position[..., :1] if own.n_images else 0.0),
        rotation=images(v.rotation, v.rotation[..., :1] if own.n_images else np.eye(3)[..., None]),
        shared=v.shared,
        points=everywhere(v.points),
        datum_eop=images(v.datum_eop, 0.0),
        datum_points=points(v.datum_points, 0.0),
    )


def _pad_group(group: CameraGroup, at: np.ndarray, n_images: int) -> CameraGroup:
    """A group of cameras without their names; images too many have its first camera."""
    return dataclasses.replace(
        group,
        names=tuple("" for _ in group.names),
        camera=put(group.camera, at, n_images, 0),
        member=put(group.member, at, n_images, group.offset == 0),
    )
