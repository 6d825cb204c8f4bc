"""Conversions between rotation matrices and omega-phi-kappa, roll-pitch-yaw, quaternions, small rotations.

Frames, signs and units: docs/conventions.md. Angles are in radians; the name of a matrix gives its target and source
frames. Every function takes one rotation and is differentiable where the rotation is.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Matrix between the body axes (right, forward, up) and (forward, right, down), and between ENU and NED: its own
# inverse. In NumPy, because a JAX array would start a device and compile at import.
_RFU_FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

# `CROSS @ v` is [v]x: one product with constants; assembly from components takes a dozen operations.
_UNIT = np.eye(3)
CROSS = np.cross(_UNIT, _UNIT[:, None])


def rotate(matrix: Float[Array, "3 3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return `matrix @ vector`, by component.

    Under `vmap` over the last axis the elementwise operations are several times faster on a CPU than a batch of 3 x 3
    products.
    """
    x, y, z = vector
    return jnp.stack([row[0] * x + row[1] * y + row[2] * z for row in matrix])


def matrix_from_omega_phi_kappa(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return `camera_from_object = R3(kappa) R2(phi) R1(omega)` from (omega, phi, kappa) in radians.

    Source: paper 001, equation (1); the rows are written out in docs/models.md.
    """
    (so, sp, sk), (co, cp, ck) = jnp.sin(angles), jnp.cos(angles)
    return jnp.stack(
        [
            jnp.stack([cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck]),
            jnp.stack([-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk]),
            jnp.stack([sp, -so * cp, co * cp]),
        ]
    )


def omega_phi_kappa_from_matrix(camera_from_object: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return (omega, phi, kappa) in radians of `camera_from_object`; omega and kappa in (-pi, pi], |phi| <= pi/2.

    At phi = +-pi/2 only omega +- kappa is determined: omega and kappa are then one valid pair of many.
    """
    m = camera_from_object
    omega = jnp.arctan2(-m[2, 1], m[2, 2])
    # Use M with omega removed: near phi = 90 degrees omega and atan2(-m10, m00) are both dominated by rounding errors,
    # which are independent, and together would give a different rotation.
    s, c = jnp.sin(omega), jnp.cos(omega)
    kappa = jnp.arctan2(c * m[0, 1] + s * m[0, 2], c * m[1, 1] + s * m[1, 2])
    return jnp.stack([omega, jnp.arctan2(m[2, 0], _norm(m[2, 1], m[2, 2])), kappa])


def matrix_from_roll_pitch_yaw(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return `object_from_body` from (roll, pitch, yaw) in radians; body right-forward-up, object east-north-up.

    Roll is right wing down positive, pitch nose up positive, yaw clockwise from north, in the sequence of airborne
    IMUs, `P Rz(yaw) Ry(pitch) Rx(roll) P`. P converts between the axes right-forward-up and forward-right-down (paper
    000, equations (1)-(4)).
    """
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(angles), jnp.cos(angles)
    ned_from_frd = jnp.stack(
        [
            jnp.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr]),
            jnp.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr]),
            jnp.stack([-sp, cp * sr, cp * cr]),
        ]
    )
    return _RFU_FRD @ ned_from_frd @ _RFU_FRD


def roll_pitch_yaw_from_matrix(object_from_body: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return (roll, pitch, yaw) in radians of `object_from_body`; the inverse of `matrix_from_roll_pitch_yaw`."""
    m = _RFU_FRD @ object_from_body @ _RFU_FRD
    return jnp.stack(
        [
            jnp.arctan2(m[2, 1], m[2, 2]),
            jnp.arctan2(-m[2, 0], _norm(m[2, 1], m[2, 2])),
            jnp.arctan2(m[1, 0], m[0, 0]),
        ]
    )


def matrix_from_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix of the quaternion (w, x, y, z), of any nonzero length."""
    w, x, y, z = quaternion / jnp.sqrt(jnp.sum(quaternion**2))
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]),
            jnp.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]),
            jnp.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]),
        ]
    )


def quaternion_from_matrix(matrix: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    Of the four equivalent formulas the one with the largest divisor is used: no digits are lost near rotations by 180
    degrees.
    """
    m = matrix
    t = jnp.stack([m[0, 0] + m[1, 1] + m[2, 2], m[0, 0], m[1, 1], m[2, 2]])
    rows = jnp.stack(
        [
            jnp.stack([1 + t[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]),
            jnp.stack([m[2, 1] - m[1, 2], 1 + 2 * t[1] - t[0], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]]),
            jnp.stack([m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 + 2 * t[2] - t[0], m[2, 1] + m[1, 2]]),
            jnp.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 + 2 * t[3] - t[0]]),
        ]
    )
    q = rows[jnp.argmax(t)]
    q = q / jnp.sqrt(jnp.sum(q**2))
    return jnp.where(q[0] < 0, -q, q)


def small_rotation(theta: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return `exp(-[theta]x)`, theta in rad: maps V to `V - theta x V` to first order (docs/models.md).

    Exact for any angle, smooth at zero. The adjustment updates rotations by it on the camera side: `camera_from_object
    = small_rotation(theta) @ start`, so phi = 90 degrees is not a singularity.
    """
    t2 = jnp.sum(theta**2)
    # Two `where`: the series replaces 0/0 of the closed form, and neither branch has NaN derivatives.
    small = t2 < 1e-6
    safe = jnp.where(small, 1.0, t2)
    t = jnp.sqrt(safe)
    a = jnp.where(small, 1 - t2 / 6 * (1 - t2 / 20), jnp.sin(t) / t)
    b = jnp.where(small, 0.5 - t2 / 24 * (1 - t2 / 30), (1 - jnp.cos(t)) / safe)
    # [theta]x^2 = theta theta' - theta'theta I.
    return (1 - b * t2) * _UNIT - a * (CROSS @ theta) + b * theta[:, None] * theta


def small_angles(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return the rotation vector theta (rad) of `small_rotation(theta) = matrix`; |theta| < pi."""
    m = matrix
    s = -0.5 * jnp.tensordot(m, CROSS)
    cosine = 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1)
    s2 = jnp.sum(s**2)
    small = (s2 < 1e-6) & (cosine > 0)
    sine = jnp.sqrt(jnp.where(small, 1.0, s2))
    series = 1 + s2 / 6 * (1 + 9 * s2 / 20)
    return s * jnp.where(small, series, jnp.arctan2(sine, cosine) / sine)


def _norm(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    """Return sqrt(a^2 + b^2) with derivative zero, not NaN, at the origin."""
    s = a * a + b * b
    zero = s == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, s)))
