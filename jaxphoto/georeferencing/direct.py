"""Direct georeferencing: exterior orientation from GNSS/IMU and mount, with its covariance.

Functions take one image. Frames and signs: docs/conventions.md; source: papers 000 and 004, equation (1).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.argument_checks import single
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing.mount import Exposure, Mount, StripBias, body_from_camera, nominal_mount, sensor_position
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, small_angles, small_rotation


class SensorCovariance(eqx.Module):
    """Covariances of the inputs of direct georeferencing, mutually independent."""

    station: Float[Array, "3 3"]
    """Covariance of the GNSS position (m^2)."""
    attitude: Float[Array, "3 3"]
    """Covariance of roll, pitch and yaw (rad^2)."""
    mount: Float[Array, "7 7"]
    """Covariance of lever arm (m), boresight (rad) and time offset (s), in this order; zeros for an error-free mount.
    """


def direct_orientation(
    station: Float[Array, "3"],
    roll_pitch_yaw: Float[Array, "3"],
    mount: Mount,
    bias: StripBias,
    exposure: Exposure,
) -> ExteriorOrientation:
    """Return the exterior orientation from the GNSS position (m) and the attitude (rad) at the recorded time.

    X = GNSS - R l - shift - drift (t - t0) + v tau, the attitude rotated by rate tau and then by the boresight (papers
    000 and 004, equation (1)).
    """
    station, roll_pitch_yaw = single("station", station, 3), single("roll_pitch_yaw", roll_pitch_yaw, 3)
    turned = matrix_from_roll_pitch_yaw(roll_pitch_yaw) @ small_rotation(exposure.rate * mount.time_offset).T
    camera_from_object = (turned @ body_from_camera(mount.boresight, nominal_mount(mount, exposure))).T
    origin = sensor_position(jnp.zeros(3), camera_from_object, mount, bias, exposure)
    return ExteriorOrientation(station - origin, camera_from_object)


class DirectPartials(NamedTuple):
    """Derivatives of X, Y, Z (m) and of a small rotation in the camera frame (rad) with respect to the inputs."""

    station: Float[Array, "6 3"]
    attitude: Float[Array, "6 3"]
    mount: Float[Array, "6 7"]
    """Derivatives with respect to lever arm (m), boresight (rad) and time offset (s), in this order."""


def direct_partials(
    station: Float[Array, "3"],
    roll_pitch_yaw: Float[Array, "3"],
    mount: Mount,
    bias: StripBias,
    exposure: Exposure,
) -> DirectPartials:
    """Differentiate the result of `direct_orientation` with respect to its arguments."""
    at = direct_orientation(station, roll_pitch_yaw, mount, bias, exposure)

    def moved(d_station, d_attitude, d_mount):
        changed = mount.lever_arm + d_mount[:3], mount.boresight + d_mount[3:6], mount.time_offset + d_mount[6]
        m = Mount(*changed, mount.image_x)
        new = direct_orientation(station + d_station, roll_pitch_yaw + d_attitude, m, bias, exposure)
        return jnp.concatenate([new.position, small_angles(new.camera_from_object @ at.camera_from_object.T)])

    return DirectPartials(*jax.jacfwd(moved, argnums=(0, 1, 2))(jnp.zeros(3), jnp.zeros(3), jnp.zeros(7)))


def direct_covariance(
    station: Float[Array, "3"],
    roll_pitch_yaw: Float[Array, "3"],
    mount: Mount,
    bias: StripBias,
    exposure: Exposure,
    covariance: SensorCovariance,
) -> Float[Array, "6 6"]:
    """Return the covariance of `direct_orientation`: X, Y, Z (m) and a small rotation in the camera frame (rad).

    First-order propagation. Images of one mount share its error and are correlated; use `direct_partials` for their
    joint covariance.
    """
    by = direct_partials(station, roll_pitch_yaw, mount, bias, exposure)
    sensors = by.station @ covariance.station @ by.station.T + by.attitude @ covariance.attitude @ by.attitude.T
    return sensors + by.mount @ covariance.mount @ by.mount.T
