"""Photographs oriented about the centre of the earth -> in the map system in which a block folder gives them."""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import MapFrame, Place, place_from_geocentric
from jaxphoto.io.reconstructions.tied_photographs import TiedPhotographs
from jaxphoto.procedures.control.surveyed import system_of
from jaxphoto.procedures.georeference_photographs import utm_of

WGS84 = 4326
# Distances (m) from the centre of the earth, from the poles to high above the equator: no local system reaches there.
_EARTH_M = (6.3e6, 6.5e6)
# No block reaches farther from the origin of its frame.
_NEAR_M = 100e3


class OnMap(NamedTuple):
    """Positions in the system of `frame`, and rotations from grid east, grid north and up at each to the camera."""

    frame: Frame
    centres: Float[np.ndarray, "images 3"]
    rotations: Float[np.ndarray, "images 3 3"]


def of_the_earth(xyz: Float[np.ndarray, "n 3"]) -> bool:
    """Whether positions are as far from the origin as places are from the centre of the earth."""
    with np.errstate(over="ignore"):
        far = np.linalg.norm(xyz, axis=1)
    return len(far) > 0 and bool(((far > _EARTH_M[0]) & (far < _EARTH_M[1])).all())


def on_map(
    file: str,
    code: int,
    vertical: int | None,
    centres: Float[np.ndarray, "images 3"],
    rotations: Float[np.ndarray, "images 3 3"],
) -> OnMap:
    """Positions (m) and rotations in geocentric axes of the datum of the EPSG system `code`, in that system.

    Raises InputError for positions that are no places of the earth, and what `MapFrame` raises.
    """
    if not of_the_earth(centres):
        raise InputError(
            f"{file}: photographs are not on the earth where its transform puts them; export it with its transform, or "
            "in local coordinates"
        )
    frame = _amid(code, vertical, place_from_geocentric(code, centres))
    system = frame.map
    turn, moved = system.geocentric_from_local()
    local = (centres - moved) @ turn
    return OnMap(frame, system.map(local), rotations @ turn @ system.local_from_grid(local))


def about_place(given: TiedPhotographs, place: Place) -> TiedPhotographs:
    """Photographs east, north and up of a `place` on WGS 84 in the zone of UTM there, the frame of whose block is that.

    Where they lie farther off than a block does they stay as they are, with a UserWarning.
    """
    far = float(np.abs(given.centres).max(initial=0.0))
    if not (far < _NEAR_M and abs(place[0]) <= 180 and abs(place[1]) <= 90):
        return _without_system(given, f"photographs lie {far / 1000:.0f} km from the origin that it tells")
    try:
        frame = Frame("epsg", utm_of(*place[:2]), None, "true", place)
    except InputError as error:
        return _without_system(given, str(error))
    return given._replace(
        frame=frame,
        centres=frame.map.map(given.centres),
        rotations=given.rotations @ frame.map.local_from_grid(given.centres),
        xyz=None if given.xyz is None else frame.map.map(given.xyz),
    )


def in_system(given: TiedPhotographs, words: str) -> TiedPhotographs:
    """Photographs in the system that `words` name; as they are, with a UserWarning, where these name none here."""
    try:
        return given._replace(frame=frame_of_words(given.file, words, given.centres))
    except InputError as error:
        return _without_system(given, str(error).removeprefix(f"{given.file}: "))


def _without_system(given: TiedPhotographs, why: str) -> TiedPhotographs:
    said = f"{given.file}: where the block lies is not read, and its coordinates are taken as Cartesian metres: {why}"
    warnings.warn(said, UserWarning, stacklevel=4)
    return given


def frame_of_words(file: str, words: str, positions: Float[np.ndarray, "images 3"]) -> Frame:
    """The frame of positions in the system that `words` name: an EPSG code, WKT, a string of PROJ, or "local".

    Raises InputError where they name none, or one without EPSG code, where positions are no places of it, and what
    `MapFrame` raises.
    """
    system = system_of(words, file)
    if system.crs is None:
        return Frame("local")
    if system.code is None:
        raise InputError(f"{file}: its system ({system.name}) has no EPSG code; write EPSG:25832, say, in its place")
    places = MapFrame(system.code, system.vertical, (0.0, 0.0, 0.0)).place(positions)
    if not np.isfinite(places).all():
        raise InputError(f"{file}: positions are no places of {system.name}; correct the system")
    return _amid(system.code, system.vertical, places)


def _amid(code: int, vertical: int | None, places: Float[np.ndarray, "n 3"]) -> Frame:
    """With a round place amid others as its origin."""
    longitude, latitude, _ = np.median(places, axis=0)
    return Frame("epsg", code, vertical, "true", (round(float(longitude), 4), round(float(latitude), 4), 0.0))
