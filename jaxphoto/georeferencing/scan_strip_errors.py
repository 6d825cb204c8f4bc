"""Errors of the strips of a point cloud, simulated or estimated."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.georeferencing.scanner_calibration import ScannerCalibration
from jaxphoto.georeferencing.trajectory_knots import SplineKnots, StripSpline
from jaxphoto.short_repr import pretty_repr


@pretty_repr
class StripErrors(eqx.Module):
    """Errors of a point cloud: scanner errors, and trajectory errors per strip."""

    splines: tuple[StripSpline, ...] = eqx.field(static=True)
    """Splines of the strips of the cloud, in order."""
    position: Float[np.ndarray, "knots 3"]
    """Position errors of all knots (m); `attitude` likewise (rad)."""
    attitude: Float[np.ndarray, "knots 3"]
    boresight: Float[np.ndarray, "3"]
    calibration: ScannerCalibration

    def at(self, strip: int, time: Float[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the trajectory error of a strip at times (s): position (m) and attitude (rad), (n, 3) each."""
        knots, weights = self.splines[strip].weights(time)
        return tuple(np.einsum("nk,nkc->nc", weights, of[knots]) for of in (self.position, self.attitude))  # type: ignore[return-value]

    def of_strip(self, strip: int) -> SplineKnots:
        """Return position (m) and attitude (rad) errors as one spline with six components, for compiled programs."""
        first, size, start, interval = (np.asarray(v) for v in self.splines[strip])
        return SplineKnots(first, size, start, interval, np.concatenate([self.position, self.attitude], axis=1))
