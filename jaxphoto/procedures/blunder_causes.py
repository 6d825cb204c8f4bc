"""Causes of rejected observations: units, axes or signs of a file, mirrored images, inflated variance components.

The images determine the true positions of rejected control and stations. A file error is identified if the stated
coordinates agree with these positions in feet, or with X and Y exchanged.

A few blunders inflate a variance component: one control height with an error of 70 standard deviations raises the
component of thirteen heights to 270. No observation is then significant.
"""

from collections.abc import Callable
from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import MAX_STEPS, Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, JaxphotoError
from jaxphoto.initial import resect
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.initial.resection import reprojection_errors
from jaxphoto.observations import AbstractCoordinates
from jaxphoto.procedures.snooping import Snooped, mostly_rejected, snoop
from jaxphoto.statistics import (
    Partition,
    VarianceComponents,
    blunder_test,
    covariance,
    partition_observations,
    redundancy_numbers,
    variance_components,
)

# Ratio of stated to correct value. International and US survey foot differ by 2 ppm, which is rarely observable.
_FACTORS = {
    1 / 0.3048: "in feet, not in metres",
    0.3048: "converted from feet, but were metres",
    1000.0: "in millimetres, not in metres",
    0.001: "in kilometres, not in metres",
    -1.0: "of the other sign",
}
_AXES = "XYZ"
# Maximum ratio of the median error after the correction to that before. Without the group, the other observations
# determine it less accurately.
_LEFT = 0.1
# Maximum median image residual, in standard deviations: large, because distortion may be poorly known.
_FIT = 10.0


def coordinate_mistakes(snooped: Snooped, block: Block) -> dict[str, str]:
    """Return common file errors that explain coordinate groups with mostly rejected observations, by group."""
    causes = {}
    for name, counts in mostly_rejected(snooped, block).items():
        rows = block.named_observations[name]
        if isinstance(rows, AbstractCoordinates):
            stated, predicted = _stated_and_predicted(snooped, name, rows)
            if cause := _exchanged_axes(stated, predicted) or _scaled_axes(
                stated, predicted, [_AXES.index(axis) for axis in counts]
            ):
                causes[name] = cause
    return causes


def is_mirrored(snooped: Snooped, block: Block, image: int) -> bool:
    """Return True if a rejected image of `block` fits when mirrored, on the same side of the object as the others."""
    adjusted, p = snooped.adjusted, block.image_points
    place = dict(zip(adjusted.block.points, to_numpy(adjusted.unknowns.points), strict=True))
    rows = np.flatnonzero((p.image == image) & np.isin(np.array(block.points, object)[p.point], list(place)))
    points = np.array([place[block.points[k]] for k in p.point[rows]]).reshape(-1, 3)
    interior, xy = adjusted.unknowns.interior[block.image_camera[image]], to_numpy(p.xy)[rows]
    mirrored = xy * [-1.0, 1.0]
    try:
        pose = resect(interior, mirrored, points, block.images[image])
    except BlockError:
        return False
    errors = reprojection_errors(
        float(interior.c),
        ideal_coordinates(interior, mirrored),
        points,
        to_numpy(pose.position)[None],
        to_numpy(pose.camera_from_object)[None],
    )
    others = to_numpy(adjusted.unknowns.exterior.position).mean(axis=0)
    # Flat ground, mirrored, also fits from below.
    if (others - points.mean(axis=0)) @ (to_numpy(pose.position) - points.mean(axis=0)) <= 0:
        return False
    return bool(np.median(errors) < _FIT * np.median(to_numpy(p.sigma)[rows]))


def _stated_and_predicted(
    snooped: Snooped, name: str, rows: AbstractCoordinates
) -> tuple[Float[np.ndarray, "who 3"], Float[np.ndarray, "who 3"]]:
    """Return stated positions, and positions predicted by the other observations (m); NaN if missing."""
    stated = np.full((int(rows.who.max()) + 1, 3), np.nan)
    stated[rows.who, rows.axis] = to_numpy(rows.value)
    predicted = stated.copy()
    for s in snooped.left_out:
        if s.group == name:
            predicted[rows.who[s.row], rows.axis[s.row]] -= s.error
    has_value = np.isfinite(stated).any(axis=1)
    return stated[has_value], predicted[has_value]


def _explains(stated: np.ndarray, instead: np.ndarray, predicted: np.ndarray) -> bool:
    """Return True if `instead` removes nearly all errors of `given`."""
    deviation = np.abs(stated - predicted)
    wrong = deviation > 0
    left = np.abs(instead - predicted)[wrong]
    return bool(np.isfinite(left).any() and np.nanmedian(left) < _LEFT * np.nanmedian(deviation[wrong]))


def _exchanged_axes(stated: Float[np.ndarray, "who 3"], predicted: Float[np.ndarray, "who 3"]) -> str:
    """Return a message that names exchanged axes."""
    for order in permutations(range(3)):
        moved = [k for k in range(3) if order[k] != k]
        if moved and all(_explains(stated[:, k], stated[:, order[k]], predicted[:, k]) for k in moved):
            return f"{' and '.join(_AXES[k] for k in moved)} are exchanged"
    return ""


def _scaled_axes(stated: Float[np.ndarray, "who 3"], predicted: Float[np.ndarray, "who 3"], axes: list[int]) -> str:
    """Return a message that names axes in other units."""
    messages = []
    for factor, words in _FACTORS.items():
        if scaled := [k for k in axes if _explains(stated[:, k], stated[:, k] / factor, predicted[:, k])]:
            messages.append(f"{' and '.join(_AXES[k] for k in scaled)} {'is' if len(scaled) == 1 else 'are'} {words}")
    return ", ".join(messages)


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
