"""Point cloud of a laser scanner."""

import dataclasses
import warnings
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxphoto.rounding import float_step
from jaxphoto.short_repr import pretty_repr

OF_POINTS = ("xyz", "classification", "returns", "time", "strip", "withheld")
"""Point-wise fields of a `Cloud`."""
PRECISION_M = 0.01
"""Standard deviation of precise laser points (m)."""


@pretty_repr
class Cloud(eqx.Module):
    """Laser points in one Cartesian frame (m): the frame of the block they were read for, or of their file.

    Missing fields are None. `time` (s) is the time in the file; `strip` is the index, in `strips`, of the flight line
    of a point (LAS: point source ID). `returns` are return number and number of returns of the pulse. `withheld` marks
    points that the file excludes: only `rewrite_cloud` processes them.
    """

    xyz: Float[np.ndarray, "n 3"]
    classification: UInt8[np.ndarray, "n"] | None = None
    returns: UInt8[np.ndarray, "n 2"] | None = None
    time: Float[np.ndarray, "n"] | None = None
    strip: Int[np.ndarray, "n"] | None = None
    strips: tuple[str, ...] = eqx.field(static=True, default=())
    withheld: Bool[np.ndarray, "n"] | None = None

    def __check_init__(self) -> None:
        for name, values in zip("XYZ", np.asarray(self.xyz).T, strict=True):
            if step := float_step(values, PRECISION_M):
                warnings.warn(
                    f"Cloud.xyz, column {name}: {values.dtype} has steps of {step:.2g} m at "
                    f"{np.abs(values).max():.7g} m, laser points are precise to {PRECISION_M:g} m; give float64 "
                    "computed from the original numbers",
                    UserWarning,
                    stacklevel=3,
                )

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, chosen: np.ndarray) -> "Cloud":
        """Select points by index or mask."""
        kept = {name: v[chosen] for name in OF_POINTS if (v := getattr(self, name)) is not None}
        return dataclasses.replace(self, **kept)

    def numbered(self, names: Sequence[str]) -> "Cloud":
        """Renumber strips as in `names`; other strips follow after these."""
        if self.strip is None:
            return self
        order = (*names, *(name for name in self.strips if name not in names))
        number = np.array([order.index(name) for name in self.strips], np.int32)
        return dataclasses.replace(self, strip=number[self.strip], strips=order)

    @staticmethod
    def joined(parts: Sequence["Cloud"]) -> "Cloud":
        """Concatenate parts of one cloud; the strip list of the last part applies to all."""
        columns = {}
        for name in OF_POINTS:
            values = [getattr(part, name) for part in parts]
            if values[0] is not None:
                columns[name] = np.concatenate(values)
        return Cloud(**columns, strips=parts[-1].strips)

    @property
    def extent(self) -> Float[np.ndarray, "2 3"]:
        """Return minimum and maximum X, Y, Z (m)."""
        # By column: NumPy takes ten times as long over an axis.
        return np.array([[v.min() for v in self.xyz.T], [v.max() for v in self.xyz.T]])
