"""Which observation contradicts the others: the normalised residual of every one against what no correct one reaches.

An error e in observation i alone is estimated by (P v)_i / (P Q_vv P)_ii with the standard deviation
sigma0 / sqrt((P Q_vv P)_ii), and w_i is their ratio. Where sigma naught is estimated from the same residuals, w follows
the tau distribution; of n of them the largest is compared with its quantile of level alpha / n (Bonferroni).

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Pope (1976), The statistics of residuals and
the detection of outliers, NOAA Technical Report NOS 65 NGS 1.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import still
from jaxphoto.short_repr import shown
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.quantiles import student_limit
from jaxphoto.statistics.reliability import LEAST_CHECKED, UNCHECKED, Redundancy, error_precision, normalised_residuals

LEVEL = 1e-3
"""Error probability of a test of the whole adjustment: of sigma naught, and of all normalised residuals together."""
LEAST_SIGMA0 = 1e-3
"""Below this, residuals are the rounding of exact numbers, and none of them contradicts another."""
DELTA0 = 4.13
"""Shift of a normalised residual that a test of level 0.1 % finds with a power of 80 % (Baarda)."""


@shown
class Suspect(eqx.Module):
    """An observation that contradicts the others, and by how much it is off if it alone is."""

    group: str
    row: int
    """Of its group in the block."""
    number: int
    """Which of the numbers of its row shows it."""
    words: str
    """What a sentence calls it."""
    w: float
    error: float
    sigma: float
    """Of `error`, a posteriori; both in `unit`."""
    unit: str


@shown
class BlunderTest(eqx.Module):
    """The `suspects`, rows with a number beyond `limit`, the worst first; `n` normalised residuals were tested."""

    suspects: tuple[Suspect, ...]
    limit: float
    n: int


def blunder_test(adjusted: Adjustment, redundancy: Redundancy, level: float = LEVEL) -> BlunderTest:
    """All observations of `adjusted` against the critical value of |w| for all of them together.

    What is known of parameters beforehand is no observation; what hardly anything checks is not tested.
    """
    w, precision = normalised_residuals(adjusted, redundancy), error_precision(adjusted, redundancy)
    sigma0 = float(adjusted.sigma0)
    groups = {name: rows for name, rows in observation_groups(adjusted).items() if rows.unit}
    sizes = {name: np.where(still(redundancy[name]) > LEAST_CHECKED, np.abs(w[name]), 0.0) for name in groups}
    n = sum(int((v > 0).sum()) for v in sizes.values())
    limit, block, found = critical_w(n, adjusted.redundancy, level), adjusted.block, []
    if sigma0 < LEAST_SIGMA0:
        return BlunderTest((), limit, n)
    for name, rows in groups.items():
        size = np.atleast_2d(sizes[name])
        bad = np.flatnonzero(size.max(axis=0, initial=0.0) > limit)
        if not len(bad):
            continue
        # The largest number of a row speaks for it: a point in an image is one blunder, whichever coordinate shows it.
        worst = size[:, bad].argmax(axis=0)
        words = rows.words_of(worst, bad, block.images, block.points)
        of_worst = (np.atleast_2d(v)[worst, bad] for v in (w[name], precision[name]))
        for row, number, word, value, p in zip(bad.tolist(), worst.tolist(), words, *of_worst, strict=True):
            sigma, ratio = sigma0 / float(p) ** 0.5, float(value)
            found.append(Suspect(name, row, number, word, ratio, ratio * sigma, sigma, rows.unit))
    return BlunderTest(tuple(sorted(found, key=lambda s: -abs(s.w))), limit, n)


def critical_w(n: int, redundancy: int, level: float = LEVEL) -> float:
    """What the largest of `n` normalised residuals exceeds with probability `level` at most (Pope's tau).

    With nu the redundancy and t the quantile of Student's distribution of nu - 1 degrees of freedom,
    tau = t sqrt(nu) / sqrt(nu - 1 + t^2); infinite below a redundancy of 2, where all |w| are 1.
    """
    if redundancy < 2 or n == 0:
        return float("inf")
    t = student_limit(redundancy - 1, level / n)
    return t * redundancy**0.5 / (redundancy - 1 + t * t) ** 0.5


def detectable_errors(
    adjusted: Adjustment, redundancy: Redundancy, delta0: float = DELTA0
) -> dict[str, Float[np.ndarray, "..."]]:
    """By group, the least error that the test of one normalised residual finds with its power: delta0 / sqrt(P Q_vv P).

    In the unit of each observation; infinite where nothing checks it.
    """
    found = {}
    for name, p in error_precision(adjusted, redundancy).items():
        checked = still(redundancy[name]) > UNCHECKED
        found[name] = np.where(checked, delta0 / np.sqrt(np.where(checked, p, 1.0)), np.inf)
    return found


@shown
class Hidden(NamedTuple):
    """The observation of a group whose errors are found worst: `detectable` is infinite where none ever is."""

    group: str
    words: str
    detectable: float
    sigma: float
    """A priori; both in `unit`."""
    unit: str


def worst_checked(adjusted: Adjustment, redundancy: Redundancy) -> list[Hidden]:
    """Of each group of observations, that of the largest detectable error beside its standard deviation."""
    found, block = [], adjusted.block
    detectable = detectable_errors(adjusted, redundancy)
    for name, rows in observation_groups(adjusted).items():
        if rows.unit and len(rows):
            size, sigma = np.atleast_2d(detectable[name]), np.atleast_2d(still(rows.sigmas).T)
            k = np.unravel_index(np.argmax(size / sigma), size.shape)
            number, row = np.reshape(k, (2, 1))
            (words,) = rows.words_of(number, row, block.images, block.points)
            found.append(Hidden(name, words, float(size[k]), float(sigma[k]), rows.unit))
    return found
