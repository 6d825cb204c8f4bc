"""Strip planes: one plane measured by two laser strips."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import Scanner, ScannerCalibration, TrajectoryKnot, corrected_return, weighted_knot
from jaxphoto.observations.base import AbstractObservations, index_of
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
    """Apply `georeferencing.corrected_return` to a point of a strip (m), given the trajectory error `off`."""
    boresight = jnp.zeros(3) if scanner is None else scanner.boresight
    known = ScannerCalibration(jnp.zeros(3)) if calibration is None else calibration
    turn = matrix_from_roll_pitch_yaw(jnp.asarray(roll_pitch_yaw))
    return corrected_return(point, position, turn, velocity, rate, off.position, off.attitude, boresight, known)


class StripPlanes(AbstractObservations):
    """Point of a plane measured by strip a and by strip b: after correction, both lie on one plane.

        normal . (X'_a - X'_b) = gap

    with standard deviation `sigma` (m). `point_a` (m) is the measured point on the plane of strip a; `scanner_a` and
    `roll_pitch_yaw_a` the pose of the scanner at that time, from the trajectory; `velocity_a` (m/s) and `rate_a`
    (rad/s, about the body axes) its motion. `knots_a` and `weights_a` define the trajectory error at that time
    (`georeferencing.StripSpline.weights`). X' is `georeferencing.corrected_return`. `gap` is the observation: zero,
    unless an error is simulated. Without a trajectory the scanner position above is arbitrary.
    """

    group = "strip_planes"
    unit = "m"
    axes = ("normal",)
    block_parameters = ("scanner", "scanner_calibration")
    observed = "gap"
    columns = {  # noqa: RUF012
        **knot_columns("_a"),
        **knot_columns("_b"),
        **pose_columns("point", "_a"),
        **pose_columns("point", "_b"),
        **NORMAL,
        "gap": (),
    }

    knots_a: Int[np.ndarray, "n 4"] = index_of("trajectory_knots")
    knots_b: Int[np.ndarray, "n 4"] = index_of("trajectory_knots")
    weights_a: Float[ArrayLike, "n 4"]
    weights_b: Float[ArrayLike, "n 4"]
    point_a: Float[ArrayLike, "n 3"]
    point_b: Float[ArrayLike, "n 3"]
    scanner_a: Float[ArrayLike, "n 3"]
    scanner_b: Float[ArrayLike, "n 3"]
    roll_pitch_yaw_a: Float[ArrayLike, "n 3"]
    roll_pitch_yaw_b: Float[ArrayLike, "n 3"]
    velocity_a: Float[ArrayLike, "n 3"]
    velocity_b: Float[ArrayLike, "n 3"]
    rate_a: Float[ArrayLike, "n 3"]
    rate_b: Float[ArrayLike, "n 3"]
    normal: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n"]
    gap: Float[ArrayLike, "n"]

    def residual(
        self,
        knots_a: TrajectoryKnot,
        knots_b: TrajectoryKnot,
        scanner: Scanner | None,
        calibration: ScannerCalibration | None,
    ) -> Float[ArrayLike, ""]:
        """Return the distance of the plane of b above the plane of a (m), along the normal."""
        known = scanner, calibration
        off_a, off_b = weighted_knot(knots_a, self.weights_a), weighted_knot(knots_b, self.weights_b)
        motion_a, motion_b = (self.velocity_a, self.rate_a), (self.velocity_b, self.rate_b)
        a = return_at(self.point_a, self.scanner_a, self.roll_pitch_yaw_a, *motion_a, off_a, *known)
        b = return_at(self.point_b, self.scanner_b, self.roll_pitch_yaw_b, *motion_b, off_b, *known)
        return self.gap - jnp.sum(self.normal * (a - b))

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for invalid weights and normals."""
        yield from weight_flaws(self.weights_a)
        yield from weight_flaws(self.weights_b)
        yield from normal_flaws(self.normal)

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "plane 12 of two strips"."""
        return np.array([f"plane {k + 1} of two strips" for k in range(len(self))], object)
