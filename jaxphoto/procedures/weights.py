"""Variance components that blunders make: a few observations that contradict the others are no weight of all of them.

One control height that is off by 70 of its standard deviations makes the component of thirteen 270, with which nothing
contradicts anything any more.
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

# A part's variance is that of blunders where it would be so many times less without those that contradict the others,
# at most such a part of it. Of normal errors whose sigma is stated too small no tenth and no third does that: without
# the largest tenth a variance is 1.6 times less, without the largest third 3.4 times.
_MADE = {4.0: 0.1, 10.0: 1 / 3}


class MadeByBlunders(NamedTuple):
    """A variance component that a few observations make."""

    label: str
    factor: float
    without: float
    """The factor without them."""
    words: tuple[str, ...]
    """What each of them is, the worst first."""


def made_by_blunders(
    adjusted: Adjustment,
    found: VarianceComponents,
    partition: Partition,
    *,
    max_steps: int = MAX_STEPS,
    report: Callable[[str], object] = lambda text: None,
) -> tuple[MadeByBlunders, ...]:
    """Of the components `found` for `adjusted`, which has the weights as stated, those that a few blunders make.

    Looked for with `snoop` and components of what it leaves, where some part's variance is raised and something
    contradicts the others at the stated weights.
    """
    raised = [k for k, factor in enumerate(found.factor) if found.supported[k] and factor > min(_MADE)]
    if not raised or not blunder_test(adjusted, redundancy_numbers(adjusted, covariance(adjusted, rows=True))).suspects:
        return ()
    try:
        snooped = snoop(adjusted.block, adjusted.unknowns, max_steps=max_steps, report=report)
        report("estimating variance components without what contradicts the others")
        clean = variance_components(snooped.adjusted, partition, max_steps=max_steps)
    except JaxphotoError:
        # Then so much contradicts so much that these are no few.
        return ()
    without = dict(zip(clean.labels, clean.factor.tolist(), strict=True))
    told = []
    for k in raised:
        label, factor = found.labels[k], float(found.factor[k])
        numbers, words = _out_of(adjusted, snooped, partition, k)
        less = factor / without.get(label, factor)
        if numbers and any(
            less > times and numbers <= max(1.0, n * found.observations[k]) for times, n in _MADE.items()
        ):
            told.append(MadeByBlunders(label, factor, without[label], words))
    return tuple(told)


def _out_of(adjusted: Adjustment, snooped: Snooped, partition: Partition, part: int) -> tuple[int, tuple[str, ...]]:
    """How many numbers of a part went or were exchanged, and what they are."""
    parts = partition_observations(adjusted, partition).part_of
    own = {name: np.atleast_2d(part_of) == part for name, part_of in parts.items()}
    out = [(s.words, own[s.group][:, s.row]) for s in snooped.left_out]
    out += [(e.words, own[e.group][:, np.ravel(e.rows)]) for e in snooped.exchanged]
    out = [(words, numbers) for words, numbers in out if numbers.any()]
    return sum(int(numbers.sum()) for _, numbers in out), tuple(words for words, _ in out)
