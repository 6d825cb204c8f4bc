"""Lever arm offset by equation (1) of paper 004, its approximation (2)-(4), and the error of the approximation.

The arm of papers 000 and 004 runs from the sensor to the camera; `Mount.lever_arm` runs from the camera to the sensor.
`arm_to_camera` converts between them. Both are in the body axes right, forward, up (m). Functions take one image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.georeferencing.mount import Mount
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, rotate


def arm_to_camera(mount: Mount) -> Float[Array, "3"]:
    """Return (dX, dY, dZ) of papers 000 and 004, Table 1 (m): the camera relative to the sensor."""
    return -jnp.asarray(mount.lever_arm)


def exact_offset(arm: Float[Array, "3"], roll_pitch_yaw: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return camera minus sensor in the object frame (m): R(roll, pitch, yaw) (dX, dY, dZ)'.

    `arm` runs from the sensor to the camera. Source: paper 004, equation (1).
    """
    return rotate(matrix_from_roll_pitch_yaw(roll_pitch_yaw), arm)


def level_offset(arm: Float[Array, "3"], azimuth: Float[Array, ""]) -> Float[Array, "3"]:
    """Return camera minus sensor (m) for level flight, from the azimuth alone (rad, clockwise from north).

        X = d sin(azimuth + atan2(dX, dY)),  Y = d cos(azimuth + atan2(dX, dY)),  Z = dZ,  d^2 = dX^2 + dY^2

    `arm` runs from the sensor to the camera. Source: paper 004, equations (2)-(4), whose arctan(dX / dY) is wrong for
    dY < 0. Computed by the addition theorem, which is also valid and differentiable for dX = dY = 0.
    """
    right, forward, up = arm
    s, c = jnp.sin(azimuth), jnp.cos(azimuth)
    return jnp.stack([right * c + forward * s, forward * c - right * s, up])


def level_error(arm: Float[Array, "3"], roll: Float[Array, ""], pitch: Float[Array, ""]) -> Float[Array, "3"]:
    """Return `level_offset` minus `exact_offset` (m) at this roll and pitch (rad): right, forward, up.

    Right and forward are relative to the azimuth; the error does not depend on it. To first order the height error is
    dX sin(roll) - dY sin(pitch).
    """
    level = jnp.zeros(())
    return level_offset(arm, level) - exact_offset(arm, jnp.stack([roll, pitch, level]))


def worst_level_error(arm: Float[Array, "3"], tilt: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the maximum horizontal and vertical `level_error` (m) for |roll| = |pitch| = `tilt` (rad)."""
    right, forward, up = jax.vmap(lambda signs: level_error(arm, *(signs * tilt)))(_SIGNS).T
    return jnp.stack([jnp.hypot(right, forward).max(), jnp.abs(up).max()])


_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
