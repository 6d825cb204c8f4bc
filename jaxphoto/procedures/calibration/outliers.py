"""What of the residuals of a calibration is gross error, and how large the rest is beside the measurement's noise."""

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

# Of the typical standard deviation: beyond, an image point is a blunder (one good point in 270,000 is).
_LIMIT = 5.0
# Of an image's largest blunder: others so large go with it.
_NEARLY = 0.5
# Of the typical image's RMS, and in pixels: beyond both, a photograph does not fit.
_IMAGE_LIMIT, _IMAGE_PX = 5.0, 2.0
# The median of the length of a vector with two normal components of sigma 1.
_MEDIAN = float(np.sqrt(2 * np.log(2)))


def blunders(
    residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "n"]:
    """Image points whose residual is over five times what their sigma and the median of all let expect.

    Of each image only those at least half as large as its largest: a blunder turns its image, and good points with it.
    """
    size = np.linalg.norm(residuals / sigma, axis=1)
    largest = np.zeros(n_images)
    np.maximum.at(largest, image, size)
    return (size >= _NEARLY * largest[image]) & (size > _LIMIT * max(float(np.median(size)) / _MEDIAN, 1e-12))


def misfits(
    residuals: Float[np.ndarray, "n 2"], image: Int[np.ndarray, "n"], n_images: int
) -> Bool[np.ndarray, "images"]:
    """Images in which more than half of the points are off by five times what is usual in the others, and by pixels."""
    size = np.linalg.norm(residuals, axis=1)
    typical = np.array([np.median(size[image == k]) for k in range(n_images)])
    return (typical > _IMAGE_LIMIT * np.median(typical)) & (typical > _IMAGE_PX)


def added_sigma(residuals: Float[np.ndarray, "n 2"], sigma: Float[np.ndarray, "n 2"], redundancy: int) -> float:
    """The standard deviation a that explains the residuals beside the measurement's: sum v^2 / (sigma^2 + a^2) = r.

    Zero where sigma alone explains them. In pixels, as `residuals` and `sigma`. It is what an uneven board, a shutter
    that takes one row after the other, or a lens model with too few coefficients add; without it the points that happen
    to be measured best would bend the camera to their own systematic errors.
    """
    square, variance = residuals**2, sigma**2

    def excess(added: float) -> float:
        return float(np.sum(square / (variance + added**2))) - redundancy

    largest = float(np.sqrt(np.sum(square) / max(redundancy, 1)))
    if redundancy <= 0 or largest == 0 or excess(0.0) <= 0:
        return 0.0
    return float(scipy.optimize.brentq(excess, 0.0, largest, xtol=1e-9 * largest))
