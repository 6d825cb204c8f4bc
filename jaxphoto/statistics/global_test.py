"""Do the residuals fit the standard deviations: sigma naught of the whole adjustment, and of each group by itself.

With true weights v'Pv follows chi-square of the redundancy nu, and v'Pv of a group has the mean nu_g, the sum of its
redundancy numbers (Förstner 1979). It varies at most as chi-square of nu_g does, so its test is on the safe side.
"""

import equinox as eqx
import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.quantiles import chi_square_tails
from jaxphoto.statistics.reliability import Redundancy


class VarianceFactor(eqx.Module):
    """v'Pv over the redundancy of a group of observations, and the two-sided probability of one as far from 1."""

    group: str
    n: int
    redundancy: float
    factor: float
    p_value: float

    @property
    def sigma(self) -> float:
        """By what the a priori standard deviations of the group would be multiplied to fit."""
        return self.factor**0.5


def global_test(adjusted: Adjustment) -> VarianceFactor:
    """Sigma naught of all observations against 1."""
    return _tested("", sum(adjusted.n_observations.values()), float(adjusted.square_sum), adjusted.redundancy)


def group_factors(adjusted: Adjustment, redundancy: Redundancy) -> list[VarianceFactor]:
    """The same of each group, with the a priori variance factor 1; groups that nothing checks are left out."""
    found = []
    for name in observation_groups(adjusted):
        v, r = np.asarray(adjusted.residuals[name]), float(np.sum(redundancy[name]))
        if r >= 1:
            found.append(_tested(name, v.size, float((v**2).sum()), r))
    return found


def _tested(group: str, n: int, square_sum: float, redundancy: float) -> VarianceFactor:
    if redundancy <= 0:
        return VarianceFactor(group, n, redundancy, 1.0, 1.0)
    p = 2 * min(chi_square_tails(square_sum, redundancy))
    return VarianceFactor(group, n, redundancy, square_sum / redundancy, min(p, 1.0))
