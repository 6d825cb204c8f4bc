"""Blunder test: compare normalised residuals with the critical value of their maximum, for one or several outliers.

An error in observation i alone is estimated by (P v)_i / (P Q_vv P)_ii with the standard deviation
sigma0 / sqrt((P Q_vv P)_ii), and w_i is their ratio. If sigma naught is estimated from the same residuals, w follows
the tau distribution; the largest of n is compared with its quantile of level alpha / n (Bonferroni).

Several outliers: a blunder inflates the residuals around it. The suspects are therefore selected iteratively, largest
first, each as an unknown error of its row. With S the selected suspects, i any other suspect, C = P Q_vv P of whitened
observations and u = v,

    u_i|S = u_i - C_iS C_SS^-1 u_S,     c_i|S = C_ii - C_iS C_SS^-1 C_Si,     w_i|S = u_i|S / (s_S sqrt(c_i|S))

where s_S^2 = (v'v - u_S' C_SS^-1 u_S) / (r - f_S) is the variance factor without the selected suspects.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Pope (1976), The statistics of residuals and
the detection of outliers, NOAA Technical Report NOS 65 NGS 1; Kok (1984), On data snooping and multiple outlier
testing, NOAA Technical Report NOS NGS 30.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.quantiles import student_limit
from jaxphoto.statistics.reliability import LEAST_CHECKED, Redundancy, error_precision, normalised_residuals
from jaxphoto.statistics.systematic_effects import (
    MIN_FRACTION,
    EffectTerm,
    SystematicEffect,
    candidate_effects,
    truncated_inverse,
)

LEVEL = 1e-3
"""Significance level of a test of the whole adjustment: of the global test, and of all normalised residuals jointly."""
LEAST_SIGMA0 = 1e-3
"""Sigma naught below which residuals are only rounding errors; no blunder test is made."""


@pretty_repr
class Suspect(eqx.Module):
    """Observation whose normalised residual exceeds the critical value. `error`: its estimate as the only outlier."""

    group: str
    row: int
    """Index in the observation group."""
    number: int
    """Component of the row with the largest normalised residual."""
    words: str
    """Label for messages."""
    w: float
    error: float
    sigma: float
    """A posteriori standard deviation of `error`; both are in `unit`."""
    unit: str


@pretty_repr
class BlunderTest(eqx.Module):
    """Blunder test of `n` normalised residuals.

    `suspects`: rows with a component beyond `limit`, largest normalised residual first.
    """

    suspects: tuple[Suspect, ...]
    limit: float
    n: int


def blunder_test(adjusted: Adjustment, redundancy: Redundancy, level: float = LEVEL) -> BlunderTest:
    """Test all normalised residuals of `adjusted` against the critical value of their maximum.

    Prior information and observations with a redundancy number below `LEAST_CHECKED` are not tested.
    """
    w, precision = normalised_residuals(adjusted, redundancy), error_precision(adjusted, redundancy)
    sigma0 = float(adjusted.sigma0)
    groups = {name: rows for name, rows in observation_groups(adjusted).items() if rows.unit}
    absolute = {name: np.where(to_numpy(redundancy[name]) > LEAST_CHECKED, np.abs(w[name]), 0.0) for name in groups}
    n = sum(int((v > 0).sum()) for v in absolute.values())
    limit, block, suspects = critical_w(n, adjusted.redundancy, level), adjusted.block, []
    if sigma0 < LEAST_SIGMA0:
        return BlunderTest((), limit, n)
    for name, rows in groups.items():
        absolute_w = np.atleast_2d(absolute[name])
        rejected = np.flatnonzero(absolute_w.max(axis=0, initial=0.0) > limit)
        if not len(rejected):
            continue
        # One suspect per row: both coordinates of an image point have the same blunder.
        worst = absolute_w[:, rejected].argmax(axis=0)
        labels = rows.words_of(worst, rejected, block.images, block.points)
        values = (np.atleast_2d(v)[worst, rejected] for v in (w[name], precision[name]))
        for row, component, label, value, p in zip(rejected.tolist(), worst.tolist(), labels, *values, strict=True):
            sigma, w_i = sigma0 / float(p) ** 0.5, float(value)
            suspects.append(Suspect(name, row, component, label, w_i, w_i * sigma, sigma, rows.unit))
    return BlunderTest(tuple(sorted(suspects, key=lambda s: -abs(s.w))), limit, n)


def critical_w(n: int, redundancy: int, level: float = LEVEL) -> float:
    """Return the critical value of the largest of `n` normalised residuals at significance `level` (Pope's tau).

    With nu the redundancy and t the quantile of Student's distribution with nu - 1 degrees of freedom, tau = t sqrt(nu)
    / sqrt(nu - 1 + t^2). It is infinite for a redundancy below 2, where all |w| are 1.
    """
    if redundancy < 2 or n == 0:
        return float("inf")
    t = student_limit(redundancy - 1, level / n)
    return t * redundancy**0.5 / (redundancy - 1 + t * t) ** 0.5


# Maximum number of suspects in the multiple outlier test; iterative data snooping tests larger sets.
_MAX_SUSPECTS = 24


def multiple_outlier_test(
    adjusted: Adjustment, test: BlunderTest, effects: Sequence[tuple[SystematicEffect, EffectTerm]] = ()
) -> tuple[Suspect, ...]:
    """Return the suspects that exceed the critical value when all larger ones are modelled as unknown errors.

    The largest is first. Terms of systematic `effects` are additional unknowns from the start, so deviations that they
    explain are not blunders. Suspects beyond the first 24 are returned untested.
    """
    tested, others = test.suspects[:_MAX_SUSPECTS], test.suspects[_MAX_SUSPECTS:]
    if len(tested) + len(effects) < 2 or not tested:
        return test.suspects
    hat_matrix = HatMatrix.of(adjusted)
    rows = [np.ravel(hat_matrix.places[s.group][..., s.row]) for s in tested]
    largest_component = [int(np.atleast_2d(hat_matrix.places[s.group])[s.number, s.row]) for s in tested]
    at, n = np.concatenate(rows), len(effects)
    term_columns = effect_columns(hat_matrix, effects)

    def column(k: int) -> np.ndarray:
        return (
            term_columns[k] if k < n else np.bincount(at[k - n : k - n + 1], minlength=hat_matrix.count).astype(float)
        )

    unadjusted = np.eye(n + len(at))
    unadjusted[:n, :n], unadjusted[:n, n:], unadjusted[n:, :n] = (
        term_columns @ term_columns.T,
        term_columns[:, at],
        term_columns[:, at].T,
    )
    c = unadjusted - hat_matrix.products(column, n + len(at))[0]
    v = hat_matrix.residuals
    sum_of_squares, unknowns = float(v @ v), [n + np.flatnonzero(np.isin(at, row_index)) for row_index in rows]
    u = np.concatenate([term_columns @ v, v[at]])
    min_fraction = min([MIN_FRACTION, *(pattern.min_fraction for pattern, _ in effects)])
    chosen: list[int] = [] if n else [0]
    while len(chosen) < len(tested):
        s = np.concatenate([np.arange(n), *(unknowns[i] for i in chosen)])
        inverse, freedom = truncated_inverse(c[np.ix_(s, s)], unadjusted[np.ix_(s, s)], min_fraction)
        errors, redundancy = inverse @ u[s], adjusted.redundancy - freedom
        remaining = sum_of_squares - float(u[s] @ errors)
        if redundancy < 1 or remaining <= LEAST_SIGMA0**2 * redundancy:
            break
        w = np.zeros(len(tested))
        for i in (i for i in range(len(tested)) if i not in chosen):
            k = n + int(np.flatnonzero(at == largest_component[i])[0])
            variance = float(c[k, k] - c[k, s] @ inverse @ c[s, k])
            if variance > MIN_FRACTION * c[k, k]:
                w[i] = abs(u[k] - c[k, s] @ errors) / (remaining / redundancy * variance) ** 0.5
        if w.max() <= test.limit:
            break
        chosen.append(int(w.argmax()))
    return (*(tested[i] for i in chosen), *others)


def effect_columns(
    hat_matrix: HatMatrix, effects: Sequence[tuple[SystematicEffect, EffectTerm]]
) -> Float[np.ndarray, "terms count"]:
    """Return each term as whitened errors of all observations. The columns of `effects` are recomputed."""
    columns, labels = np.zeros((len(effects), hat_matrix.count)), [(e.what, e.camera) for e, _ in effects]
    for effect in candidate_effects(hat_matrix.adjusted, hat_matrix.places) if effects else ():
        for row, (label, (_, term)) in enumerate(zip(labels, effects, strict=True)):
            if label == (effect.what, effect.camera):
                used = ((k, float(a)) for k, a in enumerate(term.coefficients) if a != 0.0)
                columns[row] = sum((a * effect.column(k, hat_matrix.count) for k, a in used), columns[row])
    return columns
