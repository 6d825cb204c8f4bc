"""The epipolar lines of two photographs, and which of their matches lie on them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

LEAST_MATCHES = 15
"""Of two photographs: fewer may lie on the epipolar lines of some matrix by chance."""
_LEAST_SHARE = 0.3
_CONFIDENCE = 0.9999
_TRIALS = 10_000


def epipolar_lines(
    one: Float[np.ndarray, "matches 2"], other: Float[np.ndarray, "matches 2"], off_line: float
) -> tuple[Float[np.ndarray, "3 3"] | None, Bool[np.ndarray, "matches"]]:
    """The fundamental matrix F of two photographs, other' F one = 0, and which matches lie within `off_line` of it.

    None, and no match, where that are fewer than 15 or than 30 % of all: random matches get nearly that far. By the
    sampling of OpenCV's USAC with the weights of MAGSAC++ (Barath and others, 2020), from a fixed seed.
    """
    none = np.zeros(len(one), bool)
    if len(one) < LEAST_MATCHES:
        return None, none
    try:
        matrix, good = cv2.findFundamentalMat(one, other, cv2.USAC_MAGSAC, off_line, _CONFIDENCE, _TRIALS)
    except cv2.error:
        # OpenCV's own check fails where no sample gave a matrix, instead of saying that there is none.
        return None, none
    if matrix is None or good.sum() < max(LEAST_MATCHES, _LEAST_SHARE * len(one)):
        return None, none
    return matrix, good.ravel() > 0


def over_sigma(matrix: np.ndarray, one: np.ndarray, other: np.ndarray, *sigmas: np.ndarray) -> np.ndarray:
    """other' F one over its standard deviation, to first order; `sigmas` of both, in the unit of the coordinates."""
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    in_other, in_one = one @ matrix.T, other @ matrix
    slopes = (np.square(line[:, :2]).sum(axis=1) for line in (in_one, in_other))
    variance = sum(slope * sigma**2 for slope, sigma in zip(slopes, sigmas, strict=True))
    return (in_other * other).sum(axis=1) / np.sqrt(variance)
