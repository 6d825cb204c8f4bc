"""The points of a laser scanner."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxphoto.short_repr import shown

OF_POINTS = ("xyz", "classification", "returns", "time", "strip", "withheld")
"""What a `Cloud` says of each point."""


@shown
class Cloud(eqx.Module):
    """Laser points in one Cartesian frame (m): that of the block they were read for, or that of their file.

    What a file does not tell is None. `time` (s) is that of the file; `strip` is the index, in `strips`, of the flight
    line that a point belongs to (LAS: point source ID). `returns` are the return's number and the number of returns
    of its pulse. `withheld` are points that their file says not to use: only `rewrite_cloud` meets them.
    """

    xyz: Float[np.ndarray, "n 3"]
    classification: UInt8[np.ndarray, "n"] | None = None
    returns: UInt8[np.ndarray, "n 2"] | None = None
    time: Float[np.ndarray, "n"] | None = None
    strip: Int[np.ndarray, "n"] | None = None
    strips: tuple[str, ...] = eqx.field(static=True, default=())
    withheld: Bool[np.ndarray, "n"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, chosen: np.ndarray) -> "Cloud":
        """The points that `chosen` (an index or a mask) names."""
        kept = {name: v[chosen] for name in OF_POINTS if (v := getattr(self, name)) is not None}
        return dataclasses.replace(self, **kept)

    def numbered(self, names: Sequence[str]) -> "Cloud":
        """The same with strips numbered as in `names`, and those that are not among them after these."""
        if self.strip is None:
            return self
        order = (*names, *(name for name in self.strips if name not in names))
        number = np.array([order.index(name) for name in self.strips], np.int32)
        return dataclasses.replace(self, strip=number[self.strip], strips=order)

    @staticmethod
    def joined(parts: Sequence["Cloud"]) -> "Cloud":
        """Parts of one cloud as a whole; the strips of the last are those of all."""
        columns = {}
        for name in OF_POINTS:
            values = [getattr(part, name) for part in parts]
            if values[0] is not None:
                columns[name] = np.concatenate(values)
        return Cloud(**columns, strips=parts[-1].strips)

    @property
    def extent(self) -> Float[np.ndarray, "2 3"]:
        """Least and greatest X, Y, Z (m)."""
        # Column by column: numpy takes ten times as long over an axis.
        return np.array([[v.min() for v in self.xyz.T], [v.max() for v in self.xyz.T]])
