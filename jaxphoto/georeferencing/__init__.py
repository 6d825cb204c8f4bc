"""Where the camera is: mounting (lever arm, boresight, time offset), shift and drift, direct georeferencing."""

from jaxphoto.georeferencing.corrections import Corrections, apparent_point, refraction_constant
from jaxphoto.georeferencing.direct import SensorCovariance, direct_covariance, direct_orientation
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

__all__ = [
    "IMAGE_X", "NOMINAL", "Corrections", "Exposure", "Mount", "SensorCovariance", "StripBias", "apparent_point",
    "attitude_residual", "body_from_camera", "direct_covariance", "direct_orientation", "object_from_body",
    "recorded_attitude", "refraction_constant", "sensor_position",
]  # fmt: skip
