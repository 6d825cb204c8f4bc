"""Camera: sensor, interior orientation, projection, distortion."""

from jaxphoto.camera.camera_rates import RATES, AbstractCameraRates, CameraRates, ThermalRates
from jaxphoto.camera.camera_spline import CameraSpline
from jaxphoto.camera.distortion import *  # noqa: F403 - what is declared there is public here
from jaxphoto.camera.distortion import DISTORTIONS, AbstractDistortion, invert
from jaxphoto.camera.equivalence import exact, with_sign
from jaxphoto.camera.interior import (
    InteriorOrientation,
    constant_names,
    empty_camera,
    get_parameter,
    model_keys,
    parameter_names,
    parameter_unit,
    set_parameter,
    table_name,
)
from jaxphoto.camera.principal_points import (
    ConversionError,
    PrincipalPoints,
    conversion_error,
    decentring_from_symmetry,
    principal_points,
    symmetry_from_decentring,
)
from jaxphoto.camera.projection import *  # noqa: F403
from jaxphoto.camera.projection import PROJECTIONS, AbstractProjection
from jaxphoto.camera.rolling_shutter import ImageMotion, RollingShutter, RowMotion
from jaxphoto.camera.sensor import Sensor, sensor_keys
from jaxphoto.camera.smac_balance_radius import rebalance, rebalance_covariance
from jaxphoto.camera.strip_camera import StripCamera

__all__ = [
    *(model.__name__ for model in (*DISTORTIONS.values(), *PROJECTIONS.values())), "DISTORTIONS", "PROJECTIONS",
    "RATES", "AbstractCameraRates", "AbstractDistortion", "AbstractProjection", "CameraRates", "CameraSpline",
    "ConversionError", "ImageMotion", "InteriorOrientation", "PrincipalPoints", "RollingShutter", "RowMotion", "Sensor",
    "StripCamera", "ThermalRates",
    "constant_names", "conversion_error", "decentring_from_symmetry", "empty_camera", "exact", "get_parameter",
    "invert", "model_keys", "parameter_names", "parameter_unit", "principal_points", "rebalance",
    "rebalance_covariance", "sensor_keys", "set_parameter", "symmetry_from_decentring", "table_name", "with_sign",
]  # fmt: skip
