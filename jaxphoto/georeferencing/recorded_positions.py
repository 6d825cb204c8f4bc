"""Checks and corrections of GNSS positions recorded in photographs.

The photographs of a flight lie within kilometres. Detected errors: the position (0, 0), written without a fix;
exchanged latitude and longitude, far from the other positions; heights above take-off among heights above a datum,
equal to the recorded height above take-off.
"""

from collections.abc import Mapping

import numpy as np

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.georeferencing.gps import HEIGHTS, Gps, Heights
from jaxphoto.georeferencing.map_frame import MapFrame

Positions = dict[str, Gps | None]
WGS84 = 4326
"""EPSG code of the geographic coordinates of receivers."""
_EARTH_M = 6_371_000.0
_FAR_M = 50_000.0
# Maximum |latitude| and |longitude| (degrees) of positions treated as (0, 0): some hundred metres.
_NOWHERE_DEG = 1e-3
# Maximum difference (m) of an altitude that equals the height above take-off; minimum difference (m) of two different
# zero heights.
_SAME_M, _APART_M = 0.5, 5.0


def plausible_positions(positions: Mapping[str, Gps | None]) -> tuple[Positions, list[str]]:
    """Return plausible positions, with exchanged latitudes and longitudes corrected, and one message per change."""
    result: Positions = dict(positions)
    absent = [name for name, gps in result.items() if gps is None]
    nowhere = [n for n, g in result.items() if g and max(abs(g.latitude_deg), abs(g.longitude_deg)) < _NOWHERE_DEG]
    result |= dict.fromkeys(nowhere, None)
    exchanged = [n for n, g in result.items() if g and abs(g.latitude_deg) > 90]
    result |= {n: _exchanged(g) for n in exchanged if (g := result[n])}
    known = {n: g for n, g in result.items() if g}
    lost: list[str] = []
    if known:
        middle = np.median([_on_sphere(g) for g in known.values()], axis=0)
        near = lambda g: g is not None and np.linalg.norm(_on_sphere(g) - middle) <= _FAR_M  # noqa: E731
        far = [n for n, g in known.items() if not near(g)]
        back = [n for n in far if near(_exchanged(known[n]))]
        result |= {n: _exchanged(known[n]) for n in back}
        exchanged += back
        # Reject distant positions only if they are a minority.
        lost = [n for n in far if n not in back] if 2 * len(far) < len(known) else []
        result |= dict.fromkeys(lost, None)
    messages = []
    if lost:
        messages.append(f"the positions of {_names(lost)} are more than {_FAR_M / 1000:g} km from the others: not used")
    if exchanged:
        messages.append(f"latitude and longitude of {_names(exchanged)} are swapped in the files: corrected")
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
    reference. An EPSG code is a vertical system whose geoid height is added. None: heights of several references are
    reduced to the most frequent one by the heights above take-off.
    """
    result: Positions = dict(positions)
    above = {n: h for n in result if (h := above_takeoff_m.get(n)) is not None}
    known = {n: (g, g.altitude_m) for n, g in result.items() if g and g.altitude_m is not None}
    zero = {n: h - above[n] for n, (_, h) in known.items() if n in above}
    if wanted == "take-off" and above:
        result = {n: g and g._replace(altitude_m=above.get(n), heights=wanted) for n, g in result.items()}
        lost = [n for n, g in result.items() if g and g.altitude_m is None]
        return result, [_reference(result), *([f"{_names(lost)} have no height above take-off"] if lost else [])]
    messages = []
    relative = [n for n, v in zero.items() if abs(v) < _SAME_M]
    takeoff = [v for n, v in zero.items() if n not in relative]
    if relative and takeoff and abs(shift := float(np.median(takeoff))) > _APART_M:
        result |= {n: known[n][0]._replace(altitude_m=known[n][1] + shift) for n in relative}
        zero |= dict.fromkeys(relative, shift)
        messages.append(
            f"the heights of {_names(relative)} are above take-off: {shift:+.1f} m is added to match the others"
        )
    if isinstance(wanted, int):
        result, more = _above_ellipsoid(result, wanted)
        messages += more
    elif wanted is not None:
        if wanted == "take-off" and known:
            messages.append("no photograph has a height above take-off: the heights of the files are used as such")
        result = {n: g and g._replace(heights=wanted) for n, g in result.items()}
    else:
        result, more = _joined(result, zero)
        messages += more
    return result, [_reference(result), *messages] if known else messages


def _joined(positions: Positions, zero: Mapping[str, float]) -> tuple[Positions, list[str]]:
    """Reduce heights to the most frequent reference, if the take-off height is known in both references."""
    kinds: dict[Heights, list[str]] = {}
    for n, g in positions.items():
        if g and g.altitude_m is not None:
            kinds.setdefault(g.heights, []).append(n)
    if len(kinds) < 2:
        return positions, []
    usual = max(kinds, key=lambda kind: len(kinds[kind]))
    messages, result = [], dict(positions)
    for kind, names in kinds.items():
        if kind == usual:
            continue
        both = f"the heights of {_names(names)} are {HEIGHTS[kind]}, those of most {HEIGHTS[usual]}"
        here, there = ([zero[n] for n in kinds[k] if n in zero] for k in (kind, usual))
        shift = float(np.median(there) - np.median(here)) if here and there else None
        if shift is None:
            messages.append(
                f"{both}, and their difference is unknown: the former are not used (set the reference by --heights)"
            )
        elif abs(shift) > _APART_M:
            messages.append(f"{both}; {shift:+.1f} m is added (from the heights above take-off)")
        else:
            shift = 0.0
        for n in names:
            if (g := result[n]) and g.altitude_m is not None:
                result[n] = g._replace(
                    altitude_m=None if shift is None else g.altitude_m + shift,
                    heights=g.heights if shift is None else usual,
                )
    return result, messages


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
    heights = system.place(given)[:, 2]
    for name, place, height in zip(places, given, heights, strict=True):
        if not np.isfinite(height):
            raise InputError(
                f"the geoid of the heights EPSG:{vertical} does not cover the photograph {quoted(name)} at "
                f"{place[0]:.4f}, {place[1]:.4f} degrees; give the vertical CRS of that place"
            )
    result = dict(positions)
    for name, height in zip(places, heights.tolist(), strict=True):
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


def _exchanged(gps: Gps) -> Gps | None:
    """Exchange latitude and longitude; None if impossible."""
    if abs(gps.longitude_deg) > 90:
        return None
    return gps._replace(latitude_deg=gps.longitude_deg, longitude_deg=gps.latitude_deg)


def _on_sphere(gps: Gps) -> np.ndarray:
    longitude, latitude = np.deg2rad([gps.longitude_deg, gps.latitude_deg])
    level = np.cos(latitude)
    return _EARTH_M * np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


def _names(names: list[str]) -> str:
    return f"{len(names)} photographs ({few(names)})" if len(names) > 1 else names[0]
