"""Variance components of the parts whose stated standard deviations contradict the residuals.

Standard deviations of matched image points are rarely known beforehand. If only their own weight is wrong, sigma naught
corrects all standard deviations. With other observations (stations, control, lidar) the ratio of weights is wrong as
well, and sigma naught, dominated by the image points, scales the standard deviations of the others too.

The parts (`SPLITS`: X-Y and Z of a group, image points by camera) are tested by the variance factor of their residuals
(`group_factors`). The most significant part gets a variance component (restricted maximum likelihood), and the others
are tested again with the new weights, until none contradicts. All other parts retain their stated standard deviations,
which are usually better known than a few residuals can tell.

Larger residuals than stated may have other causes. A part keeps its stated standard deviations if a few blunders
explain the increase (`inflated_components`), or if a shift or drift of a group of observations remains significant with
the estimated standard deviations: the tests of the adjustment then report these.
"""

from collections.abc import Callable

import numpy as np

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.procedures.snooping import inflated_components
from jaxphoto.statistics import (
    LEVEL,
    Parts,
    VarianceComponents,
    VarianceFactor,
    covariance,
    part_factors,
    partition_observations,
    redundancy_numbers,
    systematic_effect_tests,
    variance_components,
)
from jaxphoto.tracing import outside_transformations

_SPLITS = ("xy-z", "camera")
# Minimum ratio of the estimated and the stated standard deviation: smaller ones do not change a printed sigma.
_RATIO = 1.1


@outside_transformations
def estimate_weights(
    adjusted: Adjustment, *, max_steps: int = MAX_STEPS, report: Callable[[str], object] = lambda text: None
) -> VarianceComponents | None:
    """Estimate variance components of the parts whose residuals contradict their stated standard deviations.

    Returns the components of these parts, with the adjustment that uses them, or None if no part contradicts.
    `report` receives progress. Raises InputError for an adjustment that has not converged.
    """
    parts = partition_observations(adjusted, _SPLITS)
    if len(parts.labels) < 2:
        return None
    estimated: VarianceComponents | None = None
    chosen, kept = list[str](), set[str]()
    while True:
        current = estimated.adjusted if estimated else adjusted
        contradicting = [f for f in _contradictions(current, parts) if f.group not in kept]
        if not contradicting:
            return estimated
        worst = contradicting[0]
        report(f"estimating the standard deviations of {worst.group.replace('_', ' ')}")
        labels = [label for label in parts.labels if label in (*chosen, worst.group)]
        trial = variance_components(adjusted, parts.only(labels), max_steps=max_steps)
        kept.add(worst.group)
        if not trial.converged or worst.group in trial.warnings:
            continue
        if worst.sigma > 1 and _has_another_cause(current, trial, worst.group, max_steps):
            continue
        # With the new weights, parts that were kept may have a different cause.
        estimated, chosen, kept = trial, labels, set()


def _contradictions(adjusted: Adjustment, parts: Parts) -> list[VarianceFactor]:
    """Return the parts whose variance factor differs from its expectation, most significant first."""
    redundancy = redundancy_numbers(adjusted, covariance(adjusted, rows=True))
    factors = part_factors(adjusted, parts, redundancy)
    level = LEVEL / max(len(factors), 1)
    different = [f for f in factors if f.p_value < level and not 1 / _RATIO < f.sigma < _RATIO]
    # The logarithm of a variance factor has the standard deviation sqrt(2 / redundancy); p-values underflow.
    return sorted(different, key=lambda f: -abs(np.log(f.sigma)) * f.redundancy**0.5)


def _has_another_cause(adjusted: Adjustment, trial: VarianceComponents, label: str, max_steps: int) -> bool:
    """Return True if blunders, or a shift or drift of a group, explain the large residuals of part `label`.

    `trial`: adjustment with its component, `adjusted`: without.
    """
    effects = systematic_effect_tests(trial.adjusted, np.asarray(covariance(trial.adjusted).shared_sigma))
    level = LEVEL / max(len(effects), 1)
    # Tests of effects over the image format do not depend on the weight of the image points.
    if any(e.p_value < level and not e.pattern.camera for e in effects):
        return True
    components = variance_components(adjusted, _SPLITS, max_steps=max_steps)
    return any(c.label == label for c in inflated_components(adjusted, components, _SPLITS, max_steps=max_steps))
