"""Correction of a cloud and its trajectory by the result of a strip adjustment."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.cloud import Cloud
from jaxphoto.compiling import call_compiled
from jaxphoto.georeferencing import StripErrors, Trajectory, corrected_return
from jaxphoto.lidar.correction import ScannerPath, in_portions
from jaxphoto.lidar.coverage import not_covered
from jaxphoto.rotation import matrix_from_quaternion, quaternion_from_matrix, small_rotation


def corrected_strip(
    xyz: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    strip: int,
    errors: StripErrors,
    path: ScannerPath | None,
) -> Float[np.ndarray, "n 3"]:
    """Apply `georeferencing.corrected_return` to returns of one strip; without a path, its constant shift alone.

    Raises BlockError for times (s) that the trajectory does not cover.
    """
    if path is None:
        return xyz - errors.at(strip, time)[0]
    common = path.spline, errors.of_strip(strip), errors.boresight, errors.calibration
    result = in_portions(_corrected, (xyz, time), *common)
    if np.isnan(result[:, 0]).any():
        raise not_covered(path.trajectory, time)
    return result


def correct_strips(cloud: Cloud, errors: StripErrors, path: ScannerPath | None) -> Cloud:
    """Correct a cloud for these errors; all its other fields are kept."""
    xyz = np.array(cloud.xyz)
    for k in range(len(errors.splines)):
        own = np.flatnonzero(cloud.strip == k) if cloud.strip is not None else np.arange(len(cloud))
        if len(own):
            xyz[own] = corrected_strip(cloud.xyz[own], times_of(cloud)[own], k, errors, path)
    return dataclasses.replace(cloud, xyz=xyz)


def correct_flight(trajectory: Trajectory, errors: StripErrors) -> Trajectory:
    """Correct a trajectory; between two strips, by the errors of the strip end closer in time."""
    time = np.asarray(trajectory.time)
    ends = np.array([(s.start, s.start + s.interval * max(s.size - 3, 0)) for s in errors.splines])
    away = np.maximum(ends[:, :1] - time, time - ends[:, 1:])
    nearest = np.argmin(np.maximum(away, 0.0), axis=0)
    off, turn = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    for k in range(len(ends)):
        own = nearest == k
        off[own], turn[own] = errors.at(k, time[own])
    quaternion = call_compiled(_turned, np.asarray(trajectory.quaternion), turn)
    return dataclasses.replace(
        trajectory, position=jnp.asarray(np.asarray(trajectory.position) - off), quaternion=quaternion
    )


def times_of(cloud: Cloud) -> Float[np.ndarray, "n"]:
    """Return the times of the points (s); zero if the cloud has none, as a constant shift needs none."""
    return np.zeros(len(cloud)) if cloud.time is None else cloud.time


@eqx.filter_jit
def _corrected(point, time, spline, errors, boresight, calibration) -> Float[Array, "n 3"]:
    """NaN where the trajectory has no records."""
    position, object_from_body, known = spline.poses(time)
    off, each = errors.at(time), (0, 0, 0, 0, 0, 0, 0, None, None)
    points = point, position, object_from_body, *spline.motions(time), off[:, :3], off[:, 3:], boresight, calibration
    return jnp.where(known[:, None], jax.vmap(corrected_return, each)(*points), jnp.nan)


@eqx.filter_jit
@jax.vmap
def _turned(quaternion: Float[Array, "4"], turn: Float[Array, "3"]) -> Float[Array, "4"]:
    turned = quaternion_from_matrix(jnp.matmul(matrix_from_quaternion(quaternion), small_rotation(turn)))
    return jnp.where(jnp.sum(turned * quaternion) < 0, -turned, turned)
