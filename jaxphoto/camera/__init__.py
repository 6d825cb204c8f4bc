"""What the camera does to light: sensor, interior orientation, distortion."""

from jaxphoto.camera.balance import rebalance, rebalance_covariance
from jaxphoto.camera.distortion import (
    DISTORTIONS,
    AbstractDistortion,
    AffineBrown,
    Agisoft,
    Balanced,
    Brown,
    Brown14,
    BundlerRadial,
    Ebner,
    Gruen,
    OpenCv,
    PpsRadial,
    RadialPolynomial,
    Smac,
    invert,
)
from jaxphoto.camera.equivalence import exact, with_sign
from jaxphoto.camera.interior import (
    InteriorOrientation,
    constant_names,
    get_parameter,
    needed_constants,
    parameter_names,
    set_parameter,
)
from jaxphoto.camera.principal_points import (
    ConversionError,
    PrincipalPoints,
    conversion_error,
    decentring_from_symmetry,
    principal_points,
    symmetry_from_decentring,
)
from jaxphoto.camera.sensor import Sensor

__all__ = [
    "DISTORTIONS", "AbstractDistortion", "AffineBrown", "Agisoft", "Balanced", "Brown", "Brown14", "BundlerRadial",
    "ConversionError", "Ebner", "Gruen", "InteriorOrientation", "OpenCv", "PpsRadial", "PrincipalPoints",
    "RadialPolynomial", "Sensor", "Smac", "constant_names", "conversion_error", "decentring_from_symmetry", "exact",
    "get_parameter", "invert", "needed_constants", "parameter_names", "principal_points", "rebalance",
    "rebalance_covariance", "set_parameter", "symmetry_from_decentring", "with_sign",
]  # fmt: skip
