"""Lists of image rows for many draws, and number of rows and draws processed at a time."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment.layout.rays import Places
from jaxphoto.adjustment.model.structure import Structure

# Default, maximum and minimum number of draws that a device computes together (last axis). 32 suffice for vectorisation
# and to recompute intermediates (`solver.elimination`). More are used while image rows x draws are below `_ROWS`, fewer
# if unknowns x draws exceed `_UNKNOWNS`: several such arrays are in memory.
_FEW, _MOST, _LEAST = 32, 64, 8
_ROWS, _UNKNOWNS = 100_000, 8_000_000
# Number of image rows x draws processed at a time: intermediate arrays then fit in the cache of a core.
_AT_ONCE = 16_384


def batch_size(structure: Structure) -> int:
    """Return the number of draws of a block that a device computes together."""
    s = structure
    rows, unknowns = max(len(s.image), 1), max(int(s.eop_free.sum() + len(s.free) + s.point_free.sum()), 1)
    return int(max(_LEAST, min(np.clip(_ROWS // rows, _FEW, _MOST), _UNKNOWNS // unknowns)))


class RowList(eqx.Module):
    """Image rows of the cameras of one group, in chunks: index in the block, and the objects they involve.

    Images and points are indices into a padded structure, points ascending. The last chunk repeats its last row, with
    zero weight.
    """

    row: Int[np.ndarray, "chunks rows"]
    image: Int[np.ndarray, "chunks rows"]
    point: Int[np.ndarray, "chunks rows"]
    camera: Int[np.ndarray, "chunks rows"]
    """Camera (within the group) of each row."""
    counts: Float[np.ndarray, "chunks rows"]
    """Weight: 1, or 0 for a repeated row."""


def row_lists(s: Structure, places: Places, at_once: int | None = None) -> tuple[RowList, ...]:
    """Return the image rows of each camera group; `at_once` of them are processed at a time."""
    at_once = at_once or _AT_ONCE // batch_size(s)
    lists = []
    for group in s.groups:
        own = np.flatnonzero(group.member[s.image])
        own = own[np.argsort(places.point[s.point[own]], kind="stable")]
        chunks = -(-len(own) // at_once)
        size = -(-len(own) // max(chunks, 1))
        place = np.arange(chunks * size).reshape(chunks, size)
        row = own[np.minimum(place, len(own) - 1)]
        image = s.image[row]
        of_group = places.image[image], places.point[s.point[row]], group.camera[image]
        lists.append(RowList(row, *of_group, (place < len(own)).astype(float)))
    return tuple(lists)
