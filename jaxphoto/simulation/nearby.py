"""Neighbour search: places, or ends of rays, near upright objects."""

import numpy as np
from jaxtyping import Float, Int

Pairs = tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]
"""Index of the object, and of the place or ray."""


def pairs_near(
    xy: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "m 2"], radius: Float[np.ndarray, "m"], more_m: float = 0.0
) -> Pairs:
    """Return all pairs of a circle and a place within its `radius` plus `more_m` (m); sorted by circle.

    Places are sorted into square cells as wide as the largest circle, so that a circle meets only the cells around that
    of its centre: three contiguous ones in each column.
    """
    if not len(xy) or not len(centre):
        return np.zeros(0, int), np.zeros(0, int)
    # Slightly larger: the caller decides about the edge.
    reach = radius + more_m + 1e-6
    low, side = xy.min(axis=0), reach.max()
    cell = np.floor((xy - low) / side).astype(int) + 1
    rows = cell[:, 1].max() + 2
    key = cell[:, 0] * rows + cell[:, 1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    # Circles beyond the places on either side touch empty cells.
    column, row = np.clip(np.floor((centre - low) / side) + 1, 0, cell.max(axis=0) + 1).astype(int).T
    first, last = np.maximum(row - 1, 0), np.minimum(row + 1, rows - 1)
    begin = np.stack([np.searchsorted(key, (column + c) * rows + first, side="left") for c in (-1, 0, 1)], axis=1)
    end = np.stack([np.searchsorted(key, (column + c) * rows + last, side="right") for c in (-1, 0, 1)], axis=1)
    count = (end - begin).ravel()
    circle = np.repeat(np.repeat(np.arange(len(centre)), 3), count)
    place = order[np.arange(len(circle)) + np.repeat(begin.ravel() - np.cumsum(count) + count, count)]
    near = np.sum((xy[place] - centre[circle]) ** 2, axis=1) <= reach[circle] ** 2
    return circle[near], place[near]


def pairs_along(
    end: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, "m"],
    top: Float[np.ndarray, "m"],
) -> Pairs:
    """Return a superset of pairs of an upright cylinder up to Z = `top` (m) and a ray that passes it on its way to
    `end`.
    """
    if not len(end):
        return np.zeros(0, int), np.zeros(0, int)
    slant = np.max(np.hypot(*direction[:, :2].T) / -direction[:, 2])
    return pairs_near(end[:, :2], centre, radius, float(slant * max(top.max() - end[:, 2].min(), 0.0)))
