"""Read and write LAS, LAZ and COPC (LAZ in octree order) by laspy."""

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pyproj import CRS
from pyproj.exceptions import CRSError

from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers, no_points, source_ids
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, system_of
from jaxphoto.optional import extra

with extra():
    import laspy
    import lazrs

# GeoTIFF keys that laspy does not read, and metres per EPSG code of linear units.
_PLANE_UNIT, _HEIGHTS, _HEIGHT_UNIT = 3076, 4096, 4099
_LINEAR_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
_SCALE_M, _SCALE_DEG = 1e-3, 1e-8


def open_las(path: Path, system: CoordinateSystem | None) -> CloudSource:
    """Open a LAS or LAZ file without withheld points; `system` overrides its system. Raises InputError if damaged."""
    with _open(path) as reader:
        header = reader.header
        if header.point_count == 0:
            raise no_points(path.name)
        extent = np.stack([header.mins, header.maxs])
        return CloudSource(
            path.name, system or _system(header, path.name), header.point_count, extent, lambda: _chunks(path)
        )


def write_las(parts: Callable[[], Iterator[tuple[Cloud, np.ndarray]]], path: Path, frame: Frame | None) -> None:
    """Write pairs (cloud, coordinates), in the map system of `frame`, as LAS 1.4 or LAZ."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    first = np.concatenate([xyz[[0]] for _, xyz in parts()])
    plane_scale = _SCALE_DEG if frame is not None and frame.map.geographic else _SCALE_M
    header.scales, header.offsets = np.array([plane_scale, plane_scale, _SCALE_M]), np.floor(first.mean(axis=0))
    if frame is not None:
        header.add_crs(CRS(f"EPSG:{frame.code}" + (f"+{frame.vertical}" if frame.vertical else "")))
    with _las_writer(path, header) as writer:
        for part, xyz in parts():
            points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            _set_coordinates(points, xyz, header, path.name)
            if part.classification is not None:
                points.classification = part.classification
            if part.returns is not None:
                points.return_number, points.number_of_returns = part.returns.T
            if part.time is not None:
                points.gps_time = part.time
            if part.strip is not None:
                points.point_source_id = source_ids(part)
            writer.write_points(points)


def rewrite_las(source: Path, path: Path, coordinates: Callable[[Cloud], Float[np.ndarray, "n 3"]]) -> None:
    """Copy `source` to `path` with new coordinates, computed per part; all other dimensions are retained."""
    with _open(source) as reader:
        header = reader.header
        # Remove the octree of COPC: laspy writes points in different chunks.
        for records in filter(None, (header.vlrs, header.evlrs)):
            for record in [record for record in records if record.user_id == "copc"]:
                records.remove(record)
        with _las_writer(path, header) as writer:
            for points, part in _points_and_clouds(reader, source.name, withheld=True):
                _set_coordinates(points, coordinates(part), header, source.name)
                writer.write_points(points)
            if header.evlrs:
                writer.write_evlrs(header.evlrs)


@contextmanager
def _open(path: Path) -> Iterator[laspy.LasReader]:
    with _damage(path.name):
        reader = laspy.open(path)
    with reader:
        yield reader


@contextmanager
def _las_writer(path: Path, header: laspy.LasHeader) -> Iterator[laspy.LasWriter]:
    """Open a file for writing points, and close it after errors: laspy leaves it open if the disk is full."""
    compress = path.suffix.lower() == ".laz"
    try:
        with (
            path.open("w+b") as file,
            laspy.open(file, "w", header=header, do_compress=compress, closefd=False) as writer,
        ):
            yield writer
    except lazrs.LazrsError as error:
        raise OSError(errno.EIO, f"the file cannot be written ({error})", str(path)) from error


@contextmanager
def _damage(name: str) -> Iterator[None]:
    """Convert any exception that laspy or its decoder raises for damaged bytes to InputError."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    # A panic of the decoder is not an Exception.
    except BaseException as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:80]
        raise InputError(f"{name} is cut off or damaged ({reason}); copy it again from its source") from None


def _chunks(path: Path) -> Iterator[Cloud]:
    with _open(path) as reader:
        for _, chunk in _points_and_clouds(reader, path.name, withheld=False):
            yield chunk


def _points_and_clouds(
    reader: laspy.LasReader, name: str, *, withheld: bool
) -> Iterator[tuple[laspy.ScaleAwarePointRecord, Cloud]]:
    """Yield the points of a file in parts, as laspy records and as a cloud, with or without `withheld` points.

    Raises InputError for points outside the extent of the header, which indicate damaged bytes.
    """
    strips, header, read = StripNumbers(), reader.header, 0
    low, high = np.asarray(header.mins), np.asarray(header.maxs)
    # Tolerate rounding of the extent in the header.
    slack = 2 * np.asarray(header.scales) + 1e-6 * (high - low)
    has_time = "gps_time" in header.point_format.dimension_names
    while read < header.point_count:
        with _damage(name):
            points = reader.read_points(CHUNK)
        if not len(points):
            raise InputError(
                f"{name} is cut off: its header promises {header.point_count} points, but there are {read}; copy it "
                "again from its source"
            )
        read += len(points)
        used = ~np.asarray(points.withheld, bool)
        if not withheld and not used.all():
            points, used = points[used], used[used]
        counts = np.stack([points.X, points.Y, points.Z], axis=1).astype(float)
        xyz = counts * np.asarray(points.scales) + np.asarray(points.offsets)
        time = np.array(points.gps_time, float) if has_time else None
        outside = used & ~((xyz >= low - slack) & (xyz <= high + slack)).all(axis=1)
        untimed = used & ~np.isfinite(time) if time is not None else np.zeros(len(points), bool)
        for invalid, problem in ((outside, "is outside the extent of the header"), (untimed, "has no finite time")):
            if invalid.any():
                point = ", ".join(f"{value:.2f}" for value in xyz[invalid][0])
                raise InputError(f"{name} is damaged: the point ({point}) {problem}; copy it again from its source")
        yield (
            points,
            Cloud(
                xyz,
                classification=np.array(points.classification, np.uint8),
                returns=np.stack([points.return_number, points.number_of_returns], axis=1).astype(np.uint8),
                time=time,
                strip=strips.of(np.asarray(points.point_source_id)),
                withheld=~used if withheld else None,
                strips=strips.names,
            ),
        )


def _set_coordinates(points: laspy.ScaleAwarePointRecord, xyz: np.ndarray, header: laspy.LasHeader, name: str) -> None:
    """Set the coordinates of points. Raises InputError if they exceed 32 bits in the scale of the header."""
    if not (np.abs((xyz - header.offsets) / header.scales) < 2**31 - 1).all():
        raise InputError(
            f"{name} has the resolution {header.scales[0]:g}, too fine for coordinates up to "
            f"{np.abs(xyz).max():g}; write the cloud as .csv or .ply"
        )
    points.x, points.y, points.z = xyz.T


def _system(header: laspy.LasHeader, name: str) -> CoordinateSystem:
    """Read the system from WKT or GeoTIFF records, and units and vertical system from GeoTIFF keys."""
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
        raise InputError(f"{name} has a coordinate system unknown to PROJ; give it (--cloud-epsg)") from None
    if crs is not None:
        system = system_of(crs, name)
    else:
        unit = _LINEAR_UNITS.get(keys.get(_PLANE_UNIT, 0), 1.0)
        system = CoordinateSystem(units=(unit, unit))
    if system.heights is not None:
        return system
    heights, height_unit = None, system.units[1]
    try:
        vertical = CRS.from_epsg(keys[_HEIGHTS])
        if vertical.is_vertical:
            heights, height_unit = keys[_HEIGHTS], vertical.axis_info[0].unit_conversion_factor
    except (CRSError, KeyError):
        pass
    file_unit = _LINEAR_UNITS.get(keys.get(_HEIGHT_UNIT, 0), height_unit)
    return CoordinateSystem(system.plane, heights, (system.units[0], file_unit), height_unit)
