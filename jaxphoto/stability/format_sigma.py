"""How sure a calibration is of where rays lie in the image, over the format."""

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation
from jaxphoto.stability.alignment import Method
from jaxphoto.stability.comparison import bundle_offsets, check_rays


def format_sigma(
    interior: InteriorOrientation,
    covariance: Float[np.ndarray, "p p"],
    points: Float[np.ndarray, "points 2"],
    method: Method,
) -> Float[np.ndarray, "points"]:
    """Root mean square error (mm, both axes together) at image points (mm) by the covariance of `parameter_names`.

    `method` is what the orientation of images may take up (`stability.alignment`). Raises InputError where the
    distortion means nothing at some of the points.
    """
    check_rays(interior, points, "the camera")
    jacobian = np.asarray(bundle_offsets(interior, interior, points, method).measured_jacobian)
    rows = jacobian[:, : len(covariance)].reshape(len(points), 2, -1)
    return np.sqrt(np.maximum(np.einsum("nip,pq,niq->n", rows, covariance, rows), 0.0))
