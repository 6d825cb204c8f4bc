"""Reading clouds: placed in the frame of a block and filtered chunk by chunk, so that memory stays bounded."""

import dataclasses
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Real

from jaxphoto.block import Frame
from jaxphoto.cloud import OF_POINTS, Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CloudSource, check_file
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, epsg_system
from jaxphoto.io.clouds.las import open_las
from jaxphoto.io.clouds.overlap import check_overlap
from jaxphoto.io.clouds.placement import Placement
from jaxphoto.io.clouds.ply import open_ply
from jaxphoto.io.clouds.table import open_csv

Returns = Literal["all", "first", "last", "only"]
"""Which returns of a pulse are read: all, its first, its last, or those of pulses with one return only."""
_OPENERS: dict[str, Callable[[Path, CoordinateSystem | None], CloudSource]] = {
    ".las": open_las,
    ".laz": open_las,
    ".csv": open_csv,
    ".ply": open_ply,
}
NOISE = (7, 18)
"""Classes of blunders, low and high, which are read only where they are asked for."""
EVERY_CLASS = range(256)
"""All classes, those of blunders, too, and points of a file without classes."""
_NO_EXTENT = np.array([[np.inf] * 3, [-np.inf] * 3])


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
    """The cloud in a file .las, .laz, .csv or .ply, in the frame of a block.

    `frame` is that of the block (`Placement` says how points get there); without it, coordinates are the file's own in
    metres. `classes` (all but `NOISE`) and `returns` choose points; `within` (least and greatest X, Y in m) keeps those
    over the block.
    `epsg` names the file's system in place of what it says itself, `unit` (m, ft, us_ft) what its coordinates count in.

    Memory holds the points that are kept and one chunk of the file. Raises InputError where the file is none, damaged
    or empty, its system is missing, unknown or of another kind than the frame's, it does not overlap `within`, or the
    filters leave nothing.
    """
    source = open_source(path, epsg, unit)
    chunks = _placed(source, frame, classes, returns, within)
    if source.most is None:
        return _compact(Cloud.joined(list(chunks)))
    # Memory that is never written to is never taken: there is room for all points, and the rest is given back.
    columns: dict[str, np.ndarray] = {}
    kept, strips = 0, tuple[str, ...]()
    for chunk in chunks:
        present = {name: values for name in OF_POINTS if (values := getattr(chunk, name)) is not None}
        for name, values in present.items():
            if name not in columns:
                columns[name] = _room(source, values)
            columns[name][kept : kept + len(chunk)] = values
        kept, strips = kept + len(chunk), chunk.strips
    for values in columns.values():
        values.resize((kept, *values.shape[1:]), refcheck=False)
    return _compact(Cloud(**columns, strips=strips))


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
    """What `read_cloud` reads, in parts of bounded size, none of them empty. A part's `strips` are those met so far."""
    return _placed(open_source(path, epsg, unit), frame, classes, returns, within)


def extent(
    path: str | Path, frame: Frame | None = None, *, epsg: int | None = None, unit: str | None = None
) -> Float[np.ndarray, "2 3"]:
    """Least and greatest X, Y, Z (m) of a cloud in the frame of a block, from the header where the format has them.

    In a frame that turns the file's axes it is the extent of the file's box, which is a little larger than that of the
    points. Raises what `read_cloud` raises.
    """
    source = open_source(path, epsg, unit)
    placement = Placement(source.name, source.system, frame)
    if source.extent is not None:
        return placement.extent(source.extent)
    ends = _NO_EXTENT
    for chunk in source.chunks():
        ends = widened(ends, placement.frame(chunk.xyz))
    if not np.isfinite(ends).all():
        raise _empty(source)
    return ends


def cloud_system(path: str | Path, *, epsg: int | None = None, unit: str | None = None) -> CoordinateSystem:
    """The system of a cloud's own coordinates. Raises what `read_cloud` raises."""
    return open_source(path, epsg, unit).system


def most_points(path: str | Path) -> int | None:
    """How many points there are in a cloud at most, by its header; None where only reading tells."""
    return open_source(path).most


def open_source(path: str | Path, epsg: int | None = None, unit: str | None = None) -> CloudSource:
    """A cloud file before its points are read; `epsg` and `unit` in place of what it says of its coordinates."""
    path = Path(path)
    check_file(path)
    if path.suffix.lower() not in _OPENERS:
        raise InputError(f"{path.name} is no cloud that is known by its name; name a file {', '.join(_OPENERS)}")
    given = None if epsg is None else epsg_system(epsg, path.name)
    source = _OPENERS[path.suffix.lower()](path, given)
    return dataclasses.replace(source, system=source.system.in_unit(unit))


def _placed(
    source: CloudSource,
    frame: Frame | None,
    classes: Collection[int] | None,
    returns: Returns,
    within: np.ndarray | None,
) -> Iterator[Cloud]:
    if returns not in get_args(Returns):
        raise InputError(f"the returns {returns!r} are unknown; choose one of {', '.join(get_args(Returns))}")
    placement = Placement(source.name, source.system, frame)
    if within is not None and source.extent is not None:
        check_overlap(placement, source.extent, within)
    tally = _Tally(source)
    kept = 0
    for chunk in source.chunks():
        tally.count(chunk)
        part = _taken(chunk, chosen_of(chunk, classes, returns, source.name))
        part = placement.placed(part)
        if within is not None:
            part = _taken(part, ((part.xyz[:, :2] >= within[0]) & (part.xyz[:, :2] <= within[1])).all(axis=1))
        kept += len(part)
        if len(part):
            yield part
    if not kept:
        raise tally.nothing(placement, classes, returns, within)


def chosen_of(chunk: Cloud, classes: Collection[int] | None, returns: Returns, name: str) -> Bool[np.ndarray, "n"]:
    """Which points `read_cloud` chooses of those of the file `name`. Raises InputError where it cannot tell."""
    chosen = np.ones(len(chunk), bool) if chunk.withheld is None else ~chunk.withheld
    if classes is not None and classes != EVERY_CLASS:
        if chunk.classification is None:
            raise InputError(f"{name} has no classification, so no classes can be chosen; leave the filter out")
        chosen &= np.isin(chunk.classification, list(classes))
    elif classes is None and chunk.classification is not None:
        chosen &= ~np.isin(chunk.classification, NOISE)
    if returns != "all":
        if chunk.returns is None:
            raise InputError(f"{name} has no numbers of returns, so none can be chosen; leave the filter out")
        number, of = chunk.returns.T
        chosen &= {"first": number == 1, "last": number == of, "only": (number == 1) & (of == 1)}[returns]
    return chosen


class _Tally:
    """Counts what a file holds, to be told where a filter leaves nothing of it."""

    def __init__(self, source: CloudSource):
        self.source = source
        self.points = 0
        self.classes, self.returns = np.zeros(256, int), np.zeros((16, 16), int)
        self.ends = _NO_EXTENT

    def count(self, chunk: Cloud) -> None:
        self.points += len(chunk)
        if self.source.extent is None:
            self.ends = widened(self.ends, chunk.xyz)
        if chunk.classification is not None:
            self.classes += np.bincount(chunk.classification, minlength=256)
        if chunk.returns is not None:
            number, of = np.minimum(chunk.returns, 15).T.astype(int)
            self.returns += np.bincount(16 * number + of, minlength=256).reshape(16, 16)

    def nothing(
        self, placement: Placement, classes: Collection[int] | None, returns: Returns, within: np.ndarray | None
    ) -> InputError:
        if not self.points:
            return _empty(self.source)
        if within is not None:
            check_overlap(placement, self.ends if self.source.extent is None else self.source.extent, within)
        asked = []
        if classes is not None:
            asked.append(f"class {', '.join(map(str, sorted(classes)))}")
        if returns != "all":
            asked.append(f"return {returns!r}")
        if not asked:
            return InputError(f"{self.source.name} has no points over the block; name a cloud that covers it")
        held = []
        if classes is not None:
            held.append(", ".join(f"{n} of class {c}" for c, n in enumerate(self.classes) if n))
        if returns != "all":
            held.append(
                ", ".join(f"{self.returns[k, of]} of return {k} of {of}" for k, of in np.argwhere(self.returns))
            )
        where = " over the block" if within is not None else ""
        return InputError(
            f"{self.source.name} has no points of {' and '.join(asked)}{where}; it holds {'; '.join(held)}: choose of "
            "these"
        )


def widened(ends: Float[np.ndarray, "2 3"], xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"]:
    """The least and greatest coordinates `ends`, of these and of those of `xyz`."""
    if not len(xyz):
        return ends
    return np.stack([np.minimum(ends[0], xyz.min(axis=0)), np.maximum(ends[1], xyz.max(axis=0))])


def _room(source: CloudSource, values: np.ndarray) -> np.ndarray:
    """An array for all that a file may hold of what `values` are some."""
    assert source.most is not None
    try:
        return np.empty((source.most, *values.shape[1:]), values.dtype)
    except MemoryError:
        raise InputError(
            f"{source.name} promises {source.most} points, which this computer has no memory for; if the file is not "
            "damaged, cut it into parts"
        ) from None


def _taken(cloud: Cloud, chosen: np.ndarray) -> Cloud:
    """`Cloud.take` of a mask; no copy where it is all."""
    return cloud if chosen.all() else cloud.take(chosen)


def _compact(cloud: Cloud) -> Cloud:
    """The same with those strips only that have points."""
    if cloud.strip is None:
        return cloud
    used = np.bincount(cloud.strip, minlength=len(cloud.strips)) > 0
    if used.all():
        return cloud
    number = (np.cumsum(used) - 1).astype(np.int32)
    names = tuple(name for name, there in zip(cloud.strips, used, strict=True) if there)
    return Cloud(cloud.xyz, cloud.classification, cloud.returns, cloud.time, number[cloud.strip], names)


def _empty(source: CloudSource) -> InputError:
    return InputError(f"{source.name} holds no points; name another cloud")
