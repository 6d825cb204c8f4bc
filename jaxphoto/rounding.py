"""Steps to which values are rounded, compared with their standard deviations.

Rounding to multiples of a step s adds an error of standard deviation s / sqrt(12). Values recorded in steps of sigma or
finer are multiples of s by chance with a probability of at most sigma / s each, n values with (sigma / s)^n.
"""

import numpy as np
from jaxtyping import Float

M_PER_DEGREE = 111_000.0
"""Length of a degree of latitude (m), to compare steps of geographic coordinates with standard deviations."""
# Maximum probability that values not rounded to a step are all multiples of it, over all steps that are tried.
_CHANCE = 1e-6
# Maximum deviation from a multiple, as a fraction of the step: of numbers in files that were converted to other units
# and systems.
_TOLERANCE = 1e-4
# Units other than the unit itself in which values are recorded: international feet; gon, minutes and seconds of arc.
_OTHER_UNITS = {"m": (0.3048,), "deg": (0.9, 1 / 60, 1 / 3600)}
# Number of values that are tested before all.
_FIRST = 50
# Ratio of the step of float32 to sigma above which the former matters.
_MATTERS = 0.1


def rounding_error(step: float) -> float:
    """Return the standard deviation of the error of rounding to multiples of `step`: uniform over one step."""
    return step / 12**0.5


def rounding_step(values: Float[np.ndarray, "n"], sigma: float, unit: str) -> float:
    """Return the largest step above `sigma` of which all `values` are multiples; 0 if there is none.

    Steps are 1, 2 and 5 times a power of ten in `unit` or a related unit (feet, gon, minutes and seconds of arc), and
    powers of two, the steps of binary numbers. Values that are multiples by chance with a probability above 1e-6 are
    not rounded; equal values have no step.
    """
    values = np.asarray(values, float)
    if not (sigma > 0 and len(values) and np.ptp(values) > 0):
        return 0.0
    steps = _steps(sigma, float(np.abs(values).max()), unit)
    for step in steps:
        by_chance = len(steps) * max(sigma / step, 2 * _TOLERANCE) ** len(values)
        if by_chance < _CHANCE and all(_are_multiples(some, step) for some in (values[:_FIRST], values)):
            return float(step)
    return 0.0


def float_step(values: np.ndarray, sigma: float) -> float:
    """Return the step of binary numbers of 32 bits or fewer at the largest value; 0 if small compared with `sigma`."""
    if values.dtype.kind != "f" or values.dtype.itemsize >= 8 or not values.size:
        return 0.0
    step = float(np.spacing(np.nanmax(np.abs(values))))
    return step if step > _MATTERS * sigma else 0.0


def _are_multiples(values: np.ndarray, step: float) -> bool:
    return bool((np.abs(values / step - np.rint(values / step)) <= _TOLERANCE).all())


def _steps(least: float, largest: float, unit: str) -> list[float]:
    """Return the steps between `least` and `largest`, from the largest."""
    decades = range(int(np.floor(np.log10(least))) - 1, int(np.ceil(np.log10(largest))) + 1)
    decimal = [u * m * 10.0**k for u in (1.0, *_OTHER_UNITS.get(unit, ())) for m in (1, 2, 5) for k in decades]
    binary = [2.0**k for k in range(int(np.floor(np.log2(least))), int(np.ceil(np.log2(largest))) + 1)]
    return sorted((s for s in {*decimal, *binary} if least < s <= largest), reverse=True)
