"""COPC, cloud-optimised LAZ: a LAZ file whose chunks are the nodes of an octree, coarse ones first, with their places.

The cube of a node is halved along each axis for its children. It holds one point of each of its 128^3 cells, they the
rest; a node to which few points remain holds them all. Points stand in the order of the nodes.
Source: COPC specification 1.0 (copc.io), of LAS 1.4 with point formats 6 to 8.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import laspy
import lazrs
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError

_ENDING = ".copc.laz"
_USER, _INFO, _HIERARCHY = "copc", 1, 1000
_FORMATS = (6, 7, 8)
# Centre, half the side, spacing, place and size of the hierarchy, times; key, place, bytes and points of a node; the
# head of a record after the points.
_INFO_LAYOUT, _ENTRY, _RECORD_AFTER = struct.Struct("<3d2d2Q2d88x"), struct.Struct("<4iQ2i"), 60
_CELLS, _LEAF, _DEEPEST = 128, 20_000, 12


def is_copc(path: Path) -> bool:
    """Whether a file is COPC by its name."""
    return path.name.lower().endswith(_ENDING)


def check_copc(header: laspy.LasHeader, source: str, path: Path) -> None:
    """Raise InputError where `path` is to be COPC and points of `source` are of a format that COPC does not have."""
    if is_copc(path) and header.point_format.id not in _FORMATS:
        raise InputError(
            f"{path.name}: COPC has the point formats {', '.join(map(str, _FORMATS))}, and {source} has "
            f"{header.point_format.id}; name a file .laz that is not .copc.laz"
        )


def without_octree(header: laspy.LasHeader) -> laspy.LasHeader:
    """`header` without what says that the points that follow are in the order of an octree."""
    for records in (header.vlrs, header.evlrs or []):
        for record in [record for record in records if record.user_id == _USER]:
            records.remove(record)
    return header


def order_as_copc(path: Path) -> None:
    """Write the LAZ file `path` anew as COPC. Memory holds all its points."""
    las = laspy.read(path)
    header, points = without_octree(las.header), las.points
    lowest, highest = np.asarray(header.mins), np.asarray(header.maxs)
    half = max(float((highest - lowest).max()) / 2, float(np.max(header.scales)))
    # As some readers take it to lie: its lowest corner is that of the points.
    centre = lowest + half
    counts = np.stack([points.X, points.Y, points.Z], axis=1)
    unit = (counts * np.asarray(header.scales) + np.asarray(header.offsets) - lowest) / (2 * half)
    order, nodes = _octree(unit)
    times = np.asarray(points.gps_time)
    said = (*centre.tolist(), half, 2 * half / _CELLS)
    between = (float(times.min()), float(times.max()))

    packing = lazrs.LazVlr.new_for_compression(header.point_format.id, header.point_format.num_extra_bytes, True)
    info = laspy.VLR(_USER, _INFO, "COPC info VLR", _INFO_LAYOUT.pack(*said, 0, 0, *between))
    zipped = laspy.VLR("laszip encoded", 22204, "", packing.record_data())
    header.vlrs = laspy.vlrs.vlrlist.VLRList([info, zipped, *(v for v in header.vlrs if v.record_id != 22204)])
    header.are_points_compressed = True
    # Wanted of these formats even without a system.
    header.global_encoding.wkt = True
    with path.open("w+b") as file:
        header.write_to(file)
        packed = lazrs.LasZipCompressor(file, packing)
        packed.reserve_offset_to_chunk_table()
        begin = 0
        for k, node in enumerate(nodes):
            if k:
                packed.finish_current_chunk()
            packed.compress_many(np.ascontiguousarray(points.array[order[begin : begin + node.points]]).view(np.uint8))
            begin += node.points
        packed.done()
        file.seek(header.offset_to_point_data)
        sizes = [size for _, size in lazrs.read_chunk_table(file, packing)]
        header.start_of_first_evlr = file.seek(0, 2)
        page = b"".join(_entries(nodes, sizes, header.offset_to_point_data + 8))
        records = [laspy.VLR(_USER, _HIERARCHY, "EPT hierarchy", page), *(header.evlrs or [])]
        header.number_of_evlrs = len(records)
        laspy.vlrs.vlrlist.VLRList(records).write_to(file, as_extended=True)
        info.record_data = _INFO_LAYOUT.pack(*said, header.start_of_first_evlr + _RECORD_AFTER, len(page), *between)
        file.seek(0)
        header.write_to(file, ensure_same_size=True)


class _Node(NamedTuple):
    key: tuple[int, int, int, int]
    points: int


def _entries(nodes: list[_Node], sizes: list[int], begin: int) -> Iterator[bytes]:
    for node, size in zip(nodes, sizes, strict=True):
        yield _ENTRY.pack(*node.key, begin, size, node.points)
        begin += size


def _octree(unit: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, "n"], list[_Node]]:
    """The order of points, given in parts of the root cube, and the nodes that follow one another in it."""
    left, order, nodes = np.arange(len(unit)), [], []
    for level in range(_DEEPEST + 1):
        key = _numbered(unit[left], 1 << level)
        _, node, count = np.unique(key, return_inverse=True, return_counts=True)
        taken = count[node] <= _LEAF if level < _DEEPEST else np.ones(len(left), bool)
        crowded = np.flatnonzero(~taken)
        first = np.unique(_numbered(unit[left[crowded]], _CELLS << level), return_index=True)[1]
        taken[crowded[first]] = True
        own = np.flatnonzero(taken)
        own = own[np.argsort(key[own], kind="stable")]
        found, counts = np.unique(key[own], return_counts=True)
        nodes += [
            _Node((level, k >> 42, k >> 21 & _MASK, k & _MASK), n)
            for k, n in zip(found.tolist(), counts.tolist(), strict=True)
        ]
        order.append(left[own])
        left = left[~taken]
        if not len(left):
            break
    return np.concatenate(order), nodes


_MASK = (1 << 21) - 1


def _numbered(unit: Float[np.ndarray, "n 3"], cells: int) -> Int[np.ndarray, "n"]:
    """One number for the cell along each axis, 21 bits each."""
    x, y, z = np.clip((unit * cells).astype(np.int64), 0, cells - 1).T
    return x << 42 | y << 21 | z
