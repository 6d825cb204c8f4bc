"""A user's observations of two points."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto import AbstractObservations, index_of
from jaxphoto.arrays import ArrayLike


class HeightDifferences(AbstractObservations):
    """Levelled: how much higher `end` lies than `start` (m)."""

    group = "height_differences"
    unit = "m"

    start: Int[np.ndarray, "n"] = index_of("point")
    end: Int[np.ndarray, "n"] = index_of("point")
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, ""]:
        return self.value - (end[2] - start[2])
