"""Size classes: what is compiled for one block serves every block of similar size.

Before it is computed with, a block is padded to the next sizes of a coarse series, at most an eighth larger, with an
image, a point and rows that nothing depends on: rows of infinite standard deviation, unknowns that are held fixed. The
results are cropped again. Names stay outside: the padded structure has none.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment.lists import chunks_of, rows_by_image
from jaxphoto.adjustment.residuals import Residuals, State, Values
from jaxphoto.adjustment.structure import CameraGroup, Structure


class Sizes(NamedTuple):
    """How large each kind of list is, in a block or as it is compiled for."""

    images: int = 8
    points: int = 64
    rows: int = 256
    pairs: int = 1024
    blocks: int = 64
    chunks: int = 64
    width: int = 8
    """Rows of the image that has most."""
    stations: int = 128
    attitudes: int = 128
    control: int = 128

    def __or__(self, other: object) -> "Sizes":
        """What both fit into."""
        return Sizes(*map(max, self, other)) if isinstance(other, Sizes) else NotImplemented


LEAST = Sizes()
"""The least sizes worth a class of their own."""


def sizes_of(structure: Structure) -> Sizes:
    """The sizes of a block, with room for the image, the point, the row and the block of images that nothing needs."""
    s = structure
    return Sizes(
        images=s.n_images + 1,
        points=s.n_points + 1,
        rows=len(s.image) + 1,
        pairs=len(s.pair_a),
        blocks=len(s.block_row) + 1,
        chunks=len(s.chunk_block),
        width=s.image_rows.shape[1],
        stations=len(s.station_image),
        attitudes=len(s.attitude_image),
        control=len(s.control_point),
    )


def size_class(n: int) -> int:
    """The next number, from `n` on, that is 8 to 15 times a power of two."""
    step = 1 << max(0, n.bit_length() - 4)
    return -(-n // step) * step


def pad_structure(structure: Structure, sizes: Sizes = LEAST) -> Structure:
    """The same structure in padded sizes; the last image, point and row are the ones nothing depends on.

    `sizes` are sizes that are wanted at least, such as those of all blocks of a study.
    """
    s = structure
    images, points, rows, pairs, blocks, n_chunks, width, stations, attitudes, control = map(
        size_class, sizes_of(s) | LEAST | sizes
    )
    lists = rows_by_image(s.image, s.point, images, rows)
    chunks = chunks_of((s.pair_a, s.pair_b, s.pair_block), rows)
    # A group without rows is left out of the program, so it stays empty.
    stations, attitudes = stations * (len(s.station_image) > 0), attitudes * (len(s.attitude_image) > 0)
    groups = tuple(_pad_group(g, rows, len(s.image)) for g in s.groups)
    return dataclasses.replace(
        s,
        groups=groups,
        n_images=images,
        n_points=points,
        unsort=None if s.unsort is None else _places(np.concatenate([g.rows for g in groups]), rows),
        image=_pad(s.image, rows, images - 1),
        point=_pad(s.point, rows, points - 1),
        pair_a=_pad(s.pair_a, pairs, rows - 1),
        pair_b=_pad(s.pair_b, pairs, rows - 1),
        pair_block=_pad(s.pair_block, pairs, blocks - 1),
        image_rows=_pad(lists["image_rows"].T, width, rows).T,
        image_points=_pad(lists["image_points"].T, width, points - 1).T,
        chunk_a=_pad(chunks["chunk_a"], n_chunks, rows),
        chunk_b=_pad(chunks["chunk_b"], n_chunks, rows),
        chunk_block=_pad(chunks["chunk_block"], n_chunks, blocks - 1),
        # Blocks that are none lie, each elsewhere, outside the matrix: what is written there is dropped.
        block_row=np.append(s.block_row, np.arange(images, images + blocks - len(s.block_row))).astype(np.int32),
        block_column=_pad(s.block_column, blocks, 0),
        column=_pad(s.column, images, len(s.free)),
        mount=_pad(s.mount, images, 0),
        strip=_pad(s.strip, images, 0),
        station_image=_pad(s.station_image, stations, images - 1),
        station_axis=_pad(s.station_axis, stations, 0),
        attitude_image=_pad(s.attitude_image, attitudes, images - 1),
        control_point=_pad(s.control_point, control, points - 1),
        control_axis=_pad(s.control_axis, control, 0),
        point_class=_pad(s.point_class, points, 0),
        eop_free=_pad(s.eop_free.T, images, 0.0).T,
        point_free=_pad(s.point_free.T, points, 0.0).T,
        labels=(),
    )


def pad_values(values: Values, structure: Structure, padded: Structure) -> Values:
    """The numbers of a block in the sizes of its padded structure.

    A row too many is the first row once more, with infinite standard deviation: finite everywhere, and of no weight.
    """
    v, p = values, padded
    image, point = structure.image[0], structure.point[0]
    images, points, rows = p.n_images, p.n_points, len(p.image)
    stations, attitudes, control = len(p.station_image), len(p.attitude_image), len(p.control_point)
    return Values(
        xy=_last(v.xy, rows, v.xy[:, :1]),
        sigma_xy=_last(v.sigma_xy, rows, np.inf),
        stations=_last(v.stations, stations, 0.0),
        sigma_stations=_last(v.sigma_stations, stations, np.inf),
        time=_last(v.time, images, 0.0),
        velocity=_last(v.velocity, images, 0.0),
        rate=_last(v.rate, images, 0.0),
        nominal=_last(v.nominal, images, np.eye(3)[:, :, None]),
        attitudes=_last(v.attitudes, attitudes, 0.0),
        sigma_attitudes=_last(v.sigma_attitudes, attitudes, np.inf),
        control=_last(v.control, control, 0.0),
        sigma_control=_last(v.sigma_control, control, np.inf),
        distances=v.distances,
        sigma_distances=v.sigma_distances,
        priors=v.priors,
        sigma_priors=v.sigma_priors,
        position=_last(v.position, images, v.position[:, image : image + 1]),
        rotation=_last(v.rotation, images, v.rotation[:, :, image : image + 1]),
        shared=v.shared,
        points=_last(v.points, points, v.points[:, point : point + 1]),
        datum_eop=_last(v.datum_eop, images, 0.0),
        datum_points=_last(v.datum_points, points, 0.0),
    )


def crop_state(state: State, structure: Structure) -> State:
    """The state in the block's own sizes."""
    n, m = structure.n_images, structure.n_points
    position, rotation, shared, points = map(_still, state)
    return State(position[:, :n], rotation[:, :, :n], shared, points[:, :m])


def crop_residuals(residuals: Residuals, structure: Structure) -> Residuals:
    """Residuals, or what is shaped like them, in the block's own sizes."""
    s, r = structure, Residuals(*map(_still, residuals))
    return r._replace(
        image=r.image[:, : len(s.image)],
        stations=r.stations[: len(s.station_image)],
        attitudes=r.attitudes[:, : len(s.attitude_image)],
        control=r.control[: len(s.control_point)],
    )


def crop_reduced(matrix: Any, structure: Structure) -> np.ndarray:
    """A matrix over the reduced unknowns (6 an image, then the shared ones) in the block's own sizes."""
    matrix, q = np.asarray(matrix), structure.n_shared
    kept = np.r_[0 : 6 * structure.n_images, len(matrix) - q : len(matrix)]
    return matrix[np.ix_(kept, kept)]


def _still(x: Any) -> Any:
    """numpy's array where nothing is traced: its slices need no compilation."""
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x)


def _pad(array: np.ndarray, size: int, fill: float) -> np.ndarray:
    """`array` with its first axis filled up to `size`."""
    more = np.full((size - len(array), *array.shape[1:]), fill, array.dtype)
    return np.concatenate([array, more])


def _last(array: Any, size: int, fill: Any) -> Any:
    """`array` with its last axis filled up to `size`."""
    xp = jnp if any(isinstance(x, jax.core.Tracer) for x in (array, fill)) else np
    more = xp.broadcast_to(xp.asarray(fill, float), (*array.shape[:-1], size - array.shape[-1]))
    return xp.concatenate([array, more], axis=-1)


def _pad_group(group: CameraGroup, rows: int, n_rows: int) -> CameraGroup:
    """A group of cameras without their names; where there are several groups, the first has the rows too many."""
    names = tuple("" for _ in group.names)
    if group.rows is None:
        return dataclasses.replace(group, names=names, camera=_pad(group.camera, rows, 0))
    own = np.append(group.rows, np.arange(n_rows, rows)) if group.offset == 0 else group.rows
    size = size_class(max(len(own), LEAST.rows))
    return dataclasses.replace(
        group, names=names, camera=_pad(group.camera, size, 0), rows=_pad(own, size, rows - 1).astype(np.int32)
    )


def _places(sequence: np.ndarray, n: int) -> np.ndarray:
    """Where each of 0 ... n - 1 stands first in `sequence`."""
    places = np.zeros(n, np.int32)
    places[sequence[::-1]] = np.arange(len(sequence))[::-1]
    return places
