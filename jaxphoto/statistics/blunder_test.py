"""Which observation contradicts the others: the normalised residual of every one against what no correct one reaches.

An error e in observation i alone is estimated by (P v)_i / (P Q_vv P)_ii with the standard deviation
sigma0 / sqrt((P Q_vv P)_ii), and w_i is their ratio. Where sigma naught is estimated from the same residuals, w follows
the tau distribution; of n of them the largest is compared with its quantile of level alpha / n (Bonferroni).

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Pope (1976), The statistics of residuals and
the detection of outliers, NOAA Technical Report NOS 65 NGS 1.


Which of several suspects a test cannot do without: a blunder inflates the residuals around it.

Suspects are taken out one after another, the worst first, each as an unknown error of its row. What is left to another
suspect i beside those that are out, S, is with C = P Q_vv P of whitened observations and u = v

    u_i|S = u_i - C_iS C_SS^-1 u_S,     c_i|S = C_ii - C_iS C_SS^-1 C_Si,     w_i|S = u_i|S / (s_S sqrt(c_i|S))

where s_S^2 = (v'v - u_S' C_SS^-1 u_S) / (r - f_S) is the variance factor without them.
Source: Kok (1984), On data snooping and multiple outlier testing, NOAA Technical Report NOS NGS 30.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import still
from jaxphoto.short_repr import shown
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import Responses
from jaxphoto.statistics.quantiles import student_limit
from jaxphoto.statistics.reliability import LEAST_CHECKED, Redundancy, error_precision, normalised_residuals
from jaxphoto.statistics.systematic_effects import (
    LEAST_SEEN,
    PatternTerm,
    ResidualPattern,
    inverse_of_seen,
    patterns_of,
)

LEVEL = 1e-3
"""Error probability of a test of the whole adjustment: of sigma naught, and of all normalised residuals together."""
LEAST_SIGMA0 = 1e-3
"""Below this, residuals are the rounding of exact numbers, and none of them contradicts another."""


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


# Of more suspects the worst: where so many contradict one another, it is for snooping to tell.
_MOST = 24


def culprits(
    adjusted: Adjustment, test: BlunderTest, beside: Sequence[tuple[ResidualPattern, PatternTerm]] = ()
) -> tuple[Suspect, ...]:
    """The suspects that are still beyond the critical value when those of them that are worse are out.

    The worst first. Terms `beside` them are unknowns from the beginning: what they explain accuses nobody. Of more than
    two dozen suspects those beyond these are taken as they are.
    """
    some, others = test.suspects[:_MOST], test.suspects[_MOST:]
    if len(some) + len(beside) < 2 or not some:
        return test.suspects
    responses = Responses.of(adjusted)
    rows = [np.ravel(responses.places[s.group][..., s.row]) for s in some]
    shown = [int(np.atleast_2d(responses.places[s.group])[s.number, s.row]) for s in some]
    at, n = np.concatenate(rows), len(beside)
    first = _columns(responses, beside)

    def column(k: int) -> np.ndarray:
        return first[k] if k < n else np.bincount(at[k - n : k - n + 1], minlength=responses.count).astype(float)

    own_products = np.eye(n + len(at))
    own_products[:n, :n], own_products[:n, n:], own_products[n:, :n] = first @ first.T, first[:, at], first[:, at].T
    c = own_products - responses.products(column, n + len(at))[0]
    v = responses.residuals
    whole, places = float(v @ v), [n + np.flatnonzero(np.isin(at, own)) for own in rows]
    u = np.concatenate([first @ v, v[at]])
    least = min([LEAST_SEEN, *(pattern.least_seen for pattern, _ in beside)])
    chosen: list[int] = [] if n else [0]
    while len(chosen) < len(some):
        out = np.concatenate([np.arange(n), *(places[i] for i in chosen)])
        inverse, freedom = inverse_of_seen(c[np.ix_(out, out)], own_products[np.ix_(out, out)], least)
        errors, redundancy = inverse @ u[out], adjusted.redundancy - freedom
        left = whole - float(u[out] @ errors)
        if redundancy < 1 or left <= LEAST_SIGMA0**2 * redundancy:
            break
        w = np.zeros(len(some))
        for i in (i for i in range(len(some)) if i not in chosen):
            own = n + int(np.flatnonzero(at == shown[i])[0])
            square = float(c[own, own] - c[own, out] @ inverse @ c[out, own])
            if square > LEAST_SEEN * c[own, own]:
                w[i] = abs(u[own] - c[own, out] @ errors) / (left / redundancy * square) ** 0.5
        if w.max() <= test.limit:
            break
        chosen.append(int(w.argmax()))
    return (*(some[i] for i in chosen), *others)


def _columns(
    responses: Responses, beside: Sequence[tuple[ResidualPattern, PatternTerm]]
) -> Float[np.ndarray, "terms count"]:
    """Terms of patterns, of which their columns need not be known, as whitened errors of all observations."""
    found, told = np.zeros((len(beside), responses.count)), [(p.what, p.camera) for p, _ in beside]
    for pattern in patterns_of(responses.adjusted, responses.places) if beside else ():
        for row, (name, (_, term)) in enumerate(zip(told, beside, strict=True)):
            if name == (pattern.what, pattern.camera):
                used = ((k, float(a)) for k, a in enumerate(term.coefficients) if a != 0.0)
                found[row] = sum((a * pattern.column(k, responses.count) for k, a in used), found[row])
    return found
