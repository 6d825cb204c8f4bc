"""Recorded GNSS positions of photographs."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

Heights = Literal["ellipsoid", "geoid", "take-off", "unknown"]
"""Reference of heights; a geoid is that of any model (mean sea level)."""
HEIGHTS: dict[Heights, str] = {
    "ellipsoid": "above the ellipsoid",
    "geoid": "above a geoid (mean sea level)",
    "take-off": "above take-off",
    "unknown": "of unknown reference",
}
"""Names in messages."""
Fix = Literal["fixed", "float", "single", "integrated", "unknown"]
"""Kind of solution: integer ambiguities, real ambiguities, code only, or GNSS and IMU integrated in post-processing."""
FIX_SIGMA_M: dict[Fix, tuple[float, float, float]] = {
    "fixed": (0.02, 0.02, 0.04),
    "float": (0.3, 0.3, 0.6),
    "integrated": (0.05, 0.05, 0.1),
}
"""East, north and up, for files with the kind of solution but without standard deviations.

A fixed solution has 1 cm + 1 ppm in plan and 1.5 cm + 1 ppm in height (DJI, specifications of the Phantom 4 RTK), a
float one decimetres (DJI, manuals: RtkFlag); twice the former allows for base station and interpolation. An integrated
one has 2 to 5 cm in plan and 5 to 10 in height (Applanix, specifications of APX-15 and POS AV, post-processed).
"""


class Gps(NamedTuple):
    """A recorded position of the projection centre."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    sigma_m: tuple[float, float, float] | None = None
    """East, north and up, if the file has them."""
    heights: Heights = "unknown"
    """Reference of `altitude_m`."""
    fix: Fix = "unknown"

    @property
    def stated_sigma_m(self) -> tuple[float, float, float] | None:
        """East, north and up: those of the file, else those of the kind of solution; None without either."""
        return self.sigma_m or FIX_SIGMA_M.get(self.fix)


def moved(gps: Gps, east_north_up_m: Float[np.ndarray, "3"]) -> Gps:
    """Return the position shifted by a lever arm (m, on WGS 84)."""
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
