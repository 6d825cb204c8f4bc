"""Convergent images as planned, at close range: stations round a level field, all aiming at its middle.

The object frame is that of the field: X and Y along its sides, Z towards the cameras. Lengths are in metres.
"""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Station:
    """One image, taken `distance_m` from the middle of the field and aiming at it.

    `azimuth_deg` is where the camera looks, clockwise from Y; `tilt_deg` how far from straight down; `roll_deg` how far
    it is turned about its axis, counter-clockwise as seen from behind. Without roll its x axis is level, and without
    any of them x is X and y is Y.
    """

    name: str
    camera: str
    distance_m: float
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def camera_from_object(self) -> Float[np.ndarray, "3 3"]:
        """Rows: the camera's axes; `R3(roll) R1(tilt) R3(-azimuth)`."""
        angles = np.deg2rad([self.azimuth_deg, self.tilt_deg, self.roll_deg])
        (sa, st, sr), (ca, ct, cr) = np.sin(angles), np.cos(angles)
        level = np.array([[ca, -sa, 0.0], [ct * sa, ct * ca, st], [-st * sa, -st * ca, ct]])
        return np.array([[cr, sr, 0.0], [-sr, cr, 0.0], [0.0, 0.0, 1.0]]) @ level

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """From the middle of the field, in m."""
        return self.distance_m * self.camera_from_object[2]


@dataclasses.dataclass(frozen=True)
class Field:
    """The ground of a convergent set: a rectangle about the origin, of so many metres along X and Y."""

    size_m: tuple[float, float]

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors (X, Y) along the sides."""
        return np.eye(2)

    @property
    def directions(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors of its arms: the sides."""
        return self.axes

    def extent(self, axes: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Least and greatest coordinate, (least or greatest, axis) in m along the unit vectors `axes`."""
        reach = np.abs(axes) @ np.array(self.size_m) / 2
        return np.stack([-reach, reach])

    def draw(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Places (X, Y) of uniform density."""
        return rng.uniform(-0.5, 0.5, (n, 2)) * np.array(self.size_m)


@dataclasses.dataclass(frozen=True)
class ConvergentPlan:
    """Stations in the order in which images are taken, and the field they aim at."""

    stations: tuple[Station, ...]
    field: Field

    @property
    def cameras(self) -> set[str]:
        """Those that take an image."""
        return {station.camera for station in self.stations}

    @property
    def n_images(self) -> int:
        """Each station is one."""
        return len(self.stations)
