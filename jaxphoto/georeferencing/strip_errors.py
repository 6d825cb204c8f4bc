"""All that the strips of a cloud are off by, of a simulation as of an adjustment."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.georeferencing.scanner_calibration import ScannerCalibration
from jaxphoto.georeferencing.trajectory_knots import SplineKnots, StripSpline
from jaxphoto.short_repr import shown


@shown
class StripErrors(eqx.Module):
    """What a cloud is off by: its scanner, and its trajectory strip by strip."""

    splines: tuple[StripSpline, ...] = eqx.field(static=True)
    """One for each strip of the cloud, in their order."""
    position: Float[np.ndarray, "knots 3"]
    """Of all knots (m, rad)."""
    attitude: Float[np.ndarray, "knots 3"]
    boresight: Float[np.ndarray, "3"]
    calibration: ScannerCalibration

    def at(self, strip: int, time: Float[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        """What the trajectory of a strip is off by at times (s): position (m) and attitude (rad), (n, 3) each."""
        knots, weights = self.splines[strip].weights(time)
        return tuple(np.einsum("nk,nkc->nc", weights, of[knots]) for of in (self.position, self.attitude))  # type: ignore[return-value]

    def of_strip(self, strip: int) -> SplineKnots:
        """The same for what is compiled: position (m) and attitude (rad), six numbers together."""
        first, size, start, interval = (np.asarray(v) for v in self.splines[strip])
        return SplineKnots(first, size, start, interval, np.concatenate([self.position, self.attitude], axis=1))
