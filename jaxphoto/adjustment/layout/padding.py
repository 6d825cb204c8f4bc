"""Padding of blocks to size classes: one compiled program serves all blocks of similar size.

A block is arranged in rays (`rays`) and padded with images and points that have no effect: rows of infinite standard
deviation, fixed unknowns. Results are cropped and returned in the order of the block. No program depends on ids.
"""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np

from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues, RayLists
from jaxphoto.adjustment.layout.padded_groups import crop_rows, pad_groups, pad_rows, put, scatter
from jaxphoto.adjustment.layout.rays import (
    CHUNK,
    GROUP,
    MINIMAL_SIZES,
    PAIRS,
    PaddedSizes,
    Places,
    RayLayout,
    size_class,
)
from jaxphoto.adjustment.model.camera_groups import CameraGroup
from jaxphoto.adjustment.model.numbers import Residuals, UnknownArrays, Values
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.arrays import namespace, to_numpy
from jaxphoto.short_repr import pretty_repr
from jaxphoto.static_values import Content


@pretty_repr
@dataclasses.dataclass(frozen=True, eq=False)
class PaddedBlock:
    """Block in its own order and padded, with the conversions between both.

    Compared by content and hashed once: for JAX it is static structure of an `Adjustment`.
    """

    own: Structure
    structure: PaddedStructure
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
        return self is other or (isinstance(other, PaddedBlock) and self._content == other._content)

    def pad(self, values: Values) -> PaddedValues:
        """Pad the arrays of the block."""
        return pad_values(values, self.own, self.structure, self.places)

    def crop_state(self, state: UnknownArrays) -> UnknownArrays:
        """Crop a state to the sizes and order of the block."""
        position, rotation, shared, points = map(to_numpy, state)
        p = self.places
        return UnknownArrays(position[..., p.image], rotation[..., p.image], shared, points[..., p.point])

    def crop_residuals(self, residuals: PaddedResiduals) -> Residuals:
        """Crop residuals to the sizes and order of the block."""
        groups = zip(self.own.observed, residuals.others, strict=True)
        others = tuple(self.crop_rows(g, to_numpy(v)) for g, v in groups)
        return Residuals(others, to_numpy(residuals.datum), residuals.names, self.crop_image(residuals.image))

    def pad_residuals(self, own: Residuals, fill: float) -> PaddedResiduals:
        """Invert `crop_residuals`: scatter one value per observation into padded arrays, `fill` elsewhere."""
        s = self.structure

        def rows(g: ObservedGroup) -> tuple[int, ...]:
            return np.shape(jax.tree.leaves(g.own)[0])[-2 if isinstance(g.rows, RowsAtPoints) else -1 :]

        batches, chunks, _ = s.rays.ray_point.shape
        image = batches, 2, chunks, CHUNK
        shapes = (image, *((g.components, *rows(g)) for g in s.observed), np.shape(own.datum))
        starts = np.cumsum([0, *(np.prod(shape, dtype=int) for shape in shapes)])

        def split(numbers: np.ndarray) -> PaddedResiduals:
            pieces = zip(shapes, np.split(numbers, starts[1:-1]), strict=True)
            image, *others, datum = (piece.reshape(shape) for shape, piece in pieces)
            return PaddedResiduals(tuple(others), datum, own.names, image)

        laid = np.full(starts[-1], fill)
        places = self.crop_residuals(split(np.arange(starts[-1], dtype=float)))
        for place, values in zip(jax.tree.leaves(places), jax.tree.leaves(own), strict=True):
            laid[place.astype(int)] = values
        return split(laid)

    def crop_rows(self, group: ObservedGroup, numbers: np.ndarray) -> np.ndarray:
        """Crop padded rows (components, ...) to the order of the block; (rows) if a row is one scalar."""
        return crop_rows(group, numbers, self.places)

    def crop_image(self, image: Any) -> np.ndarray:
        """Return values of rays (batches, k, chunks, p) by image row of the block (k, rows)."""
        by_ray = np.moveaxis(to_numpy(image), 1, 0)
        return by_ray.reshape(len(by_ray), -1)[:, self.places.row]

    def crop_reduced(self, matrix: Any) -> np.ndarray:
        """Crop a matrix over the reduced unknowns (6 per image, then shared ones) to the order of the block."""
        matrix, q = to_numpy(matrix), self.own.n_shared
        of_images = (6 * self.places.image[:, None] + np.arange(6)).ravel()
        kept = np.append(of_images, np.arange(len(matrix) - q, len(matrix)))
        return matrix[np.ix_(kept, kept)]


# Number of rays per batch, number of pairs per batch, and minimum size of a single batch.
_RAYS, _PAIRS, _FEWEST = 4096, 2048, 2048


def pad_structure(
    structure: Structure, sizes: PaddedSizes = MINIMAL_SIZES, *, shards: int = 1, dense: bool = False
) -> PaddedBlock:
    """Build the padded structure of a block; its last image is padding.

    `sizes` are minimum sizes, such as `common_sizes` of all blocks of a study; `shards` is the number of devices;
    `dense` requests a dense reduced matrix instead of a band.
    """
    s, layout = structure, RayLayout.of(structure, sizes, shards, dense)
    have = layout.sizes | sizes
    n_images, n_points = layout.columns * layout.width, shards * have.point_groups * GROUP
    chunks = min(size_class(have.chunks, _FEWEST // CHUNK), _RAYS // CHUNK)
    batches, pair_chunks = size_class(-(-have.chunks // chunks), 1), _PAIRS // PAIRS
    # Round up to multiples of four; unused batches cost no time.
    pair_batches = size_class(max(-(-have.pair_chunks // pair_chunks), 1), 4)
    image = np.full((shards, batches * chunks), n_images - 1, np.int32)
    # Empty slots refer to a point of the same device.
    first = (n_points // shards) * np.arange(shards)[:, None]
    ray_point = np.repeat(first, batches * chunks * CHUNK, axis=1).astype(np.int32)
    none = batches * chunks * CHUNK * (1 + np.arange(shards)) - 1
    pair = np.tile(none[:, None, None], (1, 2, pair_batches * pair_chunks * PAIRS)).astype(np.int32)
    # Empty blocks lie outside the matrix; writes to them are dropped.
    block = np.tile(np.array([layout.columns, 0, 0], np.int32), (shards, pair_batches * pair_chunks, 1))
    row, used = np.empty(len(s.image), np.int64), np.zeros((shards, 2), np.int32)
    for k, own in enumerate(layout.devices):
        rays, meet = own.chunks, own.pair_chunks
        slot = rays.slot + k * batches * chunks * CHUNK
        row[own.ray] = slot
        image[k, : len(rays.key)] = rays.key
        ray_point[k, rays.slot] = layout.point_place[s.point[own.ray]]
        pair[k, :, meet.slot] = slot[own.pair].T
        one, other = np.divmod(meet.key, n_images)
        which = other // layout.width
        block[k, : len(meet.key)] = np.stack([which, one - which * layout.width, other % layout.width], axis=1)
        used[k] = -(-(len(rays.key) + 1) // chunks), -(-len(meet.key) // pair_chunks)
    places = Places(layout.image_place, layout.point_place, row)
    at = places.image
    slots = {g.name: layout.met.slots(g) for g in s.observed if g.elimination == "point"}
    padded = PaddedStructure(
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
        rays=RayLists(
            chunk_image=image.reshape(-1, chunks),
            ray_point=ray_point.reshape(-1, chunks, CHUNK),
            pair=pair.reshape(shards, 2, pair_batches, pair_chunks, PAIRS)
            .transpose(0, 2, 3, 1, 4)
            .reshape(-1, pair_chunks, 2, PAIRS),
            block=block.reshape(-1, pair_chunks, 3),
            used=used,
            met=layout.met.listed(n_points // GROUP, have.met),
            free_points=bool(s.point_free.any()),
            by_image=_eliminates_cameras(s),
            columns=layout.columns,
            shards=shards,
        ),
    )
    return PaddedBlock(s, padded, places)


def _eliminates_cameras(s: Structure) -> bool:
    """Return `RayLists.by_image`."""
    return s.n_interior > 4 * s.n_image_colours


def pad_values(values: Values, structure: Structure, padded: PaddedStructure, places: Places) -> PaddedValues:
    """Convert the arrays of a block to the sizes and order of its padded structure.

    Empty slots have infinite standard deviation: finite values with zero weight.
    """
    v, p, own = values, padded, structure
    n_images, n_points = p.n_images, p.n_points
    batches, chunks, _ = p.rays.ray_point.shape

    def observed(xy: Any, fill: float) -> Any:
        rows = scatter(xy, places.row, batches * chunks * CHUNK, fill)
        return namespace(rows).moveaxis(rows.reshape(2, batches, chunks, CHUNK), 0, 1)

    def images(x: Any, fill: Any) -> Any:
        return scatter(x, places.image, n_images, fill)

    def points(x: Any, fill: Any) -> Any:
        return scatter(x, places.point, n_points, fill)

    return PaddedValues(
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
        # Padded points repeat the first point.
        points=points(v.points, v.points[..., :1] if own.n_points else 0.0),
        datum_eop=images(v.datum_eop, 0.0),
        datum_points=points(v.datum_points, 0.0),
    )


def _pad_group(group: CameraGroup, at: np.ndarray, n_images: int) -> CameraGroup:
    """Pad a camera group and remove its names; padded images use its first camera."""
    return dataclasses.replace(
        group,
        names=tuple("" for _ in group.names),
        camera=put(group.camera, at, n_images, 0),
        member=put(group.member, at, n_images, group.offset == 0),
    )
