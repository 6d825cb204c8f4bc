"""Matched photographs and their connected groups."""

from collections.abc import Container
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.initial.matches import PairMatches, connected_images


class MatchedPart(NamedTuple):
    """Features of photographs and their matches, as input of `orient`."""

    names: list[str]
    xy_mm: list[Float[np.ndarray, "n 2"]]
    sigma_mm: list[Float[np.ndarray, "n"]]
    pairs: list[PairMatches]
    gross: Int[np.ndarray, "compared 3"]
    """By compared pair: first, second, number of rejected matches."""
    sigma_factor: float
    """Ratio of the scatter of the accepted matches to that expected of coplanar features."""

    @property
    def n_gross(self) -> int:
        """Number of rejected matches of all pairs."""
        return int(self.gross[:, 2].sum())

    def groups(self, least: int = 2) -> list["MatchedPart"]:
        """Connected groups, the largest first, of `least` photographs or more."""
        together = connected_images(len(self.names), self.pairs)
        return [self._of(group) for group in together if len(group) >= least]

    def among(self, names: Container[str]) -> "MatchedPart":
        """Select photographs by name."""
        return self._of(np.array([k for k, name in enumerate(self.names) if name in names], int))

    def _of(self, photographs: Int[np.ndarray, "photographs"]) -> "MatchedPart":
        """Select photographs and renumber."""
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
