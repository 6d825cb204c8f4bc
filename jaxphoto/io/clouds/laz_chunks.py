"""How the points of a LAZ file are packed: looked through before they are unpacked.

Points lie in chunks, each unpacked on its own: where the points begin stands the offset of a table of the chunks'
sizes, which follows the last of them. The decoder takes room for whatever such a number says, and a process that asks
for too much is ended, not told. Hence every number by which it takes room is held against the bytes that there are.

From point format 6 on, the fields of a chunk lie in layers: the first point as it is, the number of points, the sizes
of the layers, the layers.
Source: Isenburg (2013), LASzip: lossless compression of lidar data, and the record 22204 of github.com/LASzip.
"""

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.errors import LaspyException

# Compressor, coder, version, options, points in a chunk, special records, number of items; of an item type, size and
# version; of a table version and number of chunks.
_HEAD, _ITEM, _TABLE = struct.Struct("<HHIIIqqH"), struct.Struct("<HHH"), struct.Struct("<II")
_OFFSET = struct.Struct("<q")
# Without chunks, as the first version packed; all others have a table.
_POINT_WISE = 1
# What stands for the number of points in a chunk where each has its own.
_VARIABLE = (0, 2**32 - 1)
# How many layers an item of a type has (14: one for each of its bytes).
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_LAYERED_BYTES = 14
# LASzip packs 50,000 points in a chunk, at most some MB. Larger ones are unpacked point by point: by chunks, on all
# cores, one is held in memory whole.
_LARGEST_CHUNK = 64 << 20


def unpacker(path: Path, header: laspy.LasHeader) -> laspy.LazBackend:
    """What unpacks the points of a LAZ file. Raises LaspyException or LazrsError where they cannot be all there."""
    record = header.vlrs[header.vlrs.index("LasZipVlr")].record_data
    compressor, *_, chunk_size, _, _, n_items = _HEAD.unpack_from(record)
    items = [_ITEM.unpack_from(record, _HEAD.size + _ITEM.size * k)[:2] for k in range(n_items)]
    point_format = header.point_format
    _check_items(items, point_format.id, point_format.num_extra_bytes)
    if compressor == _POINT_WISE:
        return laspy.LazBackend.Lazrs
    with path.open("rb") as file:
        counts, sizes = _chunks(file, header, record, chunk_size)
        begins = np.cumsum(sizes) - sizes + header.offset_to_point_data + _OFFSET.size
        layers = sum(size if kind == _LAYERED_BYTES else _LAYERS.get(kind, 0) for kind, size in items)
        if layers:
            _check_layers(file, begins, sizes, point_format.size, layers)
    large = counts.max() * point_format.size > _LARGEST_CHUNK
    return laspy.LazBackend.Lazrs if large else laspy.LazBackend.LazrsParallel


def _check_items(items: Sequence[tuple[int, ...]], format_id: int, extra_bytes: int) -> None:
    """The parts of a point, by type and size, are those of its format."""
    usual = lazrs.LazVlr.new_for_compression(format_id, extra_bytes).record_data()
    if b"".join(struct.pack("<HH", *item) for item in items) != b"".join(
        part[:4] for part in (usual[at : at + _ITEM.size] for at in range(_HEAD.size, len(usual), _ITEM.size))
    ):
        raise LaspyException("it packs points of another format than its header gives")


def _chunks(file: BinaryIO, header: laspy.LasHeader, record: bytes, chunk_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Number of points (at most, where all have one number) and of bytes of every chunk, which follow one another."""
    begin, end = header.offset_to_point_data, os.fstat(file.fileno()).st_size
    first, promised, point_size = begin + _OFFSET.size, header.point_count, header.point_format.size
    # A writer that could not go back has left the offset at the end.
    table = next((at for at in (_read(file, _OFFSET, begin), _read(file, _OFFSET, end - 8)) if at[0] > begin), (0,))[0]
    if not first <= table <= end - _TABLE.size:
        raise LaspyException("the table of its chunks is not where it says")
    n_chunks = _read(file, _TABLE, table)[1]
    # The first point of a chunk is not packed, and no chunk is empty.
    if not 1 <= n_chunks <= min(promised, (table - first) // point_size):
        raise LaspyException(f"{n_chunks} chunks of points have no room in it")
    if chunk_size not in _VARIABLE and n_chunks * chunk_size < promised:
        raise LaspyException(f"{n_chunks} chunks of {chunk_size} points do not hold the {promised} that it promises")
    file.seek(begin)
    counts, sizes = np.array(lazrs.read_chunk_table(file, lazrs.LazVlr(record)), float).T
    if (sizes < point_size).any() or sizes.sum() > table - first:
        raise LaspyException("its chunks do not end where their table begins")
    if chunk_size in _VARIABLE and counts.sum() != promised:
        raise LaspyException(f"its chunks hold {counts.sum():.0f} points, not the {promised} that it promises")
    return counts.astype(int), sizes.astype(int)


def _check_layers(file: BinaryIO, begins: np.ndarray, sizes: np.ndarray, point_size: int, layers: int) -> None:
    """The layers of every chunk, whose sizes follow its first point and the number of its points, fit into it."""
    told = struct.Struct(f"<{1 + layers}I")
    for begin, size in zip(begins.tolist(), sizes.tolist(), strict=True):
        _, *bytes_of = _read(file, told, begin + point_size)
        if point_size + told.size + sum(bytes_of) > size:
            raise LaspyException("the layers of a chunk are longer than the chunk")


def _read(file: BinaryIO, layout: struct.Struct, at: int) -> tuple[int, ...]:
    """Numbers at a place of the file. Raises struct.error where the file ends before."""
    file.seek(at)
    return layout.unpack(file.read(layout.size))
