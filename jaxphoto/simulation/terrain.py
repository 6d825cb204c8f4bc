"""The ground: level, sloping or wavy, and rough."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Wave:
    """`amplitude_m sin(2 pi d / length_m + phase_deg)`, d the distance (m) towards `heading_deg` (from north)."""

    amplitude_m: float
    length_m: float
    heading_deg: float = 90.0
    phase_deg: float = 0.0


@dataclasses.dataclass(frozen=True)
class RandomWaves:
    """So many waves of one root mean square height together: headings and phases of chance.

    Lengths are spread evenly, on a logarithmic scale, around `length_m` by a factor of two.
    """

    count: int
    rms_m: float
    length_m: float

    def draw(self, rng: np.random.Generator) -> tuple[Wave, ...]:
        """The waves."""
        heading, phase = rng.uniform(0, 360, (2, self.count))
        length = self.length_m * 2.0 ** rng.uniform(-1, 1, self.count)
        amplitude = self.rms_m * np.sqrt(2 / self.count)
        return tuple(Wave(amplitude, *row) for row in np.stack([length, heading, phase], axis=1).tolist())


@dataclasses.dataclass(frozen=True)
class Terrain:
    """Z = height + slope . (X, Y) + waves, and at every point by itself a uniform roughness within +- `roughness_m`.

    `slope` is in metres per metre to the east and to the north. `seed` keeps random waves when the simulation's seed
    changes.
    """

    height_m: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[Wave, ...] = ()
    roughness_m: float = 0.0
    random: RandomWaves | None = None
    seed: int | None = None

    def drawn(self, rng: np.random.Generator) -> "Terrain":
        """The same ground with its random waves settled."""
        if self.random is None:
            return self
        rng = rng if self.seed is None else np.random.default_rng(self.seed)
        return dataclasses.replace(self, waves=self.waves + self.random.draw(rng), random=None)

    def height(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Z (m) of the smooth ground at (east, north); random waves must have been `drawn`."""
        z = self.height_m + xy @ np.array(self.slope)
        for wave in self.waves:
            heading = np.deg2rad(wave.heading_deg)
            distance = xy @ np.array([np.sin(heading), np.cos(heading)])
            z = z + wave.amplitude_m * np.sin(2 * np.pi * distance / wave.length_m + np.deg2rad(wave.phase_deg))
        return z

    def place(self, xy: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
        """Points on the rough ground at (east, north), in m."""
        rough = rng.uniform(-1, 1, len(xy)) * self.roughness_m
        return np.column_stack([xy, self.height(xy) + rough])


ROLLING = Terrain(
    waves=(Wave(14.0, 2 * np.pi * 420.0, 90.0), Wave(10.0, 2 * np.pi * 310.0, 0.0, 90.0)), roughness_m=6.0
)
"""14 sin(X / 420 m) + 10 cos(Y / 310 m) +- 6 m: gentle country with about 57 m between its extremes."""
