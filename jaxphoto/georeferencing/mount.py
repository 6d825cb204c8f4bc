"""Mount of a camera relative to the GNSS/IMU: lever arm, boresight, time offset; shift and drift of the positions.

Functions take one image. Frames and signs: docs/conventions.md; source: paper 000, equations (1)-(4), paper 003.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.gnss_bias import StripBias
from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_angles, small_rotation
from jaxphoto.short_repr import pretty_repr

ImageX = Literal["forward", "left", "back", "right"]
"""Direction of the camera's x axis in the body."""
# Columns: camera axes x, y and z in the body axes right, forward, up; z is always up (docs/models.md).
NOMINAL: dict[str, np.ndarray] = {
    "forward": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "left": np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    "back": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "right": np.eye(3),
}
IMAGE_X = tuple(NOMINAL)


class Mount(AbstractParameters):
    """Position, orientation and time offset of a camera relative to the GNSS/IMU.

    `lever_arm` from the projection centre to the GNSS/IMU reference (m: right, forward, up), `boresight` as a small
    rotation in the camera frame (rad), `time_offset` of the true exposure after the recorded one (s). `image_x` is the
    nominal mount: the direction of the camera's x axis.
    """

    kind = "mounts"
    owner = "mount"
    names = {  # noqa: RUF012
        "lever_arm": tuple(f"lever_arm_{axis}_m" for axis in ("right", "forward", "up")),
        "boresight": tuple(f"boresight_{axis}_rad" for axis in "xyz"),
        "time_offset": ("time_offset_s",),
    }

    lever_arm: Float[Array, "3 *images"]
    boresight: Float[Array, "3 *images"]
    time_offset: Float[Array, "*images"] | float = 0.0
    image_x: ImageX = eqx.field(static=True, default="forward")

    def __check_init__(self) -> None:
        if self.image_x not in NOMINAL:
            raise ValueError(f"unknown image_x {self.image_x!r}; use one of {', '.join(IMAGE_X)}")

    @property
    def nominal(self) -> Float[np.ndarray, "3 3"]:
        """Return `body_from_camera` without misalignment."""
        return NOMINAL[self.image_x]


@pretty_repr
class Exposure(eqx.Module):
    """Unobserved properties of an exposure; arrays of exposures have a leading (in an adjustment: last) axis.

    `time` from the strip's reference time (s), `velocity` of the GNSS/IMU in the object frame (m/s), rotation `rate`
    about the body's right, forward and up axes (rad/s). Velocity and rate are needed for a time offset, and for a delay
    in a rig. `nominal` is the `Mount.nominal` of each exposure, needed only if mounts with different `image_x` are
    stacked. `flight_time` is the time from the middle of the flight (s), for changes between strips; None: equal to
    `time`. `height` is the height of the camera's format (mm), for a rolling shutter. `temperature` is the temperature
    of the camera above the reference of its block (K).
    """

    time: Float[Array, "*images"] | float
    velocity: Float[Array, "*images 3"] | Float[Array, "3 *images"]
    rate: Float[Array, "*images 3"] | Float[Array, "3 *images"]
    nominal: Float[Array, "*images 3 3"] | Float[Array, "3 3 *images"] | None = None
    flight_time: Float[Array, "*images"] | float | None = None
    height: Float[Array, "*images"] | float | None = None
    temperature: Float[Array, "*images"] | float | None = None

    @property
    def in_flight(self) -> Float[Array, "*images"] | float:
        """Return the time from the middle of the flight (s)."""
        return self.time if self.flight_time is None else self.flight_time


def nominal_mount(mount: Mount, exposure: Exposure) -> Float[ArrayLike, "3 3"]:
    """Return `body_from_camera` without misalignment: from the exposure if given, else from the mount.

    Raises InputError (under `jit` an Equinox error) if a mount other than "forward" contradicts the exposure.
    """
    if exposure.nominal is None or mount.image_x == "forward":
        return mount.nominal if exposure.nominal is None else exposure.nominal
    differ = jnp.any(jnp.asarray(exposure.nominal) != mount.nominal)
    message = (
        f"image_x = {mount.image_x!r} of the mount contradicts the nominal mount of the exposure; omit "
        "Exposure.nominal, or set it to Mount.nominal"
    )
    if not isinstance(differ, jax.core.Tracer) and differ:
        raise InputError(message)
    return eqx.error_if(jnp.asarray(exposure.nominal), differ, message)


def body_from_camera(boresight: Float[Array, "3"], nominal: Float[ArrayLike, "3 3"]) -> Float[Array, "3 3"]:
    """Multiply the nominal mount by the misalignment (small rotation in the camera frame, rad)."""
    return jnp.matmul(nominal, small_rotation(boresight))


def object_from_body(
    camera_from_object: Float[Array, "3 3"], boresight: Float[Array, "3"], nominal: Float[ArrayLike, "3 3"]
) -> Float[Array, "3 3"]:
    """Compute the attitude of the body from the orientation of the camera and the boresight misalignment."""
    return camera_from_object.T @ body_from_camera(boresight, nominal).T


def sensor_position(
    position: Float[Array, "3"],
    camera_from_object: Float[Array, "3 3"],
    mount: Mount,
    bias: StripBias,
    exposure: Exposure,
) -> Float[Array, "3"]:
    """Return the predicted GNSS observation (m) at the recorded time: X + R l + shift + drift (t - t0) - v tau.

    tau is the mount's time offset. Source: paper 000, equation (1).
    """
    arm = rotate(object_from_body(camera_from_object, mount.boresight, nominal_mount(mount, exposure)), mount.lever_arm)
    return position + arm + bias.shift + bias.drift * exposure.time - exposure.velocity * mount.time_offset


def recorded_attitude(camera_from_object: Float[Array, "3 3"], mount: Mount, exposure: Exposure) -> Float[Array, "3 3"]:
    """Return `object_from_body` at the recorded time, tau before the exposure: rotated back by `rate * tau`."""
    body = object_from_body(camera_from_object, mount.boresight, nominal_mount(mount, exposure))
    return body @ small_rotation(exposure.rate * mount.time_offset)


def attitude_residual(
    observed_object_from_body: Float[Array, "3 3"], computed_object_from_body: Float[Array, "3 3"]
) -> Float[Array, "3"]:
    """Return observed minus computed attitude as a small rotation about (forward, right, down), in rad.

    These are the axes of roll, pitch and yaw: near level flight, each component is the residual of one angle.
    """
    right, forward, up = -small_angles(computed_object_from_body.T @ observed_object_from_body)
    return jnp.stack([forward, right, -up])
