"""Probabilities and quantiles of the distributions that tests compare with, by SciPy."""

from types import ModuleType

import numpy as np
from jaxtyping import Float, Int


def chi_square_tails(square_sum: float, freedom: float) -> tuple[float, float]:
    """Probabilities of a square sum as small as this or smaller, and as large or larger."""
    special = _special()
    return float(special.gammainc(freedom / 2, square_sum / 2)), float(special.gammaincc(freedom / 2, square_sum / 2))


def chi_square_limit(freedom: Int[np.ndarray, "*n"], level: float) -> Float[np.ndarray, "*n"]:
    """What a square sum exceeds with probability `level`."""
    return np.asarray(2 * _special().gammainccinv(freedom / 2, level))


def chi_square_shift(freedom: int, level: float, power: float) -> float:
    """The noncentrality with which a square sum exceeds its limit of `level` with the probability `power`."""
    special = _special()
    return float(special.chndtrinc(chi_square_limit(np.array(freedom), level), freedom, 1 - power))


def student_limit(freedom: int, level: float) -> float:
    """What the size of Student's t exceeds with probability `level`."""
    return float(-_special().stdtrit(freedom, level / 2))


def beta_tail(share: float, a: float, b: float) -> float:
    """Probability that a share that follows the beta distribution of `a` and `b` is as large as this or larger."""
    return float(_special().betainc(b, a, np.clip(1 - share, 0.0, 1.0)))


def student_freedom(square: Float[np.ndarray, "n"], numbers: int) -> float:
    """Degrees of freedom, 1 to 100, of the Student's distribution that is most likely for rows of so many numbers.

    `square` are v'v over the square of the distribution's scale. From 100 on it is the normal distribution.
    """
    from scipy.optimize import minimize_scalar

    gammaln, k = _special().gammaln, numbers

    def cost(log_nu: float) -> float:
        nu = float(np.exp(log_nu))
        density = gammaln((nu + k) / 2) - gammaln(nu / 2) - k / 2 * np.log(nu)
        return float((nu + k) / 2 * np.mean(np.log1p(square / nu)) - density)

    return float(np.exp(minimize_scalar(cost, bounds=np.log((1.0, 100.0)), method="bounded").x))


def _special() -> ModuleType:
    """SciPy takes a fifth of a second, and importing jaxphoto does not need it."""
    from scipy import special

    return special
