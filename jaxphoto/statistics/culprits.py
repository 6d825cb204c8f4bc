"""Which of several suspects a test cannot do without: a blunder inflates the residuals around it.

Suspects are taken out one after another, the worst first, each as an unknown error of its row. What is left to another
suspect i beside those that are out, S, is with C = P Q_vv P of whitened observations and u = v

    u_i|S = u_i - C_iS C_SS^-1 u_S,     c_i|S = C_ii - C_iS C_SS^-1 C_Si,     w_i|S = u_i|S / (s_S sqrt(c_i|S))

where s_S^2 = (v'v - u_S' C_SS^-1 u_S) / (r - f_S) is the variance factor without them.
Source: Kok (1984), On data snooping and multiple outlier testing, NOAA Technical Report NOS NGS 30.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.statistics.blunder_test import LEAST_SIGMA0, BlunderTest, Suspect
from jaxphoto.statistics.patterns import PatternTerm, ResidualPattern, patterns_of
from jaxphoto.statistics.responses import Responses
from jaxphoto.statistics.trends import LEAST_SEEN, inverse_of_seen

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
