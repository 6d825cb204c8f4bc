"""Rows of a block that have each other's numbers, and the block with these exchanged."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import still
from jaxphoto.block import Block
from jaxphoto.procedures.robust import Masks


class Exchange(NamedTuple):
    """Rows of a group to exchange with one another: what was observed, and its standard deviation."""

    group: str
    rows: tuple[tuple[int, int], ...]
    words: str
    """Such as "points 12 and 31 of image A2 had each other's name"."""
    back: dict[str, tuple[int, ...]]
    """By group, rows that are in again, once these are exchanged."""


def exchanged(block: Block, left: Masks, exchange: Exchange) -> tuple[Block, Masks]:
    """The block with these rows exchanged, and what is no longer left out."""
    rows = block.named_observations[exchange.group]
    order = np.arange(len(rows))
    one, other = np.array(exchange.rows).T
    order[one], order[other] = other, one
    new, sigma = rows.with_observation(still(rows.observation)[order]), still(rows.sigmas)
    new = new.with_sigmas_times(sigma[order] / sigma)
    left = left | {group: _without(left[group], back) for group, back in exchange.back.items()}
    return block.with_observations({exchange.group: new}), left


def with_places(at: Adjustment, places: Mapping[int, Float[np.ndarray, "3"]]) -> Adjustment:
    """`at` with points at these places (m)."""
    points = np.array(still(at.unknowns.points))
    for point, place in places.items():
        points[point] = place
    return eqx.tree_at(lambda a: a.unknowns.points, at, points)


def _without(left: np.ndarray, back: tuple[int, ...]) -> np.ndarray:
    out = left.copy()
    out[list(back)] = False
    return out
