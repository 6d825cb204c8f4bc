"""Sizes of errors in observations, estimated as unknowns of a repeated adjustment.

First-order theory gives the size of an error from the residuals of the adjustment that contains it. A large error
distorts that adjustment, and its first-order size, even more its standard deviation, is wrong. Here the observations
are corrected by the estimated errors and adjusted again, until the estimates no longer change. At that point

    b = C^-1 G'v = 0,    C = G' (I - H) G,    covariance sigma0^2 C^-1

with G the whitened errors of unit size and H the hat matrix: the solution with the errors as unknowns.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import MAX_STEPS, Adjustment, solve
from jaxphoto.errors import JaxphotoError
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.blunder_test import Suspect, effect_columns
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.systematic_effects import MIN_FRACTION, EffectTerm, SystematicEffect, truncated_inverse

_MAX_ITERATIONS = 10
# Maximum change of an estimate in its standard deviations.
_TOLERANCE = 0.05


@pretty_repr
class ErrorSizes(NamedTuple):
    """Sizes of errors estimated together, with a posteriori standard deviations, and the corrected adjustment."""

    suspects: dict[tuple[str, int, int], tuple[float, float]]
    """Size and sigma of the error of an observation by group, row and component, in the unit of the group."""
    terms: dict[tuple[str, str], tuple[float, float]]
    """Size and sigma of a systematic effect by its subject (`SystematicEffect.what`) and the name of the term."""
    adjusted: Adjustment
    """Adjustment of the observations without these errors."""


def error_sizes(
    adjusted: Adjustment,
    suspects: Sequence[Suspect],
    effects: Sequence[tuple[SystematicEffect, EffectTerm]] = (),
    max_steps: int = MAX_STEPS,
) -> ErrorSizes | None:
    """Estimate the errors of all `suspects` and all terms of systematic `effects` together.

    All components of a suspect's row are unknown if the other observations determine them, otherwise only the component
    with the largest normalised residual. Returns None if the errors are inseparable or in prior information, or an
    adjustment does not converge.
    """
    places = HatMatrix.of(adjusted).places
    largest = [np.atleast_2d(places[s.group])[s.number, s.row] for s in suspects]
    rows = [np.ravel(places[s.group][..., s.row]) for s in suspects]
    for at in (np.concatenate([np.zeros(0, int), *rows]), np.array(largest, int)):
        if (estimate := _estimate(adjusted, at, effects, max_steps)) is not None:
            break
    else:
        return None
    size, sigma, corrected = estimate
    n, names = len(effects), [(effect.what, term.name) for effect, term in effects]
    of_suspects = {}
    for s, place in zip(suspects, largest, strict=True):
        k = n + int(np.flatnonzero(at == place)[0])
        unit = float(np.atleast_2d(np.asarray(adjusted.block.named_observations[s.group].sigmas).T)[s.number, s.row])
        of_suspects[s.group, s.row, s.number] = (float(size[k]) * unit, float(sigma[k]) * unit)
    return ErrorSizes(
        of_suspects, dict(zip(names, zip(size[:n].tolist(), sigma.tolist(), strict=False), strict=True)), corrected
    )


def _estimate(
    adjusted: Adjustment,
    at: Int[np.ndarray, "m"],
    effects: Sequence[tuple[SystematicEffect, EffectTerm]],
    max_steps: int,
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"], Adjustment] | None:
    """Estimate the terms of `effects`, then whitened errors of the observations `at`; sizes, sigmas and adjustment."""
    block, hat_matrix = adjusted.block, HatMatrix.of(adjusted)
    columns = np.zeros((len(effects) + len(at), hat_matrix.count))
    columns[: len(effects)] = effect_columns(hat_matrix, effects)
    columns[np.arange(len(effects), len(columns)), at] = 1.0
    if any(
        columns[:, np.ravel(p)].any() for name, p in hat_matrix.places.items() if name not in block.named_observations
    ):
        return None
    unadjusted, size, corrected = columns @ columns.T, np.zeros(len(columns)), adjusted
    min_fraction = min([MIN_FRACTION, *(effect.min_fraction for effect, _ in effects)])
    for _ in range(_MAX_ITERATIONS):
        hat_matrix = HatMatrix.of(corrected)
        c = unadjusted - hat_matrix.products(columns.__getitem__, len(columns))[0]
        inverse, freedom = truncated_inverse(c, unadjusted, min_fraction)
        v, redundancy = hat_matrix.residuals, corrected.redundancy - freedom
        if freedom < len(columns) or redundancy < 1:
            return None
        change = inverse @ (columns @ v)
        variance_factor = max(float(v @ v - change @ (columns @ v)), 0.0) / redundancy
        sigma = np.sqrt(variance_factor * np.diagonal(inverse))
        size += change
        if (np.abs(change) <= _TOLERANCE * sigma).all():
            return size, sigma, corrected
        errors = size @ columns
        observations = {
            name: rows.with_observation(np.asarray(rows.observation) - rows.physical(errors[hat_matrix.places[name]]).T)
            for name, rows in block.named_observations.items()
            if errors[hat_matrix.places[name]].any()
        }
        try:
            corrected = solve(
                block.with_observations(observations), corrected.unknowns, adjusted.priors, max_steps, adjusted.sizes
            )
        except JaxphotoError:
            return None
        if not bool(corrected.converged):
            return None
    return None
