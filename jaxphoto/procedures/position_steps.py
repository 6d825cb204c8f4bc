"""Detect steps (jumps) in recorded positions, after a lost fix or a change of base station.

Differences of successive offsets (recorded minus network), in the order of exposures, are tested: a step is an outlier,
by axis, among all differences. Its test statistic is the deleted residual (Student's t), at a level divided by the
number of places and axes (Bonferroni). Differences suit white noise and random walk of the receiver: either has
constant variance. The model has everything else that changes offsets: the similarity of the network to the positions,
which would absorb a step, a bend of the network in height, and a delay or lever arm, which rotates with the flight.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.block import Block
from jaxphoto.georeferencing import StripBias
from jaxphoto.unknowns import FIXED, FREE

_STEP_LEVEL = 0.03
# More indicate another systematic effect.
_MOST = 3
# Minimum number of photographs on either side; fewer are single outliers.
_LEAST = 3
# Minimum degrees of freedom per axis.
_LEAST_FREE = 5
# Maximum ratio of a deviation from the local median to the scatter; scale of the median absolute deviation.
_ISOLATED, _MAD = 6.0, 1.4826
# Columns of the bend in the model.
_BEND = (4, 5, 6)


class PositionStep(NamedTuple):
    """Step of the positions from photograph `first` on (index in the given order)."""

    first: int
    by_m: Float[np.ndarray, "3"]
    sigma_m: Float[np.ndarray, "3"]


def detect_steps(
    offsets_m: Float[np.ndarray, "n 3"], at_m: Float[np.ndarray, "n 3"], least_m: Float[np.ndarray, "3"]
) -> list[PositionStep]:
    """Detect steps of `offsets_m` (recorded minus network: east, north, up) of ordered photographs at positions `at_m`.

    Steps of at most `least_m` on every axis are ignored: the positions' standard deviations allow them. Returns none if
    there are more than three.
    """
    valid = np.flatnonzero(~_isolated(offsets_m))
    y, model = offsets_m[valid], _model(at_m[valid])
    places: list[int] = []
    while len(places) <= _MOST and (place := _most_significant(y, model, np.diff(valid), places, least_m)) is not None:
        places.append(place)
    if not places or len(places) > _MOST:
        return []
    places.sort()
    by, sigma = _step_sizes(y, model, places)
    return [PositionStep(int(valid[c]), by[k], sigma[k]) for k, c in enumerate(places)]


def _model(at: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 u"]:
    """Design matrix of offsets without steps; no shift, which differences do not contain."""
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


def _most_significant(
    y: np.ndarray, model: np.ndarray, apart: np.ndarray, places: list[int], least_m: np.ndarray
) -> int | None:
    """Return the most significant place other than `known`; None if none is significant."""
    # Place k is the difference between photographs k - 1 and k; known steps are excluded.
    place = np.setdiff1d(np.arange(1, len(y)), places)
    # The standard deviation of a random walk increases with the number of omitted photographs.
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
    # These scales standardise each axis; the deleted variance is smaller.
    known_well = lever > 0.1
    jump = np.where(known_well, left / np.maximum(lever, 0.1), 0.0)
    squares = np.sum(left**2, axis=0) - left * jump
    t = np.abs(jump) * np.sqrt(np.maximum(lever, 0.1) * free / np.maximum(squares, 1e-12))
    inside = (place >= _LEAST) & (place <= len(y) - _LEAST)
    t = np.where(inside[:, None] & (np.abs(jump) * scale * wide > least_m), t, 0.0)
    limit = float(scipy.stats.t.isf(_STEP_LEVEL / (2 * t.size), free))
    return int(place[np.argmax(t.max(axis=1))]) if t.max() > limit else None


def _step_sizes(y: np.ndarray, model: np.ndarray, places: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the steps at `places` and their standard deviations, from the mean offsets before and after them.

    First-order autoregressive errors are allowed for. The bend is omitted: few strips determine it as poorly as the
    steps.
    """
    n, k = len(y), len(places)
    model = np.delete(model, _BEND, axis=2)
    columns = np.column_stack([np.ones(n), np.arange(n)[:, None] >= np.array(places)]).astype(float)
    step_columns = np.einsum("nc,ab->nacb", columns, np.eye(3)).reshape(n, 3, -1)
    design = np.concatenate([step_columns, model], axis=2).reshape(3 * n, -1)
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


def _isolated(offsets: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Mark offsets far from the median of their neighbours."""
    n = len(offsets)
    about = np.stack([np.clip(np.arange(n) + k, 0, n - 1) for k in range(-_LEAST, _LEAST + 1)])
    deviation = offsets - np.median(offsets[about], axis=0)
    scale = np.maximum(_MAD * np.median(np.abs(deviation), axis=0), 1e-9)
    return (np.abs(deviation) > _ISOLATED * scale).any(axis=1)


class PositionParts(NamedTuple):
    """Part of each photograph with a position."""

    part: Int[np.ndarray, "n"]
    shift_m: Float[np.ndarray, "parts 3"]
    """Zero for the part with most photographs, the reference."""
    first: tuple[str, ...]
    """First photograph of each part."""
    sentences: tuple[str, ...]

    @property
    def off_m(self) -> Float[np.ndarray, "n 3"]:
        """Shift of each position."""
        return self.shift_m[self.part]


def position_parts(
    names: Sequence[str],
    order: Sequence[str],
    offsets_m: Float[np.ndarray, "n 3"],
    at_m: Float[np.ndarray, "n 3"],
    least_m: Float[np.ndarray, "3"],
) -> PositionParts:
    """Divide photographs `names` at steps of their positions; `order` contains these names; see `detect_steps`."""
    rank = {name: k for k, name in enumerate(order)}
    turn = np.array(sorted(range(len(names)), key=lambda k: rank.get(names[k], k)), int)
    steps = detect_steps(offsets_m[turn], at_m[turn], least_m)
    part = np.zeros(len(names), int)
    part[turn] = np.searchsorted([s.first for s in steps], np.arange(len(names)), side="right")
    shift = np.concatenate([np.zeros((1, 3)), np.cumsum([s.by_m for s in steps], axis=0).reshape(-1, 3)])
    most = int(np.argmax(np.bincount(part)))
    first = tuple(names[turn[k]] for k in (0, *(s.first for s in steps)))
    messages = []
    for k, step in enumerate(steps, 1):
        by, sigma = (", ".join(f"{v:.2f}" for v in of) for of in (step.by_m, step.sigma_m))
        messages.append(
            f"recorded positions jump by {by} m (east, north, up; sigma {sigma}) between {names[turn[step.first - 1]]} "
            f"and {first[k]} (lost fix or changed base): the {np.sum(part == most)} photographs from {first[most]} on "
            "are the reference, the others have a shift in the adjustment. Omit the wrong ones if known"
        )
    return PositionParts(part, shift - shift[most], first, tuple(messages))


def with_part_shifts(block: Block, parts: PositionParts, image: Int[np.ndarray, "n"]) -> Block:
    """Estimate one shift per part, as a strip, except for the reference part; `image` are the images of `parts`."""
    if not parts.sentences:
        return block
    shifts = {f"from_{parts.first[k]}": v for k, v in enumerate(parts.shift_m) if v.any()}
    strip = [""] * len(block.images)
    for i, k in zip(image.tolist(), parts.part.tolist(), strict=True):
        strip[i] = f"from_{parts.first[k]}" if parts.shift_m[k].any() else ""
    zero = np.zeros(3)
    unknowns = dataclasses.replace(
        block.start.unknowns,
        strips={name: StripBias(v, zero) for name, v in shifts.items()},  # type: ignore[arg-type]
    )
    priors = {name: StripBias(FREE, FIXED) for name in shifts}  # type: ignore[arg-type]
    return dataclasses.replace(
        block,
        image_strip=tuple(strip),
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, strips=priors),
    )
