"""Georeferencing: trajectory, mount (lever arm, boresight, time offset), shift and drift, corrections, map frames."""

from jaxphoto.georeferencing.corrections import Corrections, apparent_point, refraction_constant
from jaxphoto.georeferencing.direct import (
    DirectPartials,
    SensorCovariance,
    direct_covariance,
    direct_orientation,
    direct_partials,
)
from jaxphoto.georeferencing.gnss_bias import FlightBias
from jaxphoto.georeferencing.ground import Surface, ground_point
from jaxphoto.georeferencing.lever_arm import (
    arm_to_camera,
    exact_offset,
    level_error,
    level_offset,
    worst_level_error,
)
from jaxphoto.georeferencing.mount import (
    IMAGE_X,
    NOMINAL,
    Exposure,
    Mount,
    StripBias,
    attitude_residual,
    body_from_camera,
    object_from_body,
    recorded_attitude,
    sensor_position,
)
from jaxphoto.georeferencing.rig import RigCamera, in_rig, reference_later, rig_place, rig_turn, turn_off
from jaxphoto.georeferencing.scan_strip_errors import StripErrors
from jaxphoto.georeferencing.scanner import Scanner, corrected_point, raised_by_boresight
from jaxphoto.georeferencing.scanner_calibration import (
    PATTERNS,
    Pattern,
    ScannerCalibration,
    corrected_return,
    corrected_shot,
)
from jaxphoto.georeferencing.trajectory import Poses, Trajectory, TrajectorySpline, covered, interpolate, spline_through
from jaxphoto.georeferencing.trajectory_knots import (
    StripSpline,
    TrajectoryKnot,
    knot_name,
    strip_of_knot,
    weighted_knot,
)

__all__ = [
    "IMAGE_X", "NOMINAL", "PATTERNS", "Corrections", "DirectPartials", "Exposure", "FlightBias", "Mount",
    "Pattern", "Poses", "RigCamera", "Scanner", "ScannerCalibration", "SensorCovariance", "StripBias",
    "StripErrors", "StripSpline", "Surface", "Trajectory", "TrajectoryKnot", "TrajectorySpline", "apparent_point",
    "arm_to_camera", "attitude_residual", "body_from_camera", "corrected_point", "corrected_return", "corrected_shot",
    "covered", "direct_covariance", "direct_orientation", "direct_partials", "exact_offset",
    "ground_point", "in_rig", "interpolate", "knot_name", "level_error", "level_offset", "object_from_body",
    "raised_by_boresight", "recorded_attitude", "reference_later", "refraction_constant", "rig_place", "rig_turn",
    "sensor_position", "spline_through", "strip_of_knot", "turn_off", "weighted_knot", "worst_level_error",
]  # fmt: skip
