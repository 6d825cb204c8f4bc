"""Camera calibration from photographs of a board with known targets."""

from jaxphoto.procedures.calibration.start import (
    CAMERA,
    Board,
    Detection,
    TargetRows,
    calibration_block,
    distortion_model,
    free_parameters,
    reprojection_residuals,
    rms_px,
)
from jaxphoto.procedures.calibration.target_calibration import Calibration, calibrate, eccentricity, interior_covariance

__all__ = [
    "CAMERA", "Board", "Calibration", "Detection", "TargetRows", "calibrate", "calibration_block",
    "distortion_model", "eccentricity", "free_parameters", "interior_covariance", "reprojection_residuals", "rms_px",
]  # fmt: skip
