"""Scale factor of standard deviations, and an error band over the format, from repeated halves of a block.

A block is split in two K times. The bundles of rays of the two halves of split k differ at cell j of the format by
d_kj, with the predicted covariance C_kj. Then

    f_j^2 = mean over splits of |d_kj|^2 / tr C_kj      the factor of a cell
    F^2   = mean over cells of f_j^2                    the factor of the whole format

are 1 up to chance if the covariances are correct. F^2 is a sum of squares of normal variables with the weights w of the
axes of d (sum w = 1), so one split gives it with the variance 2 sum w^2 F^4. Splits of one block are not independent:
d_k = sum over units i of s_ki z_i, where s_ki = +1 or -1 is the half that contains unit i. Two splits therefore have
the correlation r_kl = sum n_i s_ki s_li / sum n_i, and their squares r_kl^2. Hence

    var F^2 = 2 F^4 sum w^2 rho,     rho = mean over k and l of r_kl^2

which has a lower bound set by the number of units. In a cell of the covariance C the squared length of an error over
f^2 tr C follows approximately F with a and a / rho degrees of freedom, a = (tr C)^2 / tr C^2 (Satterthwaite): its 95 %
quantile is the squared radius of the band.

Differences need not be normal: if one unit dominates, they have one size and two signs, and such a radius contains all
of them. From twenty splits on, the band of differences is therefore scaled to contain 95 % of the cells, each split in
the band of the other splits, after the jackknife+. The error of the calibration itself is one unobserved draw, for
which the band assumes the normal distribution.
Source: Barber, Candes, Ramdas and Tibshirani (2021), Annals of Statistics 49(1), 486-507.

Source of the overlap of half-samples: McCarthy (1969), Review of the International Statistical Institute 37, 239-264.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.short_repr import pretty_repr

LEVEL = 0.95
"""Confidence level of error bands and limits."""
# Minimum number of splits: in a smaller sample no value exceeds the 95 % quantile.
_MIN_SPLITS = round(1 / (1 - LEVEL))


@pretty_repr
class Differences(NamedTuple):
    """Differences of the halves of all splits, and their predicted covariances; pixels of the measured image."""

    offsets: Float[np.ndarray, "cuts cells 2"]
    covariances: Float[np.ndarray, "cuts cells 2 2"]
    concentration: float
    """sum w^2 of the axes of a difference over the whole format, w their weights in F^2."""
    overlap: Float[np.ndarray, "cuts cuts"]
    """r_kl^2."""


@pretty_repr
class ErrorBand(NamedTuple):
    """Scale factor of the standard deviations, and radii that contain 95 % of the errors; in pixels."""

    factor: float
    """F of the whole format."""
    sigma_factor: float
    """Standard deviation of `factor` over repeated measurements of the block."""
    cell_factor: Float[np.ndarray, "cells"]
    halves: Float[np.ndarray, "cells"]
    """Radius that contains 95 % of the differences of halves of this block, with their mean covariance, for any
    distribution."""
    calibration: Float[np.ndarray, "cells"]
    """Radius that contains 95 % of the errors of the calibration by the whole block, as far as halves show them."""
    of_cuts: Float[np.ndarray, "cuts"]
    """F of each split alone."""
    inside: Float[np.ndarray, "cuts"]
    """Fraction of the cells of each split whose difference is within the band of its covariance by the *other*
    splits."""


def error_band(differences: Differences, covariance: Float[np.ndarray, "cells 2 2"]) -> ErrorBand:
    """Factors and bands of `differences`; `covariance` is predicted for the calibration by the whole block (px^2)."""
    squares, n = (differences.offsets**2).sum(axis=2), len(differences.offsets)
    ratio = squares / np.trace(differences.covariances, axis1=2, axis2=3)
    rho = float(differences.overlap.mean())
    cell_square = ratio.mean(axis=0)
    factor = float(cell_square.mean()) ** 0.5
    relative = np.full(squares.shape, np.nan)
    for k in range(n if n > 1 else 0):
        others = np.delete(ratio, k, axis=0).mean(axis=0)
        relative[k] = squares[k] / (others * square_radius(differences.covariances[k], 1 / (n - 1)))
    scale = _scale(relative)
    inside = [(split <= _scale(np.delete(relative, k, axis=0))).mean() for k, split in enumerate(relative)]
    mean_covariance = differences.covariances.mean(axis=0)
    return ErrorBand(
        factor=factor,
        sigma_factor=factor * (differences.concentration * rho / 2) ** 0.5,
        cell_factor=np.sqrt(cell_square),
        halves=np.sqrt(cell_square * scale * square_radius(mean_covariance, 1 / n)),
        calibration=np.sqrt(cell_square * square_radius(covariance, rho)),
        of_cuts=np.sqrt(ratio.mean(axis=1)),
        inside=np.array(inside) if n > 1 else np.full(n, np.nan),
    )


def _scale(relative: Float[np.ndarray, "cuts cells"]) -> float:
    """LEVEL quantile of squared differences relative to the squared radius of the other splits."""
    return float(np.quantile(relative, LEVEL)) if len(relative) >= _MIN_SPLITS else 1.0


def concentration(
    jacobian: Float[np.ndarray, "coordinates parameters"], covariance: Float[np.ndarray, "parameters parameters"]
) -> float:
    """sum w^2 of differences J e over cells, e of this covariance: 1 for one axis, 1/m for m equal ones."""
    by_cell = jacobian.reshape(-1, 2, jacobian.shape[1])
    trace = np.einsum("cip,pq,ciq->c", by_cell, covariance, by_cell)
    scaled = (by_cell / np.sqrt(len(trace) * trace)[:, None, None]).reshape(jacobian.shape)
    form = scaled.T @ scaled @ covariance
    return float(np.trace(form @ form))


def leading_unit(
    first: Bool[np.ndarray, "cuts units"], offsets: Float[np.ndarray, "cuts cells 2"]
) -> tuple[int, float]:
    """Return the unit whose half alone explains most of the squares of all differences, and the fraction it explains.

    d_k = s_ku z_u + the rest: each of many equal units explains about its share, and 1 / cuts by chance.
    """
    side = np.where(first, 1.0, -1.0)
    mean = np.einsum("ku,kcx->ucx", side, offsets) / len(side)
    fraction = (mean**2).sum(axis=(1, 2)) * len(side) / (offsets**2).sum()
    return int(fraction.argmax()), float(fraction.max())


def overlap(first: Bool[np.ndarray, "cuts units"], size: ArrayLike) -> Float[np.ndarray, "cuts cuts"]:
    """r_kl^2 of splits with the units `first` in their first half; `size` is the weight of each unit."""
    side = np.where(first, 1.0, -1.0)
    return ((side * size) @ side.T / size.sum()) ** 2


def square_radius(covariance: Float[np.ndarray, "cells 2 2"], rho: float = 0.0) -> Float[np.ndarray, "cells"]:
    """LEVEL quantile of |e|^2 of errors e with this covariance.

    With `rho`, of |e|^2 / f^2, where f^2 is estimated from 1 / rho squares.
    """
    trace = np.trace(covariance, axis1=1, axis2=2)
    a = trace**2 / (covariance**2).sum(axis=(1, 2))
    return trace * (scipy.special.fdtri(a, a / rho, LEVEL) if rho else 2 * scipy.special.gammaincinv(a / 2, LEVEL) / a)
