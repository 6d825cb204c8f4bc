"""LAS and LAZ, by laspy with its Rust backend."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers, at_once
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, system_of
from jaxphoto.io.clouds.laz_chunks import unpacker

# Bytes of the head of a record before the points; that of one after them ends with its length and a description.
_RECORD, _RECORD_AFTER = 54, struct.Struct("<20xQ32x")
# Keys of GeoTIFF, and the metres in its codes of lengths.
_PLANE_UNIT, _HEIGHTS, _HEIGHT_UNIT = 3076, 4096, 4099
_LENGTHS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}


def open_las(path: Path, given: CoordinateSystem | None) -> CloudSource:
    """A LAS or LAZ file as a source, in the system `given` or, without one, that of the file.

    Points that are marked as withheld are left out, as the format wants.

    Raises InputError where the file is damaged: cut off, with points outside the extent that its header gives, or fewer
    of them than it promises.
    """
    with opened(path) as reader:
        header = reader.header
        count, system = header.point_count, given or _system(header, path.name)
        there = (path.stat().st_size - header.offset_to_point_data) // header.point_format.size
        if there < count and not header.are_points_compressed:
            raise _cut_off(path.name, count, there)
        extent = np.stack([header.mins, header.maxs])
        _check_counting(header, path.name)
    if count == 0:
        raise InputError(f"{path.name} holds no points; name another cloud")
    return CloudSource(path.name, system, count, extent, lambda: _chunks(path))


@contextmanager
def opened(path: Path) -> Iterator[laspy.LasReader]:
    """A reader of `path`. Raises InputError where what stands before or after the points is damaged."""
    with _damage(path):
        _check_records(path)
        reader = laspy.open(path)
    with reader:
        yield reader


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Whatever goes wrong in laspy or its decoder on bytes that are not what they should be, as InputError."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    # They have no errors of their own for most of it, and a panic of the decoder is no Exception.
    except BaseException as error:
        said = (str(error).strip() or type(error).__name__).splitlines()[0][:80]
        raise InputError(f"{path.name} is cut off or damaged ({said}); copy it anew from its source") from None


def _check_records(path: Path) -> None:
    """Raise LaspyException where a header counts more or longer records than fit in: laspy would take room for all."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(375).ljust(375, b"\0")
        minor, length, begin, n_records = header[25], *struct.unpack_from("<HII", header, 94)
        if begin > size:
            raise laspy.errors.LaspyException("its points begin after its end")
        if length + _RECORD * n_records > begin:
            raise laspy.errors.LaspyException("its header counts more records than it has room for")
        after, n_after = struct.unpack_from("<QI", header, 235)
        if minor < 4 or not n_after:
            return
        if after + _RECORD_AFTER.size * n_after > size:
            raise laspy.errors.LaspyException("its header counts more records after the points than there are")
        for _ in range(n_after):
            file.seek(after)
            after += _RECORD_AFTER.size + _RECORD_AFTER.unpack(file.read(_RECORD_AFTER.size))[0]
            if after > size:
                raise laspy.errors.LaspyException("a record after the points is longer than the file")


def _check_counting(header: laspy.LasHeader, name: str) -> None:
    """Raise InputError where scales, offsets and extent of a header are no numbers that coordinates can have."""
    for what, values in (
        ("scale", header.scales), ("offset", header.offsets), ("least", header.mins), ("greatest", header.maxs),
    ):  # fmt: skip
        if not np.isfinite(values).all() or (what == "scale" and not (values > 0).all()):
            said = ", ".join(f"{value:g}" for value in values)
            raise InputError(
                f"{name} is damaged: its header gives {said} as {what} X, Y, Z; copy the file anew from its source, or "
                "have its header mended (lasinfo -repair)"
            )


def raw_chunks(reader: laspy.LasReader, path: Path) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The points of `path`, open. Raises InputError where they are damaged or too few."""
    read, promised = 0, reader.header.point_count
    if reader.header.are_points_compressed:
        with _damage(path):
            reader.laz_backend = unpacker(path, reader.header)
    together = at_once(reader.header.point_format.size, CHUNK)
    while read < promised:
        with _damage(path):
            points = reader.read_points(together)
        if not len(points):
            raise _cut_off(path.name, promised, read)
        read += len(points)
        yield points


def _cut_off(name: str, promised: int, there: int) -> InputError:
    return InputError(
        f"{name} is cut off: its header promises {promised} points, but there are {there}; copy it anew from its source"
    )


def coordinates(points: laspy.ScaleAwarePointRecord) -> np.ndarray:
    """X, Y, Z (n, 3) as the file counts them."""
    counts = np.stack([points.X, points.Y, points.Z], axis=1).astype(float)
    return counts * np.asarray(points.scales) + np.asarray(points.offsets)


def _chunks(path: Path) -> Iterator[Cloud]:
    with opened(path) as reader:
        for _, chunk in points_and_clouds(reader, path, withheld=False):
            yield chunk


def points_and_clouds(
    reader: laspy.LasReader, path: Path, *, withheld: bool
) -> Iterator[tuple[laspy.ScaleAwarePointRecord, Cloud]]:
    """Part by part, the points of `path`, open, as they stand in it and as a cloud in its own coordinates.

    With those that are `withheld`, or without. Raises as `raw_chunks`, and InputError for points that lie or are timed
    where none can be, if they are not withheld.
    """
    strips = StripNumbers()
    low, high = np.asarray(reader.header.mins), np.asarray(reader.header.maxs)
    # Headers are rounded in their own ways.
    slack = 2 * np.asarray(reader.header.scales) + 1e-6 * (high - low)
    has_time = "gps_time" in reader.header.point_format.dimension_names
    for every in raw_chunks(reader, path):
        with _damage(path):
            kept = ~np.asarray(every.withheld, bool)
        points = every if withheld or kept.all() else every[kept]
        used = kept if withheld else np.ones(len(points), bool)
        xyz = coordinates(points)
        outside = used & ~((xyz >= low - slack) & (xyz <= high + slack)).all(axis=1)
        if outside.any():
            at = ", ".join(f"{value:.2f}" for value in xyz[outside][0])
            raise InputError(
                f"{path.name} is damaged: the point ({at}) lies outside the extent that the header gives; copy the "
                "file anew from its source, or have its header mended (lasinfo -repair)"
            )
        time = np.array(points.gps_time, float) if has_time else None
        if time is not None and not np.isfinite(time[used]).all():
            at = ", ".join(f"{value:.2f}" for value in xyz[used & ~np.isfinite(time)][0])
            raise InputError(
                f"{path.name} is damaged: the time of the point ({at}) is no finite number; copy the file anew "
                "from its source, or set that time"
            )
        cloud = Cloud(
            xyz,
            classification=np.array(points.classification, np.uint8),
            returns=np.stack([points.return_number, points.number_of_returns], axis=1).astype(np.uint8),
            time=time,
            strip=strips.of(np.asarray(points.point_source_id)),
            withheld=~kept if withheld else None,
            strips=strips.names,
        )
        yield points, cloud


def _system(header: laspy.LasHeader, name: str) -> CoordinateSystem:
    """What WKT or GeoTIFF keys say; keys that laspy leaves aside tell units and heights."""
    keys = {
        key.id: key.value_offset
        for record in header.vlrs.get_by_id("LASF_Projection")
        if isinstance(record, laspy.vlrs.known.GeoKeyDirectoryVlr)
        for key in record.geo_keys
        if key.tiff_tag_location == 0
    }
    try:
        crs = header.parse_crs()
    except CRSError:
        raise InputError(
            f"{name} names a system of coordinates that PROJ does not know; name it yourself (--cloud-epsg)"
        ) from None
    unit = _LENGTHS.get(keys.get(_PLANE_UNIT, 0))
    system = CoordinateSystem() if crs is None else system_of(crs, name)
    if crs is None and unit is not None:
        system = CoordinateSystem(units=(unit, unit))
    if system.heights is not None:
        return system
    heights, height_unit = None, system.units[1]
    if keys.get(_HEIGHTS, 0):
        try:
            upper = CRS.from_epsg(keys[_HEIGHTS])
        except CRSError:
            upper = None
        if upper is not None and upper.is_vertical:
            heights, height_unit = keys[_HEIGHTS], upper.axis_info[0].unit_conversion_factor
    own_unit = height_unit
    height_unit = _LENGTHS.get(keys.get(_HEIGHT_UNIT, 0), height_unit)
    return CoordinateSystem(system.plane, heights, (system.units[0], height_unit), own_unit)
