"""The covariance of a calibrated interior orientation, as the stability analysis wants it."""

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import parameter_names
from jaxphoto.procedures.calibration.block import CAMERA
from jaxphoto.statistics import covariance


def interior_covariance(adjusted: Adjustment) -> Float[np.ndarray, "parameters parameters"]:
    """A posteriori covariance of the camera of a calibration, in the order and units of `parameter_names`.

    Rows and columns of what was held are zero. It takes the image points as independent of each other: what a board
    that is not flat does to many of them alike is not in it.
    """
    known, names = covariance(adjusted), parameter_names(adjusted.unknowns.interior[CAMERA])
    shared = known.labels[6 * known.n_images :]
    own = f"interior[{CAMERA}]."
    place = [k for k, label in enumerate(shared) if label.startswith(own)]
    which = [names.index(shared[k].removeprefix(own)) for k in place]
    matrix = np.asarray(known.matrix)[6 * known.n_images :, 6 * known.n_images :] * float(known.variance_factor)
    found = np.zeros((len(names), len(names)))
    found[np.ix_(which, which)] = matrix[np.ix_(place, place)]
    return found
