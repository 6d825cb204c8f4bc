"""What the coordinates of a cloud or raster mean: the system of its plane, of its heights, and their units."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from jaxphoto.block import Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import map_system

UNITS: Mapping[str, float] = {"m": 1.0, "ft": 0.3048, "us_ft": 1200 / 3937}
"""Metres in a metre, an international foot and a US survey foot, by the name that options give them."""
_ELLIPSOID = "ellipsoid"
# Heights of NAVD88, NGVD29 and the sea in feet, and the same in metres.
_METRIC_HEIGHTS = {6360: 5703, 8228: 5703, 5702: 7968, 8050: 5714}


@dataclasses.dataclass(frozen=True)
class CoordinateSystem:
    """How a file counts. `plane` is its map system with axes in metres, its geographic system, or None (a local frame).

    `heights` is the EPSG code of its heights, "ellipsoid", or None where the file does not say. `units` are the metres
    in a unit of X and Y, and of Z, as the file counts them; 1 for degrees. `heights_unit` is that of the system of the
    heights, which is what PROJ wants.
    """

    plane: CRS | None = None
    heights: int | str | None = None
    units: tuple[float, float] = (1.0, 1.0)
    heights_unit: float = 1.0

    @property
    def geographic(self) -> bool:
        """Whether X and Y are longitude and latitude in degrees."""
        return self.plane is not None and self.plane.is_geographic

    @property
    def name(self) -> str:
        """The system as a sentence names it."""
        return "a local frame" if self.plane is None else self.plane.name

    def metres(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Coordinates in m (geographic: degrees and m) of those of the file."""
        return xyz * self._factors

    def own(self, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Coordinates as the file counts them; the inverse of `metres`."""
        return xyz / self._factors

    def in_unit(self, unit: str | None) -> "CoordinateSystem":
        """The same with coordinates counted in `unit` of `UNITS` (None: as it is), whatever the file says.

        Raises InputError for an unknown unit.
        """
        if unit is None:
            return self
        if unit not in UNITS:
            raise InputError(f"the unit {unit!r} is unknown; choose one of {', '.join(UNITS)}")
        return dataclasses.replace(self, units=(1.0 if self.geographic else UNITS[unit], UNITS[unit]))

    @property
    def metric(self) -> CRS | None:
        """The system of its coordinates in metres, with that of the heights where it is known and has one in metres."""
        heights = _METRIC_HEIGHTS.get(self.heights, self.heights)  # type: ignore[arg-type]
        if (
            self.plane is None
            or not isinstance(heights, int)
            or CRS.from_epsg(heights).axis_info[0].unit_name != "metre"
        ):
            return self.plane
        upper = CRS.from_epsg(heights)
        return CompoundCRS(f"{self.plane.name} + {upper.name}", [self.plane, upper])

    @property
    def _factors(self) -> np.ndarray:
        plane, height = self.units
        return np.array([plane, plane, height])


def system_of(crs: CRS, name: str) -> CoordinateSystem:
    """The system that `crs` says, in a file `name`.

    Where it says nothing of heights, these are counted in the unit of the map. Raises InputError for a geocentric
    system, and for one that counts southwards or westwards.
    """
    plane, *upper = [_unbound(part) for part in crs.sub_crs_list] if crs.is_compound else [_unbound(crs)]
    if plane.is_engineering:
        unit = plane.axis_info[0].unit_conversion_factor if plane.axis_info else 1.0
        return CoordinateSystem(units=(unit, unit))
    if plane.is_geocentric or not (plane.is_projected or plane.is_geographic):
        raise InputError(
            f"{name} is in {plane.name}, which is no map or geographic system; convert its coordinates to one"
        )
    axes = plane.axis_info
    if {axis.direction for axis in axes[:2]} & {"south", "west"}:
        raise InputError(
            f"{name} is in {plane.name}, which counts southwards or westwards; convert its coordinates to a system of "
            "eastings and northings"
        )
    unit = axes[0].unit_conversion_factor if plane.is_projected else 1.0
    heights: int | str | None = None
    height_unit = unit
    if len(axes) == 3:
        heights, height_unit, plane = _ELLIPSOID, axes[2].unit_conversion_factor, plane.to_2d()
    if upper:
        heights, height_unit = upper[0].to_epsg(), upper[0].axis_info[0].unit_conversion_factor
    return CoordinateSystem(_in_metres(plane), heights, (unit, height_unit), height_unit)


def epsg_system(code: int, name: str) -> CoordinateSystem:
    """The system of an EPSG code that a user gives for the file `name`. Raises InputError for an unknown one."""
    try:
        crs = CRS.from_epsg(code)
    except CRSError:
        raise InputError(f"{name}: the EPSG code {code} is unknown; correct it (epsg.io lists them)") from None
    return system_of(crs, f"EPSG:{code}, given for {name},")


def frame_system(frame: Frame | None) -> CoordinateSystem:
    """The system, in metres, of the map coordinates of a block's frame (`Frame.map`); none for a frame without them."""
    if frame is None or frame.code is None:
        return CoordinateSystem()
    return CoordinateSystem(map_system(frame.code), _ELLIPSOID if frame.vertical is None else frame.vertical)


def _unbound(crs: CRS) -> CRS:
    """The system itself, without a way to another that is bound to it."""
    while crs.is_bound:
        assert crs.source_crs is not None
        crs = crs.source_crs
    return crs


def _in_metres(crs: CRS) -> CRS:
    """The same projection with axes in metres; a false easting keeps its unit and value."""
    if crs.is_geographic or all(axis.unit_conversion_factor == 1 for axis in crs.axis_info):
        return crs
    told = crs.to_json_dict()
    for part in ("id", "ids", "usages", "scope", "area", "bbox"):
        told.pop(part, None)
    told["name"] = f"{crs.name}, in metres"
    for axis in told["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    metric = CRS.from_json_dict(told)
    # Where EPSG has the same in metres (most systems in feet have such a twin), its name and code say more.
    code = metric.to_epsg()
    return metric if code is None else CRS.from_epsg(code)
