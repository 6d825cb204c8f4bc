"""Surfaces: points observed to lie on a surface measured by a laser scanner."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import Scanner
from jaxphoto.observations.base import AbstractObservations, index_of


class SurfaceRows(AbstractObservations):
    """Points observed to lie on a surface measured by a laser scanner, on the tangent plane through `foot` (m).

        normal . (X - foot + shift) + turn . boresight = rise

    with standard deviation `sigma` (m). Shift of the lidar strip and boresight are from `Unknowns.scanner`, if the
    block has one. `turn` (m/rad) is the rise of `foot` along `normal` per unit of boresight
    (`georeferencing.raised_by_boresight`). `rise` is the observation: zero, unless an error is simulated.
    """

    group = "surfaces"
    unit = "m"
    axes = ("normal",)
    block_parameters = ("scanner",)
    observed = "rise"
    columns = {  # noqa: RUF012
        "foot": ("foot_X_m", "foot_Y_m", "foot_Z_m"),
        "normal": ("normal_X", "normal_Y", "normal_Z"),
        "turn": ("turn_right_m", "turn_forward_m", "turn_up_m"),
        "rise": (),
    }

    point: Int[np.ndarray, "n"] = index_of("point")
    strip: Int[np.ndarray, "n"]
    """Index in `Unknowns.scanner.shifts`; 0 in a block without a scanner."""
    foot: Float[ArrayLike, "n 3"]
    normal: Float[ArrayLike, "n 3"]
    turn: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n"]
    rise: Float[ArrayLike, "n"]

    def __init__(self, point, strip, foot, normal, turn, sigma, rise=None):
        self.point, self.strip = np.asarray(point), strip
        self.foot, self.normal, self.turn, self.sigma = foot, normal, turn, sigma
        self.rise = np.zeros(np.shape(sigma)) if rise is None else rise

    def residual(self, point: Float[Array, "3"], scanner: Scanner | None) -> Float[ArrayLike, ""]:
        """Return the distance of the surface above the point (m), along its normal."""
        apart, rise = point - self.foot, jnp.zeros(())
        if scanner is not None:
            shifts = list(scanner.shifts.values())
            apart = apart + jnp.stack(shifts)[self.strip] if shifts else apart
            rise = jnp.sum(scanner.boresight * self.turn)
        return self.rise - (jnp.sum(self.normal * apart) + rise)

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "point 12 on its surface"."""
        return np.array([f"point {points[p]} on its surface" for p in self.point], object)
