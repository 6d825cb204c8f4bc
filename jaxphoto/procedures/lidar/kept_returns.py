"""Selection of returns for a strip adjustment of a cloud larger than memory: those at places that strips share.

The cloud is read twice, in parts. First its cells are accumulated; then the returns of cells with planes of two strips
are kept, as many as fit, and those about control and tie points of photographs. The search then finds in them what it
would find in the whole cloud.
"""

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Pattern
from jaxphoto.lidar.correction import ScannerPath
from jaxphoto.lidar.strip_planes import CellReturns, CellTally, StripSettings, cells_of, corresponding, planes_from
from jaxphoto.procedures.lidar.strip_model import Look, looks_of, thinned

KEPT = 10_000_000
"""Returns in memory: about a gigabyte with the search, and far more than 4,000 planes need."""
# Maximum fraction about tie points; each attempt takes this factor less than the one before.
_ABOUT_POINTS, _LESS = 0.5, 0.8
_LEAST = 1e-4
# Minimum number of planes per pair of strips.
_FEWEST = 100


def kept_returns(
    parts: Callable[[], Iterator[Cloud]],
    settings: StripSettings,
    path: ScannerPath | None = None,
    pattern: Pattern = "line",
    places: Callable[[], Float[np.ndarray, "n 3"]] | None = None,
    surveyed: Float[np.ndarray, "k 3"] | None = None,
    most: int = KEPT,
) -> Cloud:
    """Return the returns of a cloud for `adjust_strips`; all of them for at most `most` returns.

    `parts` yields the cloud each time it is called, in parts of bounded size whose strips are those met so far;
    `places` (m) are approximate tie points of photographs; `surveyed` (m) is control, all of whose returns are kept.
    """
    small: list[Cloud] = []
    passed, number = _Passed(settings, path, pattern), 0
    for part in parts():
        number += len(part)
        if number <= most:
            small.append(part)
            continue
        for one in (*small, part):
            passed.add(one)
        small = []
    if number <= most:
        return Cloud.joined(small)
    none = np.zeros((0, 3))
    always = _about(passed.cells, none if surveyed is None else surveyed, 1.0, settings)
    cells = _chosen(passed.cells, settings, most, none if places is None else places(), always)
    return Cloud.joined([part.take(passed.returns(part, cells)) for part in parts()])


class _Passed:
    """Accumulated data of a cloud."""

    def __init__(self, settings: StripSettings, path: ScannerPath | None, pattern: Pattern) -> None:
        self.settings, self.path, self.pattern = settings, path, pattern
        self._tally = CellTally(settings)
        self._spans: dict[int, tuple[float, float]] = {}

    def add(self, part: Cloud) -> None:
        for look in self._looks(part):
            self._tally.add(look.name, part.xyz[look.returns])
            if part.time is not None:
                time = part.time[look.returns]
                first, last = self._spans.get(look.strip, (np.inf, -np.inf))
                self._spans[look.strip] = min(first, time.min()), max(last, time.max())

    @property
    def cells(self) -> dict[str, CellReturns]:
        """By the name of each look."""
        return self._tally.strips

    def returns(self, part: Cloud, cells: dict[str, Int[np.ndarray, "cells"]]) -> Bool[np.ndarray, "n"]:
        """Return the returns of a part in `cells`; and of each strip the first and last, the ends of its splines."""
        selected = np.zeros(len(part), bool)
        for look in self._looks(part):
            own_returns = look.returns
            selected[own_returns] = np.isin(cells_of(part.xyz[own_returns], self.settings), cells[look.name])
            if part.time is None:
                # Without times, an adjustment needs only the extents of strips.
                selected[own_returns[:1]] = True
            else:
                selected[own_returns] |= np.isin(part.time[own_returns], self._spans[look.strip])
        return selected

    def _looks(self, part: Cloud) -> list[Look]:
        path = self.path if part.time is not None else None
        return [look for look in looks_of(part, path, self.pattern) if len(look.returns)]


def _chosen(
    looks: dict[str, CellReturns],
    settings: StripSettings,
    most: int,
    places: Float[np.ndarray, "n 3"],
    always: dict[str, Int[np.ndarray, "kept"]],
) -> dict[str, Int[np.ndarray, "cells"]]:
    """Return the cells of each look whose returns are kept, at most `most`; those in `always`, and others."""
    most -= _number(looks, always)
    part, room = 1.0, _ABOUT_POINTS * most
    while (n_about := _number(looks, about := _about(looks, places, part, settings))) > room and part > _LEAST:
        part *= _LESS
    most -= n_about
    planes = {name: planes_from(cells, settings) for name, cells in looks.items()}
    pairs = [(a, b, corresponding(planes[a], planes[b], settings)) for a, b in combinations(looks, 2)]
    part = 1.0
    while True:
        chosen: dict[str, list[np.ndarray]] = {name: [about[name], always[name]] for name in looks}
        for a, b, pairs_of in pairs:
            share = max(_FEWEST, round(part * len(pairs_of.cell)))
            cells_of_pair = pairs_of.cell[thinned(pairs_of.normal, pairs_of.cell, share)]
            chosen[a].append(cells_of_pair)
            chosen[b].append(cells_of_pair)
        cells = {name: np.unique(np.concatenate(cells_of_pair)) for name, cells_of_pair in chosen.items()}
        if _number(looks, cells) <= most or part * max((len(f.cell) for *_, f in pairs), default=0) < _FEWEST:
            return cells
        part *= _LESS


def _about(
    looks: dict[str, CellReturns], places: Float[np.ndarray, "n 3"], part: float, settings: StripSettings
) -> dict[str, Int[np.ndarray, "cells"]]:
    """Return the cells in and around which some of the places lie."""
    number = max(1, round(part * len(places)))
    some = places[np.linspace(0, len(places) - 1, number).astype(int)] if len(places) else places
    beside = [np.array([x, y, 0.0]) * settings.cell_m for x in (-1, 0, 1) for y in (-1, 0, 1)]
    cells = np.unique(np.concatenate([cells_of(some + step, settings) for step in beside]))
    return {name: np.intersect1d(cells, look_cells.cell, assume_unique=True) for name, look_cells in looks.items()}


def _number(looks: dict[str, CellReturns], cells: dict[str, Int[np.ndarray, "cells"]]) -> int:
    """Return the number of returns in cells of the looks."""
    return sum(
        int(look_cells.returns[np.isin(look_cells.cell, cells[name], assume_unique=True)].sum())
        for name, look_cells in looks.items()
    )
