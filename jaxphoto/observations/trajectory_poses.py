"""Poses of exposures on the trajectory of a laser scanner, with common errors.

GNSS and IMU observations of an exposure contain the errors dp and da of the trajectory at that time (interpolated from
`georeferencing.TrajectoryKnot`), plus small independent noise:

    p = X + R l + dp + noise,    R_p S(da) = R + noise

with the projection centre X, the lever arm l and the attitude R of the body, which follows from the camera attitude and
the boresight (`georeferencing.sensor_position`, `recorded_attitude`). Laser returns at that time have the same dp and
da (`observations.strip_planes`). Source: Glira, Pfeifer and Mandlburger (2019), Hybrid orientation of airborne lidar
point clouds and aerial images.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.georeferencing import TrajectoryKnot, attitude_residual, recorded_attitude, weighted_knot
from jaxphoto.observations.attitudes import ATTITUDE_AXES
from jaxphoto.observations.base import AXES, AbstractCoordinates, AbstractObservations, ImageState, index_of
from jaxphoto.observations.on_trajectory import knot_columns, weight_flaws
from jaxphoto.observations.stations import station_of
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, small_rotation


class TrajectoryStations(AbstractCoordinates):
    """Coordinates of the trajectory at the exposure of image `who`: `axis` (0, 1, 2), `value` and `sigma` (m).

    `knots` and `weights` define the trajectory error at that time (`georeferencing.StripSpline.weights`); `sigma` is
    the standard deviation of the remaining noise.
    """

    group = "trajectory_stations"
    unit = "m"
    columns = knot_columns() | {"who": "image"}

    who: Int[np.ndarray, "n"] = index_of("image")
    knots: Int[np.ndarray, "n 4"] = index_of("trajectory_knots")
    weights: Float[ArrayLike, "n 4"]
    axis: Int[np.ndarray, "n"]
    value: Float[ArrayLike, "n"]
    sigma: Float[ArrayLike, "n"]

    def residual(self, image: ImageState, knots: TrajectoryKnot) -> Float[ArrayLike, ""]:
        """Return observed minus computed (m)."""
        off = weighted_knot(knots, self.weights)
        return self.value - (station_of(image) + off.position)[self.axis]

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for invalid weights and axes."""
        yield from weight_flaws(self.weights)
        for row in np.flatnonzero(~np.isin(self.axis, (0, 1, 2))):
            yield int(row), f"axis is {self.axis[row]}; it is 0, 1 or 2, for X, Y or Z"

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "trajectory at image 12 in Z"."""
        rows = zip(self.who, self.axis, strict=True)
        return np.array([f"trajectory at image {images[i]} in {AXES[a]}" for i, a in rows], object)


class TrajectoryAttitudes(AbstractObservations):
    """Roll, pitch and yaw (rad) of the trajectory at the exposure of `image`; otherwise like `TrajectoryStations`."""

    group = "trajectory_attitudes"
    unit = "rad"
    axes = ATTITUDE_AXES
    observed = "roll_pitch_yaw"
    columns = knot_columns() | {"roll_pitch_yaw": tuple(f"{axis}_deg" for axis in ATTITUDE_AXES)}

    image: Int[np.ndarray, "n"] = index_of("image")
    knots: Int[np.ndarray, "n 4"] = index_of("trajectory_knots")
    weights: Float[ArrayLike, "n 4"]
    roll_pitch_yaw: Float[ArrayLike, "n 3"]
    sigma: Float[ArrayLike, "n 3"]

    def residual(self, image: ImageState, knots: TrajectoryKnot) -> Float[Array, "3"]:
        """Return observed minus computed as a small rotation (rad); see `georeferencing.attitude_residual`."""
        off = weighted_knot(knots, self.weights)
        observed = matrix_from_roll_pitch_yaw(jnp.asarray(self.roll_pitch_yaw))
        computed = recorded_attitude(image.camera_from_object, image.mount, image.exposure)
        return attitude_residual(jnp.matmul(observed, small_rotation(off.attitude)), computed)

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for invalid weights."""
        return weight_flaws(self.weights)

    def words(self, images, points) -> np.ndarray:
        """Return labels such as "roll of the trajectory at image 12"."""
        return np.array(
            [[f"{axis} of the trajectory at image {images[i]}" for i in self.image] for axis in self.axes], object
        )
