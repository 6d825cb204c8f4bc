"""Test statistics of all observations, including rejected ones."""

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment, PaddedSizes, linearise
from jaxphoto.procedures.beginnings import weighed
from jaxphoto.procedures.robust import Blocks, Masks, checked_parts
from jaxphoto.statistics import LEAST_CHECKED, LEVEL, UNCHECKED, chi_square_limit

# Factor of standard deviations of rejected rows: negligible weight, without loss of digits.
_WEAK = 1000.0


def row_sizes(at: Adjustment, r: Blocks, predicted: bool = False) -> dict[str, Float[np.ndarray, "_"]]:
    """Return, for each row, sqrt(v' R^-1 v) over the root of its chi-square quantile: above 1 it is a blunder.

    Or sqrt(v' R v), for rejected rows, which the others `predict`. Only directions that the others check count: a point
    of two rays is checked across their epipolar plane, not along it. A prediction hardly checks what is hardly
    determined, but rounding does not enter.
    """
    axes = {name: np.linalg.eigh(own) for name, own in r.items()}
    least = UNCHECKED if predicted else LEAST_CHECKED
    checked = {name: values > least for name, (values, _) in axes.items()}
    n = sum(int(own.any(axis=1).sum()) for own in checked.values())
    found = {}
    for name, (values, vectors) in axes.items():
        along = np.einsum("nij,in->nj", vectors, np.atleast_2d(at.residuals[name])) ** 2
        known = np.where(checked[name], values, 1.0)
        squares = np.sum(np.where(checked[name], along * known if predicted else along / known, 0.0), axis=1)
        freedom = np.maximum(checked[name].sum(axis=1), 1)
        found[name] = np.sqrt(squares / chi_square_limit(freedom, LEVEL / max(n, 1)))
    return found


def predicted_parts(at: Adjustment, left: Masks, sizes: PaddedSizes) -> Blocks:
    """Return `checked_parts`, of rejected rows as if each was added to the others, which then predict it."""
    rows = at.block.named_observations
    weak = {name: weighed(own, np.where(left[name], _WEAK**-2, 1.0)) for name, own in rows.items()}
    r = checked_parts(linearise(at.block.with_observations(weak), at.unknowns, at.block.priors, sizes))
    for name, out in left.items():
        if out.any():
            values, vectors = np.linalg.eigh(r[name][out])
            # 1 / r = 1 + q, for a prediction of the variance q, relative to the row's own of 1; here that is _WEAK^2.
            values = np.clip(values, 0.0, 1.0)
            values = values / (values + _WEAK**2 * (1 - values))
            r[name] = r[name].copy()
            r[name][out] = (vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2)
    return r
