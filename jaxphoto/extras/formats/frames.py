"""Coordinate systems of projects: positions about a place or the centre of the earth, and systems named by words."""

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.extras.formats.files import warn
from jaxphoto.extras.formats.project import Project
from jaxphoto.georeferencing.map_frame import MapFrame, Place, place_from_geocentric
from jaxphoto.procedures.control.system import system_of
from jaxphoto.procedures.georeference_photographs import utm_of

WGS84 = 4326
# Distances (m) of places from the centre of the earth.
_EARTH_M = (6.3e6, 6.5e6)
# Largest distance from the origin of a block's frame.
_NEAR_M = 100e3


def is_geocentric(xyz: Float[np.ndarray, "n 3"]) -> bool:
    """True if all positions are as far from the origin as places are from the centre of the earth."""
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(xyz, axis=1)
    return len(xyz) > 0 and bool(((distance > _EARTH_M[0]) & (distance < _EARTH_M[1])).all())


def geocentric(p: Project, code: int, vertical: int | None) -> Project:
    """Return a project in geocentric axes of the datum of the EPSG system `code` in a frame of that system."""
    centres = np.asarray(p.exterior.position)
    if not is_geocentric(centres):
        raise InputError(
            f"{p.file}: photographs are not on the earth where its transform puts them; export it with its transform, "
            "or in local coordinates"
        )
    frame = _frame_amid(code, vertical, place_from_geocentric(code, centres))
    rotation, translation = frame.map.geocentric_from_local()
    exterior = ExteriorOrientation((centres - translation) @ rotation, p.exterior.camera_from_object @ rotation)  # type: ignore[arg-type]
    return p._replace(frame=frame, exterior=exterior)


def about_place(p: Project, place: Place) -> Project:
    """Return a project east, north and up of a `place` on WGS 84 in a frame of the UTM zone there.

    It stays local, with a UserWarning, if it lies farther off than a block does.
    """
    far = float(np.abs(np.asarray(p.exterior.position)).max(initial=0.0))
    if not (far < _NEAR_M and abs(place[0]) <= 180 and abs(place[1]) <= 90):
        return _local(p, f"photographs lie {far / 1000:.0f} km from its origin")
    try:
        return p._replace(frame=Frame("epsg", utm_of(*place[:2]), None, "true", place))
    except InputError as error:
        return _local(p, str(error))


def in_system(p: Project, words: str) -> Project:
    """Return a project in the map coordinates that `words` name; local, with a UserWarning, if they name none."""
    try:
        return with_system(p, words)
    except InputError as error:
        return _local(p, str(error).removeprefix(f"{p.file}: "))


def with_system(p: Project, words: str) -> Project:
    """Return a project in the map coordinates that `words` name: an EPSG code, WKT, a string of PROJ, "local" or "".

    Raises InputError if they name none, or one without EPSG code, or positions are no places of it.
    """
    system = system_of(words or "local", p.file)
    if system.crs is None:
        return p
    if system.code is None:
        raise InputError(f"{p.file}: its system ({system.name}) has no EPSG code; write EPSG:25832, say, in its place")
    places = MapFrame(system.code, system.vertical, (0.0, 0.0, 0.0)).place(np.asarray(p.exterior.position))
    if not np.isfinite(places).all():
        raise InputError(f"{p.file}: positions are no places of {system.name}; correct the system")
    return p._replace(frame=_frame_amid(system.code, system.vertical, places), on_map=True)


def _frame_amid(code: int, vertical: int | None, places: Float[np.ndarray, "n 3"]) -> Frame:
    """A frame with a rounded place amid `places` as its origin."""
    longitude, latitude, _ = np.median(places, axis=0)
    return Frame("epsg", code, vertical, "true", (round(float(longitude), 4), round(float(latitude), 4), 0.0))


def _local(p: Project, why: str) -> Project:
    warn(f"{p.file}: where the block lies is not read, and its coordinates are taken as Cartesian metres: {why}")
    return p
