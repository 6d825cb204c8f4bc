"""Variance components that a few blunders inflate.

One control height with an error of 70 standard deviations raises the component of thirteen heights to 270. No
observation is then significant.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.errors import JaxphotoError
from jaxphoto.procedures.snooping import Snooped, snoop
from jaxphoto.statistics import (
    Partition,
    VarianceComponents,
    blunder_test,
    covariance,
    partition_observations,
    redundancy_numbers,
    variance_components,
)

# Minimum ratio of the variance to the variance without the contradicting observations (key), by the maximum fraction of
# these (value). Normal errors with too small a stated sigma do not reach it: the ratio is 1.6 without the largest
# tenth, 3.4 without the largest third.
_INFLATION = {4.0: 0.1, 10.0: 1 / 3}


class InflatedComponent(NamedTuple):
    """Variance component inflated by a few observations."""

    label: str
    factor: float
    without: float
    """Variance factor without these observations."""
    words: tuple[str, ...]
    """Labels of the observations, worst first."""


def inflated_components(
    adjusted: Adjustment,
    components: VarianceComponents,
    partition: Partition,
    *,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> tuple[InflatedComponent, ...]:
    """Return the components `found` of `adjusted` (weights as stated) that a few blunders inflate.

    A component is examined if it exceeds 1 significantly and observations contradict the others at the stated weights.
    Blunders are detected by `snoop`, and the components re-estimated without them.
    """
    raised = [k for k, factor in enumerate(components.factor) if components.supported[k] and factor > min(_INFLATION)]
    if not raised or not blunder_test(adjusted, redundancy_numbers(adjusted, covariance(adjusted, rows=True))).suspects:
        return ()
    try:
        snooped = snoop(adjusted.block, adjusted.unknowns, max_steps=max_steps, report=report)
        report("estimating variance components without blunders")
        clean = variance_components(snooped.adjusted, partition, max_steps=max_steps)
    except JaxphotoError:
        # Most observations are inconsistent in this case.
        return ()
    without = dict(zip(clean.labels, clean.factor.tolist(), strict=True))
    inflated = []
    for k in raised:
        label, factor = components.labels[k], float(components.factor[k])
        numbers, words = _rejected_in_part(adjusted, snooped, partition, k)
        less = factor / without.get(label, factor)
        if numbers and any(
            less > times and numbers <= max(1.0, n * components.observations[k]) for times, n in _INFLATION.items()
        ):
            inflated.append(InflatedComponent(label, factor, without[label], words))
    return tuple(inflated)


def _rejected_in_part(
    adjusted: Adjustment, snooped: Snooped, partition: Partition, part: int
) -> tuple[int, tuple[str, ...]]:
    """Return the number of rejected or exchanged components in a group of observations, and their labels."""
    parts = partition_observations(adjusted, partition).part_of
    in_part = {name: np.atleast_2d(part_of) == part for name, part_of in parts.items()}
    out = [(s.words, in_part[s.group][:, s.row]) for s in snooped.left_out]
    out += [(e.words, in_part[e.group][:, np.ravel(e.rows)]) for e in snooped.exchanged]
    out = [(words, numbers) for words, numbers in out if numbers.any()]
    return sum(int(numbers.sum()) for _, numbers in out), tuple(words for words, _ in out)
