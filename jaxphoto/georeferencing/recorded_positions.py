"""Checks and height references of GNSS positions recorded in photographs."""

from collections.abc import Mapping
from datetime import datetime
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.georeferencing.map_frame import MapFrame

Heights = Literal["ellipsoid", "geoid", "take-off", "unknown"]
"""Reference of heights; "geoid" is any geoid model (mean sea level)."""
HEIGHTS: dict[Heights, str] = {
    "ellipsoid": "above the ellipsoid",
    "geoid": "above a geoid (mean sea level)",
    "take-off": "above take-off",
    "unknown": "of unknown reference",
}
"""Names of the height references in messages."""
Fix = Literal["fixed", "float", "single", "integrated", "unknown"]
"""GNSS solution type: integer ambiguities, float ambiguities, code only, or GNSS/IMU integrated in post-processing."""
FIX_SIGMA_M: dict[Fix, tuple[float, float, float]] = {
    "fixed": (0.02, 0.02, 0.04),
    "float": (0.3, 0.3, 0.6),
    "integrated": (0.05, 0.05, 0.1),
}
"""Standard deviations (m) east, north and up by solution type, for files without standard deviations.

Fixed: 1 cm + 1 ppm in plan and 1.5 cm + 1 ppm in height (DJI, specifications of the Phantom 4 RTK), doubled for errors
of base station and interpolation. Float: decimetres (DJI, manuals: RtkFlag). Integrated: 2 to 5 cm in plan and 5 to 10
cm in height (Applanix, specifications of APX-15 and POS AV, post-processed).
"""


LEAP_SECONDS = 18.0
"""GPS time minus UTC since 2017 (s)."""
WEEK_S = 604_800.0


def gps_seconds(at: datetime) -> float:
    """Return the seconds since 1980-01-06 in the time zone of `at`, without leap seconds."""
    return (at - datetime(1980, 1, 6)).total_seconds()


class Taken(NamedTuple):
    """Exposure time recorded in the file of a photograph."""

    clock_s: float
    """Time of the camera's clock in its time zone, in seconds since 1980-01-06."""
    resolution_s: float
    """Resolution of the time (s); 1 for whole seconds."""
    ahead_of_utc_s: float | None = None
    """Offset of the clock from UTC (s); None if unknown."""


class Gps(NamedTuple):
    """Recorded position of the projection centre."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    sigma_m: tuple[float, float, float] | None = None
    """Standard deviations east, north and up; None if not in the file."""
    heights: Heights = "unknown"
    """Reference of `altitude_m`."""
    fix: Fix = "unknown"

    @property
    def stated_sigma_m(self) -> tuple[float, float, float] | None:
        """Return standard deviations (m) east, north, up: from the file, else from the solution type, else None."""
        return self.sigma_m or FIX_SIGMA_M.get(self.fix)


def moved(gps: Gps, east_north_up_m: Float[np.ndarray, "3"]) -> Gps:
    """Shift the position by a lever arm (m, on WGS 84)."""
    east, north, up = np.asarray(east_north_up_m, float).tolist()
    s = np.sin(np.deg2rad(gps.latitude_deg))
    w = 1 - _E2 * s * s
    latitude = gps.latitude_deg + float(np.rad2deg(north / (_A_M * (1 - _E2) / w**1.5)))
    across = _A_M / w**0.5 * np.cos(np.deg2rad(gps.latitude_deg))
    height = None if gps.altitude_m is None else gps.altitude_m + up
    return gps._replace(
        latitude_deg=latitude,
        longitude_deg=gps.longitude_deg + float(np.rad2deg(east / max(across, 1.0))),
        altitude_m=height,
    )


# WGS 84.
_A_M, _E2 = 6_378_137.0, 0.006_694_379_990_141


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
            messages.append("no photograph has a height above take-off: the heights of the files are used unchanged")
        result = {n: g and g._replace(heights=wanted) for n, g in result.items()}
    elif known:
        kinds = list(known.values())
        usual = max(dict.fromkeys(kinds), key=kinds.count)
        for kind in dict.fromkeys(kind for kind in kinds if kind != usual):
            names = [n for n, k in known.items() if k == kind]
            messages.append(
                f"the heights of {_names(names)} are {HEIGHTS[kind]}, but most are {HEIGHTS[usual]}: the former are "
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
        reason = "all heights in the files are ellipsoidal" if any_height else "no photograph has one"
        return positions, [f"no height needs the geoid of EPSG:{vertical}: {reason}"]
    given = np.array(list(places.values()), float)
    heights, result = system.place(given)[:, 2], dict(positions)
    for name, place, height in zip(places, given, heights.tolist(), strict=True):
        if not np.isfinite(height):
            raise InputError(
                f"the geoid of the heights EPSG:{vertical} does not cover the photograph {quoted(name)} at "
                f"{place[0]:.4f}, {place[1]:.4f} degrees; give a vertical CRS that covers it"
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
    return f"heights are {HEIGHTS[kind]}; they are not converted to ellipsoidal heights"


def _on_sphere(gps: Gps) -> np.ndarray:
    longitude, latitude = np.deg2rad([gps.longitude_deg, gps.latitude_deg])
    level = np.cos(latitude)
    return _EARTH_M * np.array([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)])


def _names(names: list[str]) -> str:
    return f"{len(names)} photographs ({few(names)})" if len(names) > 1 else names[0]
