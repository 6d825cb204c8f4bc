"""Correction of laser returns for errors of trajectory and scanner.

A point cloud contains the return X; a trajectory contains the position p and attitude R of the scanner at the time of
X. Range and angle of the pulse follow from s = R' (X - p) in the body axes (right, forward, up):

    rho = |s|,    theta = atan2(s_right, -s_up)        from the nadir, about the forward axis

for a scanner with an oscillating or rotating mirror, line by line across track. For circular patterns around the nadir
(Risley prisms or a nutating mirror),

    theta = atan2(h, -s_up), h = hypot(s_right, s_forward)    from the nadir,    alpha = atan2(s_right, s_forward)

Their errors are estimated and removed. With the trajectory errors dp, da at that time (`TrajectoryKnot`), the boresight
b of `Scanner` and `ScannerCalibration`, the return lies at

    X' = p - dp + v dt + R S(da - w dt) (S(b) s' - l),       S = rotation.small_rotation
    s'  is s, of length rho (1 - m) - d, rotated about the forward axis by -(k theta + e1 cos theta + e2 sin theta);
        circular: rotated towards the nadir by k theta, and about it by -(e1 cos alpha + e2 sin alpha)

An encoder offset is equivalent to a boresight about the forward axis (opposite sign), for circular patterns about the
up axis, and is absorbed by the boresight. For two prisms, k is the error of the deflection due to wedge angle or
refractive index. dt is the delay of the scanner clock relative to the trajectory clock: the pose is extrapolated by dt
to first order, with the velocity v and the rotation rate w.

Sources: Skaloud and Lichti (2006), Rigorous approach to bore-sight self-calibration in airborne laser scanning; Glira,
Pfeifer and Mandlburger (2016), Rigorous strip adjustment of UAV-based laserscanning data including time-dependent
correction of trajectory errors. Frames and signs: docs/conventions.md.
"""

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters
from jaxphoto.rotation import rotate, small_rotation

Pattern = Literal["line", "circle"]
"""Scan pattern on the ground: lines across track, or circular figures around the nadir."""
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
_PPM = 1e-6
_AXES = ("right", "forward", "up")


class ScannerCalibration(AbstractParameters):
    """Scanner errors except the boresight, as contained in the point cloud.

    `lever_arm`: correction to the lever arm in use (m: right, forward, up). `range_offset` (m), `range_scale` (ppm):
    errors of measured ranges. `angle_scale` (ppm): scale error of theta. `eccentricity` (rad): cosine and sine terms of
    theta, for the pattern "circle" of alpha. `time_offset` (s): true time of a return on the trajectory clock minus
    recorded time.
    """

    kind = "scanner_calibration"
    owner = "lidar"
    names = {  # noqa: RUF012
        "lever_arm": tuple(f"lever_arm_{axis}_m" for axis in _AXES),
        "range_offset": ("range_offset_m",),
        "range_scale": ("range_scale_ppm",),
        "angle_scale": ("angle_scale_ppm",),
        "eccentricity": ("eccentricity_cos_rad", "eccentricity_sin_rad"),
        "time_offset": ("time_offset_s",),
    }

    lever_arm: Float[Array, "3"]
    range_offset: Float[Array, ""] | float = 0.0
    range_scale: Float[Array, ""] | float = 0.0
    angle_scale: Float[Array, ""] | float = 0.0
    eccentricity: Float[Array, "2"] | tuple[float, float] = (0.0, 0.0)
    time_offset: Float[Array, ""] | float = 0.0
    pattern: Pattern = eqx.field(static=True, default="line")

    def __check_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise ValueError(f"unknown scan pattern {self.pattern!r}; use one of {', '.join(PATTERNS)}")


def corrected_shot(shot: Float[Array, "3"], calibration: ScannerCalibration) -> Float[Array, "3"]:
    """Correct range and angle of the vector from scanner to return (m, in body axes)."""
    distance = jnp.sqrt(jnp.sum(shot**2))
    turned = _turned_across(shot, calibration) if calibration.pattern == "line" else _turned_around(shot, calibration)
    return turned * (1 - _PPM * calibration.range_scale - calibration.range_offset / distance)


def _turned_across(shot: Float[Array, "3"], calibration: ScannerCalibration) -> Float[Array, "3"]:
    """Correct the scan angle of a line pattern."""
    right, forward, up = shot
    angle = jnp.arctan2(right, -up)
    by_cos, by_sin = calibration.eccentricity
    turn = _PPM * calibration.angle_scale * angle + by_cos * jnp.cos(angle) + by_sin * jnp.sin(angle)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return jnp.stack([cos * right + sin * up, forward, cos * up - sin * right])


def _turned_around(shot: Float[Array, "3"], calibration: ScannerCalibration) -> Float[Array, "3"]:
    """Correct both angles of a circular pattern."""
    right, forward, up = shot
    square = right**2 + forward**2
    # Avoid the root at the nadir: it is not differentiable at the horizontal distance zero.
    aside = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    by_cos, by_sin = calibration.eccentricity
    around = (by_cos * forward + by_sin * right) / aside
    turn = _PPM * calibration.angle_scale * jnp.arctan2(jnp.where(square > 0, aside, 0.0), -up)
    nearer = jnp.cos(turn) + jnp.sin(turn) * up / aside
    cos, sin = nearer * jnp.cos(around), nearer * jnp.sin(around)
    return jnp.stack(
        [
            cos * right - sin * forward,
            cos * forward + sin * right,
            jnp.cos(turn) * up - jnp.sin(turn) * jnp.where(square > 0, aside, 0.0),
        ]
    )


def corrected_return(
    point: Float[Array, "3"],
    position: Float[Array, "3"],
    object_from_body: Float[Array, "3 3"],
    velocity: Float[Array, "3"],
    rate: Float[Array, "3"],
    off_position: Float[Array, "3"],
    off_attitude: Float[Array, "3"],
    boresight: Float[Array, "3"],
    calibration: ScannerCalibration,
) -> Float[Array, "3"]:
    """Correct a laser point (m); `position` and `object_from_body`: scanner pose from the trajectory.

    `velocity` (m/s, in the object frame) and `rate` (rad/s, about the body axes): as in `georeferencing.Poses`.
    `off_position` (m) and `off_attitude` (rad): trajectory errors at the time of the point.
    """
    shot = corrected_shot(rotate(object_from_body.T, point - position), calibration)
    in_body = rotate(small_rotation(boresight), shot) - calibration.lever_arm
    later = calibration.time_offset
    turn = rotate(small_rotation(off_attitude - later * rate), in_body)
    return position - off_position + later * velocity + rotate(object_from_body, turn)
