"""Gross errors of an oriented network: image points by their residuals, and two-ray points by their depth.

A false match along an epipolar line gives a two-ray point at a wrong depth without residuals. Its neighbours in the
image contradict it: over an image the inverse depth of a surface varies slowly; for a plane it is linear. A two-ray
point is rejected if its inverse depth is far from the median of its neighbours in both images, relative to their robust
spread and its standard deviation. At depth discontinuities neighbours spread widely, and nothing is rejected.
"""

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.block import Block

# Maximum residual in robust standard deviations; minimum of this limit in a priori standard deviations.
_LIMIT, _MIN_LIMIT = 4.0, 1.0
# Number of nearest points in the image; maximum deviation of a depth in their robust spreads.
_NEIGHBOURS, _DEPTH_LIMIT = 12, 8.0
# Ratio of the standard deviation of a normal distribution to its median absolute deviation; ratio of the standard
# deviation per axis to the median length of 2-D errors (Rayleigh).
_MAD, _RAYLEIGH = 1.4826, 1 / 1.1774


def beyond_limit(block: Block, residuals: Float[np.ndarray, "2 rows"]) -> tuple[Bool[np.ndarray, " rows"], float]:
    """Mark image rows whose `residuals`, over their sigmas, exceed the limit, at most one per point; also return the
    limit.

    Residuals are divided by the square root of the redundancy of one of n rays, (2 n - 3) / (2 n).
    """
    point = np.asarray(block.image_points.point)
    rays = np.bincount(point, minlength=len(block.points))[point]
    length = np.hypot(*residuals) / np.sqrt(1 - 1.5 / rays)
    limit = max(_MIN_LIMIT, _LIMIT * _RAYLEIGH * float(np.median(length)))
    largest = np.zeros(len(block.points))
    np.maximum.at(largest, point, length)
    return (length > limit) & (length == largest[point]), limit


def unsupported(block: Block) -> Bool[np.ndarray, " rows"]:
    """Mark image rows of two-ray points whose depths contradict their neighbours in both images."""
    rows, start = block.image_points, block.start.unknowns
    image, point = np.asarray(rows.image), np.asarray(rows.point)
    ray = np.asarray(start.points)[point] - np.asarray(start.exterior.position)[image]
    inverse = -1 / np.einsum("ni,ni->n", np.asarray(start.exterior.camera_from_object)[image, 2], ray)
    c = np.array([float(start.interior[camera].c) for camera in block.image_camera])[image]
    sigma = inverse * _relative_depth_sigma(ray, point, np.sqrt(np.mean(np.asarray(rows.sigma) ** 2, axis=1)) / c)
    two = np.bincount(point)[point] == 2
    contradicted = np.zeros(len(point), bool)
    for number in np.unique(image):
        rows_of = np.flatnonzero(image == number)
        xy, tested = np.asarray(rows.xy)[rows_of], two[rows_of]
        if len(rows_of) > _NEIGHBOURS and tested.any():
            contradicted[rows_of[tested]] = _far(xy, inverse[rows_of], sigma[rows_of], tested)
    return (np.bincount(point[contradicted], minlength=len(block.points)) == 2)[point]


def _far(xy, inverse, sigma, tested: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " tested"]:
    """Mark the `tested` points of an image whose `inverse` depths contradict their neighbours."""
    # The nearest point is the point itself.
    around = inverse[scipy.spatial.cKDTree(xy).query(xy[tested], _NEIGHBOURS + 1)[1][:, 1:]]
    median = np.median(around, axis=1)
    spread = _MAD * np.median(np.abs(around - median[:, None]), axis=1)
    return np.abs(inverse[tested] - median) > _DEPTH_LIMIT * np.hypot(spread, sigma[tested])


def _relative_depth_sigma(ray, point, sigma_rad) -> Float[np.ndarray, " rows"]:
    """Return the relative standard deviation of the depths of two-ray points: errors of both rays over their angle."""
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    total = np.stack([np.bincount(point, v) for v in direction.T], axis=1)
    # The sum of two unit vectors at an angle g has the length 2 cos(g / 2).
    half = np.arccos(np.clip(np.linalg.norm(total, axis=1) / 2, 0, 1))[point]
    return np.sqrt(2) * sigma_rad / np.sin(np.maximum(2 * half, 1e-9))
