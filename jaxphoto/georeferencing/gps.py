"""What the file of a photograph says of where it was taken."""

from typing import NamedTuple


class Gps(NamedTuple):
    """A position that the camera's own receiver gave, metres off at best."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    sigma_m: tuple[float, float, float] | None = None
    """East, north and up, of a receiver with corrections that says them (DJI's RTK)."""
