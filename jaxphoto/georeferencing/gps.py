"""Recorded GNSS positions and exposure times of photographs."""

from datetime import datetime
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

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
