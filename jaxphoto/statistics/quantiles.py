"""Probabilities and quantiles of test statistics, by SciPy."""

from types import ModuleType

import numpy as np
from jaxtyping import Float, Int


def chi_square_tails(sum_of_squares: float, freedom: float) -> tuple[float, float]:
    """Return the lower and upper tail probabilities of a sum of squares under chi-square."""
    special = _special()
    return float(special.gammainc(freedom / 2, sum_of_squares / 2)), float(
        special.gammaincc(freedom / 2, sum_of_squares / 2)
    )


def chi_square_limit(freedom: Int[np.ndarray, "*n"], level: float) -> Float[np.ndarray, "*n"]:
    """Return the quantile of chi-square with upper tail probability `level`."""
    return np.asarray(2 * _special().gammainccinv(freedom / 2, level))


def chi_square_shift(freedom: int, level: float, power: float) -> float:
    """Return the noncentrality for which chi-square exceeds its limit of `level` with probability `power`."""
    special = _special()
    return float(special.chndtrinc(chi_square_limit(np.array(freedom), level), freedom, 1 - power))


def student_limit(freedom: int, level: float) -> float:
    """Return the quantile of Student's |t| with upper tail probability `level`."""
    return float(-_special().stdtrit(freedom, level / 2))


def beta_tail(fraction: float, a: float, b: float) -> float:
    """Return the upper tail probability of `fraction` under the beta distribution of `a` and `b`."""
    return float(_special().betainc(b, a, np.clip(1 - fraction, 0.0, 1.0)))


def student_freedom(square: Float[np.ndarray, "n"], dimension: int) -> float:
    """Estimate the degrees of freedom (1 to 100) of multivariate Student residuals by maximum likelihood.

    `square` is v'v over the squared scale of the distribution, by row of `dimension` components. 100 stands for the
    normal distribution.
    """
    from scipy.optimize import minimize_scalar

    gammaln, k = _special().gammaln, dimension

    def cost(log_nu: float) -> float:
        nu = float(np.exp(log_nu))
        density = gammaln((nu + k) / 2) - gammaln(nu / 2) - k / 2 * np.log(nu)
        return float((nu + k) / 2 * np.mean(np.log1p(square / nu)) - density)

    return float(np.exp(minimize_scalar(cost, bounds=np.log((1.0, 100.0)), method="bounded").x))


def _special() -> ModuleType:
    """Import scipy.special on first use: it takes 0.2 s, and importing jaxphoto does not need it."""
    from scipy import special

    return special
