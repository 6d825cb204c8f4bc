"""The points of a laser scanner."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int, UInt8


class Cloud(eqx.Module):
    """Laser points in one Cartesian frame (m): that of the block they were read for, or that of their file.

    What a file does not tell is None. `time` (s) is that of the file; `strip` is the index, in `strips`, of the flight
    line that a point belongs to (LAS: point source ID). `returns` are the return's number and the number of returns
    of its pulse.
    """

    xyz: Float[np.ndarray, "n 3"]
    classification: UInt8[np.ndarray, "n"] | None = None
    returns: UInt8[np.ndarray, "n 2"] | None = None
    time: Float[np.ndarray, "n"] | None = None
    strip: Int[np.ndarray, "n"] | None = None
    strips: tuple[str, ...] = eqx.field(static=True, default=())

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, chosen: np.ndarray) -> "Cloud":
        """The points that `chosen` (an index or a mask) names."""
        of_points = ("xyz", "classification", "returns", "time", "strip")
        kept = {name: v[chosen] for name in of_points if (v := getattr(self, name)) is not None}
        return dataclasses.replace(self, **kept)

    @property
    def extent(self) -> Float[np.ndarray, "2 3"]:
        """Least and greatest X, Y, Z (m)."""
        return np.stack([self.xyz.min(axis=0), self.xyz.max(axis=0)])
