"""The covariance of a calibrated interior orientation, as the stability analysis wants it."""

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import parameter_names
from jaxphoto.procedures.calibration.calibration_block import CAMERA
from jaxphoto.statistics import covariance


def interior_covariance(adjusted: Adjustment) -> Float[np.ndarray, "parameters parameters"]:
    """A posteriori covariance of the camera of a calibration, in the order and units of `parameter_names`.

    Rows and columns of what was held are zero. It takes the image points as independent of each other: what a board
    that is not flat does to many of them alike is not in it.
    """
    return covariance(adjusted).of_interior(CAMERA, parameter_names(adjusted.unknowns.interior[CAMERA]))
