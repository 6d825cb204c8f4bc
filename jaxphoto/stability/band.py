"""Scale factor of standard deviations, and error band over the format, from repeated half-splits of a block.

A block is split in two K times. The bundles of rays of the two halves of split k differ at cell j of the format by
d_kj, with the predicted covariance C_kj. Then

    f_j^2 = mean over splits of |d_kj|^2 / tr C_kj      the factor of a cell
    F^2   = mean over cells of f_j^2                    the factor of the whole format

have the expectation 1 if the covariances are correct. F^2 is a sum of squares of normal variables with the weights w of
the axes of d (sum w = 1), so its variance from one split is 2 sum w^2 F^4. Splits of one block are not independent: d_k
= sum over units i of s_ki z_i, where s_ki = +1 or -1 is the half that contains unit i. Two splits therefore have the
correlation r_kl = sum n_i s_ki s_li / sum n_i, and their squares the correlation r_kl^2. Hence

    var F^2 = 2 F^4 sum w^2 rho,     rho = mean over k and l of r_kl^2

with a lower bound that depends on the number of units. In a cell with the covariance C, the squared length of an error
divided by f^2 tr C has approximately the F distribution with a and a / rho degrees of freedom, a = (tr C)^2 / tr C^2
(Satterthwaite). Its 95 % quantile is the squared radius of the band.

Differences are not always normal: if one unit dominates, they have the same length and either sign, and this radius
contains all of them. With twenty or more splits, the band of differences is therefore scaled to contain 95 % of the
cells, comparing each split with the band of the other splits, as in the jackknife+. The error of the calibration itself
is a single unobserved sample; its band assumes the normal distribution.
Source: Barber, Candes, Ramdas and Tibshirani (2021), Annals of Statistics 49(1), 486-507.

Overlap of half-samples: McCarthy (1969), Review of the International Statistical Institute 37, 239-264.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.short_repr import pretty_repr

LEVEL = 0.95
"""Confidence level of error bands and limits."""
# Minimum number of splits to scale the band: in a smaller sample no value exceeds the 95 % quantile.
_MIN_SPLITS = round(1 / (1 - LEVEL))


@pretty_repr
class Differences(NamedTuple):
    """Differences between the halves of all splits, and their predicted covariances; pixels of the measured image."""

    offsets: Float[np.ndarray, "cuts cells 2"]
    covariances: Float[np.ndarray, "cuts cells 2 2"]
    concentration: float
    """sum w^2 over the axes of a difference over the whole format, with their weights w in F^2."""
    overlap: Float[np.ndarray, "cuts cuts"]
    """Squared correlations r_kl^2 of the splits."""


@pretty_repr
class ErrorBand(NamedTuple):
    """Scale factor of the standard deviations, and radii that contain 95 % of the errors; in pixels."""

    factor: float
    """F of the whole format."""
    sigma_factor: float
    """Standard deviation of `factor` over repeated measurements of the block."""
    cell_factor: Float[np.ndarray, "cells"]
    halves: Float[np.ndarray, "cells"]
    """Radius that contains 95 % of the differences between halves of this block, for any distribution."""
    calibration: Float[np.ndarray, "cells"]
    """Radius that contains 95 % of the errors of the calibration by the whole block, estimated from the halves."""
    of_cuts: Float[np.ndarray, "cuts"]
    """F of each individual split."""
    inside: Float[np.ndarray, "cuts"]
    """Fraction of the cells of each split whose difference is within the band estimated from the *other* splits."""


def error_band(differences: Differences, covariance: Float[np.ndarray, "cells 2 2"]) -> ErrorBand:
    """Compute factors and bands from `differences`; `covariance` (px^2): of the calibration by the whole block."""
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
    """Return the LEVEL quantile of `relative`, squared differences over squared radii from the other splits."""
    return float(np.quantile(relative, LEVEL)) if len(relative) >= _MIN_SPLITS else 1.0


def concentration(
    jacobian: Float[np.ndarray, "coordinates parameters"], covariance: Float[np.ndarray, "parameters parameters"]
) -> float:
    """Return sum w^2 of differences J e over cells, with this covariance of e: 1 for one axis, 1/m for m equal axes."""
    by_cell = jacobian.reshape(-1, 2, jacobian.shape[1])
    trace = np.einsum("cip,pq,ciq->c", by_cell, covariance, by_cell)
    scaled = (by_cell / np.sqrt(len(trace) * trace)[:, None, None]).reshape(jacobian.shape)
    form = scaled.T @ scaled @ covariance
    return float(np.trace(form @ form))


def leading_unit(
    first: Bool[np.ndarray, "cuts units"], offsets: Float[np.ndarray, "cuts cells 2"]
) -> tuple[int, float]:
    """Return the unit that explains the largest fraction of the squared differences, and this fraction.

    Model: d_k = s_ku z_u + remainder. Each of many equal units explains about an equal fraction, plus 1 / (number of
    splits) by chance.
    """
    side = np.where(first, 1.0, -1.0)
    mean = np.einsum("ku,kcx->ucx", side, offsets) / len(side)
    fraction = (mean**2).sum(axis=(1, 2)) * len(side) / (offsets**2).sum()
    return int(fraction.argmax()), float(fraction.max())


def overlap(first: Bool[np.ndarray, "cuts units"], size: ArrayLike) -> Float[np.ndarray, "cuts cuts"]:
    """Return r_kl^2 of the splits; `first`: True for units in the first half, `size`: weight of each unit."""
    side = np.where(first, 1.0, -1.0)
    return ((side * size) @ side.T / size.sum()) ** 2


def square_radius(covariance: Float[np.ndarray, "cells 2 2"], rho: float = 0.0) -> Float[np.ndarray, "cells"]:
    """Return the LEVEL quantile of |e|^2 for errors e with this covariance.

    With `rho`: of |e|^2 / f^2, where f^2 is estimated from 1 / rho squares.
    """
    trace = np.trace(covariance, axis1=1, axis2=2)
    a = trace**2 / (covariance**2).sum(axis=(1, 2))
    return trace * (scipy.special.fdtri(a, a / rho, LEVEL) if rho else 2 * scipy.special.gammaincinv(a / 2, LEVEL) / a)
