"""Which returns of a cloud larger than memory its strip adjustment looks at: those of places that strips share.

The cloud passes twice, part by part. At first its cells are added up; then the returns of cells are taken in which two
strips have one plane, as many as there is room for, and those about control and about tie points of photographs. What
is then seen is what a search in all of it sees in these cells.
"""

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.georeferencing import Pattern
from jaxphoto.lidar.cell_returns import CellReturns, CellTally, cells_of
from jaxphoto.lidar.correction import ScannerPath
from jaxphoto.lidar.corresponding_planes import corresponding, planes_from
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.procedures.lidar.looks import Look, looks_of
from jaxphoto.procedures.lidar.strip_rows import thinned

KEPT = 10_000_000
"""Returns in memory: with what their search needs about a gigabyte, and for 4,000 planes far more than enough."""
# Of them those about tie points at most this part; each try takes so much less than the one before.
_ABOUT_POINTS, _LESS = 0.5, 0.8
_LEAST = 1e-4
# Of a pair of strips at least so many planes are looked at.
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
    """The returns of a cloud that `adjust_strips` is to look at; of one of `most` returns or fewer all.

    `parts` gives the cloud anew each time, in parts of bounded size whose strips are those met so far; `places` (m)
    where tie points of photographs are, about; `surveyed` (m) where control is, all of whose returns are kept.
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
    """What is known of a cloud that has passed."""

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
        """Those of a part that lie in `cells`; and of each strip the first and the last, which its splines go from."""
        kept = np.zeros(len(part), bool)
        for look in self._looks(part):
            own = look.returns
            kept[own] = np.isin(cells_of(part.xyz[own], self.settings), cells[look.name])
            if part.time is None:
                # Nothing that is adjusted without times asks for more than where strips are.
                kept[own[:1]] = True
            else:
                kept[own] |= np.isin(part.time[own], self._spans[look.strip])
        return kept

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
    """The cells of each look whose returns are to be kept, `most` of them together; those `always`, and others."""
    most -= _number(looks, always)
    part, room = 1.0, _ABOUT_POINTS * most
    while (kept := _number(looks, about := _about(looks, places, part, settings))) > room and part > _LEAST:
        part *= _LESS
    most -= kept
    planes = {name: planes_from(cells, settings) for name, cells in looks.items()}
    pairs = [(a, b, corresponding(planes[a], planes[b], settings)) for a, b in combinations(looks, 2)]
    part = 1.0
    while True:
        chosen: dict[str, list[np.ndarray]] = {name: [about[name], always[name]] for name in looks}
        for a, b, found in pairs:
            share = max(_FEWEST, round(part * len(found.cell)))
            own = found.cell[thinned(found.normal, found.cell, share)]
            chosen[a].append(own)
            chosen[b].append(own)
        cells = {name: np.unique(np.concatenate(own)) for name, own in chosen.items()}
        if _number(looks, cells) <= most or part * max((len(f.cell) for *_, f in pairs), default=0) < _FEWEST:
            return cells
        part *= _LESS


def _about(
    looks: dict[str, CellReturns], places: Float[np.ndarray, "n 3"], part: float, settings: StripSettings
) -> dict[str, Int[np.ndarray, "cells"]]:
    """The cells in and beside which a part of the places lie."""
    number = max(1, round(part * len(places)))
    some = places[np.linspace(0, len(places) - 1, number).astype(int)] if len(places) else places
    beside = [np.array([x, y, 0.0]) * settings.cell_m for x in (-1, 0, 1) for y in (-1, 0, 1)]
    cells = np.unique(np.concatenate([cells_of(some + step, settings) for step in beside]))
    return {name: np.intersect1d(cells, own.cell, assume_unique=True) for name, own in looks.items()}


def _number(looks: dict[str, CellReturns], cells: dict[str, Int[np.ndarray, "cells"]]) -> int:
    """Returns in cells of the looks."""
    return sum(
        int(own.returns[np.isin(own.cell, cells[name], assume_unique=True)].sum()) for name, own in looks.items()
    )
