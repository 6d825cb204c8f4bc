"""Terrain: level, sloping or wavy ground with roughness, buildings and trees."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.short_repr import pretty_repr
from jaxphoto.simulation.buildings import Building, roof_height, wall_distance
from jaxphoto.simulation.trees import Tree, under_crown

# Distance of points from walls and crowns (m).
_CLEARANCE_M = 1.0


@dataclasses.dataclass(frozen=True)
class Wave:
    """`amplitude_m sin(2 pi d / length_m + phase_deg)`, d the distance (m) towards `heading_deg` (from north)."""

    amplitude_m: float
    length_m: float
    heading_deg: float = 90.0
    phase_deg: float = 0.0


@dataclasses.dataclass(frozen=True)
class RandomWaves:
    """Random waves with a common root mean square height: random headings and phases.

    Lengths are evenly spaced, on a logarithmic scale, around `length_m` by a factor of two.
    """

    count: int
    rms_m: float
    length_m: float

    def draw(self, rng: np.random.Generator) -> tuple[Wave, ...]:
        """Draw the waves."""
        heading, phase = rng.uniform(0, 360, (2, self.count))
        length = self.length_m * 2.0 ** rng.uniform(-1, 1, self.count)
        amplitude = self.rms_m * np.sqrt(2 / self.count)
        return tuple(Wave(amplitude, *row) for row in np.stack([length, heading, phase], axis=1).tolist())


@pretty_repr
@dataclasses.dataclass(frozen=True)
class Terrain:
    """Z = height + slope . (X, Y) + waves, with an independent uniform roughness of +- `roughness_m` at every point.

    `slope` is in metres per metre to the east and to the north. `seed` keeps random waves, buildings and trees when the
    simulation's seed changes.
    """

    height_m: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[Wave, ...] = ()
    roughness_m: float = 0.0
    random: RandomWaves | None = None
    seed: int | None = None
    buildings: tuple[Building, ...] = ()
    trees: tuple[Tree, ...] = ()

    def drawn(self, rng: np.random.Generator) -> "Terrain":
        """Return the terrain with its random waves drawn."""
        if self.random is None:
            return self
        rng = rng if self.seed is None else np.random.default_rng(self.seed)
        return dataclasses.replace(self, waves=self.waves + self.random.draw(rng), random=None)

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return Z (m) of the smooth ground at (east, north); random waves must have been `drawn`."""
        z = self.height_m + xy @ np.array(self.slope)
        for wave in self.waves:
            heading = np.deg2rad(wave.heading_deg)
            distance = xy @ np.array([np.sin(heading), np.cos(heading)])
            z = z + wave.amplitude_m * np.sin(2 * np.pi * distance / wave.length_m + np.deg2rad(wave.phase_deg))
        return z

    def surface(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return Z (m) of the smooth ground, or of the roof above it, at (east, north)."""
        return np.maximum(self.height(xy), roof_height(self.buildings, xy))

    def open(self, xy: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return True if a place (east, north) is at least 1 m from walls and crowns, on the ground or on a roof."""
        near_wall = np.isfinite(wall_distance(self.buildings, xy, _CLEARANCE_M))
        return ~near_wall & ~under_crown(self.trees, xy, _CLEARANCE_M)

    def place(self, xy: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
        """Return points on the rough ground, or on smooth roofs, at (east, north), in m."""
        rough = rng.uniform(-1, 1, len(xy)) * self.roughness_m
        return np.column_stack([xy, np.maximum(self.height(xy) + rough, roof_height(self.buildings, xy))])

    def on_roofs(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 2"]:
        """Draw places (east, north) uniformly over the roofs, 1 m or more from their edges; requires a building."""
        half = np.maximum(np.stack([b.half for b in self.buildings]) - 1.01 * _CLEARANCE_M, 0)
        area = half.prod(axis=1)
        which = rng.choice(len(half), n, p=area / area.sum() if area.any() else None)
        axes = np.stack([b.axes for b in self.buildings])[which]
        centre = np.array([b.centre_m for b in self.buildings])[which]
        return centre + np.einsum("ni,nij->nj", rng.uniform(-1, 1, (n, 2)) * half[which], axes)


ROLLING = Terrain(
    waves=(Wave(14.0, 2 * np.pi * 420.0, 90.0), Wave(10.0, 2 * np.pi * 310.0, 0.0, 90.0)), roughness_m=6.0
)
"""14 sin(X / 420 m) + 10 cos(Y / 310 m) +- 6 m: hills of about 57 m between extremes."""
