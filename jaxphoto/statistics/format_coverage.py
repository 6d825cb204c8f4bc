"""How much of a camera's format its image points reach: beyond them a distortion is an extrapolation."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment


class FormatCoverage(NamedTuple):
    """Parts of the format that convex hulls of image points cover."""

    whole: float
    """Of the points of all images."""
    images: Float[np.ndarray, "images"]
    """Of those of each image that has any."""


def format_coverage(adjusted: Adjustment, camera: str) -> FormatCoverage:
    """Of one camera of a block; a line or fewer than three points cover nothing."""
    s, sensor = adjusted.structure, adjusted.block.sensors[camera]
    mine = np.array([c == camera for c in adjusted.block.image_camera])[s.image]
    xy, image = np.asarray(adjusted.values.xy).T[mine], s.image[mine]
    area = sensor.width_mm * sensor.height_mm
    order = np.argsort(image, kind="stable")
    parts = np.split(xy[order], np.flatnonzero(np.diff(image[order])) + 1) if len(xy) else []
    return FormatCoverage(_hull_area(xy) / area, np.array([_hull_area(part) / area for part in parts]))


def _hull_area(xy: Float[np.ndarray, "n 2"]) -> float:
    try:
        # In two dimensions the volume of qhull is an area.
        return float(scipy.spatial.ConvexHull(xy).volume) if len(xy) > 2 else 0.0
    except scipy.spatial.QhullError:
        return 0.0
