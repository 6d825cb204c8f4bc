"""Simulated errors of a cloud, and the recorded place of a point that was hit."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.georeferencing import PATTERN_OF, ScannerCalibration, StripErrors, StripSpline, corrected_shot
from jaxphoto.rotation import small_rotation
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.platform_path import Path
from jaxphoto.simulation.scan_plan import ScanPlan, of_strip
from jaxphoto.simulation.streams import stream

_CHUNK = 65_536
# Iterations from a corrected shot to the measured one: each reduces the error by a factor of the errors' size.
_STEPS = 3


def drawn_errors(plan: ScanPlan, paths: list[Path], seed: int) -> StripErrors:
    """Draw the errors of the scanner of `plan`, and those of its trajectory: shifts, and drifts about them.

    Drifts are Gauss-Markov processes (`observations.knot_steps`) from knot to knot.
    """
    splines: list[StripSpline] = []
    position, attitude = [], []
    for path in paths:
        first = sum(s.size for s in splines)
        splines.append(StripSpline.over(first, float(path.node[0]), float(path.node[-1]), plan.knots_s))
        drift = _drift(splines[-1], plan.correlation_s, stream(seed, f"drift of lidar strip {path.strip}"))
        # Linear in the times of the coefficients is linear in time.
        gone = (splines[-1].times - np.mean(path.node[[0, -1]]))[:, None]
        shift = drawn_shift(plan, path.strip, seed) + gone * of_strip(plan.drift_m_per_s, path.strip)
        turn = of_strip(plan.attitude_deg, path.strip) + gone * of_strip(plan.attitude_drift_deg_per_s, path.strip)
        position.append(shift + np.array(plan.drift_sigma_m) * drift[:, :3])
        attitude.append(np.deg2rad(turn + np.array(plan.drift_sigma_deg) * drift[:, 3:]))
    scales = (np.array(v) for v in (plan.range_offset_m, plan.range_scale_ppm, plan.angle_scale_ppm))
    numbers: Any = (
        np.array(plan.lever_arm_m),
        *scales,
        np.deg2rad(plan.eccentricity_deg),
        np.array(plan.time_offset_s),
    )
    calibration = ScannerCalibration(*numbers, PATTERN_OF[plan.pattern])  # type: ignore[call-arg]
    boresight = np.deg2rad(plan.boresight_deg)
    return StripErrors(tuple(splines), np.concatenate(position), np.concatenate(attitude), boresight, calibration)


def drawn_shift(plan: ScanPlan, strip: str, seed: int) -> Float[np.ndarray, "3"]:
    """Draw the shift of a strip (m), about which it drifts."""
    drawn = stream(seed, f"shift of lidar strip {strip}").standard_normal(3)
    return of_strip(plan.shift_m, strip) + np.array(plan.shift_sigma_m) * drawn


def measured_shot(
    in_body: Float[np.ndarray, "n 3"], boresight: Float[np.ndarray, "3"], calibration: ScannerCalibration
) -> Float[np.ndarray, "n 3"]:
    """Return the shots (m) as georeferencing assumes them, from those between trajectory and hit.

    The inverse of `georeferencing.corrected_return` at a trajectory without error.
    """
    true = (in_body + calibration.lever_arm) @ np.asarray(_rotation(boresight))
    shot = true
    if any(np.any(of) for of in jax.tree.leaves(calibration)):
        for _ in range(_STEPS):
            shot = shot + true - in_chunks(lambda s: _corrected(s, calibration), _CHUNK, shot)
    return shot


def turned_by(
    object_from_body: Float[np.ndarray, "n 3 3"], attitude: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Return the attitudes of a trajectory with the error `attitude` (rad)."""
    return object_from_body @ in_chunks(_rotations, _CHUNK, -attitude) if np.any(attitude) else object_from_body


def _drift(spline: StripSpline, correlation_s: float, rng: np.random.Generator) -> Float[np.ndarray, "knots 6"]:
    """Draw six processes of standard deviation 1."""
    noise = rng.standard_normal((spline.size, 6))
    kept = np.exp(-spline.interval / correlation_s)
    for k in range(1, spline.size):
        noise[k] = kept * noise[k - 1] + np.sqrt(1 - kept**2) * noise[k]
    return noise


_rotation = jax.jit(small_rotation)
_rotations = jax.jit(jax.vmap(small_rotation))


@jax.jit
def _corrected(shot: Float[Array, "n 3"], calibration: ScannerCalibration) -> Float[Array, "n 3"]:
    return jax.vmap(corrected_shot, (0, None))(shot, calibration)
