"""Exposures as a file beside the photographs lists them, in its own order."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import RowError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.gps import Fix, Gps, Heights


class Exposures(NamedTuple):
    """One entry a line of the file; NaN and None where it says nothing."""

    file: str
    rows: Int[np.ndarray, "n"]
    """Of the file, from 1."""
    time_s: Float[np.ndarray, "n"]
    """Since 1980-01-06, by the clock of the file."""
    place: Float[np.ndarray, "n 3"]
    """Longitude, latitude (degrees) and height (m)."""
    sigma_m: Float[np.ndarray, "n 3"]
    """East, north, up."""
    fix: tuple[Fix, ...]
    heights: Heights
    names: tuple[str, ...] = ()
    """Of the photographs, without the ending, where the file has them."""
    sequence: Int[np.ndarray, "n"] | None = None
    """The number of the photograph within its flight."""
    camera_from_antenna_m: Float[np.ndarray, "n 3"] | None = None
    """From the antenna to the camera, east, north, up, where the file says it."""
    of_antenna: bool = False
    """Whether `place` is that of the antenna (or IMU), not of the camera."""
    aircraft_deg: Float[np.ndarray, "n 3"] | None = None
    """Roll, pitch, yaw."""
    attitude: tuple[CameraAttitude | None, ...] = ()
    without: tuple[int, ...] = ()
    """Rows that are wrong, and left out."""
    why: str = ""
    """Which they are, and what is wrong, in words."""

    def gps(self, k: int) -> Gps | None:
        """The position of line `k`; None where it has none."""
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


def check_places(file: str, rows: np.ndarray, place: np.ndarray) -> None:
    """Raise RowError for a longitude or latitude that cannot be."""
    beyond = np.argwhere(np.abs(place[:, :2]) > [360.0, 90.0])
    for k, axis in beyond[:1]:
        name = ("longitude", "latitude")[axis]
        raise RowError(
            f"{file}, row {rows[k]}: the {name} {place[k, axis]:g} degrees cannot be; give longitude and latitude in "
            "the columns of their names, in degrees",
            rows[beyond[:, 0]].tolist(),
        )
