"""Point clouds: LAS, LAZ, COPC and CSV to `Cloud` and back (docs/clouds.md)."""

import dataclasses
import errno
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import pandas as pd
from jaxtyping import Float, Real
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from jaxphoto.block import Frame
from jaxphoto.cloud import PRECISION_M, Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.datum_change import ways
from jaxphoto.georeferencing.map_frame import MapFrame, map_system
from jaxphoto.io.text_tables import read_csv
from jaxphoto.optional import extra
from jaxphoto.rounding import rounding_error, rounding_step
from jaxphoto.writing import whole_file

if TYPE_CHECKING:
    import laspy

Returns = Literal["all", "first", "last", "only"]
"""Selection by return: all returns of a pulse, first, last, or returns of single-return pulses."""
EVERY_CLASS = range(256)
"""All classes including noise; points without classification are included."""
# ASPRS classes of low and high noise, excluded by default.
_NOISE = (7, 18)
_LAS = (".las", ".laz")
# Number of points processed at a time.
_CHUNK = 500_000
_SCALE_M, _SCALE_DEG = 1e-3, 1e-8
_XYZ = ("X_m", "Y_m", "Z_m")
_RETURNS = ("return_number", "number_of_returns")
# GeoTIFF keys (OGC 19-008r4): vertical system, units of the plane and of heights; EPSG's codes of systems and of feet.
_VERTICAL_CRS, _UNITS = 4096, (3076, 4099)
_EPSG_CODES, _FEET = range(1024, 32767), {9002, 9003}


def read_cloud(
    path: str | Path,
    frame: Frame | None = None,
    *,
    classes: Collection[int] | None = None,
    returns: Returns = "all",
    epsg: int | None = None,
    within: Real[np.ndarray, "2 2"] | None = None,
) -> Cloud:
    """Read a cloud (.las, .laz or .csv) in the frame of a block.

    `frame` is the frame of the block (see `Placement`); without it, coordinates remain in the system of the file, in
    metres. `classes` (default: all except noise, 7 and 18) and `returns` select points; withheld points are skipped.
    `within` (minimum and maximum X, Y in m) is the area of the block. `epsg` overrides the coordinate system of the
    file.
    """
    if returns not in get_args(Returns):
        raise InputError(f"unknown returns {returns!r}; choose one of {', '.join(get_args(Returns))}")
    path = Path(path)
    placement = cloud_placement(path, frame, epsg)
    parts, extents = [], []
    for k, chunk in enumerate(_chunks(path)):
        step = rounding_step(chunk.xyz[:, 2], PRECISION_M, "m") if k == 0 else 0.0
        if rounding_error(step) > PRECISION_M:
            warnings.warn(
                f"{path.name}, column Z: all heights are multiples of {step:.4g}, too coarse for laser points precise "
                f"to {PRECISION_M:g} m; export the cloud with all digits, or state a larger sigma",
                UserWarning,
                stacklevel=2,
            )
        part = placement.placed(chunk)
        mask = np.ones(len(part), bool) if part.withheld is None else ~part.withheld
        if part.classification is not None:
            mask &= (
                ~np.isin(part.classification, _NOISE)
                if classes is None
                else np.isin(part.classification, list(classes))
            )
        elif classes is not None and classes != EVERY_CLASS:
            raise InputError(f"{path.name} has no classification; remove the selection of classes")
        if returns != "all":
            if part.returns is None:
                raise InputError(f"{path.name} has no return numbers; remove the selection of returns")
            number, of = part.returns.T
            mask &= {"first": number == 1, "last": number == of, "only": of == 1}[returns]
        if within is not None:
            extents.append(part.extent)
            mask &= ((part.xyz[:, :2] >= within[0]) & (part.xyz[:, :2] <= within[1])).all(axis=1)
        parts.append(dataclasses.replace(part.take(mask), withheld=None))
    cloud = Cloud.joined(parts)
    if not len(cloud):
        where = ""
        if within is not None:
            extent = np.stack([np.min(extents, axis=0)[0], np.max(extents, axis=0)[1]])
            where = f" over the block ({_text(within)}; those of the file: {_text(extent)})"
        raise InputError(
            f"{path.name} has no points of these classes and returns{where}; choose others, or give its system "
            "(--cloud-epsg)"
        )
    if cloud.strip is None:
        return cloud
    used, strip = np.unique(cloud.strip, return_inverse=True)
    return dataclasses.replace(cloud, strip=strip.astype(np.int32), strips=tuple(cloud.strips[k] for k in used))


def write_cloud(cloud: Cloud, path: str | Path, *, frame: Frame | None = None) -> None:
    """Write `cloud`, whose coordinates are in `frame`, as .las, .laz (LAS 1.4, to the millimetre) or .csv.

    Coordinates are written in the map system of `frame`, or in metres. Raises OSError if writing fails, and InputError
    for an unsupported file name.
    """
    path = Path(path)
    map_frame = frame if frame is not None and frame.kind == "epsg" else None
    xyz = cloud.xyz if map_frame is None else map_frame.map.map(cloud.xyz)
    if _suffix(path) == ".csv":
        _write_csv(path, cloud, xyz)
        return
    laspy = _laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    plane_scale = _SCALE_DEG if map_frame is not None and map_frame.map.geographic else _SCALE_M
    header.scales, header.offsets = np.array([plane_scale, plane_scale, _SCALE_M]), np.floor(xyz[0])
    if map_frame is not None:
        header.add_crs(CRS(f"EPSG:{map_frame.code}" + (f"+{map_frame.vertical}" if map_frame.vertical else "")))
    with _las_writer(path, header) as writer:
        for begin in range(0, len(cloud), _CHUNK):
            part = cloud.take(np.arange(begin, min(begin + _CHUNK, len(cloud))))
            points = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            points.x, points.y, points.z = xyz[begin : begin + _CHUNK].T
            if part.classification is not None:
                points.classification = part.classification
            if part.returns is not None:
                points.return_number, points.number_of_returns = part.returns.T
            if part.time is not None:
                points.gps_time = part.time
            if part.strip is not None:
                # Point source IDs are 16-bit integers: number strips with other names from 1.
                ids = [int(name) if name.isdecimal() else 1 << 16 for name in part.strips]
                ids = ids if max(ids) < 1 << 16 else list(range(1, len(ids) + 1))
                points.point_source_id = np.array(ids, np.uint16)[part.strip]
            writer.write_points(points)


def rewrite_cloud(
    source: str | Path,
    path: str | Path,
    moved: Callable[[Cloud], Float[np.ndarray, "n 3"]],
    *,
    frame: Frame | None = None,
    epsg: int | None = None,
) -> int:
    """Copy cloud file `source` to `path` with new coordinates; return the number of points that were not moved.

    Both files have the same format. `moved` receives each part as in `read_cloud`, including noise and withheld points,
    and returns X, Y, Z (m) in the same `frame`; points for which it returns NaN are not moved. LAS and LAZ retain
    system, scale and all other dimensions, CSV the fields of `Cloud`; COPC is written as LAZ.
    """
    source, path = Path(source), Path(path)
    suffix = _suffix(path)
    placement, stay = cloud_placement(source, frame, epsg), 0

    def coordinates(part: Cloud) -> np.ndarray:
        nonlocal stay
        xyz = placement.file(moved(placement.placed(part)))
        lost = ~np.isfinite(xyz).all(axis=1)
        stay += int(lost.sum())
        return np.where(lost[:, None], part.xyz, xyz)

    if (suffix == ".csv") != (source.suffix.lower() == ".csv"):
        raise InputError(f"{path.name} cannot be written like {source.name}: both must be files of one kind")
    if suffix == ".csv":
        cloud = next(_chunks(source))
        _write_csv(path, cloud, coordinates(cloud))
        return stay
    with _open_las(source) as reader:
        header = reader.header
        # Remove the octree of COPC: laspy writes points in different chunks.
        for records in filter(None, (header.vlrs, header.evlrs)):
            for record in [record for record in records if record.user_id == "copc"]:
                records.remove(record)
        with _las_writer(path, header) as writer:
            for points, part in _las_parts(reader, source.name):
                points.x, points.y, points.z = coordinates(part).T
                writer.write_points(points)
            if header.evlrs:
                writer.write_evlrs(header.evlrs)
    return stay


def cloud_placement(path: Path, frame: Frame | None, epsg: int | None = None) -> "Placement":
    """Return the transformation of the coordinates of a cloud file to `frame`; `epsg` overrides its system."""
    return Placement(path.name, cloud_system(path, epsg), frame)


def cloud_system(path: Path, epsg: int | None = None) -> CRS | None:
    """Read the coordinate system of a cloud file; `epsg` overrides it."""
    if not path.is_file():
        raise InputError(f"file not found: {path}")
    suffix = _suffix(path, copc=True)
    if epsg is not None:
        try:
            return CRS.from_epsg(epsg)
        except CRSError:
            raise InputError(f"{path.name}: the EPSG code {epsg} is unknown; correct it (see epsg.io)") from None
    if suffix == ".csv":
        return None
    with _open_las(path) as reader:
        try:
            return _with_heights(reader.header.parse_crs(), reader.header, path.name)
        except CRSError:
            raise InputError(f"{path.name} has a coordinate system unknown to PROJ; give it (--cloud-epsg)") from None


def _with_heights(crs: CRS | None, header: "laspy.LasHeader", name: str) -> CRS | None:
    """Add the vertical system of the GeoTIFF keys, which laspy does not read. Raises InputError for feet only there."""
    keys = {key.id: key.value_offset for record in header.vlrs.get("GeoKeyDirectoryVlr") for key in record.geo_keys}
    if crs is None or not (crs.is_compound or len(crs.axis_info) == 3):
        if crs is not None and keys.get(_VERTICAL_CRS, 0) in _EPSG_CODES:
            vertical = CRS.from_epsg(keys[_VERTICAL_CRS])
            crs = CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])
        factors = Placement(name, crs, None).factors[[0, 2]]
        for key, axes, factor in zip(_UNITS, ("X and Y", "Z"), factors, strict=True):
            if keys.get(key) in _FEET and factor == 1.0:
                raise InputError(
                    f"{name} states feet for {axes} in its GeoTIFF keys, but its coordinate system does not; convert "
                    "the file to metres"
                )
    return crs


class Placement:
    """Transformation of coordinates of file `name`, in the system `crs`, to the frame of a block (m), and back.

    Without a frame, coordinates are only converted to metres. The frames `local` and `enu` accept coordinates without a
    system, unchanged; a frame `grid` also accepts map coordinates. A frame `epsg` transforms coordinates to its map
    system, then to its local frame. Heights of an unknown system have the unit of the map, and are assumed to be in the
    block's vertical system. `plane` is the map or geographic system (None: local), `vertical` the EPSG code of the
    heights, "ellipsoid", or None if unknown, `factors` are metres per unit of X, Y and Z (1 for degrees).
    """

    def __init__(self, name: str, crs: CRS | None, frame: Frame | None):
        self.name = name
        self.plane: CRS | None = None
        self.vertical: int | Literal["ellipsoid"] | None = None
        self.factors = np.ones(3)
        self._map: MapFrame | None = None
        self._to_plane: Transformer | None = None
        if crs is not None:
            self._set_system(crs)
        kind = None if frame is None else frame.kind
        if self.plane is not None and self.plane.is_geographic and kind != "epsg":
            raise InputError(f"{name} is in {self.system}, in degrees; convert it to a map system, in metres")
        if self.plane is not None and kind in ("local", "enu"):
            raise InputError(
                f"{name} is in {self.system}, but the block's frame is {kind}; give the block a frame of kind epsg, or "
                "write the file in the block's frame, without a coordinate system"
            )
        if frame is None or kind != "epsg":
            return
        if self.plane is None:
            raise InputError(
                f"{name} has no coordinate system, but the block is in EPSG:{frame.code}; give it (--cloud-epsg)"
            )
        self._map = frame.map
        if self.vertical is not None:
            try:
                vertical = self.vertical if isinstance(self.vertical, int) else None
                self._map = MapFrame(self._map.code, vertical, self._map.origin)
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        block_plane = map_system(self._map.code)
        if not self.plane.equals(block_plane, ignore_axis_order=True):
            self._to_plane = self._plane_transformer(self.plane, block_plane, self._map.origin[:2])

    @property
    def system(self) -> str:
        """Name of the system in messages."""
        return "a local frame" if self.plane is None else self.plane.name

    def frame(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform file coordinates to X, Y, Z (m) in the frame of the block; infinite outside a system's area."""
        if self._map is None:
            return xyz * self.factors
        x, y, z = xyz.T
        if self._to_plane is not None:
            x, y = self._to_plane.transform(x, y)
        return self._map.local(np.stack([x, y, z * self._height_factor], axis=1))

    def file(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the inverse of `frame`."""
        if self._map is None:
            return xyz / self.factors
        x, y, z = self._map.map(xyz).T
        if self._to_plane is not None:
            x, y = self._to_plane.transform(x, y, direction="INVERSE")
        return np.stack([x, y, z / self._height_factor], axis=1)

    def placed(self, cloud: Cloud) -> Cloud:
        """Transform a cloud from file coordinates to the frame. Raises InputError for points outside its area."""
        xyz = self.frame(cloud.xyz)
        outside = ~np.isfinite(xyz).all(axis=1)
        if cloud.withheld is not None:
            outside &= ~cloud.withheld
        if outside.any():
            point = ", ".join(f"{value:.2f}" for value in cloud.xyz[outside][0])
            raise InputError(
                f"{self.name}: the point ({point}) is outside the area of {self.system} or of the block's system; "
                "give the system of the file (--cloud-epsg)"
            )
        return dataclasses.replace(cloud, xyz=xyz)

    @property
    def _height_factor(self) -> float:
        # PROJ expects the heights of a vertical system in its own unit.
        return 1.0 if isinstance(self.vertical, int) else self.factors[2]

    def _set_system(self, crs: CRS) -> None:
        plane, *vertical = crs.sub_crs_list if crs.is_compound else [crs]
        while plane.is_bound and plane.source_crs is not None:
            plane = plane.source_crs
        axes = plane.axis_info
        factor = axes[0].unit_conversion_factor if axes and not plane.is_geographic else 1.0
        self.factors = np.full(3, factor)
        if plane.is_engineering:
            return
        south_or_west = {axis.direction for axis in axes[:2]} & {"south", "west"}
        if not (plane.is_projected or plane.is_geographic) or south_or_west:
            raise InputError(
                f"{self.name} is in {plane.name}, not a map system of eastings and northings or a geographic system; "
                "convert its coordinates to one"
            )
        if len(axes) == 3:
            self.vertical, self.factors[2] = "ellipsoid", axes[2].unit_conversion_factor
            plane = plane.to_2d()
        if vertical:
            self.vertical, self.factors[2] = vertical[0].to_epsg(), vertical[0].axis_info[0].unit_conversion_factor
        self.plane = plane

    def _plane_transformer(self, source: CRS, target: CRS, place: tuple[float, float]) -> Transformer:
        """Return PROJ's best installed transformation of plane coordinates near `place`."""
        transformers = ways(source, target, *place).transformers
        if not transformers:
            raise InputError(f"{self.name}: PROJ has no transformation from {source.name} to {target.name}")
        same = source.geodetic_crs and target.geodetic_crs and source.geodetic_crs.datum == target.geodetic_crs.datum
        if "Ballpark" in transformers[0].description and not same:
            warnings.warn(
                f"{self.name}: PROJ has no transformation between the datums of {source.name} and {target.name}; they "
                "are assumed identical, with errors of some metres",
                UserWarning,
                stacklevel=4,
            )
        return transformers[0]


def _chunks(path: Path) -> Iterator[Cloud]:
    """Yield the points of a file in file coordinates; `strips` lists the strips found so far."""
    if path.suffix.lower() != ".csv":
        with _open_las(path) as reader:
            for _, chunk in _las_parts(reader, path.name):
                yield chunk
        return
    table = read_csv(path, _XYZ, ("classification", *_RETURNS, "time_s", "strip"), ("strip",))
    if not len(table):
        raise InputError(f"{path.name} has no points; name another cloud")
    small = {}
    for name in ("classification", *_RETURNS):
        if name in table:
            values = table.numbers(name)
            for line in np.flatnonzero((values < 0) | (values > 255) | (values % 1 != 0))[:1]:
                raise table.bad(line, f"{name} is {values[line]:g}; give a whole number up to 255")
            small[name] = values.astype(np.uint8)
    strip, strips = pd.factorize(table.text("strip")) if "strip" in table else (None, ())
    yield Cloud(
        table.matrix(_XYZ),
        small.get("classification"),
        np.stack([small[name] for name in _RETURNS], axis=1) if set(_RETURNS) <= set(small) else None,
        table.numbers("time_s") if "time_s" in table else None,
        None if strip is None else strip.astype(np.int32),
        tuple(map(str, strips)),
    )


def _write_csv(path: Path, cloud: Cloud, xyz: np.ndarray) -> None:
    table = pd.DataFrame(dict(zip(_XYZ, xyz.T, strict=True)))
    if cloud.classification is not None:
        table["classification"] = cloud.classification
    if cloud.returns is not None:
        table[list(_RETURNS)] = cloud.returns
    if cloud.time is not None:
        table["time_s"] = cloud.time
    if cloud.strip is not None:
        table["strip"] = np.array(cloud.strips, object)[cloud.strip]
    with whole_file(path) as work:
        table.to_csv(work, index=False)


def _las_parts(reader: Any, name: str) -> Iterator[tuple[Any, Cloud]]:
    """Yield the points of a LAS file in parts, as laspy records and as a cloud, with withheld points."""
    count, read, strips = reader.header.point_count, 0, dict[str, int]()
    has_time = "gps_time" in reader.header.point_format.dimension_names
    while read < count:
        with _damage(name):
            points = reader.read_points(_CHUNK)
        if not len(points):
            raise InputError(
                f"{name} is cut off: its header promises {count} points, but there are {read}; copy it again"
            )
        read += len(points)
        codes, ids = pd.factorize(np.asarray(points.point_source_id), sort=True)
        number = np.array([strips.setdefault(str(k), len(strips)) for k in ids], np.int32)
        counts = np.stack([points.X, points.Y, points.Z], axis=1).astype(float)
        yield (
            points,
            Cloud(
                counts * np.asarray(points.scales) + np.asarray(points.offsets),
                np.array(points.classification, np.uint8),
                np.stack([points.return_number, points.number_of_returns], axis=1).astype(np.uint8),
                np.array(points.gps_time, float) if has_time else None,
                number[codes],
                tuple(strips),
                np.array(points.withheld, bool),
            ),
        )


@contextmanager
def _open_las(path: Path) -> Iterator[Any]:
    laspy = _laspy()
    with _damage(path.name):
        reader = laspy.open(path)
    with reader:
        if not reader.header.point_count:
            raise InputError(f"{path.name} has no points; name another cloud")
        yield reader


@contextmanager
def _las_writer(path: Path, header: Any) -> Iterator[Any]:
    """Open a LAS or LAZ file for writing, atomically, and close it after errors: laspy leaves it open."""
    laspy, compress = _laspy(), path.suffix.lower() == ".laz"
    import lazrs

    with whole_file(path) as work:
        try:
            with (
                work.open("w+b") as file,
                laspy.open(file, "w", header=header, do_compress=compress, closefd=False) as writer,
            ):
                yield writer
        except lazrs.LazrsError as error:
            raise OSError(errno.EIO, f"the file cannot be written ({error})", str(work)) from error


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


def _laspy() -> Any:
    # Import here: laspy takes 0.2 s.
    with extra():
        import laspy
    return laspy


def _suffix(path: Path, copc: bool = False) -> str:
    """Return the file name extension. Raises InputError for formats that cannot be read, or written."""
    if path.name.lower().endswith(".copc.laz") and not copc:
        raise InputError(f"{path.name}: COPC is read only; name a .laz file, and convert it (pdal translate, untwine)")
    if path.suffix.lower() not in (*_LAS, ".csv"):
        raise InputError(f"{path.name} is not a point cloud; supported are {', '.join((*_LAS, '.csv'))}")
    return path.suffix.lower()


def _text(extent: np.ndarray) -> str:
    (west, south), (east, north) = extent[:, :2]
    return f"X {west:.1f} to {east:.1f}, Y {south:.1f} to {north:.1f} m"
