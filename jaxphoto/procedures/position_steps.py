"""Where recorded positions step: from one photograph on all are off by the same, as where a fix or a base changed.

Of photographs in their order the differences of offsets (recorded minus network) from one to the next are judged: a
step is one difference, by axis, that is an outlier among all of them. Its likelihood ratio is that of its deleted
residual, Student's t, at a level divided by the number of places and axes (Bonferroni). Differences are as many as the
noise of the receiver is white or wanders: either has one variance throughout. Unknowns beside it are what else moves
offsets: the similarity by which the network was brought to the positions, in which a step hides otherwise, a bend of
the network in height, and a delay or a lever arm, which turn with the flight.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

_LEVEL = 0.03
# More are a pattern of another kind.
_MOST = 3
# Fewer photographs than these to either side are single positions that are off.
_LEAST = 3
# Differences of one axis that are free, beside the unknowns.
_LEAST_FREE = 5
# Of the scatter about the median of neighbours: such a position is off by itself.
_ALONE, _MAD = 6.0, 1.4826
# Columns of the model.
_BEND = (4, 5, 6)


class PositionStep(NamedTuple):
    """From the photograph `first` on (of those in order) positions are off from those before."""

    first: int
    by_m: Float[np.ndarray, "3"]
    sigma_m: Float[np.ndarray, "3"]


def steps_of(
    offsets_m: Float[np.ndarray, "n 3"], at_m: Float[np.ndarray, "n 3"], least_m: Float[np.ndarray, "3"]
) -> list[PositionStep]:
    """The steps of `offsets_m` (recorded minus network: east, north, up) of photographs in their order, taken `at_m`.

    Those that are no more than `least_m` on any axis are none: the positions' standard deviations allow as much. Of
    more than three nothing is said.
    """
    kept = np.flatnonzero(~_alone(offsets_m))
    y, model = offsets_m[kept], _model(at_m[kept])
    places: list[int] = []
    while len(places) <= _MOST and (place := _next(y, model, np.diff(kept), places, least_m)) is not None:
        places.append(place)
    if not places or len(places) > _MOST:
        return []
    places.sort()
    by, sigma = _sizes(y, model, places)
    return [PositionStep(int(kept[c]), by[k], sigma[k]) for k, c in enumerate(places)]


def _model(at: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 u"]:
    """What moves offsets beside noise and steps, as columns; without a shift, of which differences know nothing."""
    p = at - at.mean(axis=0)
    x, y, z = (p / max(float(np.abs(p).max()), 1e-9)).T
    o = np.zeros(len(p))
    along = np.gradient(p[:, :2], axis=0)
    e, n = (along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)).T
    columns = [
        *((x, y, z), (-y, x, o), (z, o, -x), (o, z, -y)),
        *((o, o, x * x), (o, o, x * y), (o, o, y * y)),
        *((e, n, o), (n, -e, o)),
    ]
    return np.stack([np.stack(c, axis=1) for c in columns], axis=2)


def _next(y: np.ndarray, model: np.ndarray, apart: np.ndarray, known: list[int], least_m: np.ndarray) -> int | None:
    """The place beside those `known` whose step is the most significant, where one is."""
    # A place is the number of the photograph after it; the difference of a known step tells nothing more.
    place = np.setdiff1d(np.arange(1, len(y)), known)
    # Noise that wanders does so the more, the more photographs between are left out.
    wide = np.sqrt(apart[place - 1])[:, None]
    d, u = np.diff(y, axis=0)[place - 1] / wide, np.diff(model, axis=0)[place - 1] / wide[..., None]
    n, free = len(place), len(place) - u.shape[2] / 3 - 1
    if free < _LEAST_FREE:
        return None
    scale = np.maximum(_MAD * np.median(np.abs(d), axis=0), 1e-9)
    left, lever = d, np.zeros_like(d)
    for _ in range(3):
        basis = _basis((u / scale[:, None]).reshape(3 * n, -1))
        left = ((d / scale).ravel() - basis @ (basis.T @ (d / scale).ravel())).reshape(n, 3)
        lever = 1 - np.sum(basis**2, axis=1).reshape(n, 3)
        scale = scale * np.maximum(np.sqrt(np.sum(left**2, axis=0) / np.sum(lever, axis=0)), 1e-9)
    # With these scales the variance of each axis is one; without the difference itself it is less.
    known_well = lever > 0.1
    jump = np.where(known_well, left / np.maximum(lever, 0.1), 0.0)
    squares = np.sum(left**2, axis=0) - left * jump
    t = np.abs(jump) * np.sqrt(np.maximum(lever, 0.1) * free / np.maximum(squares, 1e-12))
    inside = (place >= _LEAST) & (place <= len(y) - _LEAST)
    t = np.where(inside[:, None] & (np.abs(jump) * scale * wide > least_m), t, 0.0)
    limit = float(scipy.stats.t.isf(_LEVEL / (2 * t.size), free))
    return int(place[np.argmax(t.max(axis=1))]) if t.max() > limit else None


def _sizes(y: np.ndarray, model: np.ndarray, places: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """The steps at `places` by axis, and their standard deviations, by the mean offsets before and after them.

    Errors that persist from one photograph to the next are allowed for, as of an autoregression of the first order. No
    bend beside them: of few strips it is as open as they are.
    """
    n, k = len(y), len(places)
    model = np.delete(model, _BEND, axis=2)
    columns = np.column_stack([np.ones(n), np.arange(n)[:, None] >= np.array(places)]).astype(float)
    own = np.einsum("nc,ab->nacb", columns, np.eye(3)).reshape(n, 3, -1)
    design = np.concatenate([own, model], axis=2).reshape(3 * n, -1)
    inverse = np.linalg.pinv(design, rcond=1e-9)
    x = inverse @ y.ravel()
    left = (y.ravel() - design @ x).reshape(n, 3)
    squares = np.sum(left**2, axis=0)
    lag = np.clip(np.sum(left[1:] * left[:-1], axis=0) / np.maximum(squares, 1e-12), 0.0, 0.95)
    variance = squares / max(n - 1 - k - model.shape[2] / 3, 1.0) * (1 + lag) / (1 - lag)
    cofactor = np.sum(inverse.reshape(-1, n, 3) ** 2 * variance, axis=(1, 2))
    return x[3 : 3 + 3 * k].reshape(k, 3), np.sqrt(cofactor[3 : 3 + 3 * k]).reshape(k, 3)


def _basis(columns: np.ndarray) -> np.ndarray:
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-9 * max(float(s[0]), 1e-30)]


def _alone(offsets: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which are far from the median of those about them."""
    n = len(offsets)
    about = np.stack([np.clip(np.arange(n) + k, 0, n - 1) for k in range(-_LEAST, _LEAST + 1)])
    off = offsets - np.median(offsets[about], axis=0)
    scale = np.maximum(_MAD * np.median(np.abs(off), axis=0), 1e-9)
    return (np.abs(off) > _ALONE * scale).any(axis=1)
