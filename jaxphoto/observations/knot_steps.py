"""Steps of the trajectory error from knot to knot: regularisation by a drift model of GNSS and IMU.

A Gauss-Markov process with standard deviation s and correlation time T proceeds from c[k] to

    c[k + 1] = f c[k] + noise,    f = exp(-h / T),    noise with standard deviation s sqrt(1 - f^2)

after h seconds. The process is constant for infinite T; for increasing s and T with s^2 / T = q / 2 it becomes a random
walk of q (m^2/s), as of accelerometers and gyros. The first knot of a strip has the prior zero with standard deviation
s. Source: Gelb (1974), Applied optimal estimation; Cucci, Rehak and Skaloud (2017) use raw inertial measurements
instead.
"""

from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import TrajectoryKnot
from jaxphoto.observations.base import AXES, AbstractObservations, index_of


class AbstractKnotSteps(AbstractObservations):
    """Error at knot `end` minus `kept` times the error at knot `start`, observed as zero with `sigma`."""

    _words: eqx.AbstractClassVar[tuple[str, str]]
    observed = "step"
    columns = {"step": (), "kept": "kept"}  # noqa: RUF012

    start: Int[np.ndarray, "n"] = index_of("trajectory_knots")
    end: Int[np.ndarray, "n"] = index_of("trajectory_knots")
    kept: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n 3"]
    step: Float[ArrayLike, "n 3"]

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for every `kept` outside [0, 1]."""
        kept = np.asarray(self.kept)
        for row in np.flatnonzero((kept < 0) | (kept > 1)):
            yield (
                int(row),
                f"kept is {kept[row]:g}; give the fraction of an error that remains at the next knot, 0 to 1",
            )

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "step 12 of the trajectory in Z"."""
        step, along = self._words
        return np.array(
            [[f"{step} {k + 1} of the trajectory {along} {a}" for k in range(len(self))] for a in self.axes], object
        )


class PositionSteps(AbstractKnotSteps):
    """Steps of the position error (m)."""

    group = "position_steps"
    unit = "m"
    axes = AXES
    _words = ("step", "in")

    def residual(self, start: TrajectoryKnot, end: TrajectoryKnot) -> Float[ArrayLike, "3"]:
        """Return observed minus computed step (m)."""
        return self.step - (end.position - self.kept * start.position)


class AttitudeSteps(AbstractKnotSteps):
    """Steps of the attitude error, about the body's right, forward and up axes (rad)."""

    group = "attitude_steps"
    unit = "rad"
    axes = ("right", "forward", "up")
    _words = ("turn", "about")

    def residual(self, start: TrajectoryKnot, end: TrajectoryKnot) -> Float[ArrayLike, "3"]:
        """Return observed minus computed step (rad)."""
        return self.step - (end.attitude - self.kept * start.attitude)
