"""Where the camera is: mounting (lever arm, boresight), shift and drift of the positions."""

from jaxphoto.georeferencing.mount import (
    Mount,
    StripBias,
    attitude_residual,
    body_from_camera,
    object_from_body,
    sensor_position,
)

__all__ = ["Mount", "StripBias", "attitude_residual", "body_from_camera", "object_from_body", "sensor_position"]
