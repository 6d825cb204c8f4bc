"""Checks and height references of GNSS positions recorded in photographs."""

from collections.abc import Mapping

import numpy as np

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.georeferencing.gps import HEIGHTS, Gps, Heights
from jaxphoto.georeferencing.map_frame import MapFrame

Positions = dict[str, Gps | None]
WGS84 = 4326
"""EPSG code of the geographic coordinates of receivers."""
_EARTH_M = 6_371_000.0
# Maximum distance of the positions of a flight from their median.
_FAR_M = 50_000.0
# Maximum |latitude| and |longitude| (degrees) of positions treated as (0, 0), written without a fix: some hundred
# metres.
_NOWHERE_DEG = 1e-3


def plausible_positions(positions: Mapping[str, Gps | None]) -> tuple[Positions, list[str]]:
    """Return plausible positions, the others as None, and one message per kind of error."""
    result: Positions = dict(positions)
    absent = [name for name, gps in result.items() if gps is None]
    nowhere = [n for n, g in result.items() if g and max(abs(g.latitude_deg), abs(g.longitude_deg)) < _NOWHERE_DEG]
    beyond = [n for n, g in result.items() if g and abs(g.latitude_deg) > 90]
    result |= dict.fromkeys([*nowhere, *beyond], None)
    known = {n: _on_sphere(g) for n, g in result.items() if g}
    middle = np.median(list(known.values()), axis=0) if known else np.zeros(3)
    far = [n for n, place in known.items() if np.linalg.norm(place - middle) > _FAR_M]
    # Reject distant positions only if they are a minority.
    far = far if 2 * len(far) < len(known) else []
    result |= dict.fromkeys(far, None)
    messages = []
    if far:
        messages.append(
            f"the positions of {_names(far)} are more than {_FAR_M / 1000:g} km from the others: not used (another "
            "flight, or latitude and longitude exchanged)"
        )
    if beyond:
        messages.append(f"the latitudes of {_names(beyond)} exceed 90 degrees (exchanged with longitude): not used")
    if nowhere:
        messages.append(f"the positions of {_names(nowhere)} are (0, 0): treated as missing")
    if absent:
        some = f"{len(absent)} of {len(positions)} photographs {'have' if len(absent) > 1 else 'has'} no position"
        every = f"all {len(positions)} photographs have no position"
        messages.append(f"{some} ({few(absent)})" if len(absent) < len(positions) else every)
    return result, messages


def one_height(
    positions: Mapping[str, Gps | None],
    above_takeoff_m: Mapping[str, float | None],
    wanted: Heights | int | None = None,
) -> tuple[Positions, list[str]]:
    """Convert all positions to one height reference; return them with messages.

    `wanted`: "take-off" selects the heights above take-off. Any other reference applies to heights of unknown
    reference. An EPSG code is a vertical system whose geoid height is added. None: of heights with several references,
    those with the most frequent one are used.
    """
    result: Positions = dict(positions)
    known: dict[str, Heights] = {n: g.heights for n, g in result.items() if g and g.altitude_m is not None}
    messages: list[str] = []
    if wanted == "take-off" and any(h is not None for h in above_takeoff_m.values()):
        result = {n: g and g._replace(altitude_m=above_takeoff_m.get(n), heights=wanted) for n, g in result.items()}
        lost = [n for n, g in result.items() if g and g.altitude_m is None]
        messages += [f"{_names(lost)} have no height above take-off"] if lost else []
    elif isinstance(wanted, int):
        result, messages = _above_ellipsoid(result, wanted)
    elif wanted is not None:
        if wanted == "take-off" and known:
            messages.append("no photograph has a height above take-off: the heights of the files are used as such")
        result = {n: g and g._replace(heights=wanted) for n, g in result.items()}
    elif known:
        kinds = list(known.values())
        usual = max(dict.fromkeys(kinds), key=kinds.count)
        for kind in dict.fromkeys(kind for kind in kinds if kind != usual):
            names = [n for n, k in known.items() if k == kind]
            messages.append(
                f"the heights of {_names(names)} are {HEIGHTS[kind]}, those of most {HEIGHTS[usual]}: the former are "
                "not used (set the reference by --heights)"
            )
            result |= {n: g._replace(altitude_m=None) for n in names if (g := result[n])}
    return result, [_reference(result), *messages] if known else messages


def _above_ellipsoid(positions: Positions, vertical: int) -> tuple[Positions, list[str]]:
    """Convert heights of the EPSG system `vertical` to ellipsoidal heights: h = H + N with the geoid height N (m).

    Raises InputError if the code is not a vertical system, if its geoid is not installed, and for positions outside the
    geoid.
    """
    # Check the code even if no height needs it.
    system = MapFrame(WGS84, vertical, (0.0, 0.0, 0.0))
    places = {
        n: (g.longitude_deg, g.latitude_deg, g.altitude_m)
        for n, g in positions.items()
        if g and g.altitude_m is not None and g.heights != "ellipsoid"
    }
    if not places:
        any_height = any(g and g.altitude_m is not None for g in positions.values())
        reason = "the files give all above the ellipsoid" if any_height else "no photograph has one"
        return positions, [f"no height needs the geoid of EPSG:{vertical}: {reason}"]
    given = np.array(list(places.values()), float)
    heights, result = system.place(given)[:, 2], dict(positions)
    for name, place, height in zip(places, given, heights.tolist(), strict=True):
        if not np.isfinite(height):
            raise InputError(
                f"the geoid of the heights EPSG:{vertical} does not cover the photograph {quoted(name)} at "
                f"{place[0]:.4f}, {place[1]:.4f} degrees; give the vertical CRS of that place"
            )
        if gps := result[name]:
            result[name] = gps._replace(altitude_m=height, heights="ellipsoid")
    added = heights - given[:, 2]
    return result, [
        f"the heights of {len(places)} photographs are interpreted as EPSG:{vertical}; its geoid, "
        f"{added.min():+.2f} to {added.max():+.2f} m, is added"
    ]


def _reference(positions: Positions) -> str:
    kinds: list[Heights] = [g.heights for g in positions.values() if g and g.altitude_m is not None]
    kind: Heights = kinds[0] if kinds else "unknown"
    if kind == "ellipsoid":
        return "heights are above the ellipsoid"
    if kind == "unknown":
        return "heights are as in the files, of unknown reference (set it by --heights)"
    return f"heights are {HEIGHTS[kind]}; nothing is added to bring them to the ellipsoid"


def _on_sphere(gps: Gps) -> np.ndarray:
    longitude, latitude = np.deg2rad([gps.longitude_deg, gps.latitude_deg])
    level = np.cos(latitude)
    return _EARTH_M * np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


def _names(names: list[str]) -> str:
    return f"{len(names)} photographs ({few(names)})" if len(names) > 1 else names[0]
