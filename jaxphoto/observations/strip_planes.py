"""Strip planes: what two laser strips measured of one plane."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import Numbers
from jaxphoto.georeferencing import Scanner, ScannerCalibration, TrajectoryKnot, corrected_return, weighted_knot
from jaxphoto.observations.base import AbstractObservations, touching
from jaxphoto.observations.on_trajectory import NORMAL, knot_columns, normal_flaws, pose_columns, weight_flaws
from jaxphoto.rotation import matrix_from_roll_pitch_yaw


def return_at(
    point: Any,
    position: Any,
    roll_pitch_yaw: Any,
    velocity: Any,
    rate: Any,
    off: TrajectoryKnot,
    scanner: Scanner | None,
    calibration: ScannerCalibration | None,
) -> Float[Array, "3"]:
    """`georeferencing.corrected_return` of a place as a strip has it (m), seen from a scanner's pose that is `off`."""
    boresight = jnp.zeros(3) if scanner is None else scanner.boresight
    known = ScannerCalibration(jnp.zeros(3)) if calibration is None else calibration
    turn = matrix_from_roll_pitch_yaw(jnp.asarray(roll_pitch_yaw))
    return corrected_return(point, position, turn, velocity, rate, off.position, off.attitude, boresight, known)


class StripPlanes(AbstractObservations):
    """A place of a plane as one strip has it (a) and as another has it (b): corrected, they lie on one plane.

        normal . (X'_a - X'_b) = gap

    with standard deviation `sigma` (m). `point_a` (m) is the place on strip a's plane as measured, `scanner_a` and
    `roll_pitch_yaw_a` the pose of the scanner when it was, by the trajectory, `velocity_a` (m/s) and `rate_a` (rad/s,
    about the body's axes) its motion; `knots_a` and `weights_a` give what that
    is off by (`georeferencing.StripSpline.weights`). X' is `georeferencing.corrected_return`. `gap` is what was
    observed: zero, unless somebody adds an error to it. Without a trajectory a scanner may stand anywhere above.
    """

    group = "strip_planes"
    unit = "m"
    axes = ("normal",)
    also = ("scanner", "scanner_calibration")
    observed = "gap"
    columns = {  # noqa: RUF012
        **knot_columns("_a"),
        **knot_columns("_b"),
        **pose_columns("point", "_a"),
        **pose_columns("point", "_b"),
        **NORMAL,
        "gap": (),
    }

    knots_a: Int[np.ndarray, "n 4"] = touching("trajectory_knots")
    knots_b: Int[np.ndarray, "n 4"] = touching("trajectory_knots")
    weights_a: Float[Numbers, "n 4"]
    weights_b: Float[Numbers, "n 4"]
    point_a: Float[Numbers, "n 3"]
    point_b: Float[Numbers, "n 3"]
    scanner_a: Float[Numbers, "n 3"]
    scanner_b: Float[Numbers, "n 3"]
    roll_pitch_yaw_a: Float[Numbers, "n 3"]
    roll_pitch_yaw_b: Float[Numbers, "n 3"]
    velocity_a: Float[Numbers, "n 3"]
    velocity_b: Float[Numbers, "n 3"]
    rate_a: Float[Numbers, "n 3"]
    rate_b: Float[Numbers, "n 3"]
    normal: Float[Numbers, "n 3"]
    sigma: Float[Numbers, "n"]
    gap: Float[Numbers, "n"]

    def residual(
        self,
        knots_a: TrajectoryKnot,
        knots_b: TrajectoryKnot,
        scanner: Scanner | None,
        calibration: ScannerCalibration | None,
    ) -> Float[Numbers, ""]:
        """By how much a's plane lies below b's (m), along the normal."""
        known = scanner, calibration
        off_a, off_b = weighted_knot(knots_a, self.weights_a), weighted_knot(knots_b, self.weights_b)
        motion_a, motion_b = (self.velocity_a, self.rate_a), (self.velocity_b, self.rate_b)
        a = return_at(self.point_a, self.scanner_a, self.roll_pitch_yaw_a, *motion_a, off_a, *known)
        b = return_at(self.point_b, self.scanner_b, self.roll_pitch_yaw_b, *motion_b, off_b, *known)
        return self.gap - jnp.sum(self.normal * (a - b))

    def flaws(self) -> Iterator[tuple[int, str]]:
        """Weights and normals that are none."""
        yield from weight_flaws(self.weights_a)
        yield from weight_flaws(self.weights_b)
        yield from normal_flaws(self.normal)

    def words(self, images, points) -> np.ndarray:
        """Such as "plane 12 of two strips"."""
        return np.array([f"plane {k + 1} of two strips" for k in range(len(self))], object)
