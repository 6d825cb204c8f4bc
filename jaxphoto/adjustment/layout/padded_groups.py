"""Padding of observation groups, in lists or by point, and its inverse.

Padding repeats the first row with zero weight: its values stay finite and contribute nothing.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jaxphoto.adjustment.layout.padded import PaddedStructure
from jaxphoto.adjustment.layout.rays import NO_SLOT, Places, size_class
from jaxphoto.adjustment.model.numbers import Values
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints, RowsInList
from jaxphoto.adjustment.model.row_functions import rows_of
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.arrays import namespace, to_numpy


def pad_groups(
    s: Structure,
    places: Places,
    n_images: int,
    n_points: int,
    width: int,
    rows: Mapping[str, int],
    slots: Mapping[str, Int[np.ndarray, "l rows"]],
) -> tuple[ObservedGroup, ...]:
    """Pad the groups of a structure to at least `rows` rows; `width` is the number of images of a column block.

    `slots` contains, for groups stored by point, the slots of the shared unknowns that rows involve.
    """

    def padded(g: ObservedGroup) -> ObservedGroup:
        wanted = rows.get(g.name, 0)
        if g.elimination == "point":
            return _pad_at_points(g, slots[g.name], places, n_points, max(g.depth, wanted), s.n_shared)
        return _pad_list(g, places, n_images, width, wanted)

    return tuple(map(padded, s.observed))


def _pad_at_points(
    g: ObservedGroup, slot: Int[np.ndarray, "l rows"], places: Places, n_points: int, depth: int, n_shared: int
) -> ObservedGroup:
    at = _row_places(g, places, n_points)
    # Empty slots repeat the first row.
    index = put(np.arange(g.n_rows), at, depth * n_points, 0).reshape(depth, n_points)

    def of_rows(v: np.ndarray, fill: int) -> np.ndarray:
        return put(v.T, at, depth * n_points, fill).T.reshape(len(v), depth, n_points)

    return dataclasses.replace(
        g,
        rows=RowsAtPoints(jax.tree.map(lambda v: v[..., index], g.own)),
        image=np.zeros((0, 0), np.int32),
        point=np.zeros((1, 0), np.int32),
        parameter=g.parameter[:, index],
        column=of_rows(g.column, n_shared),
        slot=of_rows(slot, NO_SLOT),
        pair=np.zeros((0, 0, 4), np.int32),
    )


def _pad_list(g: ObservedGroup, places: Places, n_images: int, width: int, wanted: int) -> ObservedGroup:
    image = places.image[g.image].astype(np.int32)
    padded = dataclasses.replace(g, image=image, point=places.point[g.point], pair=_pairs(image, width))
    if g.elimination == "coupled":
        return padded
    # These lists have no separate size classes: their length is typical for this number of images.
    more = size_class(max(g.n_rows, wanted), (3 if g.scalar else 1) * n_images) - g.n_rows
    filled = lambda v: np.concatenate([v, np.repeat(v[..., :1], more, axis=-1)], axis=-1)  # noqa: E731
    last = lambda v: np.moveaxis(filled(np.moveaxis(v, 1, -1)), -1, 1)  # noqa: E731
    return dataclasses.replace(
        padded,
        rows=RowsInList(jax.tree.map(filled, g.own)),
        image=filled(padded.image),
        point=filled(padded.point),
        parameter=filled(g.parameter),
        column=filled(g.column),
        pair=last(padded.pair),
    )


def _pairs(image: Int[np.ndarray, "k rows"], width: int) -> Int[np.ndarray, "pairs rows 4"]:
    """Return column block, row and column of each pair of images of a row, and 1 if it is transposed."""
    found = []
    for a in range(len(image)):
        for b in range(a):
            row, column = np.maximum(image[a], image[b]), np.minimum(image[a], image[b])
            which = column // width
            found.append(np.stack([which, row - which * width, column % width, image[a] < image[b]], axis=1))
    return np.array(found, np.int32).reshape(-1, image.shape[1], 4)


def _row_places(g: ObservedGroup, places: Places, n_points: int) -> Int[np.ndarray, "rows"]:
    """Return the flat index of each row of a group in its padded (rows, points) array."""
    order = np.argsort(g.point[0], kind="stable")
    of_point = g.point[0][order]
    below = np.arange(len(order)) - np.searchsorted(of_point, of_point)
    result = np.zeros(len(order), int)
    result[order] = below * n_points + places.point[of_point]
    return result


def pad_rows(v: Values, s: Structure, padded: PaddedStructure, places: Places) -> tuple[RowsInList | RowsAtPoints, ...]:
    """Convert the values of all rows to the sizes and order of the padded structure."""
    groups = zip(s.observed, padded.observed, v.groups, strict=True)
    return tuple(_pad_numbers(g, wide, numbers, places) for g, wide, numbers in groups)


def _pad_numbers(g: ObservedGroup, wide: ObservedGroup, numbers: Any, places: Places) -> RowsInList | RowsAtPoints:
    own = numbers.listed
    if isinstance(wide.rows, RowsAtPoints):
        shape = np.shape(jax.tree.leaves(wide.own)[0])[-2:]
        at = _row_places(g, places, shape[1])
    else:
        shape, at = (wide.n_rows,), np.arange(g.n_rows)
    # Padding repeats the first row, with zero weight.
    idle = rows_of(g, RowsInList(jax.tree.map(lambda x: x[..., 0], own))).without_weight()
    size = int(np.prod(shape))

    def spread(x: Any, fill: Any) -> Any:
        return scatter(x, at, size, to_numpy(fill)[..., None]).reshape(*x.shape[:-1], *shape)

    fills = jax.tree.map(lambda x, y: None if x is None else y, own, idle, is_leaf=lambda x: x is None)
    laid = jax.tree.map(spread, own, fills)
    return RowsAtPoints(laid) if isinstance(wide.rows, RowsAtPoints) else RowsInList(laid)


def crop_rows(g: ObservedGroup, v: np.ndarray, places: Places) -> np.ndarray:
    """Return padded rows (components, ...) in the order of the block; (rows) if a row is one scalar."""
    if v.ndim == 3:
        v = v.reshape(len(v), -1)[:, _row_places(g, places, v.shape[2])]
    v = v[:, : g.n_rows]
    return v[0] if g.scalar else v


def put(array: np.ndarray, at: np.ndarray, size: int, fill: float) -> np.ndarray:
    """Scatter rows of `array` along the first axis."""
    result = np.full((size, *array.shape[1:]), fill, array.dtype)
    result[at] = array
    return result


def scatter(array: Any, at: np.ndarray, size: int, fill: Any) -> Any:
    """Scatter `array` along the last axis; `fill` elsewhere."""
    xp = namespace(array, fill)
    result = xp.array(xp.broadcast_to(xp.asarray(fill, float), (*array.shape[:-1], size)))
    if xp is jnp:
        return result.at[..., at].set(array, unique_indices=True)
    result[..., at] = array
    return result
