"""Scale bars: distances between two points."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.observations.base import AbstractObservations, index_of


class Distances(AbstractObservations):
    """Scale bars: the distance (m) between two points."""

    group = "distances"
    unit = "m"
    rigid_invariant = True
    columns = {"points": ("point_a", "point_b"), "value": "distance_m"}  # noqa: RUF012
    unique = True

    points: Int[np.ndarray, "n 2"] = index_of("point")
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, ends: Float[Array, "2 3"]) -> Float[ArrayLike, ""]:
        """Return observed minus computed (m)."""
        return self.value - jnp.sqrt(jnp.sum((ends[0] - ends[1]) ** 2))

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "distance A to B"."""
        return np.array([f"distance {points[a]} to {points[b]}" for a, b in self.points], object)

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for distances from a point to itself and distances that are not positive."""
        for row in np.flatnonzero(self.points[:, 0] == self.points[:, 1]):
            yield int(row), "the distance runs from a point to itself; correct point_a or point_b"
        for row in np.flatnonzero(np.asarray(self.value) <= 0):
            yield int(row), f"distance_m is {self.value[row]:g}; a distance is positive; correct it"
