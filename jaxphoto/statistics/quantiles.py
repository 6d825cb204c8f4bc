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


def student_limit(freedom: int, level: float) -> float:
    """What the size of Student's t exceeds with probability `level`."""
    return float(-_special().stdtrit(freedom, level / 2))


def _special() -> ModuleType:
    """SciPy takes a fifth of a second, and importing jaxphoto does not need it."""
    from scipy import special

    return special
