"""Flight plan: straight strips over level ground, their exposures, and the ground they cover.

Headings are in degrees clockwise from north, lengths in metres, object frame east-north-up (docs/conventions.md).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.camera import Sensor
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing.mount import ImageX

# Number of attempts to draw n places from 4 n candidates: enough if strips cover a thousandth of the area.
_TRIES = 1_000


class Footprint(NamedTuple):
    """Ground coverage of a vertical image, along and across the flight (m)."""

    along: float
    across: float


@dataclasses.dataclass(frozen=True)
class Strip:
    """Straight run of `images` exposures, `base_m` apart, flown towards `heading_deg` at a constant height.

    The centre of the run is `along_m` ahead and `across_m` to the right of the origin, in flight direction. `height_m`
    is above the mean terrain, `footprint` is that of an exposure there.
    """

    name: str
    camera: str
    heading_deg: float
    images: int
    base_m: float
    height_m: float
    footprint: Footprint
    along_m: float = 0.0
    across_m: float = 0.0

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors (east, north): ahead, and to the right."""
        heading = np.deg2rad(self.heading_deg)
        return np.array([[np.sin(heading), np.cos(heading)], [np.cos(heading), -np.sin(heading)]])

    @property
    def along(self) -> Float[np.ndarray, "images"]:
        """Distance of each exposure ahead of the centre of the strip (m)."""
        return (np.arange(self.images) - (self.images - 1) / 2) * self.base_m

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Centre of the run, (east, north) in m."""
        return np.array([self.along_m, self.across_m]) @ self.axes

    @property
    def exposures(self) -> Float[np.ndarray, "images 2"]:
        """(east, north) of the exposures, in m."""
        return self.middle + self.along[:, None] * self.axes[0]


@dataclasses.dataclass(frozen=True)
class FlightPlan:
    """Strips in order of flight, with ground speed and turns between them.

    `turn_s` is the time from the last exposure of a strip to the first of the next.
    """

    strips: tuple[Strip, ...]
    speed_m_per_s: float = 60.0
    turn_s: float = 60.0

    @property
    def clock(self) -> Float[np.ndarray, "images"]:
        """Return the time of every exposure from the mean of all (s)."""
        times, begin = [], 0.0
        for strip in self.strips:
            own = strip.along / self.speed_m_per_s
            times.append(own - own[0] + begin)
            begin = times[-1][-1] + self.turn_s
        every = np.concatenate(times)
        return every - every.mean()

    @property
    def cameras(self) -> set[str]:
        """Cameras used."""
        return {strip.camera for strip in self.strips}

    @property
    def n_images(self) -> int:
        """Number of images in all strips."""
        return sum(strip.images for strip in self.strips)


@dataclasses.dataclass(frozen=True)
class Swaths:
    """Ground between the first and last exposure of each strip, over a fraction of its width.

    `across` is that fraction; `ends` is the fraction of half a footprint added beyond the first and last exposure.
    """

    strips: tuple[Strip, ...]
    across: float = 0.95
    ends: float = 0.0

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors (east, north): along the first strip's heading, and to its right."""
        return self.strips[0].axes

    @property
    def directions(self) -> Float[np.ndarray, "directions 2"]:
        """Unit vectors (east, north) along the strips, in one direction each."""
        headings = np.deg2rad(np.unique([round(s.heading_deg % 180, 3) for s in self.strips]))
        return np.column_stack([np.sin(headings), np.cos(headings)])

    def half(self, strip: Strip) -> Float[np.ndarray, "2"]:
        """Half the length and half the width (m) of one swath."""
        length = strip.along[-1] + self.ends * strip.footprint.along / 2
        return np.array([length, self.across * strip.footprint.across / 2])

    def contain(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return True for places (east, north) in any of the swaths."""
        inside = np.zeros(len(xy), bool)
        for strip in self.strips:
            inside |= np.all(np.abs((xy - strip.middle) @ strip.axes.T) <= self.half(strip), axis=1)
        return inside

    def extent(self, axes: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Minimum and maximum coordinate of all swaths, (minimum or maximum, axis) in m along `axes`."""
        signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        corners = np.vstack([s.middle + signs * self.half(s) @ s.axes for s in self.strips]) @ axes.T
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def draw(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Draw places (east, north) uniformly over the union of the swaths. Raises BlockError if that is empty."""
        if not any(np.all(self.half(strip) > 0) for strip in self.strips):
            raise BlockError(
                "strips of one image each leave no ground between their first and last exposure; "
                "let the points lie beyond the ends too, or add images"
            )
        low, high = self.extent(np.eye(2))
        found = np.zeros((0, 2))
        for _ in range(_TRIES):
            if len(found) >= n:
                return found[:n]
            xy = rng.uniform(low, high, (4 * n, 2))
            found = np.vstack([found, xy[self.contain(xy)]])
        raise BlockError("the strips lie so far apart that places are hardly ever in one; bring them together")


def footprint(sensor: Sensor, c_mm: float, height_m: float, image_x: ImageX) -> Footprint:
    """Return the coverage of a vertical image from `height_m`: format times height over principal distance."""
    sides = np.array([sensor.width_mm, sensor.height_mm]) * height_m / c_mm
    return Footprint(*map(float, sides if image_x in ("forward", "back") else sides[::-1]))
