"""Is an interior orientation parameter significant, sigma naught too large, a residual a blunder? Ratio and tests."""

import equinox as eqx
import numpy as np
from jax.scipy.special import betainc, gammaincc, ndtri

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import get_parameter
from jaxphoto.compiling import call_compiled
from jaxphoto.statistics.covariance import Covariance

SIGNIFICANT_RATIO = 10.0
"""Paper 000: significant where the standard deviation is at least ten times smaller than the value."""


class Significance(eqx.Module):
    """One estimated interior parameter: value, a posteriori sigma, |value| / sigma, and two-sided p of value = 0.

    Value and sigma are in the parameter's unit: mm for c_mm, xp_mm and yp_mm, else that of the distortion's docstring.
    """

    camera: str
    parameter: str
    value: float
    sigma: float
    ratio: float
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether the ratio reaches `SIGNIFICANT_RATIO`."""
        return self.ratio >= SIGNIFICANT_RATIO


def significance(adjusted: Adjustment, covariance: Covariance) -> list[Significance]:
    """Of every estimated interior parameter, in the order of the cameras and their models."""
    sigma = dict(
        zip(covariance.labels[6 * covariance.n_images :], np.asarray(covariance.shared_sigma).tolist(), strict=True)
    )
    result = []
    for label, s in sigma.items():
        if not label.startswith("interior["):
            continue
        camera, parameter = label.removeprefix("interior[").rsplit("].", 1)
        value = float(get_parameter(adjusted.unknowns.interior[camera], parameter))
        ratio = abs(value) / s if s > 0 else np.inf
        result.append(Significance(camera, parameter, value, s, ratio, student_p(ratio, adjusted.redundancy)))
    return result


def student_p(t: float, degrees_of_freedom: int) -> float:
    """Two-sided p-value of Student's t; 1 where there is no redundancy to test with."""
    if degrees_of_freedom <= 0:
        return 1.0
    if not np.isfinite(t):
        return 0.0
    a, x = degrees_of_freedom / 2, degrees_of_freedom / (degrees_of_freedom + t * t)
    return float(call_compiled(_beta, np.array(a), np.array(x)))


def chi_square_p(square_sum: float, redundancy: int) -> float:
    """Probability that v'Pv is as large as this or larger if the a priori sigmas are true; 1 without redundancy."""
    return float(gammaincc(redundancy / 2, square_sum / 2)) if redundancy > 0 else 1.0


def critical_value(level: float) -> float:
    """What a standard normal value exceeds in size with probability `level`."""
    return float(-ndtri(level / 2))


@eqx.filter_jit
def _beta(a, x):
    """The regularised incomplete beta function of a and 1/2."""
    return betainc(a, 0.5, x)
