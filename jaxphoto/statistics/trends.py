"""Do residuals follow a pattern: over the format of a camera, over time, from strip to strip?

A pattern G (one column a direction, in the unit of the observations, whitened like them) that the model lacks shows in
u = G'v with the cofactors C = G' Q_vv P G of whitened observations: G b would be estimated as b = C^-1 u, if it were
unknown. Where the model lacks nothing, u' C^-1 u / v'v follows the beta distribution of f / 2 and (r - f) / 2, f the
rank of C, r the redundancy: exactly, with sigma naught estimated from the same residuals. What estimated parameters
can take up, C does not see.

Sources: Kok (1984), On data snooping and multiple outlier testing, NOAA Technical Report NOS NGS 30; Teunissen (2000),
Testing theory, 2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.statistics.patterns import PatternTerm, ResidualPattern, patterns_of
from jaxphoto.statistics.quantiles import beta_tail
from jaxphoto.statistics.responses import Responses

# Directions of which estimated parameters take up all but this are no part of the test: what is left of them is so
# small that how nearly the solver came to the optimum shows in it.
_SEEN = 1e-3
# Of many blunders the worst: each takes a solution, and more of them are a sign of the pattern itself.
_BLUNDERS, _NUMBERS = 16, 50_000_000


class Hint(NamedTuple):
    """One term that a pattern may be, and what it alone would be."""

    term: PatternTerm
    share: float
    """Of the whole pattern's square sum, 0 to 1."""
    amount: float
    sigma: float
    """A posteriori; both in the unit of the term."""
    moves: dict[str, float]
    """By how many of their standard deviations interior parameters would move with it, by path."""


class Trend(NamedTuple):
    """The test of one pattern."""

    pattern: ResidualPattern
    freedom: int
    p_value: float
    size: float
    """Root mean square of what the pattern explains, its noise taken off, in the unit of the observations."""
    hints: tuple[Hint, ...]
    """The terms that a sentence can name, the one of the largest share first."""


def trends(
    adjusted: Adjustment, shared_sigma: Float[np.ndarray, "shared"], blunders: Sequence[tuple[str, int]] = ()
) -> list[Trend]:
    """All patterns that the observations of `adjusted` can show; those beyond chance have a small `p_value`.

    `shared_sigma` are the a posteriori standard deviations of the shared unknowns. Of `blunders`, rows by the name of
    their group and their number, the first are left out: their errors are unknowns beside the pattern.
    """
    if adjusted.redundancy < 2 or not bool(adjusted.converged):
        return []
    responses = Responses.of(adjusted)
    v = np.zeros(responses.count)
    for name, place in responses.places.items():
        v[place] = np.asarray(adjusted.residuals[name])
    most = min(_BLUNDERS, _NUMBERS // responses.count)
    rows = [np.ravel(responses.places[name][..., row]) for name, row in blunders[:most]]
    out = _LeftOut.of(responses, v, np.concatenate([np.zeros(0, int), *rows]))
    found = (_tested(responses, p, v, out, shared_sigma) for p in patterns_of(adjusted, responses.places))
    return [trend for trend in found if trend is not None]


class _LeftOut(NamedTuple):
    """Observations whose errors are unknowns beside all others."""

    at: Int[np.ndarray, "m"]
    errors: Float[np.ndarray, "m"]
    """Estimated, whitened."""
    moved: Float[np.ndarray, "m shared"]
    visible: Float[np.ndarray, "m n"]
    """Q_vv P of an error in each of them."""
    inverse: Float[np.ndarray, "m m"]
    explained: float
    freedom: int

    @classmethod
    def of(cls, responses: Responses, v: Float[np.ndarray, "n"], at: Int[np.ndarray, "m"]) -> "_LeftOut":
        """Those at some places."""
        visible = np.zeros((len(at), responses.count))
        moved = np.zeros((len(at), responses.adjusted.structure.n_shared))
        unit = lambda k: np.bincount(at[k : k + 1], minlength=responses.count).astype(float)  # noqa: E731
        for k, (x, h) in enumerate(responses.to_errors(unit, len(at))):
            visible[k], moved[k] = unit(k) - h, x
        c = visible[:, at]
        inverse, freedom = _inverse((c + c.T) / 2, np.eye(len(at)))
        errors = inverse @ v[at]
        return cls(at, errors, moved, visible, inverse, float(v[at] @ errors), freedom)


def _tested(
    responses: Responses,
    pattern: ResidualPattern,
    v: Float[np.ndarray, "n"],
    out: _LeftOut,
    shared_sigma: Float[np.ndarray, "shared"],
) -> Trend | None:
    adjusted, many = responses.adjusted, pattern.many
    column = lambda k: pattern.column(k, responses.count)  # noqa: E731
    own = np.stack([pattern.times(column(k)) for k in range(many)])
    moved, seen = map(
        np.stack, zip(*((x, pattern.times(h)) for x, h in responses.to_errors(column, many)), strict=True)
    )
    beside = np.stack([pattern.times(z) for z in out.visible], axis=1) if len(out.at) else np.zeros((many, 0))
    u = pattern.times(v) - beside @ out.errors
    c = own - (seen + seen.T) / 2 - beside @ out.inverse @ beside.T
    moved = (moved - beside @ out.inverse @ out.moved) / np.where(shared_sigma > 0, shared_sigma, np.inf)
    inverse, freedom = _inverse(c, own)
    whole, redundancy = float(v @ v) - out.explained, adjusted.redundancy - out.freedom
    if freedom == 0 or redundancy <= freedom or whole <= 0:
        return None
    explained, b, sigma0 = float(u @ inverse @ u), inverse @ u, (whole / redundancy) ** 0.5
    size2 = (b @ pattern.square @ b - sigma0**2 * np.sum(pattern.square * inverse)) / pattern.rows
    hints = [h._replace(share=h.share / explained) for h in _hints(adjusted, pattern, u, c, own, moved, sigma0)]
    p = beta_tail(explained / whole, freedom / 2, (redundancy - freedom) / 2)
    return Trend(pattern, freedom, p, max(float(size2), 0.0) ** 0.5, tuple(sorted(hints, key=lambda h: -h.share)))


def _hints(
    adjusted: Adjustment,
    pattern: ResidualPattern,
    u: Float[np.ndarray, "k"],
    c: Float[np.ndarray, "k k"],
    own: Float[np.ndarray, "k k"],
    moved: Float[np.ndarray, "k shared"],
    sigma0: float,
) -> list[Hint]:
    """Each term alone; its share is still its square sum. Terms that estimated parameters take up are left out."""
    found = []
    paths = [(k, label) for k, label in enumerate(adjusted.structure.labels) if label.startswith("interior[")]
    for term in pattern.terms:
        a = term.coefficients
        precision, whole = float(a @ c @ a), float(a @ own @ a)
        if precision <= _SEEN * whole:
            continue
        amount = float(a @ u) / precision
        moves = {label: float(amount * (a @ moved[:, k])) for k, label in paths}
        found.append(Hint(term, float(a @ u) ** 2 / precision, amount, sigma0 / precision**0.5, moves))
    return found


def _inverse(c: Float[np.ndarray, "k k"], own: Float[np.ndarray, "k k"]) -> tuple[Float[np.ndarray, "k k"], int]:
    """The inverse of `c` over the directions that show, and how many they are; `own` is `c` without any unknowns."""
    size = np.sqrt(np.diagonal(own))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(c * unit[:, None] * unit)
    kept = values > _SEEN
    half = vectors[:, kept] / np.sqrt(values[kept]) * unit[:, None]
    return half @ half.T, int(kept.sum())
