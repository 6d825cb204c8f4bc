"""Read point clouds in the frame of a block, filtered in chunks of bounded memory."""

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Real

from jaxphoto.block import Frame
from jaxphoto.cloud import OF_POINTS, Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CloudSource, check_file, no_points
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, Placement, epsg_system
from jaxphoto.io.clouds.tables import open_csv, open_ply

Returns = Literal["all", "first", "last", "only"]
"""Selection by return: all returns of a pulse, first, last, or returns of single-return pulses."""
SUFFIXES = (".las", ".laz", ".csv", ".ply")
"""File name extensions of clouds."""
NOISE = (7, 18)
"""ASPRS classes of low and high noise, excluded by default."""
EVERY_CLASS = range(256)
"""All classes including noise; points without classification are included."""


def read_cloud(
    path: str | Path,
    frame: Frame | None = None,
    *,
    classes: Collection[int] | None = None,
    returns: Returns = "all",
    epsg: int | None = None,
    unit: str | None = None,
    within: Real[np.ndarray, "2 2"] | None = None,
) -> Cloud:
    """Read a cloud (.las, .laz, .csv or .ply) in the frame of a block.

    `frame` is the frame of the block (see `Placement`); without it, coordinates remain in the system of the file, in
    metres. `classes` (default: all except `NOISE`) and `returns` select points. `within` (minimum and maximum X, Y in
    m) is the area of the block. `epsg` and `unit` (m, ft, us_ft) override the coordinate system and unit of the file.

    Memory is bounded by the selected points and one chunk of the file. Raises InputError for a missing, damaged or
    empty file, a missing, unknown or incompatible coordinate system, no overlap with `within`, and an empty selection.
    """
    source = open_source(path, epsg, unit)
    chunks = _selected_chunks(source, frame, classes, returns, within)
    if source.count is None:
        return _without_empty_strips(Cloud.joined(list(chunks)))
    # Allocate for all points and shrink afterwards: the operating system commits only pages that are written.
    columns: dict[str, np.ndarray] = {}
    n, strips = 0, tuple[str, ...]()
    for chunk in chunks:
        for name in OF_POINTS:
            if (values := getattr(chunk, name)) is None:
                continue
            if name not in columns:
                try:
                    columns[name] = np.empty((source.count, *values.shape[1:]), values.dtype)
                except MemoryError:
                    raise InputError(
                        f"{source.name}: {source.count} points exceed the memory of this computer"
                    ) from None
            columns[name][n : n + len(chunk)] = values
        n, strips = n + len(chunk), chunk.strips
    for values in columns.values():
        values.resize((n, *values.shape[1:]), refcheck=False)
    return _without_empty_strips(Cloud(**columns, strips=strips))


def cloud_chunks(
    path: str | Path,
    frame: Frame | None = None,
    *,
    classes: Collection[int] | None = None,
    returns: Returns = "all",
    epsg: int | None = None,
    unit: str | None = None,
    within: Real[np.ndarray, "2 2"] | None = None,
) -> Iterator[Cloud]:
    """Yield the cloud of `read_cloud` in nonempty parts of bounded size; `strips` lists the strips found so far."""
    return _selected_chunks(open_source(path, epsg, unit), frame, classes, returns, within)


def extent(
    path: str | Path, frame: Frame | None = None, *, epsg: int | None = None, unit: str | None = None
) -> Float[np.ndarray, "2 3"]:
    """Return minimum and maximum X, Y, Z (m) of a cloud in the frame of a block, from the header if possible.

    In a rotated frame, the extent of the file's bounding box is returned, which is larger.
    """
    source = open_source(path, epsg, unit)
    placement = Placement(source.name, source.system, frame)
    if source.extent is not None:
        return placement.extent(source.extent)
    extents = [placement.placed(chunk).extent for chunk in source.chunks() if len(chunk)]
    if not extents:
        raise no_points(source.name)
    return np.stack([np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]])


def cloud_system(path: str | Path, *, epsg: int | None = None, unit: str | None = None) -> CoordinateSystem:
    """Read the coordinate system of a cloud file."""
    return open_source(path, epsg, unit).system


def point_count(path: str | Path) -> int | None:
    """Read the number of points from the header of a cloud file; None without a header."""
    return open_source(path).count


def open_source(path: str | Path, epsg: int | None = None, unit: str | None = None) -> CloudSource:
    """Open a cloud file; `epsg` and `unit` override its coordinate system and unit."""
    path = Path(path)
    check_file(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path.name} is not a point cloud; supported are {', '.join(SUFFIXES)}")
    system = None if epsg is None else epsg_system(epsg, path.name)
    if suffix in (".las", ".laz"):
        # Import here: laspy takes 0.2 s.
        from jaxphoto.io.clouds.las import open_las

        source = open_las(path, system)
    else:
        source = (open_csv if suffix == ".csv" else open_ply)(path, system)
    return dataclasses.replace(source, system=source.system.in_unit(unit))


def _selected_chunks(
    source: CloudSource,
    frame: Frame | None,
    classes: Collection[int] | None,
    returns: Returns,
    within: np.ndarray | None,
) -> Iterator[Cloud]:
    if returns not in get_args(Returns):
        raise InputError(f"unknown returns {returns!r}; choose one of {', '.join(get_args(Returns))}")
    placement = Placement(source.name, source.system, frame)
    if within is not None and source.extent is not None:
        placement.check_overlap(source.extent, within)
    empty = True
    for chunk in source.chunks():
        part = placement.placed(_take(chunk, selection(chunk, classes, returns, source.name)))
        if within is not None:
            part = _take(part, ((part.xyz[:, :2] >= within[0]) & (part.xyz[:, :2] <= within[1])).all(axis=1))
        if len(part):
            empty = False
            yield part
    if empty:
        raise _no_selection(source, placement, classes, returns, within)


def selection(chunk: Cloud, classes: Collection[int] | None, returns: Returns, name: str) -> Bool[np.ndarray, "n"]:
    """Return the mask of points that `read_cloud` selects. Raises InputError if `name` lacks classes or returns."""
    mask = np.ones(len(chunk), bool) if chunk.withheld is None else ~chunk.withheld
    if classes is not None and classes != EVERY_CLASS:
        if chunk.classification is None:
            raise InputError(f"{name} has no classification; remove the selection of classes")
        mask &= np.isin(chunk.classification, list(classes))
    elif classes is None and chunk.classification is not None:
        mask &= ~np.isin(chunk.classification, NOISE)
    if returns != "all":
        if chunk.returns is None:
            raise InputError(f"{name} has no return numbers; remove the selection of returns")
        number, of = chunk.returns.T
        mask &= {"first": number == 1, "last": number == of, "only": (number == 1) & (of == 1)}[returns]
    return mask


def _take(cloud: Cloud, mask: np.ndarray) -> Cloud:
    """Apply `Cloud.take`; do not copy if all points are selected."""
    return cloud if mask.all() else cloud.take(mask)


def _without_empty_strips(cloud: Cloud) -> Cloud:
    if cloud.strip is None:
        return cloud
    used = np.bincount(cloud.strip, minlength=len(cloud.strips)) > 0
    if used.all():
        return cloud
    number = (np.cumsum(used) - 1).astype(np.int32)
    names = tuple(name for name, present in zip(cloud.strips, used, strict=True) if present)
    return dataclasses.replace(cloud, strip=number[cloud.strip], strips=names)


def _no_selection(
    source: CloudSource,
    placement: Placement,
    classes: Collection[int] | None,
    returns: Returns,
    within: np.ndarray | None,
) -> InputError:
    """Return the error about an empty selection, listing the classes and returns of the file."""
    extents, by_class, by_return = [], Counter[int](), Counter[tuple[int, int]]()
    for chunk in (chunk for chunk in source.chunks() if len(chunk)):
        extents.append(chunk.extent)
        if chunk.classification is not None:
            by_class.update(chunk.classification.tolist())
        if chunk.returns is not None:
            by_return.update(map(tuple, chunk.returns.tolist()))
    if not extents:
        return no_points(source.name)
    if within is not None:
        placement.check_overlap(np.stack([np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]]), within)
    wanted, present = [], []
    if classes is not None:
        wanted.append(f"class {', '.join(map(str, sorted(classes)))}")
        present += [f"{n} of class {k}" for k, n in sorted(by_class.items())]
    if returns != "all":
        wanted.append(f"return {returns!r}")
        present += [f"{n} of return {k} of {of}" for (k, of), n in sorted(by_return.items())]
    if not wanted:
        return InputError(f"{source.name} has no points over the block; name a cloud that covers it")
    where = " over the block" if within is not None else ""
    return InputError(f"{source.name} has no points of {' and '.join(wanted)}{where}; it has {', '.join(present)}")
