"""Residuals in the measured image, in pixels, and their RMS as OpenCV defines it."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.compiling import call_compiled
from jaxphoto.initial.rays import padded_length
from jaxphoto.procedures.calibration.calibration_block import CAMERA


def reprojection_residuals(adjusted: Adjustment) -> Float[np.ndarray, "rows 2"]:
    """Measured minus projected, (column, row) in pixels, in the order of the block's image points.

    In the measured image whatever the model's own direction: what a distortion in the measured coordinate leaves in the
    ideal image is stretched where the lens compresses.
    """
    block, unknowns = adjusted.block, adjusted.unknowns
    rows = block.image_points
    projected = projections(
        unknowns.interior[CAMERA],
        np.asarray(unknowns.exterior.position)[rows.image],
        np.asarray(unknowns.exterior.camera_from_object)[rows.image],
        np.asarray(unknowns.points)[rows.point],
    )
    pixel = block.sensors[CAMERA].pixel_mm
    return (np.asarray(rows.xy) - projected) / (pixel, -pixel)


def projections(
    interior: InteriorOrientation,
    position: Float[np.ndarray, "rows 3"],
    camera_from_object: Float[np.ndarray, "rows 3 3"],
    point: Float[np.ndarray, "rows 3"],
) -> Float[np.ndarray, "rows 2"]:
    """Measured image coordinates (mm) of one point (m) in one image a row, distortion included."""
    n = len(point)
    some = np.arange(padded_length(n)) % n
    numbers = jax.tree.map(lambda v: np.asarray(v, float), interior)
    return np.asarray(call_compiled(_projected, numbers, position[some], camera_from_object[some], point[some]))[:n]


def rms_px(residuals: Float[np.ndarray, "rows 2"]) -> float:
    """Root mean square over image points, both axes together: sqrt(sum(dx^2 + dy^2) / n), as OpenCV's calibration."""
    return float(np.sqrt(np.mean(np.sum(np.asarray(residuals) ** 2, axis=1)))) if len(residuals) else 0.0


@eqx.filter_jit
def _projected(interior, position, camera_from_object, point):
    one = lambda x, m, p: project(interior, ExteriorOrientation(x, m), p)  # noqa: E731
    return jax.vmap(one)(position, camera_from_object, point)
