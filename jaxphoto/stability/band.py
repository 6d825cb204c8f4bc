"""By which factor standard deviations lie, and a band over the format that holds nevertheless: from repeated halves.

A block is cut in two K times. The bundles of rays of the two halves of cut k differ at cell j of the format by d_kj,
and the covariances of both promise C_kj for it. Then

    f_j^2 = mean over cuts of |d_kj|^2 / tr C_kj        the factor of a cell
    F^2   = mean over cells of f_j^2                    the factor of the whole format

are 1 but for chance where the covariances tell the truth. F^2 is a sum of squares of normal variables with the weights
w of the axes of d (sum w = 1), so one cut gives it with the variance 2 sum w^2 F^4. Cuts of one block are not
independent: d_k = sum over units i of s_ki z_i, where s_ki = +1 or -1 says in which half unit i is, so that two cuts
have the correlation r_kl = sum n_i s_ki s_li / sum n_i, and their squares r_kl^2. Hence

    var F^2 = 2 F^4 sum w^2 rho,     rho = mean over k and l of r_kl^2

which no number of cuts makes smaller than the number of units allows. In a cell of the covariance C the squared length
of an error over f^2 tr C is distributed about as F with a and a / rho degrees of freedom, a = (tr C)^2 / tr C^2
(Satterthwaite): its 95 % quantile is the squared radius of the band.

Differences need not be normal: where one unit leads, they have one size and two signs, and such a radius holds all of
them. Of twenty cuts and more the band of differences is therefore stretched by what it takes to hold 95 % of the cells,
each cut in the band that the other cuts give, after the jackknife+. What the calibration itself errs by is one draw
that nobody sees; its band keeps to the normal distribution.
Source: Barber, Candes, Ramdas and Tibshirani (2021), Annals of Statistics 49(1), 486-507.

Source of the overlap of half-samples: McCarthy (1969), Review of the International Statistical Institute 37, 239-264.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.arrays import Numbers
from jaxphoto.short_repr import shown
from jaxphoto.stability.uncertainty import LEVEL

# Of fewer than so many numbers none is beyond what 95 % stay below.
_ENOUGH = round(1 / (1 - LEVEL))


@shown
class Differences(NamedTuple):
    """What the halves of all cuts differ by, and what their covariances promise; pixels of the measured image."""

    offsets: Float[np.ndarray, "cuts cells 2"]
    promised: Float[np.ndarray, "cuts cells 2 2"]
    concentration: float
    """sum w^2 of the axes of a difference over the whole format, w their parts in F^2."""
    overlap: Float[np.ndarray, "cuts cuts"]
    """r_kl^2."""


@shown
class ErrorBand(NamedTuple):
    """The factor by which standard deviations are too small, and what holds 95 % of the errors; in pixels."""

    factor: float
    """F of the whole format,"""
    sigma_factor: float
    """and its standard deviation over repeated measurements of the block."""
    cell_factor: Float[np.ndarray, "cells"]
    halves: Float[np.ndarray, "cells"]
    """Radius that holds 95 % of the differences of halves of this block, of their mean covariance, whatever their
    distribution,"""
    calibration: Float[np.ndarray, "cells"]
    """and 95 % of the errors of the calibration by the whole block, as far as halves show them."""
    of_cuts: Float[np.ndarray, "cuts"]
    """F of each cut alone."""
    inside: Float[np.ndarray, "cuts"]
    """Of each cut, the part of the cells whose difference lies within the band of its own covariance that the *other*
    cuts give."""


def band_of(found: Differences, whole: Float[np.ndarray, "cells 2 2"]) -> ErrorBand:
    """The factors and bands of `found`; `whole` is what the calibration by the whole block promises (px^2)."""
    squares, n = (found.offsets**2).sum(axis=2), len(found.offsets)
    ratio = squares / np.trace(found.promised, axis1=2, axis2=3)
    rho = float(found.overlap.mean())
    cell_square = ratio.mean(axis=0)
    factor = float(cell_square.mean()) ** 0.5
    reach = np.full(squares.shape, np.nan)
    for k in range(n if n > 1 else 0):
        others = np.delete(ratio, k, axis=0).mean(axis=0)
        reach[k] = squares[k] / (others * square_radius(found.promised[k], 1 / (n - 1)))
    stretch = _stretch(reach)
    inside = [(own <= _stretch(np.delete(reach, k, axis=0))).mean() for k, own in enumerate(reach)]
    return ErrorBand(
        factor=factor,
        sigma_factor=factor * (found.concentration * rho / 2) ** 0.5,
        cell_factor=np.sqrt(cell_square),
        halves=np.sqrt(cell_square * stretch * square_radius(found.promised.mean(axis=0), 1 / n)),
        calibration=np.sqrt(cell_square * square_radius(whole, rho)),
        of_cuts=np.sqrt(ratio.mean(axis=1)),
        inside=np.array(inside) if n > 1 else np.full(n, np.nan),
    )


def _stretch(reach: Float[np.ndarray, "cuts cells"]) -> float:
    """What squared differences, over the squared radius of the other cuts, stay below in LEVEL of the cells."""
    return float(np.quantile(reach, LEVEL)) if len(reach) >= _ENOUGH else 1.0


def concentration(
    jacobian: Float[np.ndarray, "coordinates parameters"], covariance: Float[np.ndarray, "parameters parameters"]
) -> float:
    """sum w^2 of differences J e over cells, e of this covariance: 1 if they have one axis, 1/m if m alike."""
    by_cell = jacobian.reshape(-1, 2, jacobian.shape[1])
    trace = np.einsum("cip,pq,ciq->c", by_cell, covariance, by_cell)
    scaled = (by_cell / np.sqrt(len(trace) * trace)[:, None, None]).reshape(jacobian.shape)
    form = scaled.T @ scaled @ covariance
    return float(np.trace(form @ form))


def leading_unit(
    first: Bool[np.ndarray, "cuts units"], offsets: Float[np.ndarray, "cuts cells 2"]
) -> tuple[int, float]:
    """The unit whose side alone explains most of the squares of all differences, and which part of them.

    d_k = s_ku z_u + the rest: of many units alike each explains about its part, and as much as 1 / cuts by chance.
    """
    side = np.where(first, 1.0, -1.0)
    mean = np.einsum("ku,kcx->ucx", side, offsets) / len(side)
    share = (mean**2).sum(axis=(1, 2)) * len(side) / (offsets**2).sum()
    return int(share.argmax()), float(share.max())


def overlap(first: Bool[np.ndarray, "cuts units"], size: Numbers) -> Float[np.ndarray, "cuts cuts"]:
    """r_kl^2 of cuts that have the units `first` in their first half; `size` is how much each unit weighs."""
    side = np.where(first, 1.0, -1.0)
    return ((side * size) @ side.T / size.sum()) ** 2


def square_radius(covariance: Float[np.ndarray, "cells 2 2"], rho: float = 0.0) -> Float[np.ndarray, "cells"]:
    """What LEVEL of |e|^2 of errors e with this covariance stay below.

    Or of |e|^2 / f^2, where f^2 is estimated from as many squares as 1 / rho.
    """
    trace = np.trace(covariance, axis1=1, axis2=2)
    a = trace**2 / (covariance**2).sum(axis=(1, 2))
    return trace * (scipy.special.fdtri(a, a / rho, LEVEL) if rho else 2 * scipy.special.gammaincinv(a / 2, LEVEL) / a)
