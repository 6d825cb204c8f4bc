"""Do residuals follow a pattern: over the format of a camera, over time, from strip to strip?

A pattern G (one column a direction, in the unit of the observations, whitened like them) that the model lacks shows in
u = G'v with the cofactors C = G' Q_vv P G of whitened observations: G b would be estimated as b = C^-1 u, if it were
unknown. Where the model lacks nothing, u' C^-1 u / v'v follows the beta distribution of f / 2 and (r - f) / 2, f the
rank of C, r the redundancy: exactly, with sigma naught estimated from the same residuals. What estimated parameters
can take up, C does not see.

Sources: Kok (1984), On data snooping and multiple outlier testing, NOAA Technical Report NOS NGS 30; Teunissen (2000),
Testing theory, 2.
"""

import bisect
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.short_repr import shown
from jaxphoto.statistics.patterns import PatternTerm, ResidualPattern, patterns_of
from jaxphoto.statistics.quantiles import beta_tail
from jaxphoto.statistics.responses import Responses

LEAST_SEEN = 1e-3
"""Of an error in one observation, what estimated parameters must leave of it."""
SURE = 3.3
"""Standard deviations of itself beyond which the amount of a term is told: by chance one of a thousand."""
# Of many blunders the worst: more of them are a sign of the pattern itself.
_BLUNDERS = 16
# A blunder is what a term makes where it is off from that by less than this part.
_LIKE = 0.5


@shown
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


@shown
class Trend(NamedTuple):
    """The test of one pattern."""

    pattern: ResidualPattern
    """Without its columns, which of a large block are hundreds of MB; `patterns_of` makes them again."""
    sigma: float
    """The median standard deviation of its observations."""
    freedom: int
    p_value: float
    size: float
    """Root mean square of what the pattern explains, its noise taken off, in the unit of the observations."""
    hints: tuple[Hint, ...]
    """The terms that a sentence can name, the one of the largest share first."""
    blunders_alike: int = 0
    """Of the blunders that are unknowns beside it, how many are what the first of these makes of their observations."""

    @property
    def alike(self) -> list[Hint]:
        """Of a pattern that is what all rows of a group are off by alike, the axes of which this is sure."""
        return [h for h in self.hints if abs(h.amount) > SURE * h.sigma] if self.pattern.group else []


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
    v = responses.residuals
    rows = [np.ravel(responses.places[name][..., row]) for name, row in blunders[:_BLUNDERS]]
    directions = _Directions(
        np.concatenate([np.zeros(0, int), *rows]), tuple(patterns_of(adjusted, responses.places)), responses.count
    )
    taken_up, moved = responses.products(directions.column, directions.ends[-1])
    moved = moved / np.where(shared_sigma > 0, shared_sigma, np.inf)
    out = _LeftOut.of(directions.at, v, taken_up, moved)
    found = (_tested(adjusted, directions, k, v, out, taken_up, moved) for k in range(len(directions.patterns)))
    return [trend for trend in found if trend is not None]


class _Directions(NamedTuple):
    """All that is solved for at once: an error in each of some observations, then the columns of each pattern."""

    at: Int[np.ndarray, "m"]
    patterns: tuple[ResidualPattern, ...]
    n_observations: int

    @property
    def ends(self) -> list[int]:
        """Behind the observations, and behind each pattern."""
        return np.cumsum([len(self.at), *(p.many for p in self.patterns)]).tolist()

    def column(self, k: int) -> Float[np.ndarray, "n"]:
        """Direction `k`, whitened."""
        own = bisect.bisect_right(self.ends, k)
        if own == 0:
            return self.unit(k)
        return self.patterns[own - 1].column(k - self.ends[own - 1], self.n_observations)

    def unit(self, k: int) -> Float[np.ndarray, "n"]:
        """An error of one in observation `at[k]`."""
        return np.bincount(self.at[k : k + 1], minlength=self.n_observations).astype(float)


class _LeftOut(NamedTuple):
    """Observations whose errors are unknowns beside all others."""

    errors: Float[np.ndarray, "m"]
    """Estimated, whitened."""
    moved: Float[np.ndarray, "m shared"]
    inverse: Float[np.ndarray, "m m"]
    explained: float
    freedom: int

    @classmethod
    def of(
        cls,
        at: Int[np.ndarray, "m"],
        v: Float[np.ndarray, "n"],
        taken_up: Float[np.ndarray, "k k"],
        moved: Float[np.ndarray, "k shared"],
    ) -> "_LeftOut":
        """Those at some places, the first directions."""
        m = len(at)
        inverse, freedom = inverse_of_seen(np.eye(m) - taken_up[:m, :m], np.eye(m), LEAST_SEEN)
        errors = inverse @ v[at]
        return cls(errors, moved[:m], inverse, float(v[at] @ errors), freedom)


def _tested(
    adjusted: Adjustment,
    directions: _Directions,
    k: int,
    v: Float[np.ndarray, "n"],
    out: _LeftOut,
    taken_up: Float[np.ndarray, "k k"],
    moved: Float[np.ndarray, "k shared"],
) -> Trend | None:
    pattern, (first, last), m = directions.patterns[k], directions.ends[k : k + 2], len(directions.at)
    own = pattern.products(whitened=True)
    of_units = [pattern.times(directions.unit(i)) for i in range(m)]
    beside = np.reshape(of_units, (m, pattern.many)).T - taken_up[first:last, :m]
    u = pattern.times(v) - beside @ out.errors
    c = own - taken_up[first:last, first:last] - beside @ out.inverse @ beside.T
    moved = moved[first:last] - beside @ out.inverse @ out.moved
    inverse, freedom = inverse_of_seen(c, own, pattern.least_seen)
    whole, redundancy = float(v @ v) - out.explained, adjusted.redundancy - out.freedom
    if freedom == 0 or redundancy <= freedom or whole <= 0:
        return None
    explained, b, sigma0 = float(u @ inverse @ u), inverse @ u, (whole / redundancy) ** 0.5
    square = pattern.products(whitened=False)
    size2 = (b @ square @ b - sigma0**2 * np.sum(square * inverse)) / pattern.rows
    hints = [h._replace(share=h.share / explained) for h in _hints(adjusted, pattern, u, c, own, moved, sigma0)]
    p = beta_tail(explained / whole, freedom / 2, (redundancy - freedom) / 2)
    hints.sort(key=lambda h: -h.share)
    alike = 0
    if hints and m:
        makes = hints[0].amount * (np.array(of_units) @ hints[0].term.coefficients)
        alike = int((np.abs(out.errors - makes) < _LIKE * np.abs(makes)).sum())
    told = pattern._replace(parts=())
    return Trend(told, pattern.sigma, freedom, p, max(float(size2), 0.0) ** 0.5, tuple(hints), alike)


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
        if precision <= pattern.least_seen * whole:
            continue
        amount = float(a @ u) / precision
        moves = {label: float(amount * (a @ moved[:, k])) for k, label in paths}
        found.append(Hint(term, float(a @ u) ** 2 / precision, amount, sigma0 / precision**0.5, moves))
    return found


def inverse_of_seen(
    c: Float[np.ndarray, "k k"], own: Float[np.ndarray, "k k"], least: float
) -> tuple[Float[np.ndarray, "k k"], int]:
    """The inverse of `c` over the directions that show, and how many they are; `own` is `c` without any unknowns."""
    if not np.isfinite(c).all():
        # Numbers that overflow: of what fits nothing, no direction shows.
        return np.zeros_like(c), 0
    size = np.sqrt(np.diagonal(own))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(c * unit[:, None] * unit)
    kept = values > least
    half = vectors[:, kept] / np.sqrt(values[kept]) * unit[:, None]
    return half @ half.T, int(kept.sum())
