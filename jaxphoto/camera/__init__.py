"""What the camera does to light: sensor, interior orientation, distortion."""

from jaxphoto.camera.balance import rebalance, rebalance_covariance
from jaxphoto.camera.distortion import DISTORTIONS, AbstractDistortion, AffineBrown, Balanced, Brown, Smac, invert
from jaxphoto.camera.interior import (
    InteriorOrientation,
    constant_names,
    get_parameter,
    parameter_names,
    set_parameter,
)
from jaxphoto.camera.sensor import Sensor

__all__ = [
    "DISTORTIONS", "AbstractDistortion", "AffineBrown", "Balanced", "Brown", "InteriorOrientation", "Sensor", "Smac",
    "constant_names", "get_parameter", "invert", "parameter_names", "rebalance", "rebalance_covariance",
    "set_parameter",
]  # fmt: skip
