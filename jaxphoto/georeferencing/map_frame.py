"""Conversion of map or geographic coordinates to and from a local east-north-up frame, by PROJ.

The local frame is Cartesian: Z is the normal of the ellipsoid at its origin, Y points to true north. The datum is not
changed: longitudes, latitudes and ellipsoidal heights refer to the datum of the map system.
"""

import functools
import warnings

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from pyproj.transformer import TransformerGroup

from jaxphoto.errors import InputError

# Half of the step along a grid line that determines its direction (m, degrees): the rounding error is 1e-11 rad, the
# effect of curvature smaller.
_STEP_M, _STEP_DEG = 50.0, 5e-4
# Maximum distance (degrees) of coordinates from the area of use of their system.
_BEYOND_DEG = 3.0
# Declaration of ellipsoidal heights in a block and in a flight, for messages.
_ON_ELLIPSOID = 'vertical = "ellipsoidal" in block.toml, --heights ellipsoid of a flight'

Place = tuple[float, float, float]
"""Longitude and latitude (degrees), ellipsoidal height (m)."""


class MapFrame:
    """Local frame at `origin` for coordinates in the EPSG system `code` with heights in the EPSG system `vertical`.

    `vertical` None: heights above the ellipsoid. Map coordinates are (easting, northing, height) in m, or (longitude,
    latitude, height) in degrees and m if `geographic`. Outside the area of a system, results are infinite. Raises
    InputError for unknown or unsuitable codes, and if the geoid of the heights is not installed.
    """

    def __init__(self, code: int, vertical: int | None, origin: Place):
        self.code, self.vertical, self.origin = code, vertical, origin
        system = map_system(code)
        self.geographic = system.is_geographic
        self._to_place = _to_place(code, vertical)
        self._to_local = _topocentric(system, origin)

    def place(self, coordinates: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert map coordinates to longitude, latitude (degrees) and ellipsoidal height (m)."""
        return _transformed(self._to_place, coordinates, "FORWARD")

    def local_from_place(self, place: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert longitude, latitude and ellipsoidal height to local X, Y, Z (m)."""
        return _transformed(self._to_local, place, "FORWARD")

    def local(self, coordinates: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert map coordinates to local X, Y, Z (m)."""
        return self.local_from_place(self.place(coordinates))

    def map(self, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert local X, Y, Z (m) to map coordinates; the inverse of `local`."""
        return _transformed(self._to_place, self._place_from_local(local), "INVERSE")

    def local_from_level(self, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Return rotations from east, true north, up (ellipsoid normal) at local positions to the local frame."""
        here = _geocentric_from_level(np.array([self.origin]))[0]
        return here.T @ _geocentric_from_level(self._place_from_local(local))

    def local_from_grid(self, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Return rotations from grid east, grid north, up to the local frame; includes meridian convergence."""
        g = self.convergence(local)
        c, s, zero, one = np.cos(g), np.sin(g), np.zeros(len(g)), np.ones(len(g))
        level_from_grid = np.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
        return self.local_from_level(local) @ level_from_grid

    def convergence(self, local: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the meridian convergence (rad) at local positions: the angle of grid north east of true north."""
        step = np.array([0.0, _STEP_DEG if self.geographic else _STEP_M, 0.0])
        at = self.map(local)
        line = self.local(at + step) - self.local(at - step)
        east, north, _ = np.einsum("nji,nj->in", self.local_from_level(local), line)
        return np.arctan2(east, north)

    def geocentric_from_local(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Return rotation and translation (m) to geocentric axes: geocentric = rotation @ local + translation."""
        origin = np.array([self.origin], float)
        return _geocentric_from_level(origin)[0], _transformed(_geocentric(map_system(self.code)), origin, "FORWARD")[0]

    def sea_level(self) -> float:
        """Return local Z (m) of height zero at the origin (of the ellipsoid if heights are ellipsoidal)."""
        easting, northing, _ = self.map(np.zeros((1, 3)))[0]
        return float(self.local(np.array([[easting, northing, 0.0]]))[0, 2])

    def _place_from_local(self, local: np.ndarray) -> np.ndarray:
        return _transformed(self._to_local, local, "INVERSE")


def place_from_geocentric(code: int, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Convert geocentric X, Y, Z to longitude, latitude (degrees) and height (m) on the ellipsoid of EPSG `code`."""
    return _transformed(_geocentric(map_system(code)), xyz, "INVERSE")


@functools.cache
def map_system(code: int) -> CRS:
    """Return the projected or geographic system of an EPSG code. Raises InputError for any other code."""
    try:
        system = CRS.from_epsg(code)
    except CRSError:
        raise InputError(f"the EPSG code {code} is unknown; correct it (epsg.io lists them)") from None
    if not (system.is_projected or system.is_geographic) or system.is_compound:
        raise InputError(
            f"EPSG:{code} ({system.name}) is neither a projected nor a geographic CRS; give the code of one, and "
            "the height system as vertical"
        )
    plane = system.axis_info[:2]
    if system.is_projected and any(axis.unit_conversion_factor != 1 for axis in plane):
        raise InputError(
            f"EPSG:{code} ({system.name}) has the unit {plane[0].unit_name}; convert the coordinates to a CRS in metres"
        )
    if system.is_projected and {axis.direction for axis in plane} & {"south", "west"}:
        raise InputError(
            f"EPSG:{code} ({system.name}) has axes to the south or west; convert the coordinates to a CRS of "
            "eastings and northings"
        )
    return system


def check_heights(code: int, vertical: int) -> None:
    """Raise InputError if heights of the EPSG system `vertical` cannot be converted to the ellipsoid of `code`."""
    _to_place(code, vertical)


def check_area(
    code: int, places: Float[np.ndarray, "n 3"], file: str, coordinates: Float[np.ndarray, "n 3"], cure: str
) -> None:
    """Raise InputError if the median of `places`, of the `coordinates` in `file`, is outside the area of a system.

    `places`: longitude and latitude (degrees), height; `cure` ends the message.
    """
    area = map_system(code).area_of_use
    if area is None:
        return
    (longitude, latitude, _), (west, south, east, north) = np.median(places, axis=0), area.bounds
    outside = west <= east and not west - _BEYOND_DEG <= longitude <= east + _BEYOND_DEG
    if outside or not south - _BEYOND_DEG <= latitude <= north + _BEYOND_DEG or not np.isfinite(longitude):
        about = ", ".join(f"{value:.1f}" for value in np.median(coordinates, axis=0)[:2])
        raise InputError(
            f"{file}: the coordinates, about ({about}), are outside the area of EPSG:{code} "
            f"({area.name.split('.')[0]}); {cure}"
        )


def map_name(code: int, vertical: int | None) -> str:
    """Return the name of a map system and its vertical system, as in PROJ: EPSG:25832+7837."""
    return f"EPSG:{code}" + (f"+{vertical}" if vertical is not None else "")


@functools.cache
def _to_place(code: int, vertical: int | None) -> Transformer:
    """Return the transformer from map coordinates to longitude, latitude and ellipsoidal height of the same datum."""
    system = map_system(code)
    geodetic = system.geodetic_crs
    assert geodetic is not None
    if vertical is None:
        return Transformer.from_crs(system.to_3d(), geodetic.to_3d(), always_xy=True)
    try:
        heights = CRS.from_epsg(vertical)
    except CRSError:
        raise InputError(f"the EPSG code {vertical} is unknown; correct it, or give ellipsoidal heights") from None
    if not heights.is_vertical:
        raise InputError(
            f"EPSG:{vertical} ({heights.name}) is not a vertical CRS; give the code of one (5773 is EGM96), or "
            "ellipsoidal heights"
        )
    # Suppress the warnings of pyproj; an error is raised below.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(f"EPSG:{code}+{vertical}", geodetic.to_3d(), always_xy=True)
    if not group.best_available or not group.transformers:
        grids = [grid for operation in group.unavailable_operations for grid in operation.grids if not grid.available]
        if not grids:
            raise InputError(
                f"PROJ has no transformation from the heights of EPSG:{vertical} ({heights.name}) to the ellipsoid of "
                f"EPSG:{code}; give ellipsoidal heights ({_ON_ELLIPSOID})"
            )
        name = grids[0].short_name
        raise InputError(
            f"the heights of EPSG:{vertical} ({heights.name}) need the geoid {name}, which is not installed; "
            f'get it by "pyproj sync --file {name}", or give ellipsoidal heights ({_ON_ELLIPSOID})'
        )
    return group.transformers[0]


def _topocentric(system: CRS, origin: Place) -> Transformer:
    longitude, latitude, height = (repr(float(value)) for value in origin)
    there = f"+step +proj=topocentric {_size(system)} +lon_0={longitude} +lat_0={latitude} +h_0={height}"
    return Transformer.from_pipeline(f"{_CARTESIAN} {_size(system)} {there}")


def _geocentric(system: CRS) -> Transformer:
    return Transformer.from_pipeline(f"{_CARTESIAN} {_size(system)}")


_CARTESIAN = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart"


def _size(system: CRS) -> str:
    ellipsoid = system.ellipsoid
    assert ellipsoid is not None
    return f"+a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"


def _transformed(transformer: Transformer, values: np.ndarray, direction: str) -> np.ndarray:
    x, y, z = np.asarray(values, float).T
    return np.stack(transformer.transform(x, y, z, direction=direction), axis=1)


def _geocentric_from_level(places: np.ndarray) -> np.ndarray:
    """Return the directions east, north and up at longitude and latitude as columns, in geocentric axes."""
    (sl, sp), (cl, cp) = np.sin(np.deg2rad(places[:, :2])).T, np.cos(np.deg2rad(places[:, :2])).T
    rows = [-sl, -sp * cl, cp * cl, cl, -sp * sl, cp * sl, 0 * sl, cp, sp]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)
