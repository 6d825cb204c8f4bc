"""Trees: upright ellipsoidal crowns, which laser pulses penetrate.

A pulse hits leaves after exponentially distributed distances within crowns; each hit gives a return, and half of the
pulses continue.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.simulation.nearby import pairs_along, pairs_near

# Bare fraction of the height of a tree.
_BARE = 0.3
# Mean distance between leaves (m), and maximum number of returns of a pulse from crowns.
_WAY_M = 2.5
_RETURNS = 3


@dataclasses.dataclass(frozen=True)
class Tree:
    """Tree at `at_m` (X, Y) on ground of Z = `foot_m`, `height_m` high, with a crown of `radius_m`."""

    at_m: tuple[float, float]
    foot_m: float
    height_m: float
    radius_m: float


class Crowns(NamedTuple):
    """Ellipsoids about `centre` with half axes `half` (m)."""

    centre: Float[np.ndarray, "trees 3"]
    half: Float[np.ndarray, "trees 3"]


class Leaves(NamedTuple):
    """Hits of leaves: index of the pulse, distance along its ray (m); and the pulses that ended there."""

    pulse: Int[np.ndarray, "returns"]
    at: Float[np.ndarray, "returns"]
    stopped: Bool[np.ndarray, "pulses"]


def crowns(trees: Sequence[Tree]) -> Crowns:
    """Return the crowns of `trees`."""
    upright = [(1 - _BARE) / 2 * t.height_m for t in trees]
    centre = [(*t.at_m, t.foot_m + t.height_m - up) for t, up in zip(trees, upright, strict=True)]
    half = [(t.radius_m, t.radius_m, up) for t, up in zip(trees, upright, strict=True)]
    return Crowns(np.array(centre).reshape(-1, 3), np.array(half).reshape(-1, 3))


def under_crown(trees: Sequence[Tree], xy: Float[np.ndarray, "n 2"], margin_m: float) -> Bool[np.ndarray, "n"]:
    """Return True if a place (east, north) lies under a crown or within `margin_m` of one."""
    under = np.zeros(len(xy), bool)
    if trees:
        centre, half = crowns(trees)
        under[pairs_near(xy, centre[:, :2], half[:, 0], margin_m)[1]] = True
    return under


def met_leaves(
    trees: Sequence[Tree],
    origin: Float[np.ndarray, "pulses 3"],
    direction: Float[np.ndarray, "pulses 3"],
    end: Float[np.ndarray, "pulses"],
    rng: np.random.Generator,
) -> Leaves:
    """Return the hits of pulses along unit vectors in crowns before their `end` (m along each).

    Crowns may overlap: their path lengths add up, as if leaves were twice as dense.
    """
    pulse, into, way = _chords(trees, origin, direction, end)
    order = np.lexsort((into, pulse))
    pulse, into, way = pulse[order], into[order], way[order]
    # Concatenate the paths in crowns of all pulses on one line: place of a pulse after a distance within leaves.
    line = np.concatenate([[0.0], np.cumsum(way)])
    which, first, count = np.unique(pulse, return_index=True, return_counts=True)
    begin, length = line[first], line[first + count] - line[first]
    gone, on = np.zeros(len(which)), np.ones(len(which), bool)
    found = []
    for _ in range(_RETURNS):
        gone = gone + rng.exponential(_WAY_M, len(which))
        stays = rng.random(len(which)) < 0.5
        meets = on & (gone < length)
        place = begin[meets] + gone[meets]
        chord = np.clip(np.searchsorted(line, place, side="right") - 1, 0, len(way) - 1)
        found.append((which[meets], into[chord] + place - line[chord]))
        on &= ~(meets & stays)
    stopped = np.zeros(len(origin), bool)
    stopped[which[~on]] = True
    met, at = (np.concatenate(part) for part in zip(*found, strict=True))
    return Leaves(met, at, stopped)


def _chords(
    trees: Sequence[Tree], origin: np.ndarray, direction: np.ndarray, end: np.ndarray
) -> tuple[Int[np.ndarray, "chords"], Float[np.ndarray, "chords"], Float[np.ndarray, "chords"]]:
    """Return the pulse, the distance along it at which a crown begins (m), and its path within (m)."""
    if not trees:
        return np.zeros(0, int), np.zeros(0), np.zeros(0)
    centre, half = crowns(trees)
    ends = origin + end[:, None] * direction
    tree, pulse = pairs_along(ends, direction, centre[:, :2], half[:, 0], centre[:, 2] + half[:, 2])
    # On the unit sphere: |q + t e|^2 = 1.
    q, e = (origin[pulse] - centre[tree]) / half[tree], direction[pulse] / half[tree]
    ee, qe, qq = (np.einsum("ni,ni->n", a, b) for a, b in ((e, e), (q, e), (q, q)))
    root = np.sqrt(np.maximum(qe**2 - ee * (qq - 1), 0))
    into, out_of = (-qe - root) / ee, np.minimum((-qe + root) / ee, end[pulse])
    within = out_of > into
    return pulse[within], into[within], (out_of - into)[within]
