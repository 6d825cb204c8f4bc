"""Are several parameters zero, and how large would one have to be to be seen?

The parameters d have the cofactors Q. Where all are truly zero,

    F = d' Q^-1 d / (f sigma0^2)

of f parameters follows the distribution of Fisher with f and r degrees of freedom, r the redundancy. A parameter k that
is D, and it alone, gives f F the noncentrality D^2 (Q^-1)_kk / sigma0^2. Where that is lambda(f), the noncentral
chi-square of f degrees of freedom is beyond its limit of 5 % with the power of 80 %. So the least D that is found so is

    D_k = sigma0 sqrt(lambda(f) / (Q^-1)_kk)

which is (1.96 + 0.84) sigma where there is one parameter. The priors of parameters, of vectors with their covariance,
have no part in this: they are taken out of Q and d. What then shows in no observation, such as a change of all strips
together beside that of their camera, has no part in f.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Teunissen (2000), Testing theory.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.structure import observed_in
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.quantiles import beta_tail, chi_square_shift
from jaxphoto.statistics.significance import SIGNIFICANCE_LEVEL
from jaxphoto.unknowns import Weighted

POWER = 0.80
"""Probability with which a parameter of the `detectable` size is found."""
# Of what an adjustment knows of a parameter: where observations add no more than this, they show nothing.
_SHOWS = 1e-6


@shown
class ZeroTest(NamedTuple):
    """One entry a parameter. `value` and `sigma` (a posteriori) are those of the adjustment; `p_values`, of each being
    zero, `p_value`, of all being zero, and `detectable` leave out what was known beforehand."""

    value: Float[np.ndarray, "parameters"]
    sigma: Float[np.ndarray, "parameters"]
    p_values: Float[np.ndarray, "parameters"]
    detectable: Float[np.ndarray, "parameters"]
    p_value: float

    @property
    def rejected(self) -> bool:
        """Whether zeros are less likely to look like this than `SIGNIFICANCE_LEVEL`."""
        return self.p_value < SIGNIFICANCE_LEVEL


def zero_test(adjusted: Adjustment, covariance: Covariance, labels: Sequence[str], times: float = 1.0) -> ZeroTest:
    """The test of estimated shared parameters, each multiplied by `times`.

    KnownParameters and all other observations take part in it.
    """
    places = [covariance.labels.index(label) for label in labels]
    s, of = adjusted.structure, {label: k for k, label in enumerate(adjusted.structure.labels)}
    own = np.asarray(s.free)[[of[label] for label in labels]]
    value = times * np.asarray(adjusted.values.shared)[own]
    q = times**2 * np.asarray(covariance.matrix)[np.ix_(places, places)]
    weight, known = _known(adjusted, own)
    weight, known = weight / times**2, times * known
    # In units of the standard deviations that the adjustment gives, all that it knows is the inverse correlation.
    sigma = np.sqrt(np.diagonal(q))
    whole = np.linalg.inv(q / np.outer(sigma, sigma))
    shown = whole - weight * np.outer(sigma, sigma)
    right = whole @ (value / sigma) - sigma * (weight @ known)
    factor, r = float(covariance.variance_factor), adjusted.redundancy
    explained, freedom, inverse = _solved(shown, right)
    alone, precision = np.diagonal(inverse), np.maximum(np.diagonal(shown), 0.0)
    ratio = np.divide((inverse @ right) ** 2, alone, out=np.zeros(len(own)), where=alone > 0)
    least = chi_square_shift(max(freedom, 1), SIGNIFICANCE_LEVEL, POWER) * factor
    return ZeroTest(
        value,
        sigma * factor**0.5,
        np.array([_tail(v / factor, 1, r) for v in ratio]),
        sigma * np.sqrt(np.divide(least, precision, out=np.full(len(own), np.inf), where=precision > _SHOWS)),
        _tail(explained / factor, freedom, r),
    )


def _known(adjusted: Adjustment, own: Int[np.ndarray, "k"]) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
    """Weights and values of what was known of parameters beforehand; `own` are their places among all shared ones."""
    given, at = observed_in(adjusted.block, adjusted.priors), {int(place): k for k, place in enumerate(own)}
    weight, known = np.zeros((len(own), len(own))), np.zeros(len(own))
    for k, place in enumerate(own):
        if isinstance(prior := given.entries[place].prior, Weighted):
            weight[k, k], known[k] = 1 / float(prior.sigma) ** 2, float(prior.value)
    for joint in given.together:
        inside = [k for k, place in enumerate(joint.parameters) if int(place) in at]
        if inside:
            mine = [at[int(joint.parameters[k])] for k in inside]
            weight[np.ix_(mine, mine)] = np.linalg.inv(np.asarray(joint.covariance)[np.ix_(inside, inside)])
    return weight, known


def _solved(
    matrix: Float[np.ndarray, "k k"], right: Float[np.ndarray, "k"]
) -> tuple[float, int, Float[np.ndarray, "k k"]]:
    """right' inverse right, the rank and the inverse over what is not zero by rounding."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _SHOWS
    half = vectors[:, kept] / np.sqrt(values[kept])
    return float(np.sum((right @ half) ** 2)), int(kept.sum()), half @ half.T


def _tail(square_sum: float, freedom: int, redundancy: int) -> float:
    """Probability that a square sum over the a posteriori variance factor is as large as this; 1 without redundancy."""
    if freedom == 0 or redundancy <= 0:
        return 1.0
    return beta_tail(square_sum / (square_sum + redundancy), freedom / 2, redundancy / 2)
