"""Trajectory errors by strip: cubic B-splines of time for position and attitude.

With knots of spacing h from the start of a strip, the correction at time t in interval i is the sum of the four
coefficients c[i] to c[i + 3] with the weights (u: elapsed fraction of the interval)

    [(1 - u)^3, 3 u^3 - 6 u^2 + 4, -3 u^3 + 3 u^2 + 3 u + 1, u^3] / 6

Source: de Boor, A practical guide to splines. `observations.PositionSteps` regularises the coefficients.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.parameters import AbstractParameters

# Separator of strip and time in the name of a knot.
_AT = " at "


class TrajectoryKnot(AbstractParameters):
    """One spline coefficient of a strip.

    `position`: position error (m, in the object frame). `attitude`: small rotation about the body's right, forward and
    up axes (rad); the true attitude is `object_from_body @ small_rotation(attitude)`.
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
    """Return the name of the knot of a strip at a time (s)."""
    return f"{strip}{_AT}{time:.3f} s"


def strip_of_knot(name: str) -> str:
    """Extract the strip from the name of a knot."""
    return name.rpartition(_AT)[0]


class StripSpline(NamedTuple):
    """Knots of a strip; `first` is the index of its first knot among all knots. A single knot is a constant."""

    first: int
    size: int
    start: float
    """Start time (s)."""
    interval: float

    @classmethod
    def over(cls, first: int, start: float, end: float, apart: float) -> "StripSpline":
        """Create equidistant knots with a spacing of about `apart` (s) over a strip from `start` to `end`."""
        pieces = max(1, round((end - start) / apart))
        return cls(first, pieces + 3, start, max(end - start, 1e-9) / pieces)

    @classmethod
    def constant(cls, first: int) -> "StripSpline":
        """Create a spline with a single knot: a constant trajectory error."""
        return cls(first, 1, 0.0, 1.0)

    @property
    def times(self) -> Float[np.ndarray, "size"]:
        """Return the time of the largest weight of each coefficient (s)."""
        return self.start + (np.arange(self.size) - (self.size > 1)) * self.interval

    def weights(self, time: Float[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
        """Return indices and weights of the knots at each time; outside the strip, of its nearest end."""
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
        """Return all knots of the strip with their weights at each time; most weights are zero."""
        knots, weights = self.weights(time)
        every = np.zeros((len(knots), self.size))
        np.add.at(every, (np.arange(len(knots))[:, None], knots - self.first), weights)
        return np.tile(self.first + np.arange(self.size), (len(knots), 1)), every


class SplineKnots(NamedTuple):
    """Spline of a strip with its coefficients as arrays: compiled programs are reused for other numbers of knots."""

    first: Int[ArrayLike, ""]
    """Index of its first knot among all knots."""
    size: Int[ArrayLike, ""]
    start: Float[ArrayLike, ""]
    interval: Float[ArrayLike, ""]
    knots: Float[ArrayLike, "knots k"]

    def at(self, time: Float[Array, "n"]) -> Float[Array, "n k"]:
        """Evaluate the correction at each time (s), as by `StripSpline.weights`."""
        gone = jnp.clip((time - self.start) / self.interval, 0.0, jnp.maximum(self.size - 3, 0))
        piece = jnp.minimum(gone.astype(int), jnp.maximum(self.size - 4, 0))
        # For a single knot all four indices refer to it; the weights sum to 1.
        index = (self.first + jnp.minimum(piece + k, self.size - 1) for k in range(4))
        parts = zip(_cubic(gone - piece), index, strict=True)
        return sum(w[:, None] * self.knots[k] for w, k in parts)  # type: ignore[return-value, misc]


def _cubic(u: Float[ArrayLike, "n"]) -> list[Float[ArrayLike, "n"]]:
    """Return the weights of the four coefficients at the fraction `u` of an interval."""
    weights = (1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3
    return [w / 6 for w in weights]


def weighted_knot(knots: TrajectoryKnot, weights: Float[ArrayLike, "knots"]) -> TrajectoryKnot:
    """Compute the weighted sum of knots (leading axis)."""
    return jax.tree.map(lambda v: sum(weights[k] * v[k] for k in range(len(weights))), knots)
