"""Writing clouds: LAS, LAZ, CSV and PLY, whole or not at all."""

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pandas as pd
from jaxtyping import Float
from pyproj import CRS

from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_reader import open_source
from jaxphoto.io.clouds.cloud_source import CHUNK, check_file
from jaxphoto.io.clouds.copc import check_copc, is_copc, order_as_copc, without_octree
from jaxphoto.io.clouds.las import opened, points_and_clouds
from jaxphoto.io.clouds.placement import Placement
from jaxphoto.io.clouds.table import RETURNS, XYZ
from jaxphoto.io.text_tables import natural
from jaxphoto.writing import whole_file

# A millimetre holds what a scanner measures, and leaves 4,000 km of room.
_SCALE_M, _SCALE_DEG = 1e-3, 1e-8
_LAS = (".las", ".laz")
# Parts of a cloud, and their coordinates as they are to be written.
_Parts = Iterator[tuple[Cloud, Float[np.ndarray, "n 3"]]]


def write_cloud(
    cloud: Cloud,
    path: str | Path,
    *,
    like: str | Path | None = None,
    frame: Frame | None = None,
    epsg: int | None = None,
    unit: str | None = None,
) -> None:
    """Write `cloud`, which is in `frame`, to a file .las, .laz, .csv or .ply; nothing is left half-written.

    With `like`, the LAS or LAZ file that it was read from whole (`epsg` and `unit` as they were then): that file with
    other coordinates, in its own system, units and scale, and all else that it says of every point; those withheld,
    which were not read, stay where they were. Without, in the system of `frame` where that is of kind epsg, or as it
    stands, in metres; LAS 1.4 to the millimetre, CSV and PLY in double precision.

    Raises OSError where it cannot be written whole, InputError where `like` has another number of points, and for names
    that are no cloud's.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_LAS, ".csv", ".ply"):
        raise InputError(f"{path.name} is no cloud that is known by its name; name a file .las, .laz, .csv or .ply")
    if like is not None:
        check_file(Path(like))
        if kind not in _LAS or Path(like).suffix.lower() not in _LAS:
            raise InputError(f"{path.name} cannot be written like {Path(like).name}: both must be .las or .laz")
        source = open_source(like, epsg, unit)
        placement = Placement(source.name, source.system, frame)
        _check_copc(Path(like), path)
        with _said_of(path), whole_file(path) as work:
            _write_like(cloud, work, Path(like), placement)
            _ordered(work, path)
        return
    map_frame = frame if frame is not None and frame.kind == "epsg" else None
    with _said_of(path), whole_file(path) as work:
        if kind in _LAS:
            _write_las(cloud, work, map_frame)
            _ordered(work, path)
        else:
            _WRITERS[kind](_parts(cloud, map_frame), len(cloud), work)


def rewrite_cloud(
    source: str | Path,
    path: str | Path,
    moved: Callable[[Cloud], Float[np.ndarray, "n 3"]],
    *,
    frame: Frame | None = None,
    epsg: int | None = None,
    unit: str | None = None,
) -> int:
    """Write to `path` the cloud in the file `source`, of one kind, with other coordinates; part by part, in its order.

    `moved` takes each part as `read_cloud` gives it, with noise and what is withheld, and gives X, Y, Z (m) in the same
    `frame`.
    What is written is in the system and units of `source`; of LAS and LAZ with all else that it says of every point, of
    CSV and PLY with what a `Cloud` holds. Memory holds one part, and nothing is left half-written.

    Gives how many points stay where they were: those withheld that lie where the system of the frame does not reach, or
    of which `moved` gives NaN.

    Raises OSError where it cannot be written whole, and what `read_cloud` and `moved` raise.
    """
    source, path = Path(source), Path(path)
    opened_source = open_source(source, epsg, unit)
    kind = path.suffix.lower()
    if kind != source.suffix.lower() and not {kind, source.suffix.lower()} <= set(_LAS):
        raise InputError(f"{path.name} cannot be written like {source.name}: both must be files of one kind")
    placement = Placement(opened_source.name, opened_source.system, frame)
    if kind in _LAS:
        _check_copc(source, path)

    stay = 0

    def to_write(part: Cloud) -> np.ndarray:
        nonlocal stay
        if part.withheld is None or not part.withheld.any():
            return placement.file(moved(placement.placed(part)))
        reached = ~part.withheld
        reached[part.withheld] = np.isfinite(placement.frame(part.xyz[part.withheld])).all(axis=1)
        own, xyz = np.flatnonzero(reached), np.array(part.xyz)
        new = moved(placement.placed(part.take(own)))
        lost = np.isnan(new).any(axis=1) & part.withheld[own]
        xyz[own[~lost]] = placement.file(new[~lost])
        stay += len(part) - len(own) + int(lost.sum())
        return xyz

    with _said_of(path), whole_file(path) as work:
        if kind in _LAS:
            _rewrite_las(source, work, to_write)
            _ordered(work, path)
        else:
            parts = ((part, to_write(part)) for part in opened_source.chunks())
            _WRITERS[kind](parts, opened_source.most, work)
    return stay


def _check_copc(source: Path, path: Path) -> None:
    with opened(source) as reader:
        check_copc(reader.header, source.name, path)


def _ordered(work: Path, path: Path) -> None:
    """Put what is written in the order that the name of `path` promises."""
    if is_copc(path):
        order_as_copc(work)


@contextmanager
def _said_of(path: Path) -> Iterator[None]:
    """Have what the LAZ encoder meets, a full disk for one, be the OSError of `path` that it is elsewhere."""
    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(errno.EIO, f"the file cannot be written whole ({error})", str(path)) from error


def _parts(cloud: Cloud, frame: Frame | None) -> _Parts:
    """The cloud in parts, with coordinates in the system of `frame`."""
    for begin in range(0, len(cloud), CHUNK):
        part = cloud.take(np.arange(begin, min(begin + CHUNK, len(cloud))))
        yield part, part.xyz if frame is None else frame.map.map(part.xyz)


def _write_like(cloud: Cloud, path: Path, like: Path, placement: Placement) -> None:
    done = 0

    def to_write(part: Cloud) -> np.ndarray:
        nonlocal done
        assert part.withheld is not None
        own = np.flatnonzero(~part.withheld)
        begin, done = done, done + len(own)
        if done <= len(cloud):
            part.xyz[own] = placement.file(cloud.xyz[begin:done])
        return part.xyz

    _rewrite_las(like, path, to_write)
    if done != len(cloud):
        raise InputError(
            f"{path.name} cannot be written like {like.name}: the cloud has {len(cloud)} points, that file "
            f"{done}; read the file whole, without filters"
        )


def _rewrite_las(source: Path, path: Path, to_write: Callable[[Cloud], Float[np.ndarray, "n 3"]]) -> None:
    """Write `source` with other coordinates of its own system."""
    with opened(source) as reader:
        header = without_octree(reader.header)
        with _las_writer(path, header) as writer:
            for points, part in points_and_clouds(reader, source, withheld=True):
                xyz = to_write(part)
                _check_room(xyz, header, source.name)
                points.x, points.y, points.z = xyz.T
                writer.write_points(points)
            if header.evlrs:
                writer.write_evlrs(header.evlrs)


@contextmanager
def _las_writer(path: Path, header: laspy.LasHeader) -> Iterator[laspy.LasWriter]:
    """Open a file for points; it is closed on a full disk, too, where laspy leaves its own file open."""
    compress = path.suffix.lower() == ".laz"
    with (
        path.open("w+b") as file,
        laspy.open(file, "w", header=header, do_compress=compress, closefd=False) as writer,
    ):
        yield writer


def _write_las(cloud: Cloud, path: Path, frame: Frame | None) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    ends = np.concatenate([xyz[[0]] for _, xyz in _parts(cloud, frame)])
    geographic = frame is not None and frame.map.geographic
    header.scales = np.array([*[_SCALE_DEG if geographic else _SCALE_M] * 2, _SCALE_M])
    header.offsets = np.floor(ends.mean(axis=0))
    if frame is not None:
        header.add_crs(CRS(f"EPSG:{frame.code}" + (f"+{frame.vertical}" if frame.vertical else "")))
    with _las_writer(path, header) as writer:
        for part, xyz in _parts(cloud, frame):
            _check_room(xyz, header, path.name)
            points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            points.x, points.y, points.z = xyz.T
            if part.classification is not None:
                points.classification = part.classification
            if part.returns is not None:
                points.return_number, points.number_of_returns = part.returns.T
            if part.time is not None:
                points.gps_time = part.time
            if part.strip is not None:
                points.point_source_id = _source_ids(part)
            writer.write_points(points)


def _check_room(xyz: np.ndarray, header: laspy.LasHeader, name: str) -> None:
    """Raise InputError where coordinates cannot be counted in the scale of a file."""
    counts = np.abs((xyz - header.offsets) / header.scales)
    if not (counts < 2**31 - 1).all():
        raise InputError(
            f"{name} counts in {header.scales[0]:g} from its offset, too finely for coordinates up to "
            f"{np.abs(xyz).max():g}; write the cloud as .csv or .ply"
        )


def _source_ids(cloud: Cloud) -> np.ndarray:
    """Point source IDs: the strips' own where they are such numbers, else their index from 1."""
    numbers = [natural(name) for name in cloud.strips]
    own = [number for number in numbers if number is not None and number < 1 << 16]
    ids = np.array(own) if len(own) == len(numbers) else np.arange(1, len(numbers) + 1)
    assert cloud.strip is not None
    return ids[cloud.strip].astype(np.uint16)


def _columns(cloud: Cloud) -> dict[str, np.ndarray]:
    """What is known of every point besides its coordinates, by the names of CSV and PLY."""
    columns = {}
    if cloud.classification is not None:
        columns["classification"] = cloud.classification
    if cloud.returns is not None:
        columns |= dict(zip(RETURNS, cloud.returns.T, strict=True))
    if cloud.time is not None:
        columns["time_s"] = cloud.time
    return columns


def _write_csv(parts: _Parts, count: int | None, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        for k, (part, xyz) in enumerate(parts):
            table = pd.DataFrame(dict(zip(XYZ, xyz.T, strict=True)) | _columns(part))
            if part.strip is not None:
                table["strip"] = np.array(part.strips, object)[part.strip]
            table.to_csv(file, index=False, header=k == 0)


def _write_ply(parts: _Parts, count: int | None, path: Path) -> None:
    named = {"<f8": "double", "|u1": "uchar", "<u2": "ushort"}
    with path.open("wb") as file:
        for k, (part, xyz) in enumerate(parts):
            fields = [(axis, "<f8") for axis in "xyz"] + [(name, v.dtype.str) for name, v in _columns(part).items()]
            if part.strip is not None:
                fields.append(("point_source_id", "<u2"))
            if k == 0:
                header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
                header += [f"property {named[kind]} {name}" for name, kind in fields]
                file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
            records = np.empty(len(part), fields)
            records["x"], records["y"], records["z"] = xyz.T
            for name, values in _columns(part).items():
                records[name] = values
            if part.strip is not None:
                records["point_source_id"] = _source_ids(part)
            # By `write`, which says why where it cannot.
            file.write(records.tobytes())


_WRITERS: dict[str, Callable[[_Parts, int | None, Path], None]] = {".csv": _write_csv, ".ply": _write_ply}
