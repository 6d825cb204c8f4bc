"""Coordinate systems of clouds and rasters, and their transformation to the frame of a block."""

import dataclasses
import warnings
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Real
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.datum_change import ways
from jaxphoto.georeferencing.map_frame import MapFrame, map_system

UNITS: Mapping[str, float] = {"m": 1.0, "ft": 0.3048, "us_ft": 1200 / 3937}
"""Metres per unit: metre, international foot, US survey foot."""
# EPSG codes of vertical systems in feet (NAVD88, NGVD29, mean sea level), and of their equivalents in metres.
_METRIC_HEIGHTS = {6360: 5703, 8228: 5703, 5702: 7968, 8050: 5714}


@dataclasses.dataclass(frozen=True)
class CoordinateSystem:
    """Coordinate system and units of a file.

    `plane` is the projected system with axes in metres, the geographic system, or None (local frame). `heights` is the
    EPSG code of the vertical system, "ellipsoid", or None if unknown. `units` are metres per unit of X and Y, and of Z,
    in the file; 1 for degrees. `heights_unit` is the unit of the vertical system, which PROJ expects.
    """

    plane: CRS | None = None
    heights: int | str | None = None
    units: tuple[float, float] = (1.0, 1.0)
    heights_unit: float = 1.0

    @property
    def geographic(self) -> bool:
        """True if X and Y are longitude and latitude in degrees."""
        return self.plane is not None and self.plane.is_geographic

    @property
    def name(self) -> str:
        """Name of the system in messages."""
        return "a local frame" if self.plane is None else self.plane.name

    @property
    def factors(self) -> Float[np.ndarray, "3"]:
        """Metres per unit of X, Y and Z (1 for degrees)."""
        return np.array([self.units[0], *self.units])

    def in_unit(self, unit: str | None) -> "CoordinateSystem":
        """Return the system with coordinates in `unit` (a key of `UNITS`; None: unchanged).

        Raises InputError for an unknown unit.
        """
        if unit is None:
            return self
        if unit not in UNITS:
            raise InputError(f"the unit {unit!r} is unknown; choose one of {', '.join(UNITS)}")
        return dataclasses.replace(self, units=(1.0 if self.geographic else UNITS[unit], UNITS[unit]))

    @property
    def metric(self) -> CRS | None:
        """Compound system in metres; the plane system only if its vertical system is unknown or not in metres."""
        heights = _METRIC_HEIGHTS.get(self.heights, self.heights)  # type: ignore[arg-type]
        if self.plane is None or not isinstance(heights, int):
            return self.plane
        vertical = CRS.from_epsg(heights)
        if vertical.axis_info[0].unit_name != "metre":
            return self.plane
        return CompoundCRS(f"{self.plane.name} + {vertical.name}", [self.plane, vertical])


def system_of(crs: CRS, name: str) -> CoordinateSystem:
    """Convert `crs` of the file `name` to a coordinate system; heights of an unknown system have the unit of the map.

    Raises InputError for geocentric systems, and for axes that point south or west.
    """
    plane, *vertical = [_unbound(part) for part in (crs.sub_crs_list if crs.is_compound else [crs])]
    axes = plane.axis_info
    if plane.is_engineering:
        unit = axes[0].unit_conversion_factor if axes else 1.0
        return CoordinateSystem(units=(unit, unit))
    if plane.is_geocentric or not (plane.is_projected or plane.is_geographic):
        raise InputError(f"{name} is in {plane.name}, not a map or geographic system; convert its coordinates to one")
    if {axis.direction for axis in axes[:2]} & {"south", "west"}:
        raise InputError(f"{name} is in {plane.name}, with axes south or west; convert it to eastings and northings")
    unit = axes[0].unit_conversion_factor if plane.is_projected else 1.0
    heights: int | str | None = None
    height_unit = unit
    if len(axes) == 3:
        heights, height_unit, plane = "ellipsoid", axes[2].unit_conversion_factor, plane.to_2d()
    if vertical:
        heights, height_unit = vertical[0].to_epsg(), vertical[0].axis_info[0].unit_conversion_factor
    return CoordinateSystem(_in_metres(plane), heights, (unit, height_unit), height_unit)


def epsg_system(code: int, name: str) -> CoordinateSystem:
    """Return the coordinate system of the EPSG code `code` of file `name`. Raises InputError if unknown."""
    try:
        crs = CRS.from_epsg(code)
    except CRSError:
        raise InputError(f"{name}: the EPSG code {code} is unknown; correct it (see epsg.io)") from None
    return system_of(crs, f"EPSG:{code}, given for {name},")


def frame_system(frame: Frame | None) -> CoordinateSystem:
    """Return the coordinate system, in metres, of the map coordinates of a frame; a local frame has none."""
    if frame is None or frame.code is None:
        return CoordinateSystem()
    return CoordinateSystem(map_system(frame.code), "ellipsoid" if frame.vertical is None else frame.vertical)


def _unbound(crs: CRS) -> CRS:
    while crs.is_bound:
        assert crs.source_crs is not None
        crs = crs.source_crs
    return crs


def _in_metres(crs: CRS) -> CRS:
    """Convert the axes of a projection to metres; false easting and northing retain unit and value."""
    if crs.is_geographic or all(axis.unit_conversion_factor == 1 for axis in crs.axis_info):
        return crs
    definition = crs.to_json_dict()
    for part in ("id", "ids", "usages", "scope", "area", "bbox"):
        definition.pop(part, None)
    definition["name"] = f"{crs.name}, in metres"
    for axis in definition["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    metric = CRS.from_json_dict(definition)
    # EPSG has a metric equivalent of most systems in feet: use its name and code.
    code = metric.to_epsg()
    return metric if code is None else CRS.from_epsg(code)


class Placement:
    """Transformation of coordinates of file `name`, in `system`, to the frame of a block (m), and back.

    Without a frame, coordinates are only converted to metres. The frames `local` and `enu` accept coordinates without a
    system, unchanged; a frame `grid` also accepts map coordinates. A frame `epsg` transforms coordinates to its map
    system, then to its local frame. Heights of an unknown system are assumed to be in the block's vertical system.

    Raises InputError if system and frame are incompatible. `option` is the option that sets the file's system, for
    messages.
    """

    def __init__(self, name: str, system: CoordinateSystem, frame: Frame | None, option: str = "--cloud-epsg"):
        self.name, self.system, self.option = name, system, option
        self._map: MapFrame | None = None
        self._plane: Transformer | None = None
        kind = None if frame is None else frame.kind
        if system.geographic and kind != "epsg":
            raise InputError(f"{name} is in {system.name}, in degrees; convert it to a map system, in metres")
        if system.plane is not None and kind in ("local", "enu"):
            raise InputError(
                f"{name} is in {system.name}, but the block's frame is {kind}; give the block a frame of kind epsg, or "
                "write the file in the block's frame, without a coordinate system"
            )
        if frame is None or kind != "epsg":
            return
        if system.plane is None:
            raise InputError(
                f"{name} has no coordinate system, but the block is in EPSG:{frame.code}; give it ({option})"
            )
        self._map = frame.map
        if system.heights is not None:
            vertical = system.heights if isinstance(system.heights, int) else None
            try:
                self._map = MapFrame(self._map.code, vertical, self._map.origin)
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        self._height_unit = system.heights_unit if isinstance(system.heights, int) else 1.0
        block_plane = map_system(self._map.code)
        if not system.plane.equals(block_plane, ignore_axis_order=True):
            self._plane = self._plane_transformer(system.plane, block_plane, self._map.origin[:2])

    def frame(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform to X, Y, Z (m) in the frame of the block; infinite outside the area of a system."""
        return self.frame_from_metres(xyz * self.system.factors)

    def frame_from_metres(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform file coordinates in metres (or degrees) to X, Y, Z (m) in the frame of the block."""
        if self._map is None:
            return xyz
        x, y, z = xyz.T
        if self._plane is not None:
            x, y = self._plane.transform(x, y)
        return self._map.local(np.stack([x, y, z / self._height_unit], axis=1))

    def metres(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the inverse of `frame_from_metres`."""
        if self._map is None:
            return xyz
        x, y, z = self._map.map(xyz).T
        if self._plane is not None:
            x, y = self._plane.transform(x, y, direction="INVERSE")
        return np.stack([x, y, z * self._height_unit], axis=1)

    def file(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform to the system and units of the file: the inverse of `frame`."""
        return self.metres(xyz) / self.system.factors

    def extent(self, extent: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
        """Return minimum and maximum X, Y, Z (m) in the frame of the box `extent` in file coordinates."""
        x, y, z = (np.linspace(low, high, 9) for low, high in extent.T)
        box = self.frame(np.stack(np.meshgrid(x, y, z[[0, -1]], indexing="ij"), axis=-1).reshape(-1, 3))
        return np.stack([box.min(axis=0), box.max(axis=0)])

    def placed(self, cloud: Cloud) -> Cloud:
        """Transform a cloud from file coordinates to the frame. Raises InputError for points outside its area."""
        xyz = self.frame(cloud.xyz)
        outside = ~np.isfinite(xyz).all(axis=1)
        if outside.any():
            point = ", ".join(f"{value:.2f}" for value in cloud.xyz[outside][0])
            raise InputError(
                f"{self.name}: the point ({point}) is outside the area of {self.system.name} or of the block's system; "
                f"give the system of the file ({self.option})"
            )
        return dataclasses.replace(cloud, xyz=xyz)

    def check_overlap(self, extent: Float[np.ndarray, "2 3"], within: Real[np.ndarray, "2 2"]) -> None:
        """Raise InputError if a file of `extent` does not overlap `within` (X, Y in m) of the block.

        The message contains both extents, and the unit of the file in which they would overlap.
        """
        self.placed(Cloud(extent))
        placed = self.extent(extent)
        if _overlap(placed, within):
            return
        options = []
        for unit in UNITS if not self.system.geographic else ():
            other = self.system.in_unit(unit)
            if other.units[0] != self.system.units[0] and _overlap(
                self.extent(extent * other.factors / self.system.factors), within
            ):
                options.append(f"--cloud-unit {unit}")
        cure = f"it would in another unit ({' or '.join(options)})" if options else "give its system (--cloud-epsg)"
        raise InputError(f"{self.name} ({_text(placed)}) does not overlap the block ({_text(within)}); {cure}")

    def _plane_transformer(self, source: CRS, target: CRS, place: tuple[float, float]) -> Transformer:
        """Return PROJ's best installed transformation of plane coordinates near `place`."""
        transformers = ways(source, target, *place).transformers
        if not transformers:
            raise InputError(f"{self.name}: PROJ has no transformation from {source.name} to {target.name}")
        best = transformers[0]
        same = source.geodetic_crs and target.geodetic_crs and source.geodetic_crs.datum == target.geodetic_crs.datum
        if "Ballpark" in best.description and not same:
            warnings.warn(
                f"{self.name}: PROJ has no transformation between the datums of {source.name} and {target.name}; they "
                "are assumed identical, with errors of some metres",
                UserWarning,
                stacklevel=3,
            )
        return best


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.isfinite(a).all() and (a[0, :2] <= b[1, :2]).all() and (b[0, :2] <= a[1, :2]).all())


def _text(extent: np.ndarray) -> str:
    (west, south), (east, north) = extent[:, :2]
    return f"X {west:.1f} to {east:.1f}, Y {south:.1f} to {north:.1f} m"
