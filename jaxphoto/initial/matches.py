"""Feature matches between photographs, and their connected groups."""

from collections.abc import Container
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class PairMatches(NamedTuple):
    """Matches of features of two photographs."""

    first: int
    """Index of a photograph."""
    second: int
    """Index of another photograph, greater than `first`."""
    features: Int[np.ndarray, "n 2"]
    """Index of the feature in the first and in the second photograph; each at most once in its column."""


class MatchedPart(NamedTuple):
    """Features of photographs and their matches, input of `orient`."""

    names: list[str]
    xy_mm: list[Float[np.ndarray, "n 2"]]
    sigma_mm: list[Float[np.ndarray, "n"]]
    pairs: list[PairMatches]
    gross: Int[np.ndarray, "compared 3"]
    """Per compared pair: first, second, number of rejected matches."""
    sigma_factor: float
    """Ratio of the scatter of the accepted matches to its expectation for coplanar features."""

    @property
    def n_gross(self) -> int:
        """Return the number of rejected matches of all pairs."""
        return int(self.gross[:, 2].sum())

    def groups(self, least: int = 2) -> list["MatchedPart"]:
        """Return the connected groups with at least `least` photographs, the largest first."""
        together = connected_images(len(self.names), self.pairs)
        return [self._of(group) for group in together if len(group) >= least]

    def among(self, names: Container[str]) -> "MatchedPart":
        """Select photographs by name."""
        return self._of(np.array([k for k, name in enumerate(self.names) if name in names], int))

    def _of(self, photographs: Int[np.ndarray, "photographs"]) -> "MatchedPart":
        """Select photographs by index and renumber them."""
        new = np.full(len(self.names), -1)
        new[photographs] = np.arange(len(photographs))
        ends = new[self.gross[:, :2]]
        inside = (ends >= 0).all(axis=1)
        return self._replace(
            names=[self.names[k] for k in photographs],
            xy_mm=[self.xy_mm[k] for k in photographs],
            sigma_mm=[self.sigma_mm[k] for k in photographs],
            pairs=[
                PairMatches(int(new[p.first]), int(new[p.second]), p.features)
                for p in self.pairs
                if new[p.first] >= 0 and new[p.second] >= 0
            ],
            gross=np.column_stack([ends, self.gross[:, 2]])[inside],
        )


def connected_images(n_images: int, pairs: list[PairMatches]) -> list[Int[np.ndarray, "images"]]:
    """Return the groups of images connected by matches, the largest first; an image without matches is a group."""
    parent = list(range(n_images))
    for pair in pairs:
        if len(pair.features):
            parent[_root(parent, pair.second)] = _root(parent, pair.first)
    group = np.array([_root(parent, k) for k in range(n_images)], int)
    return sorted((np.flatnonzero(group == k) for k in np.unique(group)), key=lambda images: -len(images))


def _root(parent: list[int], k: int) -> int:
    """Return the representative of the component of `k`, with path halving."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k
