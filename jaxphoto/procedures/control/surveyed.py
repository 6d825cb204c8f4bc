"""Surveyed points, their marks in photographs, and their coordinate system.

A system is an EPSG code, with or without a code for heights (25832+7837), "WGS84 UTM 32N" and PROJ strings as in
OpenDroneMap, WKT as in Metashape, or "local" for Cartesian metres without a map.
"""

import functools
import re
import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.map_frame import MapFrame, map_name, map_system

SIGMA_M = (0.02, 0.02, 0.03)
"""Default standard deviations (m) of a surveyed point, east, north and up: RTK, one occupation."""
MARK_SIGMA_PX = 1.0
"""Default standard deviation (px) of a manual mark."""


class SurveyedPoints(NamedTuple):
    """Points with coordinates as in a file."""

    file: str
    ids: tuple[str, ...]
    coordinates: Float[np.ndarray, "points 3"]
    """Easting, northing, height (m), or longitude, latitude (degrees), height (m); NaN for an unknown height."""
    sigma_m: Float[np.ndarray, "points 3"]
    """Standard deviations east, north, up; NaN if not stated."""
    check: Bool[np.ndarray, "points"]
    """True for check points, which are never adjusted."""
    places: tuple[str, ...]
    """File and row of each point."""
    system: str = ""
    """Coordinate system in the file: EPSG code, PROJ string, WKT, "local"; "" if not stated."""
    own_axes: bool = False
    """True if the first two coordinates are in the axis order of the system (EPSG:4326: latitude first)."""


class Marks(NamedTuple):
    """Image coordinates of points in photographs (px); the centre of the upper-left pixel is (0.5, 0.5)."""

    image: tuple[str, ...]
    """File name or image name."""
    point: tuple[str, ...]
    column_row: Float[np.ndarray, "marks 2"]
    sigma_px: Float[np.ndarray, "marks"]
    """Standard deviation of each mark; NaN if not stated."""
    places: tuple[str, ...]

    @staticmethod
    def none() -> "Marks":
        """Return no marks."""
        return Marks((), (), np.zeros((0, 2)), np.zeros(0), ())

    def take(self, chosen: np.ndarray) -> "Marks":
        """Select marks by mask or index."""
        which = np.arange(len(self.image))[chosen]
        names = (tuple(names[k] for k in which) for names in (self.image, self.point, self.places))
        image, point, places = names
        return Marks(image, point, self.column_row[which], self.sigma_px[which], places)

    @staticmethod
    def joined(one: "Marks", other: "Marks") -> "Marks":
        """Concatenate marks."""
        column_row = np.concatenate([one.column_row, other.column_row])
        sigma = np.concatenate([one.sigma_px, other.sigma_px])
        places = one.places + other.places
        return Marks(one.image + other.image, one.point + other.point, column_row, sigma, places)


class GivenControl(NamedTuple):
    """Surveyed points and their marks, which may be empty if targets are searched for."""

    points: SurveyedPoints
    marks: Marks


LOCAL = "local"
_CODES = re.compile(r"(?:EPSG::?)?\s*(\d{1,6})(?:\s*\+\s*(?:EPSG::?)?(\d{1,6}))?\s*(?:[<#].*)?", re.IGNORECASE)
_UTM = re.compile(r"WGS\s?84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
# Maximum distance (m) of control from a flight.
NEAR_M = 20_000.0


class ControlSystem(NamedTuple):
    """Coordinate system of surveyed points; `crs` None is local and Cartesian."""

    crs: CRS | None
    code: int | None
    """EPSG code of the horizontal system; None if there is none."""
    vertical: int | None
    """EPSG code of the heights; None for ellipsoidal heights, or if unknown."""

    @property
    def name(self) -> str:
        """Name in messages."""
        if self.crs is None:
            return "a local system"
        code = map_name(self.code, self.vertical) if self.code else ""
        return f"{code} ({self.crs.name})" if code else str(self.crs.name)


@functools.lru_cache(maxsize=64)
def system_of(words: str, place: str) -> ControlSystem:
    """Parse the system `words`, read at `place`. Raises InputError if the text is not a coordinate system."""
    words = words.strip()
    if words.lower() == LOCAL or words.startswith("LOCAL_CS["):
        return ControlSystem(None, None, None)
    if utm := _UTM.fullmatch(words):
        words = f"EPSG:{32600 + int(utm[1]) + 100 * (utm[2] in 'Ss')}"
    if codes := _CODES.fullmatch(words):
        vertical = int(codes[2]) if codes[2] else None
        return ControlSystem(map_system(int(codes[1])), int(codes[1]), vertical)
    wrong = InputError(
        f"{place}: {quoted(words)} is not a coordinate system; write EPSG:25832, EPSG:25832+7837 with heights, or local"
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            crs = CRS.from_user_input(words)
            parts = crs.sub_crs_list if crs.is_compound else [crs]
            codes_of = [part.to_epsg() for part in parts]
    except CRSError:
        raise wrong from None
    if not (parts[0].is_projected or parts[0].is_geographic or parts[0].is_geocentric):
        raise wrong
    if len(parts) > 1 and None in codes_of:
        raise InputError(f"{place}: the system of the heights has no EPSG code; write it as EPSG:25832+7837")
    return ControlSystem(parts[0], codes_of[0], codes_of[1] if len(parts) > 1 else None)


def places(points: SurveyedPoints, system: ControlSystem, code: int) -> Float[np.ndarray, "points 3"]:
    """Return longitude, latitude (degrees) and height (m) of the points, on the ellipsoid of the EPSG system `code`.

    Unknown heights are replaced by the median of the others. Raises InputError for coordinates outside the system, for
    a missing geoid model, and if no point has a height.
    """
    crs = system.crs
    assert crs is not None
    xyz = filled(points)
    if points.own_axes and crs.axis_info[0].direction == "north":
        xyz = xyz[:, [1, 0, 2]]
    ellipsoid = map_system(code).geodetic_crs
    assert ellipsoid is not None
    if system.vertical is not None and system.code is not None:
        xyz = MapFrame(system.code, system.vertical, (0.0, 0.0, 0.0)).place(xyz)
        geodetic = map_system(system.code).geodetic_crs
        assert geodetic is not None
        crs = geodetic
    try:
        change = Transformer.from_crs(crs if crs.is_geocentric else crs.to_3d(), ellipsoid.to_3d(), always_xy=True)
    except ProjError:
        raise InputError(
            f"{points.file}: PROJ has no transformation from {system.name} to the ellipsoid of EPSG:{code}"
        ) from None
    there = np.stack(change.transform(*xyz.T), axis=1)
    for k in np.flatnonzero(~np.isfinite(there).all(axis=1)):
        text = ", ".join(f"{v:.10g}" for v in xyz[k])
        raise InputError(
            f"{points.places[k]}: {text} is not a position in {system.name}; correct coordinates, their order or the "
            "system"
        )
    return there


def filled(points: SurveyedPoints) -> Float[np.ndarray, "points 3"]:
    """Replace unknown heights by the median height. Raises InputError if no point has one."""
    xyz = points.coordinates.copy()
    if np.isnan(xyz[:, 2]).all():
        raise InputError(f"{points.file}: no point has a height; add them")
    xyz[np.isnan(xyz[:, 2]), 2] = np.nanmedian(xyz[:, 2])
    return xyz


def check_near(points: SurveyedPoints, system: ControlSystem, longitude: float, latitude: float) -> None:
    """Raise InputError for points far from the photographs, with the cure if exchanging coordinates would help."""
    code = system.code or 4326
    try:
        off = distance_m(places(points, system, code), longitude, latitude)
    except InputError as error:
        off, far = np.inf, str(error)
    else:
        far = f"{points.file}: its points lie {off / 1000:,.0f} km from where the photographs were taken"
    if off <= NEAR_M:
        return
    cure = "correct the coordinates, or the system"
    try:
        exchanged = points._replace(coordinates=points.coordinates[:, [1, 0, 2]])
        if distance_m(places(exchanged, system, code), longitude, latitude) < NEAR_M:
            cure = "they would fit with the first two coordinates exchanged"
    except InputError:
        pass
    raise InputError(f"{far}, if their system is {system.name}: {cure}")


def distance_m(places: Float[np.ndarray, "n 3"], longitude: float, latitude: float) -> float:
    """Return the distance between the median of `places` (degrees) and a position, on a sphere."""
    there = np.deg2rad(np.median(places[:, :2], axis=0))
    here = np.deg2rad([longitude, latitude])
    half = np.sin((there - here) / 2) ** 2
    return float(2 * 6.371e6 * np.arcsin(np.sqrt(min(1.0, half[1] + np.cos(here[1]) * np.cos(there[1]) * half[0]))))
