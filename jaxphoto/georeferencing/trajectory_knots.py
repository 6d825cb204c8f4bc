"""What a trajectory is off by, strip by strip: a cubic B-spline of time for position and attitude.

With knots h apart from the begin of a strip, the correction at time t in interval i, u of the interval gone, is that
of four coefficients c[i] to c[i + 3]:

    [(1 - u)^3, 3 u^3 - 6 u^2 + 4, -3 u^3 + 3 u^2 + 3 u + 1, u^3] / 6

Source: de Boor, A practical guide to splines. What holds the coefficients together is `observations.PositionSteps`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import Numbers
from jaxphoto.parameters import AbstractParameters

# Between the strip and the time in the name of a knot.
_AT = " at "


class TrajectoryKnot(AbstractParameters):
    """One coefficient of the splines of a strip.

    `position` is what positions are off by (m, in the object frame), `attitude` a small rotation about the body's
    right, forward and up axes (rad): the true attitude is `object_from_body @ small_rotation(attitude)`.
    """

    kind = "trajectory_knots"
    owner = "knot"
    names = {  # noqa: RUF012
        "position": tuple(f"{axis}_m" for axis in "XYZ"),
        "attitude": tuple(f"{axis}_rad" for axis in ("right", "forward", "up")),
    }

    position: Float[Array, "3"]
    attitude: Float[Array, "3"]


def knot_name(strip: str, time: float) -> str:
    """What the knot of a strip at a time (s) is called."""
    return f"{strip}{_AT}{time:.3f} s"


def strip_of_knot(name: str) -> str:
    """The strip of a knot by its name."""
    return name.rpartition(_AT)[0]


class StripSpline(NamedTuple):
    """The knots of a strip, numbered from `first` among those of all strips; one knot alone is a constant."""

    first: int
    size: int
    start: float
    """Seconds."""
    interval: float

    @classmethod
    def over(cls, first: int, start: float, end: float, apart: float) -> "StripSpline":
        """Knots about `apart` (s), evenly over a strip from `start` to `end`."""
        pieces = max(1, round((end - start) / apart))
        return cls(first, pieces + 3, start, max(end - start, 1e-9) / pieces)

    @classmethod
    def constant(cls, first: int) -> "StripSpline":
        """What a strip is off by at all times."""
        return cls(first, 1, 0.0, 1.0)

    @property
    def times(self) -> Float[np.ndarray, "size"]:
        """Where each coefficient weighs most (s)."""
        return self.start + (np.arange(self.size) - (self.size > 1)) * self.interval

    def weights(self, time: Float[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
        """The knots that make up the correction at each time, and by how much; before and after as at the ends."""
        n = len(time)
        if self.size == 1:
            return np.full((n, 4), self.first), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        gone = np.clip((np.asarray(time) - self.start) / self.interval, 0.0, self.size - 3)
        piece = np.minimum(gone.astype(int), self.size - 4)
        u = gone - piece
        return self.first + piece[:, None] + np.arange(4), np.column_stack(_cubic(u))

    def all_weights(
        self, time: Float[np.ndarray, "n"]
    ) -> tuple[Int[np.ndarray, "n size"], Float[np.ndarray, "n size"]]:
        """The same of all knots of the strip, most of which weigh nothing."""
        knots, weights = self.weights(time)
        every = np.zeros((len(knots), self.size))
        np.add.at(every, (np.arange(len(knots))[:, None], knots - self.first), weights)
        return np.tile(self.first + np.arange(self.size), (len(knots), 1)), every


class SplineKnots(NamedTuple):
    """The spline of a strip with its coefficients, for what is compiled; a knot more costs no new program."""

    first: Int[Numbers, ""]
    """Of the knots of all strips that of this one."""
    size: Int[Numbers, ""]
    start: Float[Numbers, ""]
    interval: Float[Numbers, ""]
    knots: Float[Numbers, "knots k"]

    def at(self, time: Float[Array, "n"]) -> Float[Array, "n k"]:
        """`StripSpline.weights`, and with them the correction at each time (s)."""
        gone = jnp.clip((time - self.start) / self.interval, 0.0, jnp.maximum(self.size - 3, 0))
        piece = jnp.minimum(gone.astype(int), jnp.maximum(self.size - 4, 0))
        # The weights sum up to 1: of one knot alone all four are that one.
        index = (self.first + jnp.minimum(piece + k, self.size - 1) for k in range(4))
        parts = zip(_cubic(gone - piece), index, strict=True)
        return sum(w[:, None] * self.knots[k] for w, k in parts)  # type: ignore[return-value, misc]


def _cubic(u: Float[Numbers, "n"]) -> list[Float[Numbers, "n"]]:
    """The weights of four coefficients, `u` of an interval gone."""
    weights = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3
    return [w / 6 for w in weights]


def weighted_knot(knots: TrajectoryKnot, weights: Float[Numbers, "knots"]) -> TrajectoryKnot:
    """The correction that four knots (leading axis) make up."""
    return jax.tree.map(lambda v: sum(weights[k] * v[k] for k in range(len(weights))), knots)
