"""Variance components of the parts whose stated standard deviations contradict the residuals.

Standard deviations of matched image points are rarely known. If only their own weight is wrong, sigma naught
corrects all standard deviations. With other observations (stations, control, lidar) the ratio of weights is wrong as
well, and sigma naught, dominated by the image points, scales the standard deviations of the others too.

The parts (`SPLITS`: X-Y and Z of a group, image points by camera) are tested by the variance factor of their residuals
(`part_factors`). The most significant part, and parts of its group that deviate in the same direction, get variance
components (restricted maximum likelihood). The others are tested again with the new weights, until none contradicts.
They retain their stated standard deviations, which are usually better known than a few residuals can tell.

Larger residuals than stated may have other causes. A part keeps its stated standard deviations if a few blunders
explain the increase (the median of the squared residuals does not have it), or if a shift or drift of a group of
observations remains significant with the estimated ones. Image points that exceed theirs more than threefold end the
estimation. The tests of the adjustment then report these.
"""

from collections.abc import Callable

import numpy as np

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.errors import few
from jaxphoto.statistics import (
    LEAST_CHECKED,
    LEVEL,
    EffectTest,
    Parts,
    Redundancy,
    VarianceComponents,
    VarianceFactor,
    covariance,
    normalised_residuals,
    observation_groups,
    p_value_of_excess,
    part_factors,
    partition_observations,
    redundancy_numbers,
    systematic_effect_tests,
    variance_components,
)
from jaxphoto.statistics.quantiles import beta_tail
from jaxphoto.tracing import outside_transformations

_SPLITS = ("xy-z", "camera")
# Minimum ratio of the estimated and the stated standard deviation: smaller ones do not change a printed sigma.
_RATIO = 1.1
# Ratio of the mean and the median square of normalised residuals, both as estimates of their variance, above which a
# few blunders explain a large mean. Median of chi-square with one degree of freedom.
_FEW, _MEDIAN = 4.0, 0.455
# Number of observations of a part up to which a test by eigenvalues is affordable; more have power without them.
_SMALL = 300
# Ratio of sigmas of image points above which weights are no sufficient explanation (docs/trust.md).
_FITS = 3.0


@outside_transformations
def estimate_weights(
    adjusted: Adjustment,
    *,
    redundancy: Redundancy | None = None,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> VarianceComponents | None:
    """Estimate variance components of the parts whose residuals contradict their stated standard deviations.

    Returns the components of these parts, with the adjustment that uses them, or None if no part contradicts.
    `redundancy`: redundancy numbers of `adjusted`, if known. `report` receives progress. Raises InputError for an
    adjustment that has not converged.
    """
    parts = partition_observations(adjusted, _SPLITS)
    if len(parts.labels) < 2 and len(observation_groups(adjusted)) < 2:
        # Sigma naught is the only factor, unless prior information has weights of its own.
        return None
    estimated: VarianceComponents | None = None
    chosen, kept = set[str](), set[str]()
    while True:
        current = estimated.adjusted if estimated else adjusted
        if redundancy is None:
            redundancy = redundancy_numbers(current, covariance(current, rows=True))
        factors = _contradictions(current, parts, redundancy)
        contradicting = [f for f in factors if f.group not in kept | chosen]
        if not contradicting:
            return estimated
        worst, too_small = contradicting[0].group.split()[0], contradicting[0].sigma > 1
        new = {f.group for f in contradicting if f.group.split()[0] == worst and (f.sigma > 1) == too_small}
        if worst == IMAGE_POINTS and max(f.sigma for f in contradicting if f.group in new) > _FITS:
            # Image points that fit nothing distort all other residuals.
            return estimated
        report(f"estimating the standard deviations of {few([label.replace('_', ' ') for label in sorted(new)])}")
        labels = [label for label in parts.labels if label in chosen | new]
        trial = variance_components(adjusted, parts.only(labels), max_steps=max_steps)
        kept |= new
        if trial.converged and not (too_small and _has_another_cause(current, redundancy, trial, parts, new)):
            # With the new weights, parts that were kept may have a different cause.
            estimated, chosen, kept, redundancy = trial, set(labels), set(trial.warnings), None


def _contradictions(adjusted: Adjustment, parts: Parts, redundancy: Redundancy) -> list[VarianceFactor]:
    """Return the parts whose variance factor differs from its expectation, most significant first."""
    factors = part_factors(adjusted, parts, redundancy)
    level = LEVEL / max(len(factors), 1)
    different = [
        f for f in factors if not 1 / _RATIO < f.sigma < _RATIO and _p_value(adjusted, parts, f, level) < level
    ]
    # The logarithm of a variance factor has the standard deviation sqrt(2 / redundancy); p-values underflow.
    return sorted(different, key=lambda f: -abs(np.log(f.sigma)) * f.redundancy**0.5)


def _p_value(adjusted: Adjustment, parts: Parts, factor: VarianceFactor, level: float) -> float:
    """Return the p-value of a factor; a large one of a small part is tested with the eigenvalues of its R."""
    small = factor.n <= _SMALL and not factor.group.startswith(IMAGE_POINTS)
    if factor.p_value < level or factor.sigma < 1 or not small:
        return factor.p_value
    return p_value_of_excess(adjusted, parts, factor)


def _has_another_cause(
    adjusted: Adjustment, redundancy: Redundancy, trial: VarianceComponents, parts: Parts, labels: set[str]
) -> bool:
    """Return True if blunders, or a shift or drift of a group, explain the large residuals of some parts.

    `trial`: adjustment with their components, `adjusted`: without.
    """
    effects = _shifts_and_drifts(trial.adjusted)
    if any(e.p_value < LEVEL / len(effects) for e in effects):
        return True
    # A few observations with a common error have little weight in v'Pv with the new weights. With the old ones their
    # own v'Pv dominates: the same test on it is independent of their weight.
    own = [f for f in part_factors(adjusted, parts, redundancy) if f.group in labels]
    freedom = sum(f.redundancy for f in own)
    squares = sum(f.factor * f.redundancy for f in own)
    effects = [e for e in _shifts_and_drifts(adjusted) if e.freedom < freedom]
    for e in effects:
        p = beta_tail(min(e.explained / squares, 1.0), e.freedom / 2, (freedom - e.freedom) / 2)
        if p < LEVEL / len(effects):
            return True
    for label in labels:
        k = parts.labels.index(label)
        # Far too small standard deviations leave residuals only at the observations with the largest redundancy.
        numbers = [np.asarray(redundancy[name])[part == k] for name, part in parts.part_of.items()]
        seen, of_seen = adjusted, redundancy
        if np.median(np.concatenate(numbers)) < LEAST_CHECKED:
            seen, of_seen = trial.adjusted, redundancy_numbers(trial.adjusted, covariance(trial.adjusted, rows=True))
        w = normalised_residuals(seen, of_seen)
        of_part = np.concatenate([np.abs(w[name][part == k]) for name, part in parts.part_of.items()])
        squares = (float(seen.sigma0) * of_part[np.isfinite(of_part)]) ** 2
        if not len(squares) or squares.mean() > _FEW * np.median(squares) / _MEDIAN:
            return True
    return False


def _shifts_and_drifts(adjusted: Adjustment) -> list[EffectTest]:
    """Test systematic effects. Those over the image format do not depend on the weight of the image points."""
    effects = systematic_effect_tests(adjusted, np.asarray(covariance(adjusted).shared_sigma))
    return [e for e in effects if not e.pattern.camera]
