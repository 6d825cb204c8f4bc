"""The returns of a strip, cell by cell of a grid: their number, mean and scatter, which can be added up in parts.

Of two parts of a cell with numbers n, means m and scatters S about them, the whole has the mean of all, and
S = sum (S_k + n_k (m_k - m) (m_k - m)'): no digits are lost to squares of coordinates. Source: Chan, Golub and LeVeque
(1979), Updating formulae and a pairwise algorithm for computing sample variances.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.lidar.strip_settings import StripSettings

# Parts are joined when so many have come: often enough to hold few, seldom enough not to join for ever.
_PARTS = 8


class CellReturns(NamedTuple):
    """What the planes of a strip follow from, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Of the returns (m)."""
    measured: Float[np.ndarray, "n 3"]
    """The same of the returns as they were measured."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    scatter: Float[np.ndarray, "n 3 3"]
    """Sum of squares and products of the returns about their mean (m^2)."""


def cells_of(xyz: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """The cell of each return, of a grid through the origin: of whatever part of a cloud, the same cells."""
    column, up = np.floor(xyz[:, :2] / settings.cell_m).astype(np.int64).T
    return (column << 32) + up


def columns_and_rows(cell: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Of cells of `cells_of`, how many lie between each and the origin in X and in Y, negative before it."""
    up = ((cell + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    return (cell - up) >> 32, up


def gathered(
    xyz: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    cell: Int[np.ndarray, "n"],
) -> CellReturns:
    """Returns `xyz` (m), corrected, by the cell of each; `measured` is where they were, `time` (s) when."""
    cells, of = np.unique(cell, return_inverse=True)
    return _together(cells, of, np.ones(len(of), int), xyz, measured, time, None)


def joined(parts: Sequence[CellReturns]) -> CellReturns:
    """Cells of parts of one strip, those that several parts have as one."""
    columns = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
    cell, count, mean, measured, time, scatter = columns
    cells, of = np.unique(cell, return_inverse=True)
    return _together(cells, of, count, mean, measured, time, scatter)


def _together(
    cells: Int[np.ndarray, "cells"],
    of: Int[np.ndarray, "n"],
    count: Int[np.ndarray, "n"],
    mean: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    scatter: Float[np.ndarray, "n 3 3"] | None,
) -> CellReturns:
    """Means of `count` returns each, and their scatters (None: of one return each), of the cells `cells[of]`."""
    total = np.bincount(of, count, len(cells))

    def average(values: np.ndarray) -> np.ndarray:
        return np.bincount(of, count * values, len(cells)) / total

    middle = np.column_stack([average(v) for v in mean.T])
    before = middle if measured is mean else np.column_stack([average(v) for v in measured.T])
    off = mean - middle[of]
    result = np.empty((len(cells), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            own = count * (off[:, i] * off[:, j])
            own = own if scatter is None else own + scatter[:, i, j]
            result[:, i, j] = result[:, j, i] = np.bincount(of, own, len(cells))
    return CellReturns(cells, total.astype(int), middle, before, average(time), result)


class CellTally:
    """Returns of several strips that come in parts, cell by cell: of the returns themselves nothing is kept."""

    def __init__(self, settings: StripSettings) -> None:
        self.settings = settings
        self._parts: dict[str, list[CellReturns]] = {}

    def add(self, key: str, xyz: Float[np.ndarray, "n 3"]) -> None:
        """Returns (m) of the strip `key`."""
        parts = self._parts.setdefault(key, [])
        parts.append(gathered(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, self.settings)))
        if len(parts) > _PARTS:
            parts[:] = [joined(parts)]

    @property
    def strips(self) -> dict[str, CellReturns]:
        """The cells of each strip, in the order in which they came."""
        return {key: joined(parts) for key, parts in self._parts.items()}
