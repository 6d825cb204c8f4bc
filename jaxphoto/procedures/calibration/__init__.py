"""Calibration of a camera from photographs of a board with known targets."""

from jaxphoto.procedures.calibration.board import Board, Detection
from jaxphoto.procedures.calibration.calibrated_precision import interior_covariance
from jaxphoto.procedures.calibration.calibration_block import CAMERA, TargetRows, calibration_block
from jaxphoto.procedures.calibration.eccentricity import eccentricity
from jaxphoto.procedures.calibration.parameters import distortion_model, free_parameters
from jaxphoto.procedures.calibration.reprojection import reprojection_residuals, rms_px
from jaxphoto.procedures.calibration.rounds import Calibration, calibrate

__all__ = [
    "CAMERA", "Board", "Calibration", "Detection", "TargetRows", "calibrate", "calibration_block",
    "distortion_model", "eccentricity", "free_parameters", "interior_covariance", "reprojection_residuals", "rms_px",
]  # fmt: skip
