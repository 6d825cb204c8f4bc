"""At which angles the rays of object points meet: what a height is worth before anything is adjusted."""

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment


def intersection_angles(adjusted: Adjustment) -> Float[np.ndarray, "points"]:
    """The largest angle (rad) between two rays of each point; NaN where fewer than two images measured it.

    cos = d_i' d_j of the unit vectors d from the point to the projection centres of its images.
    """
    s = adjusted.structure
    order = np.argsort(s.point, kind="stable")
    away = np.asarray(adjusted.unknowns.exterior.position)[s.image] - np.asarray(adjusted.unknowns.points)[s.point]
    ray = (away / np.linalg.norm(away, axis=1, keepdims=True))[order]
    rays = np.bincount(s.point, minlength=len(adjusted.block.points))
    first = np.cumsum(rays) - rays
    angle = np.full(len(rays), np.nan)
    # Points of as many rays at once.
    for many in np.unique(rays[rays > 1]):
        points = np.flatnonzero(rays == many)
        own = ray[first[points, None] + np.arange(many)]
        cosine = np.einsum("mik,mjk->mij", own, own).min(axis=(1, 2))
        angle[points] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle
