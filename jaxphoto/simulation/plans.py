"""Plans of flights, convergent images and laser scans.

Headings are in degrees clockwise from north, lengths in metres, object frame east-north-up (docs/conventions.md). The
object frame of convergent images is defined by a level field at close range: X and Y along its sides, Z towards the
cameras.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.camera import Sensor
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Pattern
from jaxphoto.georeferencing.mount import ImageX

# Number of attempts to draw n positions from 4 n candidates; sufficient if strips cover a thousandth of the area.
_TRIES = 1_000


class Footprint(NamedTuple):
    """Ground coverage of a vertical image, along and across the flight (m)."""

    along: float
    across: float


@dataclasses.dataclass(frozen=True)
class Strip:
    """Straight strip of `images` exposures, `base_m` apart, flown towards `heading_deg` at a constant height.

    The centre of the strip is `along_m` ahead and `across_m` to the right of the origin, in flight direction.
    `height_m` is above the mean terrain; `footprint` is the ground coverage of an exposure there.
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
        """Return unit vectors (east, north): ahead, and to the right."""
        heading = np.deg2rad(self.heading_deg)
        return np.array([[np.sin(heading), np.cos(heading)], [np.cos(heading), -np.sin(heading)]])

    @property
    def along(self) -> Float[np.ndarray, "images"]:
        """Return the distance of each exposure ahead of the centre of the strip (m)."""
        return (np.arange(self.images) - (self.images - 1) / 2) * self.base_m

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """Return the centre of the strip, (east, north) in m."""
        return np.array([self.along_m, self.across_m]) @ self.axes

    @property
    def exposures(self) -> Float[np.ndarray, "images 2"]:
        """Return the positions (east, north) of the exposures in m."""
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
        """Return the time of every exposure relative to the mean of all (s)."""
        times, begin = [], 0.0
        for strip in self.strips:
            at = strip.along / self.speed_m_per_s
            times.append(at - at[0] + begin)
            begin = times[-1][-1] + self.turn_s
        every = np.concatenate(times)
        return every - every.mean()

    @property
    def cameras(self) -> set[str]:
        """Return the names of the cameras."""
        return {strip.camera for strip in self.strips}

    @property
    def n_images(self) -> int:
        """Return the number of images in all strips."""
        return sum(strip.images for strip in self.strips)


@dataclasses.dataclass(frozen=True)
class Swaths:
    """Ground area between the first and last exposure of each strip, over a fraction of its width.

    `across` is this fraction; `ends` is the fraction of half a footprint added beyond the first and last exposure.
    """

    strips: tuple[Strip, ...]
    across: float = 0.95
    ends: float = 0.0

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Return unit vectors (east, north): along the first strip's heading, and to its right."""
        return self.strips[0].axes

    @property
    def directions(self) -> Float[np.ndarray, "directions 2"]:
        """Return unit vectors (east, north) along the strips, opposite headings merged."""
        headings = np.deg2rad(np.unique([round(s.heading_deg % 180, 3) for s in self.strips]))
        return np.column_stack([np.sin(headings), np.cos(headings)])

    def half(self, strip: Strip) -> Float[np.ndarray, "2"]:
        """Return half the length and half the width (m) of one swath."""
        length = strip.along[-1] + self.ends * strip.footprint.along / 2
        return np.array([length, self.across * strip.footprint.across / 2])

    def contain(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return True for positions (east, north) in any of the swaths."""
        inside = np.zeros(len(xy), bool)
        for strip in self.strips:
            inside |= np.all(np.abs((xy - strip.middle) @ strip.axes.T) <= self.half(strip), axis=1)
        return inside

    def extent(self, axes: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Return the minimum and maximum coordinates of all swaths, (minimum or maximum, axis) in m along `axes`."""
        signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        corners = np.vstack([s.middle + signs * self.half(s) @ s.axes for s in self.strips]) @ axes.T
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def draw(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Draw positions (east, north) uniformly over the union of the swaths. Raises BlockError if it is empty."""
        if not any(np.all(self.half(strip) > 0) for strip in self.strips):
            raise BlockError(
                "strips of one image each have no ground between their first and last exposure; extend the points "
                "beyond the ends, or add images"
            )
        low, high = self.extent(np.eye(2))
        result = np.zeros((0, 2))
        for _ in range(_TRIES):
            if len(result) >= n:
                return result[:n]
            xy = rng.uniform(low, high, (4 * n, 2))
            result = np.vstack([result, xy[self.contain(xy)]])
        raise BlockError("the strips are so far apart that random places are hardly ever in one; reduce their distance")


def footprint(sensor: Sensor, c_mm: float, height_m: float, image_x: ImageX) -> Footprint:
    """Return the coverage of a vertical image from `height_m`: format times height over principal distance."""
    sides = np.array([sensor.width_mm, sensor.height_mm]) * height_m / c_mm
    return Footprint(*map(float, sides if image_x in ("forward", "back") else sides[::-1]))


@dataclasses.dataclass(frozen=True)
class Station:
    """Image taken `distance_m` from the centre of the field, aimed at it.

    `azimuth_deg` is the viewing direction clockwise from Y, `tilt_deg` the angle from the nadir, `roll_deg` the
    rotation about the camera axis, counter-clockwise from behind. Without roll the x axis is level; if all are zero, x
    is X and y is Y.
    """

    name: str
    camera: str
    distance_m: float
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def camera_from_object(self) -> Float[np.ndarray, "3 3"]:
        """Return the rotation matrix `R3(roll) R1(tilt) R3(-azimuth)`; its rows are the camera's axes."""
        angles = np.deg2rad([self.azimuth_deg, self.tilt_deg, self.roll_deg])
        (sa, st, sr), (ca, ct, cr) = np.sin(angles), np.cos(angles)
        level = np.array([[ca, -sa, 0.0], [ct * sa, ct * ca, st], [-st * sa, -st * ca, ct]])
        return np.array([[cr, sr, 0.0], [-sr, cr, 0.0], [0.0, 0.0, 1.0]]) @ level

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Return the position relative to the centre of the field (m)."""
        return self.distance_m * self.camera_from_object[2]


@dataclasses.dataclass(frozen=True)
class Field:
    """Object area of a convergent set: a rectangle about the origin, in metres along X and Y."""

    size_m: tuple[float, float]

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Return unit vectors (X, Y) along the sides."""
        return np.eye(2)

    @property
    def directions(self) -> Float[np.ndarray, "2 2"]:
        """Return unit vectors along the sides."""
        return self.axes

    def extent(self, axes: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Return the minimum and maximum coordinates, (minimum or maximum, axis) in m along `axes`."""
        reach = np.abs(axes) @ np.array(self.size_m) / 2
        return np.stack([-reach, reach])

    def draw(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Draw positions (X, Y) uniformly."""
        return rng.uniform(-0.5, 0.5, (n, 2)) * np.array(self.size_m)


@dataclasses.dataclass(frozen=True)
class ConvergentPlan:
    """Stations in order of exposure, and the field they aim at."""

    stations: tuple[Station, ...]
    field: Field

    @property
    def cameras(self) -> set[str]:
        """Return the names of the cameras."""
        return {station.camera for station in self.stations}

    @property
    def n_images(self) -> int:
        """Return the number of images, one per station."""
        return len(self.stations)


Triple = tuple[float, float, float]
_ZERO = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class ScanPlan:
    """Laser scanner with lines across the track, up to `scan_angle_deg` on either side of the body's nadir.

    `pattern` "line" scans from left to right; "circle" has two counter-rotating prisms. `density_per_m2` is the pulse
    density of one strip on level ground at the mean height of the terrain.

    `boresight_deg` (about the body's right, forward and up axes) is the true misalignment. The true position error of a
    strip is `shift_m` (by name or "default") plus a normal error of `shift_sigma_m`; the attitude error is
    `attitude_deg` (about right, forward, up). Both drift linearly from the centre of the strip by `drift_m_per_s` and
    `attitude_drift_deg_per_s`, and randomly with `drift_sigma_m`, `drift_sigma_deg` and `correlation_s`, at knots
    `knots_s` apart. `lever_arm_m`, `range_offset_m`, the scales, `eccentricity_deg` (of cos and sin) and
    `time_offset_s` are the parameters of `georeferencing.ScannerCalibration`. With `same_trajectory`, stations and
    attitudes of the exposures contain the errors of this trajectory, in addition to their noise.
    """

    density_per_m2: float
    scan_angle_deg: float = 20.0
    pattern: Pattern = "line"
    boresight_deg: Triple = _ZERO
    shift_m: dict[str, Triple] = dataclasses.field(default_factory=dict)
    drift_m_per_s: dict[str, Triple] = dataclasses.field(default_factory=dict)
    attitude_deg: dict[str, Triple] = dataclasses.field(default_factory=dict)
    attitude_drift_deg_per_s: dict[str, Triple] = dataclasses.field(default_factory=dict)
    shift_sigma_m: Triple = _ZERO
    drift_sigma_m: Triple = _ZERO
    drift_sigma_deg: Triple = _ZERO
    correlation_s: float = 100.0
    knots_s: float = 5.0
    lever_arm_m: Triple = _ZERO
    range_offset_m: float = 0.0
    range_scale_ppm: float = 0.0
    angle_scale_ppm: float = 0.0
    eccentricity_deg: tuple[float, float] = (0.0, 0.0)
    time_offset_s: float = 0.0
    same_trajectory: bool = False

    @property
    def half_width(self) -> float:
        """Return the half width of the swath relative to the height above ground: tangent of the scan angle."""
        return float(np.tan(np.deg2rad(self.scan_angle_deg)))


def strip_value(values: dict[str, Triple], strip: str) -> Float[np.ndarray, "3"]:
    """Return the planned value of a strip (by its name or "default"), without random parts."""
    return np.array(values.get(strip, values.get("default", _ZERO)))
