"""Exposures read from a position file, in its order."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.gps import Fix, Gps, Heights

Lines = list[tuple[int, str]]
"""Pairs (row number from 1, line)."""


class Exposures(NamedTuple):
    """Exposures, one entry per row of a file; NaN or None for unknown values."""

    file: str
    rows: Int[np.ndarray, "n"]
    """Row numbers from 1."""
    time_s: Float[np.ndarray, "n"]
    """Seconds since 1980-01-06, on the clock of the file."""
    place: Float[np.ndarray, "n 3"]
    """Longitude, latitude (degrees) and height (m)."""
    sigma_m: Float[np.ndarray, "n 3"]
    """Standard deviations east, north, up (m)."""
    fix: tuple[Fix, ...]
    heights: Heights
    names: tuple[str, ...] = ()
    """Names of the photographs, without extension."""
    sequence: Int[np.ndarray, "n"] | None = None
    """Number of the photograph within its flight."""
    camera_from_antenna_m: Float[np.ndarray, "n 3"] | None = None
    """Lever arm from the antenna to the camera: east, north, up (m)."""
    of_antenna: bool = False
    """True if `place` is the position of the antenna or IMU."""
    aircraft_deg: Float[np.ndarray, "n 3"] | None = None
    """Roll, pitch, yaw of the aircraft (degrees)."""
    attitude: tuple[CameraAttitude | None, ...] = ()
    without: tuple[int, ...] = ()
    """Numbers of invalid rows, which were skipped."""
    why: str = ""
    """Message about the skipped rows."""

    def gps(self, k: int) -> Gps | None:
        """Return the position of entry `k`; None if unknown."""
        longitude, latitude, height = self.place[k].tolist()
        if not np.isfinite([longitude, latitude]).all():
            return None
        east, north, up = self.sigma_m[k].tolist()
        return Gps(
            latitude,
            longitude,
            height if np.isfinite(height) else None,
            (east, north, up) if np.isfinite(self.sigma_m[k]).all() else None,
            self.heights,
            self.fix[k],
        )

    def take(self, chosen: np.ndarray) -> "Exposures":
        """Select the entries of a mask."""
        n, kept = len(self.rows), {}
        for name, values in self._asdict().items():
            if isinstance(values, np.ndarray):
                kept[name] = values[chosen]
            elif isinstance(values, tuple) and len(values) == n and name != "without":
                kept[name] = tuple(v for v, c in zip(values, chosen.tolist(), strict=True) if c)
        return self._replace(**kept)
