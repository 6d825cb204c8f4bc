"""Several calibrations of one camera as one: weighted by their full covariances, with the test that they agree.

With the parameters x_i and covariances Q_i of n independent calibrations

    Q = (sum Q_i^-1)^-1,   x = Q sum Q_i^-1 x_i,   T = sum (x_i - x)' Q_i^-1 (x_i - x)

and T is distributed as chi-square of (n - 1) p where they are of one camera. Which one disagrees is told by its
difference d from the combination of all others, which has the covariance Q_i + Q_others: d' (Q_i + Q_others)^-1 d is
chi-square of p.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.short_repr import shown
from jaxphoto.stability.bundles import with_parameters
from jaxphoto.stability.change import mahalanobis, of_one_model


@shown
class Combination(NamedTuple):
    """One calibration made of several."""

    interior: InteriorOrientation
    covariance: Float[np.ndarray, "p p"]
    """In the order of `parameter_names`; zero rows for what all of them hold."""
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    """How probable a larger chi-square is if all are of one camera."""
    against_others: tuple[float, ...]
    """Of each calibration, how probable it is that it differs from all others together as much as it does or more."""

    def disagreeing(self, level: float) -> list[int]:
        """Those that differ from the others; of n calibrations that agree one is accused with the probability
        `level`."""
        n = len(self.against_others)
        return [k for k, p in enumerate(self.against_others) if p < level / n]


def combine(
    interiors: Sequence[InteriorOrientation], covariances: Sequence[Float[np.ndarray, "p p"]], names: Sequence[str]
) -> Combination:
    """Combine independent calibrations; `names` is what messages call them.

    `covariances` are in the order of `parameter_names`, with zero rows for what was held. Raises InputError for fewer
    than two, for one that is there twice, other models, and what one holds and another estimates or holds elsewhere.
    """
    if len(interiors) < 2:
        raise InputError("a combination is of two calibrations at least; name another one")
    parameters = parameter_names(interiors[0])
    free = np.diagonal(covariances[0]) > 0
    for interior, covariance, name in zip(interiors[1:], covariances[1:], names[1:], strict=True):
        if not of_one_model(interiors[0], interior):
            raise InputError(f"{name} is of another model than {names[0]}: their parameters do not mean the same")
        for parameter, one, other in zip(parameters, free, np.diagonal(covariance) > 0, strict=True):
            if one != other:
                held, estimated = (names[0], name) if other else (name, names[0])
                raise InputError(
                    f"{parameter} is held in {held} and estimated in {estimated}; adjust one of them again so that "
                    "both do the same"
                )
            values = [float(get_parameter(i, parameter)) for i in (interiors[0], interior)]
            if not one and values[0] != values[1]:
                raise InputError(f"{parameter} is held at {values[0]:g} in {names[0]} and at {values[1]:g} in {name}")
        if np.array_equal(covariance, covariances[0]) and all(
            float(get_parameter(interior, p)) == float(get_parameter(interiors[0], p)) for p in parameters
        ):
            raise InputError(f"{name} and {names[0]} are one calibration, which says nothing twice; name it once")
    own = np.ix_(free, free)
    every = np.array([[float(get_parameter(interior, name)) for name in parameters] for interior in interiors])
    x = every[:, free]
    q = np.stack([np.asarray(covariance)[own] for covariance in covariances])
    mean, combined = _mean(x, q)
    tests = [mahalanobis(own_x - mean, own_q) for own_x, own_q in zip(x, q, strict=True)]
    chi_square, freedom = sum(test[0] for test in tests), sum(test[1] for test in tests[1:])
    against = []
    for k in range(len(x)):
        others, of_others = _mean(np.delete(x, k, axis=0), np.delete(q, k, axis=0))
        square, n = mahalanobis(x[k] - others, q[k] + of_others)
        against.append(float(scipy.special.chdtrc(n, square)))
    vector = every[0].copy()
    vector[free] = mean
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[own] = combined
    return Combination(
        with_parameters(interiors[0], vector),  # type: ignore[arg-type]
        covariance,
        chi_square,
        freedom,
        float(scipy.special.chdtrc(freedom, chi_square)),
        tuple(against),
    )


def _mean(x: Float[np.ndarray, "n p"], q: Float[np.ndarray, "n p p"]) -> tuple[np.ndarray, np.ndarray]:
    """The weighted mean and its covariance, computed in units of standard deviations."""
    unit = np.sqrt(np.diagonal(q[0]))
    weights = np.linalg.inv(q / unit[:, None] / unit)
    combined = np.linalg.inv(weights.sum(axis=0))
    mean = combined @ np.einsum("npq,nq->p", weights, (x - x[0]) / unit)
    return x[0] + unit * mean, unit[:, None] * (combined + combined.T) / 2 * unit
