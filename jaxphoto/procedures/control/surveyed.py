"""What is known of control before photographs are looked at: surveyed points, and where photographs show them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

SIGMA_M = (0.02, 0.02, 0.03)
"""Of a surveyed point, east, north and up, where its file says none: a receiver with corrections, one occupation."""
MARK_SIGMA_PX = 1.0
"""Of a mark set by hand where its file says none."""


class SurveyedPoints(NamedTuple):
    """Points with coordinates, as a file has them."""

    file: str
    ids: tuple[str, ...]
    coordinates: Float[np.ndarray, "points 3"]
    """Easting, northing, height (m), or longitude, latitude (degrees), height; NaN for a height that is not known."""
    sigma_m: Float[np.ndarray, "points 3"]
    """East, north, up; NaN where the file says none."""
    check: Bool[np.ndarray, "points"]
    """Whether it only checks the block, and never enters the adjustment."""
    places: tuple[str, ...]
    """File and row of each."""
    system: str = ""
    """What the file says of the coordinate system: an EPSG code, a string of PROJ, WKT, "local"; "" for nothing."""
    own_axes: bool = False
    """Whether the first two coordinates are in the order of the system's own axes (EPSG:4326 has latitude first)."""


class Marks(NamedTuple):
    """Where photographs show points, in pixels: the centre of the upper-left pixel is (0.5, 0.5)."""

    image: tuple[str, ...]
    """The name of the file or of the image."""
    point: tuple[str, ...]
    column_row: Float[np.ndarray, "marks 2"]
    sigma_px: Float[np.ndarray, "marks"]
    """NaN where the file says none."""
    places: tuple[str, ...]

    @staticmethod
    def none() -> "Marks":
        """No marks."""
        return Marks((), (), np.zeros((0, 2)), np.zeros(0), ())

    def take(self, chosen: np.ndarray) -> "Marks":
        """Those that a mask or indices choose."""
        which = np.arange(len(self.image))[chosen]
        names = (tuple(names[k] for k in which) for names in (self.image, self.point, self.places))
        image, point, places = names
        return Marks(image, point, self.column_row[which], self.sigma_px[which], places)

    @staticmethod
    def joined(one: "Marks", other: "Marks") -> "Marks":
        """Both, one after the other."""
        column_row = np.concatenate([one.column_row, other.column_row])
        sigma = np.concatenate([one.sigma_px, other.sigma_px])
        places = one.places + other.places
        return Marks(one.image + other.image, one.point + other.point, column_row, sigma, places)


class GivenControl(NamedTuple):
    """Surveyed points and marks of them; there may be none of these, where targets are to be found."""

    points: SurveyedPoints
    marks: Marks
