"""Conversion of recorded heights above a geoid to ellipsoidal heights, by the geoid grids of PROJ."""

from collections.abc import Mapping

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.georeferencing.map_frame import MapFrame

WGS84 = 4326
"""Longitude and latitude of receivers."""


def above_ellipsoid(positions: Mapping[str, Gps | None], vertical: int) -> tuple[dict[str, Gps | None], list[str]]:
    """Return the positions with ellipsoidal heights, and a message about the conversion.

    Heights that their files do not declare ellipsoidal belong to the EPSG system `vertical`: h = H + N, N the height of
    its geoid above the ellipsoid (m). Raises InputError for a code that is not a vertical system, for a geoid that is
    not installed, and outside its area.
    """
    found = dict(positions)
    names, rows = [], []
    for name, gps in found.items():
        if gps and gps.altitude_m is not None and gps.heights != "ellipsoid":
            names.append(name)
            rows.append((gps.longitude_deg, gps.latitude_deg, gps.altitude_m))
    # A wrong code is an error even if no height needs it.
    system = MapFrame(WGS84, vertical, (0.0, 0.0, 0.0))
    if not names:
        any_height = any(gps and gps.altitude_m is not None for gps in found.values())
        all_are = "all are above the ellipsoid by their files" if any_height else "no photograph has one"
        return found, [f"no height needs the geoid of EPSG:{vertical}: {all_are}"]
    given = np.array(rows)
    height = system.place(given)[:, 2]
    for k in np.flatnonzero(~np.isfinite(height))[:1]:
        raise InputError(
            f"the geoid of the heights EPSG:{vertical} does not reach the photograph {quoted(names[k])} at "
            f"{rows[k][0]:.4f}, {rows[k][1]:.4f} degrees; give the system of heights of that place"
        )
    for name, h in zip(names, height.tolist(), strict=True):
        if gps := found[name]:
            found[name] = gps._replace(altitude_m=h, heights="ellipsoid")
    added = height - given[:, 2]
    return found, [
        f"the heights of {len(names)} photographs are taken as those of EPSG:{vertical}; its geoid, {added.min():+.2f} "
        f"to {added.max():+.2f} m, is added"
    ]
