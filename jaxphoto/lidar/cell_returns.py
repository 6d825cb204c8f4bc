"""Returns of a strip by grid cell: number, mean and scatter, which can be accumulated in parts.

For parts of a cell with numbers n, means m and scatters S about them, the total has the common mean, and S = sum (S_k +
n_k (m_k - m) (m_k - m)'): no digits are lost to squares of coordinates. Source: Chan, Golub and LeVeque (1979),
Updating formulae and a pairwise algorithm for computing sample variances.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.lidar.strip_settings import StripSettings

# Number of parts after which they are merged: a compromise between memory and time.
_PARTS = 8


class CellReturns(NamedTuple):
    """Sums from which the planes of a strip follow, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Mean of the returns (m)."""
    measured: Float[np.ndarray, "n 3"]
    """Mean of the returns as measured."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    scatter: Float[np.ndarray, "n 3 3"]
    """Sum of squares and products of the returns about their mean (m^2)."""


def cells_of(xyz: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """Return the cell of each return in a grid through the origin, independent of the part of the cloud."""
    column, up = np.floor(xyz[:, :2] / settings.cell_m).astype(np.int64).T
    return (column << 32) + up


def columns_and_rows(cell: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return column and row of cells of `cells_of` relative to the origin."""
    up = ((cell + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    return (cell - up) >> 32, up


def gathered(
    xyz: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    cell: Int[np.ndarray, "n"],
) -> CellReturns:
    """Accumulate returns `xyz` (m), corrected, by cell; `measured` are the original ones, `time` (s) their times."""
    cells, of = np.unique(cell, return_inverse=True)
    return _together(cells, of, np.ones(len(of), int), xyz, measured, time, None)


def joined(parts: Sequence[CellReturns]) -> CellReturns:
    """Merge the cells of parts of one strip."""
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
    """Merge means of `count` returns each, and their scatters (None: single returns), of the cells `cells[of]`."""
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
    """Accumulated cells of several strips; the returns themselves are not stored."""

    def __init__(self, settings: StripSettings) -> None:
        self.settings = settings
        self._parts: dict[str, list[CellReturns]] = {}

    def add(self, key: str, xyz: Float[np.ndarray, "n 3"]) -> None:
        """Add returns (m) of the strip `key`."""
        parts = self._parts.setdefault(key, [])
        parts.append(gathered(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, self.settings)))
        if len(parts) > _PARTS:
            parts[:] = [joined(parts)]

    @property
    def strips(self) -> dict[str, CellReturns]:
        """Return the cells of each strip, in order of arrival."""
        return {key: joined(parts) for key, parts in self._parts.items()}
