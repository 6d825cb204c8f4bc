"""Matches of photographs: which features of two show the same place, by their looks and by the epipolar lines.

Two features match where each looks most like the other and clearly more than any third (Lowe's ratio test, both ways).
Of these, those are kept that lie on the epipolar lines of one fundamental matrix. It is estimated of ideal coordinates,
but needs no principal distance: that of EXIF may be a third off, and would refuse true matches with an essential
matrix.
"""

import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import InputError
from jaxphoto.image_measurement.features import FEATURES, LONGEST_PX, SiftFeatures, sift_features
from jaxphoto.io.photographs import Photograph
from jaxphoto.orientation.matches import PairMatches, connected_images, tracks
from jaxphoto.orientation.rays import ideal_coordinates

# Lowe's: how much nearer the best match must be than the second best.
_RATIO = 0.8
# Off the epipolar line at most, of the diagonal: 4 pixels of 1,300. A distortion not known yet grows with the format.
_OFF_LINE = 0.003
# Fewer may lie on the epipolar lines of some matrix by chance.
_LEAST_MATCHES = 15
_LEAST_SHARE = 0.3
_CONFIDENCE = 0.9999
_TRIALS = 10_000
# Scatter is measured where nine tenths lie, 1.645 standard deviations of a normal distribution: the median would be
# blind to the long tails that features have, the square sum to nothing but the false matches left.
_MOST, _MOST_SIGMA = 0.9, 1.6449
_BLANK = "it shows no features: it is blank or out of focus"
_ALONE = f"it has {_LEAST_MATCHES} points in common with no other photograph it was compared with"
# Rows of a table of all products that the cache of a processor holds.
_ROWS = 256


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
    def n_gross(self) -> int:
        """Matches by looks that are not on the epipolar lines, or of pairs that have too few."""
        return int((self.counts[:, 2] - self.counts[:, 3]).sum())

    @property
    def parts(self) -> list[Int[np.ndarray, "photographs"]]:
        """Photographs that hang together, the most first; those that match no other are in none."""
        return [group for group in connected_images(len(self.xy_mm), self.pairs) if len(group) > 1]

    def of(self, photographs: Int[np.ndarray, "photographs"]) -> "MatchedPhotographs":
        """The same of some photographs, counted anew."""
        new = {int(k): i for i, k in enumerate(photographs)}
        pairs = [
            PairMatches(new[p.first], new[p.second], p.features)
            for p in self.pairs
            if p.first in new and p.second in new
        ]
        counts = [(new[a], new[b], *rest) for a, b, *rest in self.counts.tolist() if a in new and b in new]
        return self._replace(
            xy_mm=[self.xy_mm[k] for k in photographs],
            sigma_mm=[self.sigma_mm[k] for k in photographs],
            pairs=pairs,
            counts=np.array(counts, int).reshape(-1, 4),
        )


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
    pairs: Iterable[tuple[int, int]],
    *,
    count: int = FEATURES,
    longest_px: int = LONGEST_PX,
    in_parts: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> MatchedPhotographs:
    """SIFT features (up to `count` each) of photographs of one camera, and their matches in the `pairs` of indices.

    Photographs are made smaller to `longest_px` before.

    `interior` is what is known of the camera; only its distortion and principal point count. `progress` is called with
    the numbers of steps done and of all: a step is a photograph read or a pair compared.

    A photograph that shows no features, or matches no other one, is `left_out` by name.

    Raises InputError as `sift_features`, where no two photographs match, and where they fall into groups that nothing
    joins, but not `in_parts`.
    """
    paths = [p.path for p in photographs]
    matched = _matched(paths, sensor, interior, pairs, count, longest_px, progress or (lambda done, of: None))
    blank = [len(xy) == 0 for xy in matched.xy_mm]
    alone = _alone([path.name for path in paths], blank, matched.pairs, in_parts)
    return matched._replace(left_out={photographs[k].name: _BLANK if blank[k] else _ALONE for k in alone})


def tie_features(paths: list[Path], sensor: Sensor, count: int = FEATURES, least_photographs: int = 2) -> TieFeatures:
    """Points that overlapping photographs of one camera show in common: pairs, triplets and more.

    All pairs are matched as by `match_photographs` and joined as by `tracks`; points in fewer than `least_photographs`
    are left out. Raises InputError as `sift_features`, and where no two photographs have enough in common.
    """
    each = itertools.combinations(range(len(paths)), 2)
    matched = _matched(paths, sensor, InteriorOrientation(1.0), each, count, LONGEST_PX, lambda done, of: None)
    image, feature, point, _ = tracks([len(xy) for xy in matched.xy_mm], matched.pairs)
    kept = np.bincount(point)[point] >= least_photographs
    if not kept.any():
        raise InputError(
            f"the {len(paths)} photographs have no point in common; give such as overlap, in the same size"
        )
    xy_mm = np.stack([matched.xy_mm[i][f] for i, f in zip(image[kept], feature[kept], strict=True)])
    return TieFeatures(image[kept], np.unique(point[kept], return_inverse=True)[1], xy_mm)


class _Compared(NamedTuple):
    """Of a pair: how many look alike, those kept, and their distances from the epipolar lines over their sigmas."""

    n_alike: int
    kept: Int[np.ndarray, "kept 2"]
    off_line: Float[np.ndarray, "kept"]


def _matched(
    paths: list[Path],
    sensor: Sensor,
    interior: InteriorOrientation,
    pairs: Iterable[tuple[int, int]],
    count: int,
    longest_px: int,
    progress: Callable[[int, int], None],
) -> MatchedPhotographs:
    compared = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
    steps = len(paths) + len(compared)
    features = []
    for k, path in enumerate(paths):
        features.append(sift_features(path, sensor, count, longest_px))
        progress(k + 1, steps)
    # Of both coordinates alike, so that the unit of the epipolar lines is a pixel.
    ideal_px = [ideal_coordinates(interior, f.xy_mm) / sensor.pixel_mm for f in features]
    off_line_px = _OFF_LINE * float(np.hypot(sensor.width_px, sensor.height_px))

    def compare(pair: tuple[int, int]) -> _Compared:
        alike = match_descriptors(*(features[k] for k in pair))
        one, other = (ideal_px[k][side] for k, side in zip(pair, alike.T, strict=True))
        matrix, kept = epipolar_lines(one, other, off_line_px)
        if matrix is None:
            return _Compared(len(alike), alike[kept], np.zeros(0))
        sigmas = (features[k].sigma_mm[side[kept]] / sensor.pixel_mm for k, side in zip(pair, alike.T, strict=True))
        return _Compared(len(alike), alike[kept], _over_sigma(matrix, one[kept], other[kept], *sigmas))

    results = []
    with ThreadPoolExecutor(os.cpu_count()) as workers:
        for k, result in enumerate(workers.map(compare, compared)):
            results.append(result)
            progress(len(paths) + k + 1, steps)
    found = [PairMatches(*pair, r.kept) for pair, r in zip(compared, results, strict=True) if len(r.kept)]
    counts = [(*pair, r.n_alike, len(r.kept)) for pair, r in zip(compared, results, strict=True)]
    off_line = np.concatenate([np.zeros(0), *(r.off_line for r in results)])
    factor = float(np.quantile(np.abs(off_line), _MOST)) / _MOST_SIGMA if len(off_line) else 1.0
    return MatchedPhotographs(
        [f.xy_mm for f in features],
        [factor * f.sigma_mm for f in features],
        factor,
        found,
        np.array(counts, int).reshape(-1, 4),
        {},
    )


def match_descriptors(one: SiftFeatures, other: SiftFeatures) -> Int[np.ndarray, "matches 2"]:
    """Features of two photographs that look alike: indices in `one` and `other`, each feature once at most.

    The nearest descriptor must be below 0.8 of the distance of the second, and so must it be seen from the other side.
    """
    a, b = one.descriptors.astype(np.float32), other.descriptors.astype(np.float32)
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), int)
    rows = np.arange(len(a))
    best, clear = _nearest(a, b)
    rows, best = rows[clear], best[clear]
    # From the other side only where it matters.
    columns, where = np.unique(best, return_inverse=True)
    back, clear_back = _nearest(b[columns], a)
    mutual = (back[where] == rows) & clear_back[where]
    pairs = np.column_stack([one.feature[rows[mutual]], other.feature[best[mutual]]])
    # A place with several descriptors may match twice.
    pairs = np.unique(pairs, axis=0)
    once = np.ones(len(pairs), bool)
    for side in pairs.T:
        _, inverse, times = np.unique(side, return_inverse=True, return_counts=True)
        once &= times[inverse] == 1
    return pairs[once]


def _nearest(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each row of `a` the nearest of `b`, and whether it is clearly nearer than the second.

    |a - b|^2 = |a|^2 - (2 a.b - |b|^2). All are whole numbers below 2^24, which single precision holds exactly: no
    order of summation, and so no number of threads, changes a match.
    """
    turned = np.concatenate([2 * a, np.full((len(a), 1), -1, np.float32)], axis=1)
    upright = np.concatenate([b, np.square(b).sum(axis=1, keepdims=True)], axis=1).T
    best, clear = np.zeros(len(a), int), np.zeros(len(a), bool)
    for begin in range(0, len(a), _ROWS):
        part = slice(begin, begin + _ROWS)
        score = turned[part] @ upright
        rows = np.arange(len(score))
        nearest = score.argmax(axis=1)
        square = np.square(a[part]).sum(axis=1)
        first = square - score[rows, nearest]
        score[rows, nearest] = -np.inf
        second = square - score.max(axis=1)
        best[part], clear[part] = nearest, first < _RATIO**2 * second
    return best, clear


def epipolar_lines(
    one: Float[np.ndarray, "matches 2"], other: Float[np.ndarray, "matches 2"], off_line: float
) -> tuple[Float[np.ndarray, "3 3"] | None, Bool[np.ndarray, "matches"]]:
    """The fundamental matrix F of two photographs, other' F one = 0, and which matches lie within `off_line` of it.

    None, and no match, where that are fewer than 15 or than 30 % of all: random matches get nearly that far. By the
    sampling of OpenCV's USAC with the weights of MAGSAC++ (Barath and others, 2020), from a fixed seed.
    """
    none = np.zeros(len(one), bool)
    if len(one) < _LEAST_MATCHES:
        return None, none
    matrix, good = cv2.findFundamentalMat(one, other, cv2.USAC_MAGSAC, off_line, _CONFIDENCE, _TRIALS)
    if matrix is None or good.sum() < max(_LEAST_MATCHES, _LEAST_SHARE * len(one)):
        return None, none
    return matrix, good.ravel() > 0


def _over_sigma(matrix: np.ndarray, one: np.ndarray, other: np.ndarray, *sigmas: np.ndarray) -> np.ndarray:
    """other' F one over its standard deviation, to first order; `sigmas` of both, in the unit of the coordinates."""
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    in_other, in_one = one @ matrix.T, other @ matrix
    slopes = (np.square(line[:, :2]).sum(axis=1) for line in (in_one, in_other))
    variance = sum(slope * sigma**2 for slope, sigma in zip(slopes, sigmas, strict=True))
    return (in_other * other).sum(axis=1) / np.sqrt(variance)


def _alone(names: list[str], blank: list[bool], pairs: list[PairMatches], in_parts: bool) -> list[int]:
    """Photographs that match no other one; InputError unless all others hang together, or may be `in_parts`."""
    groups = connected_images(len(names), pairs)
    joined = [group for group in groups if len(group) > 1]
    if len(names) < 2:
        raise InputError("an orientation needs two photographs that overlap, or more; give them all")
    if not joined:
        empty = [name for name, nothing in zip(names, blank, strict=True) if nothing]
        beside = f"; {_listed(empty)} show no features: blank or out of focus" if empty else ""
        raise InputError(
            f"no two of the {len(names)} photographs ({_listed(names)}) have {_LEAST_MATCHES} points in "
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
