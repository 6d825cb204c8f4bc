"""Matching of photographs by descriptors and epipolar geometry.

COLMAP matches descriptors (mutual nearest neighbours with Lowe's ratio test) and verifies pairs by the inliers of a
fundamental matrix or homography. Neither requires the principal distance. The EXIF value may be wrong by a third, so an
essential matrix would reject correct matches.

Similarity is the number of matches of the few widest features. It costs a thousandth of matching all features; wide
features are visible at all image scales (Wu 2013, Towards linear-time incremental structure from motion).
"""

import itertools
import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy
from jaxtyping import Float, Int, UInt8

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling.freed_memory import freed_memory_kept
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import FEATURES, LONGEST_PX, OF_FEW, SiftFeatures, sift_features
from jaxphoto.initial.matches import MatchedPart, PairMatches, connected_images
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.orientation.colmap import MappedCamera, import_pycolmap, write_database

_EARTH_M = 6_371_000.0
# Default number of neighbours: contains all overlapping photographs at 80 % end and side overlap.
_NEAREST = 20
FEW = 2 * _NEAREST
"""Maximum number of photographs for which all pairs are matched (with more features each)."""

LARGEST = 300
"""Number of widest features compared."""
# Maximum ratio of the nearest to the second nearest distance (Lowe).
_RATIO = 0.8
# Number of photographs compared with one photograph in a batch; limits memory.
_AT_ONCE = 32
# Minimum number of matches of the widest features; fewer may match by chance.
_MIN_VOTES = 2


class MostSimilar(NamedTuple):
    """Request for the pairs of each photograph with its `number` most similar photographs."""

    number: int


def usual_choice(photographs: Sequence[Photograph]) -> str:
    """Return the default choice of pairs: all for few photographs, otherwise neighbours by position if known, otherwise
    similar ones.
    """
    if len(photographs) <= FEW:
        return "exhaustive"
    return f"{'position' if all(p.gps for p in photographs) else 'similar'}:{_NEAREST}"


def usual_count(photographs: int) -> int:
    """Return the default maximum number of features per photograph for N photographs."""
    return OF_FEW if photographs <= FEW else FEATURES


def photograph_pairs(
    photographs: Sequence[Photograph], choice: str = "exhaustive"
) -> list[tuple[int, int]] | MostSimilar:
    """Return index pairs (first < second) selected by `choice`.

    `exhaustive`: all pairs. `sequence:K`: each photograph with the next K in the given order. `position:K`: each with
    the K nearest by horizontal EXIF GPS position. `similar:K`: each with the K most similar (selected by
    `match_photographs`).

    Raises InputError for an invalid choice, and for `position` if a photograph has no position.
    """
    name, _, number = choice.partition(":")
    if name == "exhaustive" and not number:
        return list(itertools.combinations(range(len(photographs)), 2))
    if name not in ("sequence", "position", "similar") or not number.isdecimal() or int(number) < 1:
        raise InputError(
            f"unknown choice of pairs {choice!r}; give exhaustive, sequence:K, position:K or similar:K with a "
            "whole number K, for example sequence:10"
        )
    if name == "similar":
        return MostSimilar(int(number))
    if name == "sequence":
        n = len(photographs)
        return [(k, other) for k in range(n) for other in range(k + 1, min(n, k + 1 + int(number)))]
    without = [p.path.name for p in photographs if p.gps is None]
    if without:
        raise InputError(
            f"{len(without)} photograph(s) have no GPS position in their EXIF ({', '.join(without[:5])}); choose the "
            "pairs by similar:K, sequence:K or exhaustive"
        )
    places = np.deg2rad([(p.gps.longitude_deg, p.gps.latitude_deg) for p in photographs if p.gps])
    longitude, latitude = places.reshape(-1, 2).T
    level = np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    return nearest_pairs(_EARTH_M * level.T, int(number))


def nearest_pairs(positions_m: Float[np.ndarray, "n axes"], count: int) -> list[tuple[int, int]]:
    """Return index pairs (first < second) in which one is among the `count` nearest of the other."""
    n = len(positions_m)
    _, near = scipy.spatial.cKDTree(positions_m).query(positions_m, k=range(1, min(count + 1, n) + 1))
    return sorted({(min(k, j), max(k, j)) for k in range(n) for j in near[k].tolist() if j != k})


def largest_of(features: SiftFeatures) -> UInt8[np.ndarray, "_ 128"]:
    """Return the descriptors of the `LARGEST` widest features."""
    width = features.sigma_mm[features.feature]
    return features.descriptors[np.sort(np.argsort(-width, kind="stable")[:LARGEST])]


def most_similar(
    largest: Sequence[UInt8[np.ndarray, "_ 128"]], count: int, progress: Callable[[int, int], None]
) -> list[tuple[int, int]]:
    """Return index pairs (first < second) in which one is among the `count` photographs most similar to the other.

    `largest`: descriptors of up to `LARGEST` widest features per photograph.
    """
    n = len(largest)
    votes = np.zeros((n, n), int)
    for a in range(n):
        for begin in range(a + 1, n, _AT_ONCE):
            part = slice(begin, min(n, begin + _AT_ONCE))
            votes[a, part] = _votes(largest[a], largest[part])
        progress(a + 1, n)
    votes += votes.T
    order = np.argsort(-votes, axis=1, kind="stable")[:, :count]
    return sorted({(min(a, b), max(a, b)) for a in range(n) for b in order[a].tolist() if votes[a, b] >= _MIN_VOTES})


def _votes(one: UInt8[np.ndarray, "_ 128"], others: Sequence[UInt8[np.ndarray, "_ 128"]]) -> Int[np.ndarray, "others"]:
    """Count the descriptors of `one` that pass the ratio test in each of `others`."""
    if len(one) == 0:
        return np.zeros(len(others), int)
    # Pad up to LARGEST descriptors at infinite distance.
    b = np.zeros((len(others), LARGEST, 128), np.float32)
    square = np.full((len(others), LARGEST), np.inf, np.float32)
    for k, other in enumerate(others):
        b[k, : len(other)] = other
        square[k, : len(other)] = np.square(other.astype(np.float32)).sum(axis=1)
    a = one.astype(np.float32)
    apart = square.reshape(-1) - 2 * (a @ b.reshape(-1, 128).T)
    apart += np.square(a).sum(axis=1)[:, None]
    apart = apart.reshape(len(a), len(others), LARGEST)
    nearest = apart.argmin(axis=2)
    first = np.take_along_axis(apart, nearest[:, :, None], axis=2)
    np.put_along_axis(apart, nearest[:, :, None], np.inf, axis=2)
    second = apart.min(axis=2)
    return ((first[:, :, 0] < _RATIO**2 * second) & np.isfinite(second)).sum(axis=0)


MIN_MATCHES = 15
"""Minimum number of verified matches of a pair; fewer may agree by chance."""
# Minimum ratio of inliers to matches of a pair.
_MIN_RATIO = 0.3
# Maximum distance from the epipolar line as a fraction of the image diagonal (4 of 1,300 px); allows for unknown
# distortion.
_OFF_LINE = 0.003
# Quantile that defines the scatter, and the same quantile in standard deviations of a normal distribution. The median
# ignores the long tails of the distribution; the sum of squares is sensitive to remaining false matches.
_QUANTILE, _QUANTILE_SIGMA = 0.9, 1.6449
_BLANK = "no features: blank or out of focus"
_ALONE = f"fewer than {MIN_MATCHES} points in common with each compared photograph"
# Number of pairs matched and stored in one batch.
_CHUNK = 200
Progress = Callable[[str, int, int], None]
"""Called with the step, the number of items done, and the total number."""


class MatchedPhotographs(NamedTuple):
    """Features of photographs and their matches."""

    xy_mm: list[Float[np.ndarray, "n 2"]]
    """Image coordinates by photograph, as in `SiftFeatures`."""
    sigma_mm: list[Float[np.ndarray, "n"]]
    """Standard deviations by photograph: `SiftFeatures` times `sigma_factor`."""
    sigma_factor: float
    """Ratio of the scatter about the epipolar lines to the standard deviations of `SiftFeatures`."""
    pairs: list[PairMatches]
    """Pairs with enough matches."""
    counts: Int[np.ndarray, "compared 4"]
    """Rows for all compared pairs: first, second, descriptor matches, verified matches (0 if too few)."""
    left_out: dict[str, str]
    """Reason by name of each photograph without matches."""

    @property
    def n_gross(self) -> int:
        """Total number of rejected matches."""
        return int((self.counts[:, 2] - self.counts[:, 3]).sum())

    def named(self, names: list[str]) -> MatchedPart:
        """Return the matches with these photograph names, as the input of `calibrate_flight`."""
        gross = np.column_stack([self.counts[:, :2], self.counts[:, 2] - self.counts[:, 3]])
        return MatchedPart(names, self.xy_mm, self.sigma_mm, self.pairs, gross, self.sigma_factor)


def match_photographs(
    photographs: Sequence[Photograph],
    sensor: Sensor,
    interior: InteriorOrientation,
    pairs: Iterable[tuple[int, int]] | MostSimilar,
    *,
    count: int | None = None,
    longest_px: int = LONGEST_PX,
    in_parts: bool = False,
    progress: Progress = lambda step, done, of: None,
) -> MatchedPhotographs:
    """Match SIFT features between photographs of one camera; `pairs` contains index pairs.

    `count` limits the features per photograph: default 5,000, or 10,000 for up to 40 photographs. Photographs are
    reduced to `longest_px`. `interior` is the known camera; only its distortion and principal point are used.
    Photographs without features or matches are in `left_out`.

    Raises InputError as `sift_features`, if no two photographs match, and, unless `in_parts`, for unconnected groups;
    BlockError if pycolmap is not installed.
    """
    if len(photographs) < 2:
        raise InputError("an orientation needs at least two overlapping photographs; give them all")
    pycolmap, paths, most = import_pycolmap(), [p.path for p in photographs], count or usual_count(len(photographs))
    features: list[SiftFeatures] = []
    with freed_memory_kept(), ThreadPoolExecutor(os.cpu_count()) as workers:
        for found in workers.map(lambda path: sift_features(path, sensor, most, longest_px), paths):
            features.append(found)
            progress("features", len(features), len(paths))
    if isinstance(pairs, MostSimilar):
        largest = [largest_of(of_photograph) for of_photograph in features]
        pairs = most_similar(
            largest, pairs.number, lambda done, of: progress("comparing the largest features", done, of)
        )
    compared = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
    ideal_px = [sensor.px_from_mm(ideal_coordinates(interior, f.xy_mm)) for f in features]
    off_line_px = _OFF_LINE * float(np.hypot(sensor.width_px, sensor.height_px))
    counts, matched, off_line = [np.zeros((0, 2), int)], list[np.ndarray](), [np.zeros(0)]
    with tempfile.TemporaryDirectory() as folder:
        database = _database(pycolmap, Path(folder), sensor, features, ideal_px)
        for begin in range(0, len(compared), _CHUNK):
            chunk = compared[begin : begin + _CHUNK]
            of_chunk = _match_pairs(pycolmap, database, chunk, features, ideal_px, sensor, off_line_px)
            counts.append(of_chunk[0])
            matched += of_chunk[1]
            off_line += of_chunk[2]
            progress("matches", begin + len(chunk), len(compared))
    scatter = np.abs(np.concatenate(off_line))
    factor = float(np.quantile(scatter, _QUANTILE)) / _QUANTILE_SIGMA if len(scatter) else 1.0
    result = MatchedPhotographs(
        [f.xy_mm for f in features],
        [factor * f.sigma_mm for f in features],
        factor,
        [PairMatches(*pair, matches) for pair, matches in zip(compared, matched, strict=True) if len(matches)],
        np.column_stack([np.array(compared, int).reshape(-1, 2), np.concatenate(counts)]),
        {},
    )
    blank = [len(xy) == 0 for xy in result.xy_mm]
    alone = _alone([path.name for path in paths], blank, result.pairs, in_parts)
    return result._replace(left_out={photographs[k].name: _BLANK if blank[k] else _ALONE for k in alone})


def _database(pycolmap: Any, folder: Path, sensor: Sensor, features: list[SiftFeatures], ideal_px: list) -> Path:
    """Write a COLMAP database of descriptors; a feature with several descriptors becomes several keypoints."""
    camera = MappedCamera(sensor.width_px, sensor.height_px, float(sensor.width_px), False)
    keypoints = [xy[f.feature] for xy, f in zip(ideal_px, features, strict=True)]
    write_database(folder / "photographs.db", [camera], [0] * len(features), keypoints, (), prior_c=False)
    with pycolmap.Database.open(folder / "photographs.db") as stored:
        for k, f in enumerate(features):
            kind = pycolmap.FeatureExtractorType.SIFT
            stored.write_descriptors(k + 1, pycolmap.FeatureDescriptors(kind, f.descriptors))
    return folder / "photographs.db"


def _match_pairs(
    pycolmap: Any, database: Path, pairs: list[tuple[int, int]], features, ideal_px, sensor: Sensor, off_line_px: float
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Match pairs; return counts of descriptor and verified matches, verified matches, and `_over_sigma` of these."""
    (database.parent / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(database.parent / "pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers, verification.min_inlier_ratio = MIN_MATCHES, _MIN_RATIO
    verification.ransac.max_error, verification.ransac.random_seed = off_line_px, 0
    verification.detect_watermark = False
    pycolmap.match_image_pairs(
        database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
    )
    counts, verified, off_line = [], [], []
    with pycolmap.Database.open(database) as stored:
        for a, b in pairs:
            geometry = stored.read_two_view_geometry(a + 1, b + 1).inlier_matches
            inliers = np.asarray(geometry, int).reshape(-1, 2)
            rows = _places(inliers, features[a].feature, features[b].feature)
            if len(rows) < MIN_MATCHES:
                rows = rows[:0]
            matched = np.asarray(stored.read_matches(a + 1, b + 1), int).reshape(-1, 2)
            counts.append((len(_places(matched, features[a].feature, features[b].feature)), len(rows)))
            verified.append(rows)
            if len(rows):
                one, other = ideal_px[a][rows[:, 0]], ideal_px[b][rows[:, 1]]
                sigmas = (features[k].sigma_mm[r] / sensor.pixel_mm for k, r in zip((a, b), rows.T, strict=True))
                off_line.append(_over_sigma(off_line_px, one, other, *sigmas))
    return np.array(counts, int).reshape(-1, 2), verified, off_line


def _places(matches: Int[np.ndarray, "n 2"], one: np.ndarray, other: np.ndarray) -> Int[np.ndarray, "places 2"]:
    """Convert descriptor matches to one-to-one feature matches."""
    pairs = np.unique(np.column_stack([one[matches[:, 0]], other[matches[:, 1]]]), axis=0)
    once = np.ones(len(pairs), bool)
    for side in pairs.T:
        _, inverse, times = np.unique(side, return_inverse=True, return_counts=True)
        once &= times[inverse] == 1
    return pairs[once]


def _over_sigma(off_line_px: float, one: np.ndarray, other: np.ndarray, *sigmas: np.ndarray) -> np.ndarray:
    """Return the misclosures other' F one of verified matches, divided by their standard deviations; same unit in
    `sigmas`.
    """
    # Sample with the weights of MAGSAC++ (Barath and others, 2020) from OpenCV's fixed seed.
    try:
        matrix, _ = cv2.findFundamentalMat(one, other, cv2.USAC_MAGSAC, off_line_px, 0.9999, 10_000)
    except cv2.error:
        # OpenCV 5.0 fails an assertion where its local optimisation finds no matrix for few matches.
        matrix = None
    if matrix is None:
        return np.zeros(0)
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    in_other, in_one = one @ matrix.T, other @ matrix
    slopes = (np.square(line[:, :2]).sum(axis=1) for line in (in_one, in_other))
    variance = sum(slope * sigma**2 for slope, sigma in zip(slopes, sigmas, strict=True))
    return (in_other * other).sum(axis=1) / np.sqrt(variance)


def _alone(names: list[str], blank: list[bool], pairs: list[PairMatches], in_parts: bool) -> list[int]:
    """Return the photographs without matches. Raise InputError for unconnected groups, unless `in_parts`."""
    groups = connected_images(len(names), pairs)
    joined = [group for group in groups if len(group) > 1]
    if not joined:
        empty = [name for name, nothing in zip(names, blank, strict=True) if nothing]
        beside = f"; {_listed(empty)} have no features: blank or out of focus" if empty else ""
        raise InputError(
            f"no two of the {len(names)} photographs ({_listed(names)}) have {MIN_MATCHES} points in "
            f"common{beside}; give sharp photographs that overlap by at least half, or compare more pairs"
        )
    if len(joined) > 1 and not in_parts:
        each = "; ".join(_listed([names[k] for k in group]) for group in joined)
        raise InputError(
            f"{len(joined)} groups of photographs without matches between them ({each}); add photographs "
            "that overlap both, compare more pairs, or orient each group separately"
        )
    return [int(group[0]) for group in groups if len(group) == 1]


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:10])} and {len(names) - 10} more"
