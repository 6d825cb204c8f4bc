"""Strip points: tie points of images on planes measured by a laser strip."""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import Scanner, ScannerCalibration, TrajectoryKnot, weighted_knot
from jaxphoto.observations.base import AbstractObservations, index_of
from jaxphoto.observations.on_trajectory import NORMAL, knot_columns, normal_flaws, pose_columns, weight_flaws
from jaxphoto.observations.strip_planes import return_at


class StripPoints(AbstractObservations):
    """Object points on the plane of the surrounding returns of one strip, after correction of the returns.

        normal . (X - F') = rise

    with standard deviation `sigma` (m). `foot` F (m) is a point on the plane as measured by the strip; `scanner` and
    `roll_pitch_yaw` the pose of the scanner at that time, from the trajectory; `velocity` (m/s) and `rate` (rad/s,
    about the body axes) its motion. `knots` and `weights` define the trajectory error at that time
    (`georeferencing.StripSpline.weights`), and F' is `georeferencing.corrected_return`. `rise` is the observation:
    zero, unless an error is simulated.
    """

    group = "strip_points"
    unit = "m"
    axes = ("normal",)
    block_parameters = ("scanner", "scanner_calibration")
    observed = "rise"
    columns = knot_columns() | pose_columns("foot") | NORMAL | {"rise": ()}

    point: Int[np.ndarray, "n"] = index_of("point")
    knots: Int[np.ndarray, "n 4"] = index_of("trajectory_knots")
    weights: Float[ArrayLike, "n 4"]
    foot: Float[ArrayLike, "n 3"]
    scanner: Float[ArrayLike, "n 3"]
    roll_pitch_yaw: Float[ArrayLike, "n 3"]
    velocity: Float[ArrayLike, "n 3"]
    rate: Float[ArrayLike, "n 3"]
    normal: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n"]
    rise: Float[ArrayLike, "n"]

    def residual(
        self,
        point: Float[Array, "3"],
        knots: TrajectoryKnot,
        scanner: Scanner | None,
        calibration: ScannerCalibration | None,
    ) -> Float[ArrayLike, ""]:
        """Return the distance of the plane above the point (m), along its normal."""
        off = weighted_knot(knots, self.weights)
        pose = self.scanner, self.roll_pitch_yaw, self.velocity, self.rate
        foot = return_at(self.foot, *pose, off, scanner, calibration)
        return self.rise - jnp.sum(self.normal * (point - foot))

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for invalid weights and normals."""
        yield from weight_flaws(self.weights)
        yield from normal_flaws(self.normal)

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "point 12 on its plane of a strip"."""
        return np.array([f"point {points[p]} on its plane of a strip" for p in self.point], object)
