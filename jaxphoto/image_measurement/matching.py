"""Matches of photographs: which features of two show the same place, by their looks and by the epipolar lines.

Two features match where each looks most like the other and clearly more than any third (Lowe's ratio test, both ways).
Of these, those are kept that lie on the epipolar lines of one fundamental matrix. It is estimated of ideal coordinates,
but needs no principal distance: that of EXIF may be a third off, and would refuse true matches with an essential
matrix.
"""

import functools
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import faiss
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling.freed_memory import freed_memory_kept
from jaxphoto.errors import InputError
from jaxphoto.image_measurement.descriptors import METHOD as LOOKS
from jaxphoto.image_measurement.descriptors import FindableFeatures, findable, match_descriptors
from jaxphoto.image_measurement.epipolar import LEAST_MATCHES, epipolar_lines, over_sigma
from jaxphoto.image_measurement.features import LONGEST_PX, METHOD, SiftFeatures, sift_features
from jaxphoto.image_measurement.likely_pairs import largest_of, most_alike
from jaxphoto.image_measurement.photograph_pairs import MostAlike, usual_count
from jaxphoto.initial.matches import PairMatches, connected_images, tracks
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.io.kept_pieces import KeptPieces, name_of
from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.matched_part import MatchedPart

# Off the epipolar line at most, of the diagonal: 4 pixels of 1,300. A distortion not known yet grows with the format.
_OFF_LINE = 0.003
# Scatter is measured where nine tenths lie, 1.645 standard deviations of a normal distribution: the median would be
# blind to the long tails that features have, the square sum to nothing but the false matches left.
_MOST, _MOST_SIGMA = 0.9, 1.6449
_BLANK = "it shows no features: it is blank or out of focus"
_ALONE = f"it has {LEAST_MATCHES} points in common with no other photograph it was compared with"
# Pairs that are kept in one piece at most, so that a run that is killed loses some seconds; and pieces at least, which
# are shared among the cores.
_AT_ONCE, _LEAST_PIECES = 20, 8
# Photographs whose descriptors and cells are in memory, where descriptors are also on the disk: those of one piece and
# some more. Sorting them into cells again takes a quarter of the time of a pair.
_IN_MEMORY = 64
Progress = Callable[[str, int, int], None]
"""What is done, how many of it are, and of how many."""


class MatchedPhotographs(NamedTuple):
    """Features of photographs, and which of them are the same places."""

    xy_mm: list[Float[np.ndarray, "n 2"]]
    """For each photograph, as `SiftFeatures`."""
    sigma_mm: list[Float[np.ndarray, "n"]]
    """Those of `SiftFeatures` times `sigma_factor`."""
    sigma_factor: float
    """How far the matches scatter about the epipolar lines, over what `SiftFeatures` expects."""
    pairs: list[PairMatches]
    """Of those that have enough in common."""
    counts: Int[np.ndarray, "compared 4"]
    """For all pairs compared: first, second, matches by looks, those of them kept (0 where they are too few)."""
    left_out: dict[str, str]
    """Photographs by name that match no other one, and why."""

    @property
    def gross(self) -> Int[np.ndarray, "compared 3"]:
        """For all pairs compared: first, second, matches by looks that are not on the epipolar lines, or too few."""
        return np.column_stack([self.counts[:, :2], self.counts[:, 2] - self.counts[:, 3]])

    @property
    def n_gross(self) -> int:
        """How many those are in all."""
        return int(self.gross[:, 2].sum())

    def named(self, names: list[str]) -> MatchedPart:
        """The same of photographs that are called so, as `calibrate_flight` takes it."""
        return MatchedPart(names, self.xy_mm, self.sigma_mm, self.pairs, self.gross, self.sigma_factor)


class TieFeatures(NamedTuple):
    """Points seen in several photographs, one row for each measurement, sorted by point."""

    photograph: Int[np.ndarray, "rows"]
    """Index of the photograph, in the order given."""
    point: Int[np.ndarray, "rows"]
    xy_mm: Float[np.ndarray, "rows 2"]


def match_photographs(
    photographs: Sequence[Photograph],
    sensor: Sensor,
    interior: InteriorOrientation,
    pairs: Iterable[tuple[int, int]] | MostAlike,
    *,
    count: int | None = None,
    longest_px: int = LONGEST_PX,
    in_parts: bool = False,
    keep: KeptPieces | None = None,
    progress: Progress | None = None,
) -> MatchedPhotographs:
    """SIFT features of photographs of one camera, and their matches in the `pairs` of indices.

    Of each there are `count` features at most, unless given 5,000, or 10,000 of up to 40 photographs; it is made
    smaller to `longest_px` before.

    `interior` is what is known of the camera; only its distortion and principal point count. What is found goes to
    `keep` as it is found, and what is there already is not found again: a run that was killed goes on, to the same
    result. `progress` is called with the numbers of photographs or pairs done and of all.

    A photograph that shows no features, or matches no other one, is `left_out` by name.

    Raises InputError as `sift_features`, where no two photographs match, and where they fall into groups that nothing
    joins, but not `in_parts`.
    """
    if len(photographs) < 2:
        raise InputError("an orientation needs two photographs that overlap, or more; give them all")
    paths = [p.path for p in photographs]
    matched = _matched(paths, sensor, interior, pairs, count, longest_px, keep or _InMemory(), progress or _untold)
    blank = [len(xy) == 0 for xy in matched.xy_mm]
    alone = _alone([path.name for path in paths], blank, matched.pairs, in_parts)
    return matched._replace(left_out={photographs[k].name: _BLANK if blank[k] else _ALONE for k in alone})


def tie_features(
    paths: list[Path], sensor: Sensor, count: int | None = None, least_photographs: int = 2
) -> TieFeatures:
    """Points that overlapping photographs of one camera show in common: pairs, triplets and more.

    All pairs are matched as by `match_photographs` and joined as by `tracks`; points in fewer than `least_photographs`
    are left out. Raises InputError as `sift_features`, and where no two photographs have enough in common.
    """
    each = itertools.combinations(range(len(paths)), 2)
    matched = _matched(paths, sensor, InteriorOrientation(1.0), each, count, LONGEST_PX, _InMemory(), _untold)
    image, feature, point, _ = tracks([len(xy) for xy in matched.xy_mm], matched.pairs)
    kept = np.bincount(point)[point] >= least_photographs
    if not kept.any():
        raise InputError(
            f"the {len(paths)} photographs have no point in common; give such as overlap, in the same size"
        )
    xy_mm = np.stack([matched.xy_mm[i][f] for i, f in zip(image[kept], feature[kept], strict=True)])
    return TieFeatures(image[kept], np.unique(point[kept], return_inverse=True)[1], xy_mm)


def _untold(what: str, done: int, of: int) -> None:
    """Nobody is told how far it is."""


@runtime_checkable
class _Pieces(Protocol):
    def read(self, name: str) -> dict[str, np.ndarray] | None: ...

    def write(self, name: str, **arrays: np.ndarray) -> None: ...


class _InMemory(dict[str, dict[str, np.ndarray]]):
    """Pieces that nobody goes on from."""

    def read(self, name: str) -> dict[str, np.ndarray] | None:
        return self.get(name)

    def write(self, name: str, **arrays: np.ndarray) -> None:
        self[name] = arrays


class _Compared(NamedTuple):
    """Of some pairs, one after the other."""

    counts: Int[np.ndarray, "pairs 2"]
    """How many look alike, and how many of these are kept."""
    kept: Int[np.ndarray, "kept 2"]
    off_line: Float[np.ndarray, "kept"]
    """Distances from the epipolar lines over their sigmas."""


def _matched(
    paths: list[Path],
    sensor: Sensor,
    interior: InteriorOrientation,
    pairs: Iterable[tuple[int, int]] | MostAlike,
    most: int | None,
    longest_px: int,
    pieces: _Pieces,
    progress: Progress,
) -> MatchedPhotographs:
    names: list[str] = []
    count = most or usual_count(len(paths))

    def described(k: int) -> SiftFeatures:
        kept = pieces.read(names[k])
        # Damaged since it was written, where it is not there.
        return SiftFeatures(**kept) if kept else sift_features(paths[k], sensor, count, longest_px)

    def find(path: Path) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
        name = name_of("features", *METHOD, cv2.__version__, count, longest_px, sensor, path.read_bytes())
        kept = pieces.read(name)
        if kept is None:
            kept = sift_features(path, sensor, count, longest_px)._asdict()
            pieces.write(name, **kept)
        return name, kept["xy_mm"], kept["sigma_mm"], largest_of(SiftFeatures(**kept))

    xy_mm, sigma_mm, largest = [], [], []
    with freed_memory_kept(), ThreadPoolExecutor(os.cpu_count()) as workers:
        for k, (name, xy, sigma, wide) in enumerate(workers.map(find, paths)):
            names.append(name)
            xy_mm.append(xy)
            sigma_mm.append(sigma)
            largest.append(wide)
            progress("features", k + 1, len(paths))
    if isinstance(pairs, MostAlike):
        pairs = most_alike(largest, pairs.number, lambda done, of: progress("comparing the largest features", done, of))
    compared = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
    # Of both coordinates alike, so that the unit of the epipolar lines is a pixel.
    ideal_px = [ideal_coordinates(interior, xy) / sensor.pixel_mm for xy in xy_mm]
    sigma_px = [sigma / sensor.pixel_mm for sigma in sigma_mm]
    off_line_px = _OFF_LINE * float(np.hypot(sensor.width_px, sensor.height_px))
    lately = functools.lru_cache(_IN_MEMORY)(lambda k: findable(described(k)))

    def compare(some: list[tuple[int, int]]) -> _Compared:
        each = [(names[k], ideal_px[k].tobytes()) for pair in some for k in pair]
        name = name_of("matches", *METHOD, *LOOKS, cv2.__version__, off_line_px, *itertools.chain(*each))
        kept = pieces.read(name)
        if kept is None:
            kept = _compared(some, lately, ideal_px, sigma_px, off_line_px)._asdict()
            pieces.write(name, **kept)
        return _Compared(**kept)

    results, done = [], 0
    size = min(_AT_ONCE, max(1, len(compared) // _LEAST_PIECES))
    some = [compared[k : k + size] for k in range(0, len(compared), size)]
    # Each worker by itself: pairs are many, and on one machine all sums have one order, whatever runs beside.
    with ThreadPoolExecutor(os.cpu_count(), initializer=faiss.omp_set_num_threads, initargs=(1,)) as workers:
        for pairs_done, result in zip(some, workers.map(compare, some), strict=True):
            results.append(result)
            done += len(pairs_done)
            progress("matches", done, len(compared))
    numbers = np.concatenate([np.zeros((0, 2), int), *(r.counts for r in results)])
    kept = np.concatenate([np.zeros((0, 2), int), *(r.kept for r in results)])
    off_line = np.concatenate([np.zeros(0), *(r.off_line for r in results)])
    own = np.split(kept, np.cumsum(numbers[:, 1]))[:-1]
    factor = float(np.quantile(np.abs(off_line), _MOST)) / _MOST_SIGMA if len(off_line) else 1.0
    return MatchedPhotographs(
        xy_mm,
        [factor * sigma for sigma in sigma_mm],
        factor,
        [PairMatches(*pair, features) for pair, features in zip(compared, own, strict=True) if len(features)],
        np.column_stack([np.array(compared, int).reshape(-1, 2), numbers]),
        {},
    )


def _compared(
    pairs: list[tuple[int, int]],
    described: Callable[[int], FindableFeatures],
    ideal_px: list[Float[np.ndarray, "_ 2"]],
    sigma_px: list[Float[np.ndarray, "_"]],
    off_line_px: float,
) -> _Compared:
    counts, kept, off_line = [], [np.zeros((0, 2), int)], [np.zeros(0)]
    for a, b in pairs:
        alike = match_descriptors(described(a), described(b))
        one, other = ideal_px[a][alike[:, 0]], ideal_px[b][alike[:, 1]]
        matrix, good = epipolar_lines(one, other, off_line_px)
        own = alike[good]
        counts.append((len(alike), len(own)))
        kept.append(own)
        if matrix is not None:
            sigmas = sigma_px[a][own[:, 0]], sigma_px[b][own[:, 1]]
            off_line.append(over_sigma(matrix, one[good], other[good], *sigmas))
    return _Compared(np.array(counts, int), np.concatenate(kept), np.concatenate(off_line))


def _alone(names: list[str], blank: list[bool], pairs: list[PairMatches], in_parts: bool) -> list[int]:
    """Photographs that match no other one; InputError unless all others hang together, or may be `in_parts`."""
    groups = connected_images(len(names), pairs)
    joined = [group for group in groups if len(group) > 1]
    if not joined:
        empty = [name for name, nothing in zip(names, blank, strict=True) if nothing]
        beside = f"; {_listed(empty)} show no features: blank or out of focus" if empty else ""
        raise InputError(
            f"no two of the {len(names)} photographs ({_listed(names)}) have {LEAST_MATCHES} points in "
            f"common{beside}; give photographs that overlap by half at least, in sharp focus, or compare more pairs"
        )
    if len(joined) > 1 and not in_parts:
        each = "; ".join(_listed([names[k] for k in group]) for group in joined)
        raise InputError(
            f"the photographs fall into {len(joined)} groups without matches between them ({each}); add photographs "
            "that see both, compare more pairs, or take each group by itself"
        )
    return [int(group[0]) for group in groups if len(group) == 1]


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:10])} and {len(names) - 10} more"
